"""
Which series of a log become voltage, throttle and current; repeats dropped.

The battery is meant when nothing is said, never a rail behind a regulator; of
several batteries the user chooses.  For the throttle the smallest rank is
taken: what goes to the motors before what the stick asks for.

Limits of dropping repeats: where they come at no steady distance, those of the logger
are not told from two readings that agree; then nothing is dropped, unless every
repeat is to go, which selects changes and makes noise look larger.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from ou_monitor.errors import InputError, nearest
from ou_monitor.online.estimator.quality import refreshes
from ou_monitor.recordings.importers.log import ANY, clean, CURRENT, Log, Series, THROTTLE, VOLTAGE
from ou_monitor.recordings.samples import check_throttle

# What leaves a quantity out.
NONE = 'none'

# Series named in one line; the others are in the list.
MOST = 4


@dataclass(frozen=True, eq=False)
class Chosen:
    """
    What is taken from a log.

    Attributes
    ----------
    voltage : Series
        At least one sample.
    throttle, current : Series or None
        None where the log has none, or none is wanted.
    notes : tuple of str
        What was dropped, and what else could have been taken.

    """

    voltage: Series
    throttle: Series | None
    current: Series | None
    notes: tuple[str, ...]


def choose(path: Path, log: Log, *, voltage: str | None = None, throttle: str | None = None,
           current: str | None = None, option: str = '--{}') -> Chosen:
    """Choose, and drop what cannot be a sample (option: what chooses a quantity by name)."""
    volts = _pick(path, log, VOLTAGE, voltage, option)
    if volts is None:
        raise InputError(_no_voltage(path, log))
    first = _pick(path, log, THROTTLE, throttle, option)
    if first is not None and log.format == 'csv':
        # Readers of autopilot logs know the scale of theirs; a column says nothing of it.
        check_throttle(f'{path}: {first.name}', first.values)
    if current is not None:
        second = _pick(path, log, CURRENT, current, option)
    else:
        second = _current(log, volts)
    notes = []
    if second is None and current is None and (
            held := [one for one in _of(log, CURRENT) if not one.silent]):
        notes.append('No current is clearly that of this voltage: ' + _listed(held)
                     + '; none taken (--current NAME).')
    chosen: list[Series | None] = []
    dropped: dict[str, list[str]] = {}
    for one in (volts, first, second):
        if one is None:
            chosen.append(None)
            continue
        mended, why = clean(one)
        for sentence in why:
            dropped.setdefault(sentence, []).append(one.name)
        if not mended.n:
            notes.append(f'{one.name} has no usable sample.')
        chosen.append(mended if mended.n else None)
    # What befell several alike, such as columns of one table, is said once.
    notes = [f'{", ".join(names)}: {sentence}' for sentence, names in dropped.items()] + notes
    if chosen[0] is None:
        raise InputError(f'{path}: {volts.name} has no usable sample'
                         + ''.join(f' ({note})' for note in notes))
    notes += _also(log, (volts, first), option)
    return Chosen(chosen[0], chosen[1], chosen[2], tuple(notes))


def default(log: Log, quantity: str) -> list[Series]:
    """Return the series that are taken when nothing is said; several: it is not clear."""
    ranked = [one for one in _of(log, quantity) if one.rank is not None and one.n]
    least = min((one.rank for one in ranked if one.rank is not None), default=None)
    return [one for one in ranked if one.rank == least]


def _of(log: Log, quantity: str) -> list[Series]:
    return [one for one in log.series if one.quantity == quantity]


def _listed(series: list[Series]) -> str:
    shown = ', '.join(f'{one.name} ({one.words})' for one in series[:MOST])
    return shown + (f' and {len(series) - MOST} more, see --list' if len(series) > MOST else '')


def _pick(path: Path, log: Log, quantity: str, name: str | None, option: str
          ) -> Series | None:
    if name == NONE and quantity != VOLTAGE:
        return None
    if name is None:
        found = default(log, quantity)
        if len(found) > 1:
            raise InputError(f'{path} has several: {_listed(found)}; choose with '
                             f'{option.format(quantity)} NAME, see all with --list')
        return found[0] if found else None
    held = [one for one in log.series if one.quantity in (quantity, ANY)]
    for one in held:
        if one.name == name:
            return replace(one, quantity=quantity)
    for one in log.series:
        if one.name == name:
            raise InputError(f"{path}: '{name}' is a {one.quantity}, not a {quantity}")
    hint = 'there is none' if not held else (
        nearest(name, [one.name for one in held]) if len(held) < 8 else 'see --list')
    raise InputError(f"{path} has no {quantity} '{name}': {hint}"
                     + ''.join(f' ({note})' for note in log.notes))


def _current(log: Log, voltage: Series) -> Series | None:
    """Return the current of the sensor of the voltage, or the only one of a lone battery."""
    ranked = [one for one in _of(log, CURRENT) if one.rank is not None and one.n]
    beside = [one for one in _of(log, CURRENT)
              if one.group and one.group == voltage.group and not one.silent]
    beside = [one for one in beside if one.rank is not None] or beside
    if beside:
        return beside[0]
    batteries = [one for one in _of(log, VOLTAGE) if one.rank is not None]
    return ranked[0] if len(ranked) == 1 and len(batteries) < 2 else None


def _no_voltage(path: Path, log: Log) -> str:
    others = _of(log, VOLTAGE) + _of(log, ANY)
    why = ''.join(f' ({note})' for note in log.notes)
    if log.format == 'csv':
        return (f"{path}: no column 'voltage_v': name one with --voltage, see all with --list")
    if others:
        return (f'{path} has no battery voltage; choose another with --voltage NAME: '
                f'{_listed(others)}{why}')
    return f'{path} holds no voltage{why}: there is nothing to convert'


def _also(log: Log, chosen: tuple[Series, Series | None], option: str) -> list[str]:
    """Say what else could have been taken."""
    notes = []
    for quantity, one in zip((VOLTAGE, THROTTLE), chosen):
        others = [other for other in _of(log, quantity)
                  if not other.silent and (one is None or other.name != one.name)]
        # Of the throttles, what could have been taken unasked; of the voltages, the rails as well.
        ranked = [other for other in others if other.rank is not None]
        others = ranked or others if quantity == THROTTLE else others
        if others:
            notes.append(f'Also in the log: {_listed(others)} '
                         f'({option.format(quantity)} NAME).')
    return notes


def drop_held(series: Series, *, every: bool = False) -> tuple[Series, str]:
    """Return a series without repeats, and one sentence on what was done."""
    share = series.repeats
    t, values, period = refreshes(series.t, series.values)
    if period > 1.0:
        kept = replace(series, t=t, values=values)
        words = (f'refreshed every {period:.4g} samples: {series.n - kept.n} of {series.n} '
                 'held samples dropped')
    elif every and share > 0.0:
        fresh = np.ones(series.n, dtype=bool)
        fresh[1:] = np.diff(series.values) != 0.0
        kept = replace(series, t=series.t[fresh], values=series.values[fresh])
        words = (f'{series.n - kept.n} of {series.n} repeats dropped; they come at no steady '
                 'distance, so readings that agree went too')
    else:
        kept = series
        words = (f'nothing dropped: {share:.0%} of the increments are zero, at no steady distance'
                 if share > 0.0 else 'nothing dropped: no sample repeats the one before')
    return kept, f'{series.name}: {words}.'
