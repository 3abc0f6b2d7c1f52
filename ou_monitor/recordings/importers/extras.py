"""
What else travels from a log into a bag: gyro and accelerometer, motor speeds, named series.

Limits first: rows with a number that is not finite are dropped whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import re

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.importers.choose import NONE
from ou_monitor.recordings.importers.log import (
    clean, LARGEST, Log, near, rising, Series, UNKNOWN)
from ou_monitor.recordings.importers.motion import Inertial, MotorSpeeds
from ou_monitor.records import FloatArray

IMU, SPEEDS = 'imu', 'motor_speed'
# Topics that a named series must not take.
_TAKEN = ('voltage', 'throttle', 'current', IMU, SPEEDS)
# Parts of a series whose spacings are compared, and how unequal is told.
_PARTS, _UNEQUAL = 10, 1.5
# A pause of so many usual steps is a gap.
_GAP = 3.0


@dataclass(frozen=True, eq=False)
class Extras:
    """
    What is taken from a log beside voltage, throttle and current.

    Attributes
    ----------
    inertial : dict of str to Inertial
        By topic, without the slash.
    speeds : MotorSpeeds or None
        Of the motors.
    signals : dict of str to Series
        By topic, without the slash.
    notes : tuple of str
        What was dropped, and what the log does not hold.

    """

    inertial: dict[str, Inertial]
    speeds: MotorSpeeds | None
    signals: dict[str, Series]
    notes: tuple[str, ...]


def choose_extras(path: Path, log: Log, *, imus: Sequence[str] = (),
                  signals: Sequence[str] = ()) -> Extras:
    """Choose: the gyro that is there when nothing is said, and the series named."""
    notes: list[str] = []
    inertial: dict[str, Inertial] = {}
    for one in _inertial(path, log, imus):
        kept, said = clean_inertial(one)
        notes += [f'{one.name}: {sentence}' for sentence in said]
        if not kept.t.size:
            notes.append(f'{one.name} has no usable sample.')
            continue
        name = IMU if not inertial else f'{IMU}_{topic_of(one.name)}'
        inertial[name] = kept
    if not inertial and NONE not in imus and log.format != 'csv':
        notes.append('The log holds no gyro: there is no topic /imu.')
    others = [one.name for one in log.inertial if one.name not in {
        kept.name for kept in inertial.values()}]
    if others:
        notes.append(f"Also in the log: {', '.join(others)} (--imu NAME).")
    speeds = log.speeds
    if speeds is not None:
        speeds, said = clean_speeds(speeds)
        notes += [f'{SPEEDS}: {sentence}' for sentence in said]
        speeds = speeds if speeds.t.size else None
    named: dict[str, Series] = {}
    for name in dict.fromkeys(signals):
        series, said = clean(named_series(path, log, name))
        notes += [f'{name}: {sentence}' for sentence in (*said, *pace_notes(series.t))]
        if not series.n:
            raise InputError(f'{path}: {name} has no usable sample'
                             + ''.join(f' ({sentence})' for sentence in said))
        if series.unit == UNKNOWN:
            notes.append(f'{name}: the log does not state its unit; written as it is logged.')
        named[_free(topic_of(name), {*_TAKEN, *inertial, *named})] = series
    return Extras(inertial, speeds, named, tuple(notes))


def default_inertial(log: Log) -> list[Inertial]:
    """Return what becomes /imu when nothing is said: one, or none."""
    ranked = [one for one in log.inertial if one.rank is not None and one.t.size]
    return sorted(ranked, key=lambda one: one.rank or 0)[:1]


def named_series(path: Path, log: Log, name: str) -> Series:
    """Return a series of a log by its name."""
    for one in log.series:
        if one.name == name:
            return one
    known = list(dict.fromkeys([*log.names, *(one.name for one in log.series)]))
    hint = nearest(name, known) if known else 'it holds none'
    if hint.startswith('valid:'):
        hint = 'see --list of convert'
    raise InputError(f"{path} has no series '{name}': {hint}")


def topic_of(name: str) -> str:
    """Return the topic of a series, without the slash: IMU[0].GyrX -> IMU_0/GyrX."""
    words = re.sub(r'\[(\w+)\]', r'_\1', name).split('.')
    tokens = [re.sub(r'__+', '_', re.sub(r'[^A-Za-z0-9_]', '_', word)).strip('_')
              for word in words]
    return '/'.join(token if token[0].isalpha() else f'n{token}' for token in tokens if token
                    ) or 'unnamed'


def _free(topic: str, taken: set[str]) -> str:
    """Return a topic that is not taken."""
    if topic in taken:
        topic = f'signal/{topic}'
    number, free = 2, topic
    while free in taken:
        free, number = f'{topic}_{number}', number + 1
    return free


def _inertial(path: Path, log: Log, names: Sequence[str]) -> list[Inertial]:
    if not names:
        return default_inertial(log)
    found = []
    for name in dict.fromkeys(names):
        if name == NONE:
            if len(names) > 1:
                raise InputError("--imu: 'none' leaves no room for another")
            return []
        held = [one for one in log.inertial if one.name == name]
        if not held:
            known = [one.name for one in log.inertial]
            raise InputError(f"{path} has no gyro '{name}': "
                             + (nearest(name, known) if known else 'it holds none'))
        found += held
    return found


def clean_inertial(one: Inertial) -> tuple[Inertial, tuple[str, ...]]:
    """Return finite rows with rising stamps, and what that took."""
    columns = [part for part in (one.angular_velocity, one.acceleration) if part is not None]
    good, notes = _good(one.t, np.hstack(columns))
    gyro, acc = (None if part is None else part[good]
                 for part in (one.angular_velocity, one.acceleration))
    kept = replace(one, t=one.t[good], angular_velocity=gyro, acceleration=acc)
    return kept, (*notes, *pace_notes(kept.t))


def clean_speeds(one: MotorSpeeds) -> tuple[MotorSpeeds, tuple[str, ...]]:
    """Return finite rows with rising stamps, and what that took."""
    good, notes = _good(one.t, one.values)
    return replace(one, t=one.t[good], values=one.values[good]), notes


def _good(t: FloatArray, values: FloatArray,
          ) -> tuple[npt.NDArray[np.intp], tuple[str, ...]]:
    """Return the places of usable rows in the order of the log."""
    usable = np.isfinite(t) & (np.abs(values) <= LARGEST).all(axis=1) & near(t)
    places = np.flatnonzero(usable)
    notes = []
    if places.size < t.size:
        notes.append(f'{t.size - places.size} rows dropped: no finite numbers, or a stamp far '
                     'off.')
    ahead = rising(t[places])
    if not ahead.all():
        notes.append(f'{int((~ahead).sum())} rows dropped: their stamps do not rise.')
    return places[ahead], tuple(notes)


def pace_notes(t: FloatArray) -> tuple[str, ...]:
    """Say where stamps pause, and whether their rate changes (t in s)."""
    if t.size < 4 * _PARTS:
        return ()
    steps = np.diff(t)
    usual = float(np.median(steps))
    notes = []
    gaps = steps > _GAP * usual
    if gaps.any():
        count = int(gaps.sum())
        notes.append(f'{count} gap{"s" * (count != 1)} of up to {float(steps.max()):.3g} s.')
    paces = [float(np.median(part)) for part in np.array_split(steps, _PARTS)]
    if max(paces) > _UNEQUAL * min(paces):
        notes.append(f'The rate changes between {1.0 / max(paces):.4g} and '
                     f'{1.0 / min(paces):.4g} Hz.')
    return tuple(notes)
