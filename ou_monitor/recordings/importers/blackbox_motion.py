"""
Gyro, accelerometer, eRPM and all other fields of a blackbox frame, in SI.

Limits first: the axes are Betaflight's own (x forwards, y left, z up), which are those of
`base_link`.  Scales are those of Betaflight's viewer (flightlog_parser,
flightlog_fields_presenter) and of the header: `gyro_scale`, `acc_1G`, `motor_poles`,
`blackbox_high_resolution`.
"""

from __future__ import annotations

from collections.abc import Iterator
import math
import struct
from typing import Any

import numpy as np
from ou_monitor.recordings.importers.log import (
    DEGREE, GRAVITY, Inertial, MotorSpeeds, RPM, Series, SIGNAL, UNKNOWN)
from ou_monitor.records import FloatArray

GYRO, UNFILTERED, DEBUG, ACCELEROMETER = 'gyroADC', 'gyroUnfilt', 'debug', 'accSmooth'
ERPM = 'eRPM'
# debug_mode GYRO_SCALED of Betaflight 4.0 to 4.5: the gyro before its filters, deg/s.
_GYRO_SCALED, _FIRST, _LAST = 6, (4, 0, 0), (4, 6, 0)
# A scale below this is in rad/us, as Baseflight had it, not in deg/s.
_BASEFLIGHT = 1e-3

Columns = dict[str, FloatArray]


def high_resolution(headers: dict[str, Any]) -> float:
    """Return by what gyro, sticks and setpoints are larger than usual: 1 or 10."""
    return 10.0 if _number(headers, 'blackbox_high_resolution') else 1.0


def motion(t: FloatArray, columns: Columns, headers: dict[str, Any], notes: list[str], *,
           debug_gyro: bool, poles: int | None) -> tuple[tuple[Inertial, ...], MotorSpeeds | None]:
    """Return gyros with the accelerometer, and motor speeds (t in s)."""
    acc = _three(columns, ACCELEROMETER)
    one_g = _number(headers, 'acc_1G')
    if acc is not None and not one_g:
        notes.append('accSmooth was left out of /imu: the header does not state acc_1G.')
        acc = None
    scaled = None if acc is None else acc * (GRAVITY / one_g)
    words = f'accSmooth {GRAVITY:g} / {one_g:g}' if scaled is not None else 'no accelerometer'
    inertial = []
    gyro = gyro_scale(headers)
    for name, scale, rank, what in (
            (GYRO, gyro, 0, "gyro after the autopilot's filters"),
            (UNFILTERED, gyro, 1, 'gyro before the filters'),
            (DEBUG, DEGREE if debug_gyro else None, 2,
             'gyro before the filters (debug_mode GYRO_SCALED)')):
        values = _three(columns, name)
        if values is None or (name == DEBUG and not debug_gyro):
            continue
        if scale is None:
            notes.append(f'{name} was left out of /imu: the header does not state gyro_scale.')
            continue
        inertial.append(Inertial(name, t, values * scale, scaled, f'{name} {scale:.6g}, {words}',
                                 what, rank))
    return tuple(inertial), _speeds(t, columns, headers, notes, poles)


def shows_gyro(headers: dict[str, Any], firmware: str, version: tuple[int, int, int]) -> bool:
    """Whether the debug fields hold the gyro before its filters."""
    return (firmware == 'betaflight' and _FIRST <= version < _LAST
            and headers.get('debug_mode') == _GYRO_SCALED)


def gyro_scale(headers: dict[str, Any]) -> float | None:
    """Return rad/s per unit of the gyro; None where the header does not state it."""
    raw: Any = headers.get('gyro_scale', headers.get('gyro.scale'))
    try:
        # The bits of a float, written as a whole number.
        bits = int(raw, 16) if isinstance(raw, str) else int(raw)
        scale = float(struct.unpack('<f', struct.pack('<I', bits))[0])
    except (TypeError, ValueError, struct.error, OverflowError):
        return None
    if not (math.isfinite(scale) and scale > 0.0):
        return None
    if scale < _BASEFLIGHT:
        return scale * 1e6
    return scale * DEGREE / high_resolution(headers)


def signals(t: FloatArray, columns: Columns, headers: dict[str, Any], known: set[str], *,
            debug_gyro: bool) -> Iterator[Series]:
    """Yield the fields that are nothing else, in SI where their unit is known (t in s)."""
    gyro, one_g = gyro_scale(headers), _number(headers, 'acc_1G')
    rates = DEGREE / high_resolution(headers)
    for name, values in columns.items():
        stem = name.partition('[')[0]
        if name == 'time' or name in known:
            continue
        scale, unit, words = 1.0, UNKNOWN, 'as logged'
        if stem in (GYRO, UNFILTERED) and gyro is not None:
            scale, unit, words = gyro, 'rad/s', 'gyro'
        elif stem == DEBUG and debug_gyro and not name.endswith('[3]'):
            scale, unit, words = DEGREE, 'rad/s', 'gyro before the filters'
        elif stem == ACCELEROMETER and one_g:
            scale, unit, words = GRAVITY / one_g, 'm/s^2', 'accelerometer'
        elif stem == 'setpoint':
            scale, unit, words = rates, 'rad/s', 'rate asked for'
        elif stem == 'BaroAlt':
            scale, unit, words = 0.01, 'm', 'altitude by the barometer'
        yield Series(name, SIGNAL, t, values * scale, f'{scale:.6g}', words, own_unit=unit)


def _speeds(t: FloatArray, columns: Columns, headers: dict[str, Any], notes: list[str],
            poles: int | None) -> MotorSpeeds | None:
    fields = sorted((name for name in columns if name.startswith(f'{ERPM}[')), key=_place)
    if not fields:
        return None
    stated = _number(headers, 'motor_poles')
    count = poles or int(stated)
    if count < 2:
        notes.append('eRPM was left out: the header does not state motor_poles; give --poles N, '
                     'the magnets of a rotor (14 is common).')
        return None
    # Logged are hundreds of electrical turns a minute, of which a pair of poles makes one.
    scale = 100.0 * RPM * 2.0 / count
    values = np.column_stack([columns[name] for name in fields]) * scale
    origin = '--poles' if poles else 'the header'
    return MotorSpeeds(tuple(f'motor_{_place(name)}' for name in fields), t, values,
                       f'eRPM {scale:.6g}', f'rotor speed, {count} poles by {origin}')


def _place(name: str) -> int:
    digits = name.partition('[')[2].rstrip(']')
    return int(digits) if digits.isdigit() else 0


def _three(columns: Columns, stem: str) -> FloatArray | None:
    """Return three axes as rows of (n, 3); None when one is missing."""
    names = [f'{stem}[{axis}]' for axis in range(3)]
    if not all(name in columns for name in names):
        return None
    return np.column_stack([columns[name] for name in names])


def _number(headers: dict[str, Any], key: str) -> float:
    """Return a positive number of the header; 0 when it states none."""
    value = headers.get(key)
    good = isinstance(value, (int, float)) and math.isfinite(value) and value > 0
    return float(value) if good and value is not None else 0.0
