"""
Gyros of recorded flights, unfiltered where the log has them so, with throttle and motor speeds.

Betaflight logs the gyro before its filters as `gyroUnfilt` (from 4.5), or in `debug` when
debug_mode is GYRO_SCALED (6); else `gyroADC`, behind them.
"""

from __future__ import annotations

from dataclasses import dataclass

from common import recorded, say
import numpy as np
from ou_monitor.recordings.importers.choose import choose
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import Request

# Name, file below OU_MONITOR_REALDATA, number of the flight, which gyro.
FLIGHTS = (
    ('bf3s', 'raw/bf_3s_erpm2.bbl', 2, 'gyroUnfilt'),
    ('nazgul', 'raw/bf_nazgul_4s.bbl', 1, 'debug'),
    ('roma 1', 'raw/bf_roma_6s.bbl', 1, 'debug'),
    ('roma 2', 'raw/bf_roma_6s.bbl', 2, 'debug'),
    ('roma 3', 'raw/bf_roma_6s.bbl', 3, 'debug'),
    ('gecko', 'raw/ie_btfl_002.bbl', 1, 'gyroADC'),
)
# Gyros logged at 50 Hz, below what a notch follows.
SLOW = (('erle', 'raw/ac_erle_althold2.BIN', 1, 'IMU'), ('jd', 'raw/ac_jd_2004.bin', 1, 'IMU'))


@dataclass(frozen=True, eq=False)
class Gyro:
    """One flight."""

    # Name; the gyro of the log.
    name: str
    kind: str
    t: np.ndarray  # s.
    rate: float  # Mean sample rate, Hz.
    signal: np.ndarray  # Angular velocity, degree/s.
    # As `convert` chooses it: where the log has them the mean of the motors' commands, 0..1.
    throttle: np.ndarray
    rpm: np.ndarray | None  # Of the shafts.


def read(name: str, seconds: float = np.inf) -> Gyro | None:
    """Read a flight up to so many s; None where it is not there, with a word on stderr."""
    file, number, kind = next(one[1:] for one in (*FLIGHTS, *SLOW) if one[0] == name)
    where = recorded()
    if not (where / file).exists():
        say(f'{name}: {file} is not there, left out')
        return None
    log = import_log(where / file, Request(number, poles=14 if name == 'bf3s' else None))
    (gyro,) = (one for one in log.inertial if one.name == kind)
    part = gyro.t - gyro.t[0] <= seconds
    t = gyro.t[part]
    throttle = choose(where / file, log).throttle
    assert throttle is not None
    held = throttle.values[np.clip(np.searchsorted(throttle.t, t, 'right') - 1, 0, None)]
    rpm = None
    if log.speeds is not None:
        place = np.clip(np.searchsorted(log.speeds.t, t, 'right') - 1, 0, None)
        rpm = 60.0 / (2.0 * np.pi) * log.speeds.vectors['velocity'][place]
    return Gyro(name, kind, t - t[0], (t.size - 1) / float(t[-1] - t[0]),
                np.degrees(gyro.vectors['angular_velocity'][part]), held, rpm)
