"""
Convert columns of a table of text to SI: stamps in s, voltage in V, throttle 0..1, current in A.

A stated or given unit is used; otherwise the unit is guessed from the sizes of the values, and the
words returned with it say so.
"""

from __future__ import annotations

import math
from pathlib import Path
import re
from typing import NamedTuple

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers import log as logs
from ou_monitor.recordings.importers.csv_cells import (
    AMPERE_WORDS, SCALES, SHARE_WORDS, TIME_WORDS, VOLT_WORDS)
from ou_monitor.recordings.importers.csv_form import Form, holds_clocks
from ou_monitor.recordings.importers.log import CsvColumns
from ou_monitor.records import clock_unit, FloatArray, LONGEST_STEP, TIME_UNITS
from ou_monitor.timeline import MOST_THROTTLE, Picked, WILD

# Unit -> values at throttle 0 and 1; other values are written LOW:HIGH.
THROTTLE_UNITS = {'1': (0.0, 1.0), '%': (0.0, 100.0), 'us': (1000.0, 2000.0), 'ms': (1.0, 2.0)}
PULSE_WORDS = {word: unit for word, unit in TIME_WORDS.items() if unit in THROTTLE_UNITS}
# Largest values of sticks that are centred at 0: EdgeTX, DJI, 16 bits.
_STICKS = (1024, 10000, 32768)
# Ends of the stick in DJI's flight logs (with the column names of CsvView and PhantomHelp).
_DJI = '364:1684'
# Usual maximum step and span of a recording, s; an unstated unit of time is taken to be the
# coarsest one within both.
_USUAL_STEP, _USUAL_SPAN = 2.0, 43200.0
# Number of the first day of 1970 in Excel and MATLAB; days from there to 2100.
_OF_1970, _TO_2100 = (25569.0, 719529.0), 47482.0
# Number of values of a 32-bit counter; seconds per day.
_COUNTS, _DAY = 2.0**32, 86400.0
# Maximum voltage of a pack, V. Without a unit, larger values are mV; whole numbers down to a tenth
# of it may be ADC counts, and are refused.
_MOST_VOLTS = 1000.0
# Peak above which a throttle without a unit is percent, not a lever's voltage of up to 5 V.
_LEAST_PERCENT = 5.5


class FileColumn(NamedTuple):
    """A selected column."""

    place: tuple[int, ...]  # Its columns: two for a date and a time, none if rows are counted
    name: str
    unit: str  # As stated or given, '' if neither
    scale: float  # Factor that the maker defines; 0: the unit decides
    unknown: float = math.nan  # Number that stands for "unknown"
    guess: bool = False  # Whether the quantity is guessed


def unwrapped(t: FloatArray) -> FloatArray:
    """Unwrap a 32-bit counter of a time; micros() wraps after 72 minutes."""
    known = np.isfinite(t)
    if ((t[known] >= 0.0) & (t[known] < _COUNTS)).all():
        on = np.unwrap(t[known], period=_COUNTS)
        # A restart of the logger is not a wrap: unwrapped, it would become an unusually long step.
        if (np.diff(on) <= 2.0 * np.diff(t[known]).max(initial=0.0)).all():
            t[known] = on
    return t


def _of_day(t: FloatArray) -> FloatArray | None:
    """Convert times written as numbers HHMMSS.ss to s; None if they are not of this form."""
    minutes, second = np.divmod(t, 100.0)
    hour, minute = np.divmod(minutes, 100.0)
    if (t < 0.0).any() or (second >= 60.0).any() or (minute >= 60.0).any() or (hour >= 24.0).any():
        return None
    seconds = 3600.0 * hour + 60.0 * minute + second
    seconds += _DAY * np.append(0.0, np.cumsum(np.diff(seconds) < -0.5 * _DAY))[:t.size]
    # At each full minute the numbers leap by 40, but the time must go on evenly.
    steps, full = np.diff(seconds), np.diff(minutes) != 0.0
    within, over = steps[~full & (steps != 0.0)], steps[full]
    if not over.size or over.size > within.size:
        return None
    usual = float(np.median(within))
    return seconds if abs(np.median(over) - usual) <= 0.5 * usual else None


def stamps_of(path: Path, t: FloatArray, form: Form, wanted: CsvColumns, time: FileColumn,
              ) -> tuple[FloatArray, str]:
    """Return the time in s, and its unit in words."""
    if not time.place:
        return t, f'{time.scale:g} s'
    if holds_clocks(form, time.place[0]):
        return t, 'dates and times'
    known = t[np.isfinite(t)]
    steps = np.abs(np.diff(known))
    usual = float(np.median(steps[steps > 0.0])) if steps.any() else 0.0
    if len(time.place) > 1:
        unit, words = 's', ''
    elif time.unit:
        unit, words = time.unit if wanted.time_unit else TIME_WORDS[time.unit], ''
        # Some tools name ms, but write s.
        if unit in ('ms', 'us') and 0.0 < usual < 1e-3 and not wanted.time_unit:
            words = f', {usual * SCALES[unit]:.4g} s from row to row: --time-unit s if it is in s'
    else:
        if (of_day := _of_day(known)) is not None:
            t = t.copy()
            t[np.isfinite(t)] = of_day
            return t, 'HHMMSS, a guess: --time-unit'
        # Clocks that count from 1970 show their unit by their size.
        size = float(np.median(np.abs(known))) if known.size else 0.0
        span = float(np.ptp(known)) if known.size else 0.0
        unit = clock_unit(size)
        if not unit or usual * TIME_UNITS[unit] > LONGEST_STEP:
            unit = next((name for name, scale in TIME_UNITS.items() if (
                usual * scale <= _USUAL_STEP and span * scale <= _USUAL_SPAN)), 's')
        first = next((day for day in _OF_1970 if 0.0 < size - day < _TO_2100), 0.0)
        if unit == 's' and first and 0.0 < usual < 1e-4:
            unit, t = 'd', t - first
        words = '' if unit == 's' else ', a guess: --time-unit'
    t = t * SCALES[unit]
    # Refuse only s and finer units: a stated minute, or a unit given by the user, is deliberate.
    if usual * SCALES[unit] > LONGEST_STEP and SCALES[unit] <= 1.0 and not wanted.time_unit:
        raise InputError(f'{path}: the samples are {usual * SCALES[unit]:g} s apart by '
                         f"'{time.name}': is it in ms, us or ns? Give --time-unit")
    return t, unit + words


def lower_rows(t: FloatArray, volts: FloatArray) -> tuple[Picked, list[str]]:
    """Return the rows to keep (the lower ones if each stamp has two), and notes."""
    first, second = (np.arange(k, t.size // 2 * 2, 2) for k in (0, 1))
    change = volts[second] - volts[first]
    if not (change.size and np.isfinite(volts).all() and (t[first] == t[second]).all() and (
            np.diff(t[first]) > 0.0).all() and 2 * np.count_nonzero(change) > change.size):
        return slice(None), []
    return np.append(np.where(change < 0.0, second, first), np.arange(2 * first.size, t.size)), [
        'Each stamp has two rows, as in an envelope: the row of the lower voltage was kept; if '
        'the two are successive samples, give --sample-interval.']


def in_si(path: Path, quantity: str, column: FileColumn, values: FloatArray, given: str | None,
          volts: FloatArray, beside: str) -> tuple[FloatArray, str]:
    """Return values in V, 0..1 or A, and their unit in words (beside: the voltage's unit)."""
    known = np.abs(values[np.isfinite(values)])
    if quantity == logs.THROTTLE:
        unit = given or SHARE_WORDS.get(column.unit) or PULSE_WORDS.get(column.unit)
        guess = unit is None
        if guess and column.name.lower() == 'rc.throttle' and known.size and known.max() > 100.0:
            unit = _DJI
        unit = unit or _throttle_unit(values[np.isfinite(values)], volts)
        # Negative percentages come from a stick, or, as a duty, from a motor in reverse.
        if given is None and unit == '%' and np.mean(values < -MOST_THROTTLE) > WILD and not (
                re.search('duty|pwm', column.name.lower())):
            guess, unit = True, '-100:100'
        words = ', a guess: --throttle-unit' if guess and unit != '1' else ''
        if unit in ('us', 'ms'):
            # 0: an output without pulses.
            values = np.where(values == 0.0, THROTTLE_UNITS[unit][0], values)
            if known.size and np.nanmedian(values) < 0.5 * THROTTLE_UNITS[unit][0]:
                raise InputError(f"{path}: '{column.name}' is not a pulse in {unit}: half of its "
                                 f'values are below {np.nanmedian(values):.4g}; give its unit '
                                 'by --throttle-unit')
        low, high = THROTTLE_UNITS.get(unit) or map(float, unit.split(':'))
        return (values - low) / (high - low), (
            '0..1' if unit == '1' else unit) + words
    # Use the maker's factor, unless it makes a supply of less than 1 V: then the numbers were
    # converted already, under the same names.
    if column.scale and 'V' not in (given, beside.split(',')[0]) and (
            math.isnan(column.unknown) or (known == np.rint(known)).all()) and (
            quantity == logs.CURRENT or known.size and np.median(known) * column.scale >= 1.0):
        return np.where(values == column.unknown, np.nan, values * column.scale), column.unit
    if quantity == logs.CURRENT:
        small = not column.unit and beside.startswith('mV,') and bool(
            (known == np.rint(known)).all())
        unit = 'mA' if small else AMPERE_WORDS.get(column.unit, 'A')
        return values * SCALES[unit], unit + ', a guess' * small
    unit, words = given or VOLT_WORDS.get(column.unit) or '', ''
    if not unit:
        usual = float(np.median(known)) if known.size else 0.0
        if 0.1 * _MOST_VOLTS < usual <= _MOST_VOLTS and (known == np.rint(known)).all():
            raise InputError(f"{path}: '{column.name}' has whole numbers about {usual:g} and no "
                             'stated unit: convert counts to V, or give --unit V or mV')
        unit = 'mV' if usual > _MOST_VOLTS else 'V'
        words = ', a guess: ' + '--voltage-column and ' * column.guess + '--unit'
    return values * SCALES[unit], unit + words


def _throttle_unit(values: FloatArray, volts: FloatArray) -> str:
    """Return the unit suggested by the sizes of a throttle; '1' by default."""
    known = np.abs(values)
    if not known.size:
        return '1'
    low, high = (float(np.quantile(known, q)) for q in (WILD, 1.0 - 0.1 * WILD))
    if low >= 0.8 and 1.1 < high <= 2.2:
        # Pulses in ms.
        return '1:2'
    beyond = known[known > MOST_THROTTLE]
    # If the voltage is within 0 to 1, the columns may be swapped: `check_throttle` reports it.
    if beyond.size <= WILD * known.size or float(np.nanmax(np.abs(volts), initial=0.0)) <= 1.0:
        return '1'
    if high <= 110.0:
        return '%' if high > _LEAST_PERCENT else '1'
    negative = float(np.mean(values < -MOST_THROTTLE)) > WILD
    if np.quantile(known[known > 0.0], WILD) >= 800.0 and high <= 2200.0 and not negative:
        return 'us'
    if negative:
        return next((f'{-end}:{end}' for end in _STICKS if high <= end), '1')
    # The thrust of a Crazyflie; other counts end at 10 000 at most.
    return '0:65535' if 10000.0 < high <= 65535.0 and values.min() >= 0.0 and (
        high > 32768.0 or (values == np.rint(values)).all()) else '1'
