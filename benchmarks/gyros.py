"""
Used by notch.py and learned.py: gyros of recorded flights, with throttle and motor speeds.

Betaflight logs the gyro before its filters as `gyroUnfilt` (from 4.5), or in `debug` if
debug_mode is GYRO_SCALED (6); otherwise only `gyroADC`, after the filters.
"""

from __future__ import annotations

from dataclasses import dataclass

from common import FLIGHTS as known, recorded, say
import numpy as np
from ou_monitor.recordings.importers.choose import choose
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import IMU, Request, SPEEDS

# Name, file below OU_MONITOR_REALDATA, number of the flight, which gyro.
FLIGHTS = (
    ('bf3s', *known['bf3s'], 'gyroUnfilt'), ('nazgul', *known['nazgul'], 'debug'),
    *((f'roma {k}', known['roma'][0], k, 'debug') for k in (1, 2, 3)),
    ('gecko', 'raw/ie_btfl_002.bbl', 1, 'gyroADC'))
# Gyros logged at 50 Hz, too slow for a notch.
SLOW = (('erle', known['erle'][0], 1, 'IMU'), ('jd', known['jd'][0], 1, 'IMU'))


@dataclass(frozen=True, eq=False)
class Gyro:
    """One flight."""

    name: str
    t: np.ndarray  # s.
    rate: float  # Mean sample rate, Hz.
    signal: np.ndarray  # Angular velocity, degree/s.
    # As in `convert`: the mean of the motors' commands if the log has them, 0..1.
    throttle: np.ndarray
    rpm: np.ndarray | None  # Speeds of the motor shafts, 1/min.


def read(name: str, seconds: float = np.inf) -> Gyro | None:
    """Read a flight up to `seconds`; None, with a message, if its file is missing."""
    file, number, kind = next(one[1:] for one in (*FLIGHTS, *SLOW) if one[0] == name)
    where = recorded()
    if not (where / file).exists():
        say(f'{name}: {file} is not there, left out')
        return None
    log = import_log(where / file, Request(number, poles=14 if name == 'bf3s' else None))
    (gyro,) = (one for one in log.of(IMU) if one.name == kind)
    part = gyro.t - gyro.t[0] <= seconds
    t = gyro.t[part]
    throttle = choose(where / file, log).throttle
    assert throttle is not None
    held = throttle.values[np.clip(np.searchsorted(throttle.t, t, 'right') - 1, 0, None)]
    rpm = None
    if log.of(SPEEDS):
        place = np.clip(np.searchsorted(log.of(SPEEDS)[0].t, t, 'right') - 1, 0, None)
        rpm = 60.0 / (2.0 * np.pi) * log.of(SPEEDS)[0].values[place]
    return Gyro(name, t - t[0], (t.size - 1) / float(t[-1] - t[0]),
                np.degrees(gyro.values[part, :3]), held, rpm)
