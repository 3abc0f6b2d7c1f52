"""
Gyros of recorded flights, unfiltered where the log has them so, with throttle and motor speeds.

Betaflight logs the gyro before its filters as `gyroUnfilt` (from 4.5), or in `debug` when
debug_mode is GYRO_SCALED (6); else `gyroADC`, behind them.  eRPM is logged in hundreds.
"""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
import sys

import numpy as np
from orangebox import Parser
from orangebox.types import FrameType
from ou_monitor.recordings.importers import blackbox
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
POLES = 14


@dataclass(frozen=True, eq=False)
class Gyro:
    """
    One flight.

    Attributes
    ----------
    name, kind : str
        Name; the field of the log.
    t : ndarray, shape (n,)
        s.
    rate : float
        Mean sample rate, Hz.
    signal : ndarray, shape (n, 3)
        Angular velocity, degree/s.
    throttle : ndarray, shape (n,)
        Mean of the motors' commands, 0..1.
    rpm : ndarray, shape (n, 4), or None
        Of the shafts.

    """

    name: str
    kind: str
    t: np.ndarray
    rate: float
    signal: np.ndarray
    throttle: np.ndarray
    rpm: np.ndarray | None


def folder() -> Path | None:
    """Return where the recordings are; None where OU_MONITOR_REALDATA is not set."""
    named = os.environ.get('OU_MONITOR_REALDATA')
    return Path(named) if named else None


def read(name: str, seconds: float = np.inf) -> Gyro | None:
    """Read a flight up to so many s; None where it is not there, with a word on stderr."""
    file, number, kind = next(one[1:] for one in FLIGHTS if one[0] == name)
    where = folder()
    if where is None or not (where / file).exists():
        print(f'{name}: {file} is not there, left out', file=sys.stderr)
        return None
    parser = Parser.load(str(where / file), number, True)
    names = [one.name for one in parser.reader.field_defs[FrameType.INTRA]]
    wanted = ['time', *(f'{kind}[{k}]' for k in range(3)), *(f'motor[{k}]' for k in range(4)),
              *(one for one in (f'eRPM[{k}]' for k in range(4)) if one in names)]
    table, _ = blackbox._frames(parser, [names.index(one) for one in wanted], Request())
    table, _ = blackbox._in_time(table)
    t = 1e-6 * (table[:, 0] - table[0, 0])
    table, t = table[t <= seconds], t[t <= seconds]
    low, high = parser.headers['motorOutput']
    throttle = np.clip((table[:, 4:8].mean(axis=1) - low) / (high - low), 0.0, 1.0)
    rpm = 100.0 * table[:, 8:] / (0.5 * POLES) if table.shape[1] > 8 else None
    return Gyro(name, kind, t, (t.size - 1) / float(t[-1] - t[0]), table[:, 1:4], throttle, rpm)
