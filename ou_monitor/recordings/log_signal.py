"""
The supply and one signal of a log, without a bag between.

Limits first: voltage and throttle are chosen as `convert` does; stamps count from the start of
the log.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import re

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import (
    choose, clean_inertial, clean_speeds, default_inertial, IMU, named_series, pace_notes, SPEEDS)
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import clean, Log, Progress, Request, Series, SIGNAL
from ou_monitor.records import FloatArray, Recording

_FIELDS = ('angular_velocity', 'linear_acceleration')
_AXES = 'xyz'


def read_log_signal(
    path: Path, signal: str, *, voltage: str | None = None, throttle: str | None = None,
    flight: int | None = None, start: float | None = None, end: float | None = None,
    progress: Progress | None = None,
) -> tuple[Recording, Series]:
    """
    Read the supply of a log, and a series beside it.

    start, end in s from the first voltage on, progress 0..1.
    """
    if not signal:
        raise InputError('the name of the signal is empty: see convert LOG --list')
    names = frozenset(name for name in (voltage, throttle, signal) if name is not None)
    log = import_log(path, Request(flight, names, progress=progress))
    chosen = choose(path, log, voltage=voltage, throttle=throttle, option='--{}-column')
    series, said = clean(_of_topic(path, log, signal) or named_series(path, log, signal))
    if not series.n:
        raise InputError(f'{path}: {signal} has no usable sample' + ''.join(
            f' ({sentence})' for sentence in said))
    volts = chosen.voltage
    held = np.full(volts.n, np.nan)
    if chosen.throttle is not None:
        # A throttle holds until the next one.
        place = np.searchsorted(chosen.throttle.t, volts.t, 'right') - 1
        held[place >= 0] = chosen.throttle.values[place[place >= 0]]
    notes = (*log.notes, *(note for note in chosen.notes if not note.startswith('Also')),
             *(f'{signal}: {sentence}' for sentence in (*said, *pace_notes(series.t))))
    first = float(volts.t[0])
    part = ((volts.t - first >= (start or 0.0))
            & (volts.t - first < (np.inf if end is None else end)))
    if not part.any():
        raise InputError(f'{path}: the part holds no voltage; the log lasts '
                         f'{float(volts.t[-1]) - first:.3f} s')
    source = {'file': path.name, 'format': log.format, 'voltage_field': volts.name,
              **{f'log_{key}': value for key, value in log.facts.items()}}
    return (Recording(volts.t[part], volts.values[part], held[part], path.name, source,
                      tuple(notes)), series)


def _of_topic(path: Path, log: Log, signal: str) -> Series | None:
    """Return what a topic of `convert` would hold: NAME/angular_velocity.x, motor_speed/..."""
    found = re.fullmatch(rf'/?(.+)/({"|".join(_FIELDS)})\.([{_AXES}])', signal)
    if found is not None:
        name, field, axis = found.groups()
        held = (default_inertial(log) if name == IMU else
                [one for one in log.inertial if one.name == name])
        if not held:
            known = ', '.join(one.name for one in log.inertial) or 'none'
            raise InputError(f"{path} has no gyro '{name}': it holds {known}")
        one, _ = clean_inertial(held[0])
        values = one.angular_velocity if field == _FIELDS[0] else one.acceleration
        if values is None:
            raise InputError(f"{path}: {held[0].name} has no {field.replace('_', ' ')}")
        unit = 'rad/s' if field == _FIELDS[0] else 'm/s^2'
        return _series(signal, one.t, values[:, _AXES.index(axis)], one.scale, unit)
    found = re.fullmatch(rf'/?{SPEEDS}/velocity\[(\d+)\]', signal)
    if found is not None:
        if log.speeds is None:
            raise InputError(f'{path} holds no motor speeds'
                             + ''.join(f' ({note})' for note in log.notes if 'eRPM' in note))
        speeds, _ = clean_speeds(log.speeds)
        place = int(found[1])
        if place >= len(speeds.names):
            raise InputError(f'{path} holds {len(speeds.names)} motor speeds: '
                             f'velocity[{place}] is not there')
        return _series(signal, speeds.t, speeds.values[:, place], speeds.scale, 'rad/s')
    return None


def _series(name: str, t: FloatArray, values: FloatArray, scale: str, unit: str) -> Series:
    return replace(Series(name, SIGNAL, t, values, scale), own_unit=unit)
