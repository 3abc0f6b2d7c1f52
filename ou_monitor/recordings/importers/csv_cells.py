"""
Read one cell or name of a table of text: numbers, units, dates and times.

A number may be followed by its unit, and loggers' words for a missing number are recognised. Dates
and times may have the formats of loggers and spreadsheets of several countries.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from contextlib import suppress
from datetime import date
import math
from pathlib import Path
import re

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.records import FloatArray, LONGEST_STEP, TIME_UNITS
from ou_monitor.text import plain_number

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


def clock_times(path: Path, cells: list[str], name: str, left_out: list[str] | None) -> FloatArray:
    """Return dates and times in s since 1970; without a date since the first midnight."""
    found = [None if not cell.strip() else _CLOCK.fullmatch(cell) for cell in map(_swapped, cells)]
    bad = [f"{path}: column '{name}' holds '{shown(cells[k])}', not a date or a time"
           for k, one in enumerate(found) if one is None and cells[k].strip()]
    if bad and left_out is None:
        raise InputError(bad[0])
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
