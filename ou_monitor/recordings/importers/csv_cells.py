"""
Read cells and names of a table of text, and convert its columns to SI.

A number may be followed by its unit, and loggers' words for a missing number are recognised. Dates
and times may have the formats of loggers and spreadsheets of several countries. A stated or given
unit is used; otherwise it is guessed from the sizes of the values, and the words returned with it
say so.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from contextlib import suppress
from datetime import date
import math
from pathlib import Path
import re
from typing import NamedTuple

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers import log as logs
from ou_monitor.records import clock_unit, FloatArray, LONGEST_STEP, TIME_UNITS
from ou_monitor.text import plain_number
from ou_monitor.timeline import like_throttle, MOST_THROTTLE, Picked, WILD

# Words of loggers for a missing number, or for one beyond the range.
_MISSING = frozenset('nan,null,none,na,n/a,#n/a,x,∞,-∞,ol,-ol,ovl,overload,'
                     'unavailable,unknown,1.#qnan,-1.#qnan,-1.#ind,1.#inf,-1.#inf'.split(','))
# Maximum number of characters of a cell in a message.
_LONGEST = 40


def _by_word(**units: str) -> dict[str, str]:
    """Return a map from each word for a unit, in lower case, to the unit."""
    return {word: unit for unit, words in units.items() for word in words.split()}


TIME_WORDS = _by_word(
    s='s sec secs second seconds sekunden', ms='ms msec millis millisecond milliseconds',
    us='us µs μs usec micros microseconds', ns='ns nsec nanoseconds', min='min mins minutes',
    h='h hr hours', d='d days')
# Ambiguous at the end of a name: 'Voltage (min)' is a minimum.
_LONG = 'min|mins|minutes|h|hr|hours|d|days'
VOLT_WORDS = _by_word(V='v volt volts vdc', mV='mv mvdc millivolt millivolts', cV='cv', dV='dv',
                      kV='kv', uV='uv µv μv')
AMPERE_WORDS = _by_word(A='a amp amps ampere amperes adc', mA='ma madc', cA='ca', dA='da',
                        uA='ua µa μa')
SHARE_WORDS = dict.fromkeys(('%', 'percent', 'pct', 'prozent'), '%')
# Other units that a line of units may hold.
OTHER_WORDS = frozenset(('', *('- sequence w wh ah mah hz khz rpm 1/min ° deg °c degc °f m m/s '
                               'km/h g kg n nm ohm mohm').split()))
WORDS = {**TIME_WORDS, **VOLT_WORDS, **AMPERE_WORDS, **SHARE_WORDS}
# Unit -> its size in V, A, s or 1.  Units with the same last letter measure the same quantity.
SCALES = {**TIME_UNITS, 'min': 60.0, 'h': 3600.0, 'd': 86400.0, 'V': 1.0, 'dV': 0.1, 'cV': 0.01,
          'mV': 1e-3, 'kV': 1e3, 'uV': 1e-6, 'A': 1.0, 'dA': 0.1, 'cA': 0.01, 'mA': 1e-3,
          'uA': 1e-6, '%': 0.01}
# A name that ends with a unit, preferably in brackets. Repetitions after the quantity are bounded,
# so that matching takes time proportional to the length of the name.
_WORD = rf"({'|'.join(sorted(WORDS.keys() - _LONG.split('|'), key=len, reverse=True))})(?: dc)?"
_WITH_UNIT = re.compile(
    rf'(.*(?:time|zeit|stamp|elapsed)|t)(?: ?[\[({{/_ ] ?| in )({_LONG})[\])}}]?|'
    r'(.*(?:time|stamp))([mun]s)|'  # ArduPilot's TimeUS
    rf'(.*?) ?[\[({{] ?{_WORD} ?[\])}}]|(.+?) in {_WORD}|(.[^/]*?|.+? ) ?/ ?{_WORD}|'
    rf'(.+?)[ _](?!adc){_WORD}')  # Raw_ADC is not a current
# A unit before more words: 101 (VDC)- Battery.
_BEFORE = re.compile(rf'(.*?)( ?[\[(]{_WORD}[\])]) ?[-:] ?(\w.*)', re.IGNORECASE)
# A multiple of a unit: Volts*100; current (10 mA).
_MULTIPLE = re.compile(
    r'(.*?)(?: ?\* ?(10+)|([\[(] ?)(?:x ?)?(10+|0?\.0*1) ?([a-zµμ%]+ ?[\])]))', re.IGNORECASE)
_AND_UNIT = re.compile(r'(\S*[\d.])\s*+([^\d\s.]{1,12}+(?: [AaDd][Cc])?)')  # 12.3 mV DC
# Without a date, hours may count up to 99; time zones reach from -12:00 to +14:00.
_CLOCK = re.compile(
    r'\s*+(?:(\d{4})[-/.](\d\d?)[-/.](\d\d?)|(\d\d?)([./-])(\d\d?)[./-](\d{4}|\d\d))?+[T ,]*+'
    r'(?:(\d\d?):([0-5]\d)(?::([0-5]\d|60)(?:[.,:](\d{1,9}))?)?)?+\s*+'
    r'(Z|UTC|[-+](?:0\d|1[0-4]):?[0-5]\d)?+\s*+([AaPp][Mm])?+\s*+')
# Minutes, seconds and a part of a second: 03:12.0 (Excel).
_MINUTES = re.compile(r'\d\d?:[0-5]\d[.,]\d{1,9}')
_DAY, _HOUR = 86400.0, 3600.0  # s
_MONTHS = 'jan feb mar apr may jun jul aug sep oct nov dec'
_MONTH = re.compile(rf"[- ]({_MONTHS.replace(' ', '|')})[a-z]*[- ]", re.IGNORECASE)
# A time span: 0 days 00:00:01.5
_DAYS = re.compile(r'(\d{1,2}) days?,? \+?(\d\d?):')
CHANNEL = re.compile(r'(?:ch|channel|chan|kanal|analog|ain)[_ ]?[0-9a-d]|a[0-3]', re.IGNORECASE)


def number_of(cell: str) -> tuple[float, str]:
    """Return a number and the unit written after it, in lower case; '': none."""
    with suppress(ValueError):
        return plain_number(cell), ''
    # Graphtec puts blanks between sign and digits.
    cell = re.sub(r'^([-+]) +', r'\1', cell.strip())
    found = _AND_UNIT.fullmatch(cell)
    text, unit = (found[1], found[2].lower()) if found else (cell, '')
    unit = unit.removesuffix(' dc').removesuffix(' ac')
    if unit and unit not in WORDS:
        raise ValueError(cell)
    return plain_number(text), unit


def is_missing(cell: str) -> bool:
    """Return whether a cell stands for a missing number: blank, a word, or dashes (--.--)."""
    return not cell.strip(' \t\n-.') or cell.strip().lower() in _MISSING


def is_number(cell: str) -> bool:
    try:
        number_of(cell)
    except ValueError:
        return False
    return True


def is_value(cell: str) -> bool:
    return is_number(cell) or is_clock(cell)


def is_clock(cell: str) -> bool:
    """Return whether a cell is a date, a time, or both."""
    return bool(cell[:1].isdigit() and (':' in cell or max(map(cell.count, '-./,')) > 1)
                and _CLOCK.fullmatch(_swapped(cell)))


def has_day(cell: str) -> bool:
    found = _CLOCK.fullmatch(_swapped(cell)) if is_clock(cell) else None
    return found is not None and (found[1] or found[4]) is not None


def _swapped(cell: str) -> str:
    """Return a clock in the form of `_CLOCK`: days become hours, a month's name its number."""
    if found := _DAYS.match(cell):
        cell = f'{24 * int(found[1]) + int(found[2])}:{cell[found.end():]}'
    if found := _MONTH.search(cell):
        month = 1 + _MONTHS.index(found[1].lower()) // 4
        cell = f'{cell[:found.start()]}-{month}-{cell[found.end():]}'
    if _MINUTES.fullmatch(cell):
        cell = f'0:{cell}'
    # 14/03/2024 10.22.31
    cell = re.sub(r' (\d\d)[.,](\d\d)[.,](\d\d)(?!\d)', r' \1:\2:\3', cell)
    return cell.replace(',', '.') if cell.count(',') > 1 else cell


def unit_of(name: str) -> tuple[str, str]:
    """Split a name into its quantity and the unit it states, in lower case; '': none."""
    text = ' '.join(name.strip().strip('\'"').split())
    if found := _BEFORE.fullmatch(text):
        text = f'{found[1]} {found[4]}{found[2]}'
    if found := _MULTIPLE.fullmatch(text):
        text = found[1] + (found[3] or '') + (found[5] or '')
    if found := re.match(r'(milli(?:second)?s|micro(?:second)?s|[mun]s)(?![a-z])', text.lower()):
        return text, found[1]
    found = None if CHANNEL.fullmatch(text) else _WITH_UNIT.fullmatch(
        text.lower()) or re.fullmatch(r'(CH\d+)(V|A)|(?=(\w+))(m?[VA]) DC', text)
    if found is None:
        return text, ''
    quantity, unit = (part for part in found.groups() if part is not None)
    return quantity, unit.lower()


def factor_of(name: str) -> float:
    """Return the factor to the unit in a name: 0.01 of 'Volts*100', 10 of 'I (10 mA)'."""
    found = _MULTIPLE.fullmatch(' '.join(name.split()))
    return 1.0 if found is None else 1.0 / float(found[2]) if found[2] else float(found[4])


def unit_word(text: str) -> str:
    """Return the first word of a unit in lower case, without DC or AC; '' if there is none."""
    return next((word for word in text.lower().split() if word not in ('dc', 'ac')), '')


def shown(text: str) -> str:
    """Shorten a cell to one line: an unclosed quote makes the rest of a file one cell."""
    shown = text.strip()
    return shown if len(shown) <= _LONGEST else shown[:_LONGEST] + '...'


def _days(year: int, month: int, day: int) -> int:
    return date(year + (2000 if year < 100 else 0), month, day).toordinal() - 719163


class BadLine(NamedTuple):
    """A line of a CSV that cannot be read."""

    line: int | None  # None: unknown
    why: str

    def error(self, path: Path) -> str:
        """Return the error message."""
        return f'{path}: {self.why}' if self.line is None else f'{path}:{self.line}: {self.why}'


def clock_times(path: Path, cells: list[str], name: str,
                left_out: list[BadLine] | None) -> FloatArray:
    """Return dates and times in s since 1970; without a date since the first midnight."""
    found = [None if not cell.strip() else _CLOCK.fullmatch(cell) for cell in map(_swapped, cells)]
    bad = [BadLine(None, f"column '{name}' holds '{shown(cells[k])}', not a date or a time")
           for k, one in enumerate(found) if one is None and cells[k].strip()]
    if bad and left_out is None:
        raise InputError(bad[0].error(path))
    if left_out is not None:
        left_out += bad
    try:
        either = [_clock_seconds(found, first) for first in (True, False)]
    except ValueError as error:
        raise InputError(f"{path}: column '{name}': {error}") from error
    spans = [float(np.nanmax(t) - np.nanmin(t)) if np.isfinite(t).any() else math.inf
             for t in either]
    # Italians write times with dots. Try that if the cells are not valid dates (10.22.31), or are
    # dates without a time of day.
    dotted = [re.sub(r'^(\d\d?)[.,]([0-5]\d)[.,]([0-5]\d)(?!\d)', r'\1:\2:\3', cell)
              for cell in cells]
    if dotted != cells and (min(spans) == math.inf or not any(one and one[8] for one in found)
                            and all(_CLOCK.fullmatch(cell) for cell in dotted)):
        t = clock_times(path, dotted, name, left_out)
        if min(spans) == math.inf or np.abs(np.diff(t)).mean() <= LONGEST_STEP:
            return t
    # In 04/05 either number may be the day: choose what gives the shorter recording.
    t = either[0] if spans[0] <= spans[1] else either[1]
    if any(one is not None and not (one[1] or one[4]) for one in found):
        # Times without a date start anew each day; minutes and seconds alone, each hour.
        turn = _DAY if not np.nanmax(t, initial=0.0) < _HOUR else _HOUR
        t = t + turn * np.concatenate(([0.0], np.cumsum(np.diff(t) < -0.5 * turn)))
    return t


def _clock_seconds(found: Sequence[re.Match[str] | None], day_first: bool) -> FloatArray:
    seconds = array('d')
    wrong = False
    for one in found:
        if one is None:
            seconds.append(math.nan)
            continue
        year, month, day, a, mark, b, c, hour, minute, second, part, zone, half = one.groups()
        days = 0
        if year:
            days = _days(int(year), int(month), int(day))
        elif a:
            x, y = (int(a), int(b)) if day_first or mark != '/' else (int(b), int(a))
            wrong |= y > 12
            days = _days(int(c), min(y, 12), x)
        t = 60.0 * int(minute or 0) + int(second or 0) + (float(f'0.{part}') if part else 0.0)
        hours = int(hour or 0)
        if hours > 23 and (year or a):
            raise ValueError('hour must be in 0..23')
        if half:
            hours = hours % 12 + 12 * (half.lower() == 'pm')
        if zone and zone[0] in '+-':
            shift = 3600 * int(zone[1:3]) + 60 * int(zone[-2:])
            t -= math.copysign(shift, float(zone[0] + '1'))
        seconds.append(_DAY * days + 3600.0 * hours + t)
    return np.full(len(seconds), math.nan) if wrong else np.array(seconds, dtype=np.float64)


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
# Number of values of a 32-bit counter.
_COUNTS = 2.0**32
# Maximum voltage of a pack, V. Without a unit, larger values are mV, or uV (as Linux reports) if
# too large for that; whole numbers down to a tenth of it may be ADC counts, and are refused.
MOST_VOLTS = 1000.0
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


def stamps_of(path: Path, t: FloatArray, time: FileColumn, given: bool, clocks: bool,
              ) -> tuple[FloatArray, str]:
    """Return the time in s, and its unit in words (given: by the user; clocks: not numbers)."""
    if not time.place:
        return t, f'{time.scale:g} s'
    if clocks:
        return t, 'dates and times'
    known = t[np.isfinite(t)]
    steps = np.abs(np.diff(known))
    usual = float(np.median(steps[steps > 0.0])) if steps.any() else 0.0
    if len(time.place) > 1:
        unit, words = 's', ''
    elif time.unit:
        unit, words = time.unit if given else TIME_WORDS[time.unit], ''
        # Some tools name ms, but write s.
        if unit in ('ms', 'us') and 0.0 < usual < 1e-3 and not given:
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
    if usual * SCALES[unit] > LONGEST_STEP and SCALES[unit] <= 1.0 and not given:
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
        if 0.1 * MOST_VOLTS < usual <= MOST_VOLTS and (known == np.rint(known)).all():
            raise InputError(f"{path}: '{column.name}' has whole numbers about {usual:g} and no "
                             'stated unit: convert counts to V, or give --unit V or mV')
        unit = next((one for one in ('V', 'mV') if usual * SCALES[one] <= MOST_VOLTS), 'uV')
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
    if beyond.size <= WILD * known.size or like_throttle(volts):
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
