"""
Choose voltage, throttle, current, gyro, motor speeds and named series from a log.

The default voltage is the battery's, never a rail behind a regulator; if there are several
batteries, the user must choose. The default throttle has the smallest rank: motor outputs before
stick commands.

Rows of gyro and accelerometer with a non-finite number are dropped whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, count
from pathlib import Path
import re

import numpy as np
from ou_monitor.errors import closest, InputError, nearest
from ou_monitor.recordings.importers.log import (
    ANY, clean, CURRENT, IMU, Log, Series, SPEEDS, THROTTLE, UNKNOWN, VOLTAGE)
from ou_monitor.records import Defect, FloatArray, Note, prefixed, Recording
from ou_monitor.text import counted, printable
from ou_monitor.timeline import check_throttle, held_words, plausible_stamps

# Name by which the user leaves a quantity out.
NONE = 'none'

# Maximum number of series named in one line, and the hint where to find the others.
MOST, _LIST = 4, 'see convert LOG --list'


@dataclass(frozen=True, eq=False)
class ChosenSeries:
    """The series chosen from a log."""

    voltage: Series  # At least one sample
    # None if missing in the log, or not wanted.
    throttle: Series | None
    current: Series | None
    notes: tuple[str, ...]  # Dropped samples, and alternatives in the log


def choose(path: Path, log: Log, *, voltage: str | None = None, throttle: str | None = None,
           current: str | None = None, option: str = '--{}') -> ChosenSeries:
    """Choose series, drop unusable samples (option: pattern of option names, for errors)."""
    volts = _pick(path, log, VOLTAGE, voltage, option)
    if volts is None:
        others = log.of(VOLTAGE, ANY)
        raise InputError(f'{path} ' + (
            f'has no battery voltage; choose another with {option.format(VOLTAGE)} NAME: '
            f'{_names_of(others)}' if others else 'holds no voltage')
            + ''.join(f' ({note})' for note in log.notes))
    first = _pick(path, log, THROTTLE, throttle, option)
    if first is not None and log.format == 'csv':
        # The scale of a CSV column is not stated; importers of autopilot logs know theirs.
        check_throttle(f'{path}: {first.name}', first.values)
    if current is not None:
        second = _pick(path, log, CURRENT, current, option)
    else:
        second = _current(log, volts)
    names = [one.name for one in (volts, first, second) if one is not None]
    if len(set(names)) < len(names):
        raise InputError(f'{path}: one series cannot be two of voltage, throttle and current: '
                         + ', '.join(names))
    notes: list[str] = []
    if second is None and current is None and (
            held := [one for one in log.of(CURRENT) if not one.silent]):
        notes.append('No current clearly belongs to this voltage, so none is used; found: '
                     + _names_of(held) + f' ({option.format(CURRENT)} NAME names one).')
    usable: dict[str, Series] = {}
    dropped: dict[str, list[str]] = {}
    for one in (volts, first, second):
        if one is not None:
            mended, why = clean(one)
            for sentence in why:
                dropped.setdefault(sentence, []).append(one.name)
            if mended.n:
                usable[one.quantity] = mended
            else:
                notes.append(f'{one.name} has no usable sample.')
    # A note common to several series, such as columns of one table, appears once.
    notes = [note for sentence, names in dropped.items()
             for note in prefixed(', '.join(names), [sentence])] + notes
    if VOLTAGE not in usable:
        raise InputError(f'{path}: {volts.name} has no usable sample'
                         + ''.join(f' ({note})' for note in notes))
    notes += _alternatives(log, (volts, first), option)
    return ChosenSeries(usable[VOLTAGE], usable.get(THROTTLE), usable.get(CURRENT), tuple(notes))


def columns_of(path: Path, log: Log, chosen: ChosenSeries) -> Recording:
    """Return the samples of a log, rounded as in the bag that `convert` writes."""
    volts = chosen.voltage
    t = _in_a_bag(volts.t)
    held, taken = {}, {VOLTAGE: volts.name}
    for one in (chosen.throttle, chosen.current):
        if one is not None:
            # A value holds until the next one.
            place = np.searchsorted(_in_a_bag(one.t), t, 'right')
            held[one.quantity] = np.append(np.nan, _single(one.values))[place]
            taken[one.quantity] = one.name
    unknown = np.full(volts.n, np.nan)
    said = '' if chosen.throttle is None else held_words(t, chosen.throttle.t)
    name = printable(path.name)
    return Recording(
        plausible_stamps(name, t), _single(volts.values), held.get(THROTTLE, unknown), name,
        {'file': name, 'format': log.format, **taken, **log.facts},
        (*log.notes, *chosen.notes, *filter(None, [said])), held.get(CURRENT, unknown))


def _in_a_bag(t: FloatArray) -> FloatArray:
    """Return stamps as a message holds them: whole seconds and ns (t in s)."""
    whole, rest = np.divmod(np.rint(t * 1e9), 1e9)
    return whole + rest * 1e-9


def _single(values: FloatArray) -> FloatArray:
    return values.astype(np.float32).astype(np.float64)


def default(log: Log, quantity: str) -> list[Series]:
    """Return the default series; several if the choice is not clear."""
    ranked = [one for one in log.of(quantity) if one.rank is not None and one.n]
    least = min((one.rank for one in ranked if one.rank is not None), default=None)
    return [one for one in ranked if one.rank == least]


def _names_of(series: list[Series]) -> str:
    shown = ', '.join(f'{one.name} ({one.words})' for one in series[:MOST])
    return shown + (f' and {len(series) - MOST} more, {_LIST}' if len(series) > MOST else '')


def _pick(path: Path, log: Log, quantity: str, name: str | None, option: str
          ) -> Series | None:
    if name == NONE and quantity != VOLTAGE:
        return None
    if name is None:
        found = default(log, quantity)
        if len(found) > 1:
            raise InputError(f'{path} has several {quantity} series: {_names_of(found)}; choose '
                             f'with {option.format(quantity)} NAME, {_LIST}')
        return found[0] if found else None
    held = log.of(quantity, ANY)
    for one in held:
        if one.name == name:
            return replace(one, quantity=quantity)
    for one in log.series:
        if one.name == name:
            raise InputError(f"{path}: '{name}' is a {one.quantity}, not a {quantity}")
    hint = 'there is none' if not held else (
        nearest(name, [one.name for one in held]) if len(held) < 8 else _LIST)
    raise InputError(f"{path} has no {quantity} '{name}': {hint}"
                     + ''.join(f' ({note})' for note in log.notes))


def _current(log: Log, voltage: Series) -> Series | None:
    """Return the current measured with a voltage, or the only current of a single battery."""
    ranked = [one for one in log.of(CURRENT) if one.rank is not None and one.n]
    beside = [one for one in log.of(CURRENT)
              if one.group and one.group == voltage.group and not one.silent]
    beside = [one for one in beside if one.rank is not None] or beside
    if beside:
        return beside[0]
    batteries = [one for one in log.of(VOLTAGE) if one.rank is not None]
    return ranked[0] if len(ranked) == 1 and len(batteries) < 2 else None


def _alternatives(log: Log, chosen: tuple[Series, Series | None], option: str) -> list[str]:
    """Return notes on other series that could be the voltage or the throttle."""
    notes: list[str] = []
    for quantity, one in zip((VOLTAGE, THROTTLE), chosen):
        others = [other for other in log.of(quantity)
                  if not other.silent and (one is None or other.name != one.name)]
        # Prefer throttles that could be the default; list all voltages, rails included.
        ranked = [other for other in others if other.rank is not None]
        others = ranked or others if quantity == THROTTLE else others
        if others:
            notes.append(f'Also in the log: {_names_of(others)} '
                         f'({option.format(quantity)} NAME).')
    return notes


# Topics that a named series must not take.
_TAKEN = ('voltage', 'throttle', 'current', IMU, SPEEDS)
# Minimum length of a gap, in median steps; minimum number of stamps for the median.
_GAP, _LEAST = 3.0, 40


def choose_extras(path: Path, log: Log, *, imu: str | None = None, signals: Sequence[str] = (),
                  ) -> tuple[dict[str, Series], tuple[str, ...]]:
    """Return gyro (imu: its name), motor speeds and named series, by topic, and notes."""
    notes: list[str] = []
    found: dict[str, Series] = {}
    gyro = _gyro(path, log, imu)
    if gyro is not None:
        gyro, said = clean(gyro)
        notes += prefixed(gyro.name, (*said, *gap_notes(gyro.t)))
        if gyro.n:
            found[IMU] = gyro
        else:
            notes.append(f'{gyro.name} has no usable sample.')
    if IMU not in found and imu != NONE and log.format != 'csv':
        notes.append('The log holds no gyro, so there is no topic /imu.')
    others = [one.name for one in log.of(IMU) if IMU not in found or one.name != found[IMU].name]
    if others:
        notes.append(f"Also in the log: {', '.join(others)} (--imu NAME).")
    for one in log.of(SPEEDS):
        speeds, said = clean(one)
        notes += prefixed(SPEEDS, said)
        if speeds.n:
            found[SPEEDS] = speeds
    for name in dict.fromkeys(signals):
        series, said = signal_of(path, log, name)
        notes += said
        if series.unit == UNKNOWN:
            notes.append(f'{name}: the log does not state its unit; written as it is logged.')
        topic = topic_of(name)
        free = chain((topic, f'signal/{topic}'), (f'signal/{topic}_{k}' for k in count(2)))
        found[next(one for one in free if one not in {*_TAKEN, *found})] = series
    return found, tuple(notes)


def signal_of(path: Path, log: Log, name: str) -> tuple[Series, tuple[str, ...]]:
    """Return the usable samples of a series by its name, and notes on it."""
    if not name:
        raise InputError('the name of the signal is empty: ' + _LIST)
    found = next((one for one in log.scalars if one.name == name), None)
    if found is None:
        known = list(dict.fromkeys([*log.names, *(one.name for one in log.scalars)]))
        hint = 'it holds none' if not known else (
            nearest(name, known) if closest(name, known) else _LIST)
        raise InputError(f"{path} has no series '{name}': {hint}")
    series, said = clean(found)
    if not series.n:
        raise InputError(f'{path}: {name} has no usable sample'
                         + ''.join(f' ({sentence})' for sentence in said))
    return series, tuple(prefixed(name, (*said, *gap_notes(series.t))))


def topic_of(name: str) -> str:
    """Return the topic of a series, without the slash: IMU[0].GyrX -> IMU_0/GyrX."""
    words = re.sub(r'\[(\w+)\]', r'_\1', name).split('.')
    tokens = [re.sub(r'__+', '_', re.sub(r'[^A-Za-z0-9_]', '_', word)).strip('_')
              for word in words]
    return '/'.join(token if token[0].isalpha() else f'n{token}' for token in tokens if token
                    ) or 'unnamed'


def _gyro(path: Path, log: Log, name: str | None) -> Series | None:
    """Return the gyro with this name; without a name, the default, if there is one."""
    if name is None or name == NONE:
        return None if name else next(iter(default(log, IMU)), None)
    known = {one.name: one for one in log.of(IMU)}
    if name not in known:
        raise InputError(f"{path} has no gyro '{name}': "
                         + (nearest(name, known) if known else 'it holds none'))
    return known[name]


def gap_notes(t: FloatArray) -> tuple[str, ...]:
    """Return a note on pauses of the stamps, s, if there are any."""
    steps = np.diff(t)
    if t.size < _LEAST or not (gaps := int((steps > _GAP * np.median(steps)).sum())):
        return ()
    return (Note(f'{counted(gaps, "gap")} of up to {float(steps.max()):.3g} s.', Defect.GAPS),)
