"""
Read a table of text, such as a CSV: time, voltage and, where present, throttle and current.

Limits: a file is one flight; all rows have the same number of cells.  The format is detected in
the first 64 kB: the encoding, delimiter, decimal mark, header lines and stated units with which
most cells of the first lines are numbers, dates or times.  Columns and units are found by names
and sizes and reported in one note; fields of `CsvColumns` override them.  A unit in a name or
in a line of units is taken as stated; an unstated unit is guessed from the values.
`time_s`, `voltage_v`, `throttle` and `current_a` are taken first and need no note.

The csv module of the standard library reads the rows, in blocks whose columns are converted
to numbers at once.  Measured for 10^6 rows of 3 columns: 1.1 s of CPU, 3.2 s row by row;
`numpy.loadtxt` and the CSV reader of pyarrow take 0.3 s, but the first accepts no blank cell or
text, the second reports no line number and no row of another width, and is a dependency of 100 MB.
"""

from __future__ import annotations

from array import array
import codecs
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
import csv
from dataclasses import replace
from datetime import date
from functools import lru_cache, partial
import io
from itertools import chain, islice
import math
from pathlib import Path
import re
from typing import NamedTuple, TextIO

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.importers import log as logs
from ou_monitor.recordings.importers.formats import kind_of_foreign
from ou_monitor.recordings.importers.log import (
    ANY, CsvColumns, Log, one_flight, RawColumns, Request, Series)
from ou_monitor.records import (
    clock_unit, Defect, FloatArray, LEAST_STEP, LONGEST_STEP, Note, TIME_UNITS)
from ou_monitor.stream.files import open_regular
from ou_monitor.text import counted, plain_number, printable, some
from ou_monitor.timeline.line import hold, MOST_THROTTLE, WILD

TIME, VOLTAGE, THROTTLE, CURRENT = 'time_s', 'voltage_v', 'throttle', 'current_a'

# Words of loggers for a missing number.
MISSING = frozenset(('', 'nan', 'null', 'none', 'na', 'n/a', '#n/a', '-', '--', 'x'))
# Added to the error about a cell with a decimal comma.
_MARK = ': the decimal mark is a point'
# Maximum characters of a cell that are shown.
_LONGEST = 40
# Maximum characters of a line: a log of 1000 columns has lines of some 10 000.
MOST_OF_LINE = 65536
# Bytes, then lines, in which the format is detected; characters and rows read at once.
_HEAD, _HEAD_LINES, _CHUNK, _BLOCK = 65536, 200, 1 << 20, 8192

VOLTAGE_UNITS = {'V': 1.0, 'mV': 1e-3}
# Unit -> the summand that is subtracted from a value, and the factor; '1024' are the sticks of
# EdgeTX, -1024 to 1024, '65535' is the thrust of a Crazyflie.
THROTTLE_UNITS = {'1': (0.0, 1.0), '%': (0.0, 0.01), 'us': (1000.0, 1e-3),
                  '1024': (-1024.0, 1.0 / 2048.0), '65535': (0.0, 1.0 / 65535.0)}
DELIMITERS = {'tab': '\t', 'space': ' '}
NONE = 'none'

# Words of units, in small letters -> name among the units above, or of a current.
TIME_WORDS = {
    's': 's', 'sec': 's', 'secs': 's', 'second': 's', 'seconds': 's', 'sekunden': 's', 'ms': 'ms',
    'msec': 'ms', 'millis': 'ms', 'millisecond': 'ms', 'milliseconds': 'ms', 'us': 'us',
    'µs': 'us', 'μs': 'us', 'usec': 'us', 'micros': 'us', 'microseconds': 'us', 'ns': 'ns',
    'nsec': 'ns', 'nanoseconds': 'ns'}
VOLT_WORDS = {'v': 'V', 'volt': 'V', 'volts': 'V', 'vdc': 'V', 'mv': 'mV', 'millivolt': 'mV',
              'millivolts': 'mV'}
AMPERE_WORDS = {'a': 'A', 'amp': 'A', 'amps': 'A', 'ampere': 'A', 'amperes': 'A', 'ma': 'mA',
                'µa': 'uA', 'μa': 'uA', 'ua': 'uA'}
SHARE_WORDS = {'%': '%', 'percent': '%', 'pct': '%', 'prozent': '%'}
CURRENT_UNITS = {'A': 1.0, 'mA': 1e-3, 'uA': 1e-6}
# Other units, which a line of units holds beside those.
OTHER_WORDS = frozenset((
    '', '-', 'sequence', 'w', 'wh', 'ah', 'mah', 'hz', 'khz', 'rpm', '1/min', '°', 'deg', '°c',
    'degc', '°f', 'm', 'm/s', 'km/h', 'g', 'kg', 'n', 'nm', 'ohm', 'mohm'))
WORDS = {**TIME_WORDS, **VOLT_WORDS, **AMPERE_WORDS, **SHARE_WORDS}
# A quantity with one of these words at the end of its name: first in brackets.  Without unbounded
# repetitions after the quantity, so that long names cost no more than their length.
_WORD = f"({'|'.join(sorted(WORDS, key=len, reverse=True))})"
_WITH_UNIT = re.compile(
    rf'(.*?) ?[\[({{] ?{_WORD} ?[\])}}]|(.+?) in {_WORD}|(.[^/]*?|.+? ) ?/ ?{_WORD}|'
    rf'(.+?)[ _]{_WORD}')
# A number with groups of thousands and decimals, or with a unit.
_GROUPED = re.compile(r'[-+]?\d{1,3}(?:,\d{3})+\.\d+')
_AND_UNIT = re.compile(r'(\S*[\d.])\s*+([^\d\s.]{1,12}+(?: [AaDd][Cc])?)')
# Lines above the data that state the time between rows, or its inverse.
_NUMBER = r'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?'
# Possessive, so that lines of blanks cost no more than their length.
_INTERVAL = re.compile(
    r'(sampl(?:e|ing)[ _]*(?:interval|period|time)|t_?inc(?:rement)?|x[ _-]?inc(?:rement)?|'
    r'increment|delta[ _]?t|h_?resolution|sampl(?:e|ing)[ _]*(?:rate|frequency))\b'
    r'["\s]*+(?:[\[(](\w+)[\])])?+'
    rf'[\s"=:,;]*+(?:\w+:)?[\s"]*+({_NUMBER})\s*+(n|u|µ|m|k|M|G)?(s|sec|hz|sa/s)?',
    re.IGNORECASE)
_PREFIX = {'n': 1e-9, 'u': 1e-6, 'µ': 1e-6, 'm': 1e-3, 'k': 1e3, 'M': 1e6, 'G': 1e9, '': 1.0}
# Without a date hours may have gone by, up to 99; zones reach from -12:00 to +14:00.
CLOCK = re.compile(
    r'\s*+(?:(\d{4})[-/.](\d\d?)[-/.](\d\d?)|(\d\d?)([./-])(\d\d?)[./-](\d{4}|\d\d))?+[T ,]*+'
    r'(?:(\d\d?):([0-5]\d)(?::([0-5]\d|60)(?:[.,:](\d{1,9}))?)?)?+\s*+'
    r'(Z|UTC|[-+](?:0\d|1[0-4]):?[0-5]\d)?+\s*+([AaPp][Mm])?+\s*+')
CHANNEL = re.compile(r'(?:ch|channel|chan|kanal|analog)[_ ]?[0-9a-d]|a[0-3]', re.IGNORECASE)


class Form(NamedTuple):
    """The format of a file."""

    encoding: str
    delimiter: str
    comma: bool  # Whether the decimal mark is a comma
    skip: int  # Lines above the first row of numbers
    line: int  # Number of the line with the names; 0: there is none
    names: tuple[str, ...]  # Names of the columns as written, else 'column 1' and so on
    units: tuple[str, ...]  # As stated, '' if not stated
    width: int  # Cells of a row
    rows: tuple[tuple[str, ...], ...]  # The first rows
    start: float  # Start of numbered rows, s
    step: float  # From row to row, s; NaN: not stated
    stated: str  # Words that state the step


def form_of(path: Path, wanted: CsvColumns) -> Form:
    """Detect the format of a file from its first lines."""
    try:
        with open_regular(path) as file:
            head = file.read(_HEAD)
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror}') from error
    encoding = _encoding(path, head)
    text = head.decode(encoding, 'ignore')
    lines = io.StringIO(text, newline=None).readlines()[:_HEAD_LINES]
    if len(head) == _HEAD and len(lines) > 1 and len(lines) < _HEAD_LINES:
        lines.pop()
    if max(map(len, lines), default=0) >= min(MOST_OF_LINE, _HEAD - 3):
        raise InputError(f'{path}:1: the line has more than {MOST_OF_LINE} characters')
    if not any(line.strip() and not line.lstrip().startswith('#') for line in lines):
        raise InputError(f'{path} is empty: expected a header with {TIME},{VOLTAGE}[,{THROTTLE}]')
    given = None if wanted.delimiter is None else DELIMITERS.get(
        wanted.delimiter, wanted.delimiter)
    if given is not None and (len(given) != 1 or given in '"\r\n'):
        raise InputError(f"--delimiter: '{shown(given)}' is not one character that separates "
                         "cells, 'tab' or 'space'")
    best: tuple[float, Form] | None = None
    for delimiter in (',', ';', '\t', '|', ' ') if given is None else (given,):
        for mark in (wanted.decimal,) if wanted.decimal else ('.', ','):
            if mark == delimiter or best and delimiter == ' ' and best[1].width > 1:
                continue
            found = _score_form(lines, encoding, delimiter, mark == ',', wanted.skip_rows or 0)
            if found and (best is None or found[0] > best[0]):
                best = found
    if best is None:
        raise InputError(f'{path}: the header cannot be separated from the numbers: --delimiter, '
                         '--decimal and --skip-rows say how it is written')
    return best[1]


def _encoding(path: Path, head: bytes) -> str:
    for mark, name in ((codecs.BOM_UTF8, 'utf-8-sig'), (codecs.BOM_UTF16_LE, 'utf-16'),
                       (codecs.BOM_UTF16_BE, 'utf-16')):
        if head.startswith(mark):
            return name
    if head[1:2] == b'\0' != head[:1] and head[3:4] == b'\0':
        return 'utf-16-le'
    kind = kind_of_foreign(head, path)
    if b'\0' in head or kind.startswith('it is') and kind != 'it is text':
        raise InputError(f'{path} is not text: {kind}')
    try:
        codecs.getincrementaldecoder('utf-8')().decode(head)
    except UnicodeDecodeError:
        # Units such as µs and °C of older Windows programs.
        return 'cp1252'
    return 'utf-8'


def _score_form(lines: list[str], encoding: str, delimiter: str, comma: bool, skip: int,
                ) -> tuple[float, Form] | None:
    """Return how well a delimiter and a decimal mark fit, and the form; None if they do not."""
    rows: list[list[str]] = []
    for line in lines:
        plain = '' if line.lstrip().startswith('#') else line
        try:
            rows.append([cell.strip() for cell in next(iter(csv.reader(
                _prepared([plain], delimiter, comma), delimiter=delimiter,
                skipinitialspace=True)), [])])
        except csv.Error:
            rows.append([])
    # A quoted field may hold line breaks; the rest of it is not a row of the format.
    filled = [row for row in rows[skip:] if any(row)]
    widths = Counter(len(row) for row in filled[len(filled) // 3:])
    if not widths:
        return None
    width = max(widths, key=lambda size: (widths[size], size))
    full = [row for row in filled if len(row) == width]
    good = [[is_value(row[k]) for row in full if row[k]] for k in range(width)]
    places = [k for k, ok in enumerate(good) if ok and (ok[-1] or 2 * sum(ok) >= len(ok))]
    first = next((k for k, row in enumerate(rows) if k >= skip and len(row) >= min(width, 2)
                  and any(row[j:j + 1] and is_value(row[j]) for j in places)
                  and all(not row[j:j + 1] or is_value(row[j]) or row[j].lower() in MISSING
                          for j in places)), None)
    if first is not None:
        first = _after_names(rows, skip, first, width, places)
    else:
        # A header alone is a format without rows.
        first, places = len(rows), []
        if len(filled) != 1 or any(map(is_value, filled[0])):
            return None
    names, units, at = _header(rows, lines, first, width, delimiter, skip)
    cells = [cell for row in rows[first:] for cell in row if cell]
    fit = sum(map(is_value, cells)) / max(len(cells), 1)
    start, step, stated = _stated_step(lines[:max(first, 20)], rows[:first])
    first_rows = tuple(tuple(row) for row in rows[first:] if any(row))
    return fit * (1.0 if width > 1 else 0.4) + 0.01 * min(width, 20) / 20, Form(
        encoding, delimiter, comma, first, at, names, units, width, first_rows, start, step,
        stated)


def _after_names(rows: list[list[str]], skip: int, first: int, width: int, places: list[int],
                 ) -> int:
    """Return the first row below the names; `first` is the first without a bad cell."""
    full = [k for k in range(skip, first) if len(rows[k]) == width]
    numeric = [any(is_value(rows[k][place]) for place in places) for k in full]
    names = max((k for k, some in zip(full, numeric) if not some and all(
        rows[k][place] for place in places)), default=first)
    return next((k for k, some in zip(full, numeric)
                 if k > names and some and not _are_units(rows[k])), first)


def _prepared(lines: list[str], delimiter: str, comma: bool) -> list[str]:
    """Return lines with decimal points, and single blanks if blanks separate the cells."""
    if comma:
        # A point becomes a comma, so that a thousands separator is not taken for a decimal mark.
        lines = ['\0'.join(line.split('.')).replace(',', '.').replace('\0', ',')
                 for line in lines]
    return [' '.join(line.split()) + '\n' for line in lines] if delimiter == ' ' else lines


def number_of(cell: str) -> tuple[float, str]:
    """Return a number and the unit written behind it, in small letters; '': none."""
    try:
        return plain_number(cell), ''
    except ValueError:
        pass
    # Graphtec aligns numbers behind their sign.
    cell = re.sub(r'^([-+]) +', r'\1', cell.strip())
    found = _AND_UNIT.fullmatch(cell)
    text, unit = (found[1], found[2].lower()) if found else (cell, '')
    unit = unit.removesuffix(' dc').removesuffix(' ac')
    if unit and unit not in WORDS:
        raise ValueError(cell)
    return plain_number(text.replace(',', '') if _GROUPED.fullmatch(text) else text), unit


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
    return bool(cell[:1].isdigit() and (':' in cell or cell.count('-') > 1 or cell.count('.') > 1
                                        or cell.count('/') > 1 or cell.count(',') > 1)
                and CLOCK.fullmatch(swapped(cell)))


def swapped(cell: str) -> str:
    """Return a date whose points were taken for decimal marks, with points again."""
    return cell.replace(',', '.') if cell.count(',') > 1 else cell


def unit_of(name: str) -> tuple[str, str]:
    """Split a name into its quantity and the unit it states, in small letters; '': none."""
    text = ' '.join(name.strip().strip('\'"').split())
    if found := re.match(r'(millis|micros|ms|us|ns)(?![A-Za-z])', text):
        return text, found[1]
    found = _WITH_UNIT.fullmatch(text.lower()) or re.fullmatch(r'(CH\d+)(V|A)', text)
    if found is None or CHANNEL.fullmatch(text):
        return text, ''
    quantity, unit = (part for part in found.groups() if part is not None)
    return quantity, unit.lower()


def _header(rows: list[list[str]], lines: list[str], first: int, width: int, delimiter: str,
            skip: int) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Return names, units as stated, and the line of the names."""
    above = [k for k in range(skip, first) if any(rows[k])]
    names: list[str] = []
    units: list[str] = []
    line = 0
    if len(above) > 1 and (_are_units_of_channels(rows[above[-2]], rows[above[-1]]) or _are_units(
            rows[above[-1]]) and len(rows[above[-2]]) >= min(width, len(rows[above[-1]]))):
        units = [cell.strip('[](){} ').lower() for cell in rows[above.pop()]]
    if above:
        names, line = rows[above[-1]], above[-1] + 1
    else:
        # A header marked as a comment.
        for k in range(first - 1, skip - 1, -1):
            cells = next(iter(csv.reader([lines[k].lstrip('# \t')], delimiter=delimiter)), [])
            if len(cells) == width and width > 1:
                names, line = [cell.strip() for cell in cells], k + 1
                break
    names = names or [f'column {k + 1}' for k in range(width)]
    stated = [units[k] if k < len(units) and units[k] in WORDS else unit_of(name)[1]
              for k, name in enumerate(names)]
    # Else the unit behind the first number of the column.
    for k, unit in enumerate(stated):
        cell = next((row[k] for row in rows[first:] if k < len(row) and is_number(row[k])), '0')
        stated[k] = unit or number_of(cell)[1] or _unit_beside(names, rows[first:], k)
    return tuple(names), tuple(stated), line


def _unit_beside(names: Sequence[str], rows: list[list[str]], place: int) -> str:
    """Return the unit in the next column, such as Volt DC, if that is named so."""
    beside = names[place + 1].lower() if place + 1 < len(names) else ''
    words = rows[0][place + 1].lower().split() if beside in ('unit', 'units') and rows and len(
        rows[0]) > place + 1 else []
    return words[0] if words and words[0] in WORDS else ''


def _are_units_of_channels(names: list[str], row: list[str]) -> bool:
    """Return whether a row holds units below the names of channels, whatever else it holds."""
    below = [name for name, cell in zip(names, row)
             if cell.lower() in VOLT_WORDS or cell.lower() in AMPERE_WORDS]
    return len(names) == len(row) and bool(below) and all(map(CHANNEL.fullmatch, below))


def _are_units(row: list[str]) -> bool:
    """Return whether cells are units, in brackets, numbers, or blank, and some are units."""
    words = [cell.strip('[](){} ').lower() for cell in row]
    return any(word in WORDS for word in words) and all(
        word in WORDS or word in OTHER_WORDS or is_number(word) or cell[0] in '[({'
        for cell, word in zip(row, words))


def _stated_step(lines: list[str], above: list[list[str]]) -> tuple[float, float, str]:
    """Return start and step of numbered rows, s, and the words that state the step."""
    for names, row in zip(above, above[1:]):
        low = [name.lower() for name in names]
        if 'increment' in low and low.index('increment') < len(row) \
                and is_number(row[low.index('increment')]):
            at = low.index('start') if 'start' in low else -1
            start = float(row[at]) if at >= 0 and is_number(row[at]) else 0.0
            return start, float(row[low.index('increment')]), names[low.index('increment')]
    for line in lines:
        found = _INTERVAL.search(line)
        if found:
            words, unit, number, prefix, _ = found.groups()
            value = float(number) * _PREFIX[prefix or '']
            if unit and unit.lower() in TIME_WORDS:
                value *= TIME_UNITS[TIME_WORDS[unit.lower()]]
            if re.search('rate|frequency', words, re.IGNORECASE):
                value = 1.0 / value if value else math.nan
            if value > 0.0:
                return 0.0, value, ' '.join(words.split())
    return 0.0, math.nan, ''


def numbers(path: Path, form: Form, places: Sequence[int],
            texts: dict[int, list[str]] | None = None,
            left_out: list[str] | None = None) -> list[FloatArray]:
    """
    Return columns of numbers, NaN where blank; `texts` gets cells as written.

    A bad line is an InputError, unless `left_out` is there to get the errors of those left out.
    """
    parts: list[list[FloatArray]] = [[] for _ in places]
    last = max([*places, *(texts or {})])
    width = len(form.names)
    try:
        with io.TextIOWrapper(open_regular(path), form.encoding, newline=None) as file:
            for begin, block in _blocks(path, file, form, width):
                rows = block
                if len(rows[0]) <= last or len(rows[0]) > width or len(set(map(len, rows))) > 1:
                    rows = _fitting(path, rows, width, last, form, begin, left_out)
                columns: list[tuple[str, ...]] = list(zip(*rows))
                if not columns:
                    continue
                good = np.ones(len(rows), dtype=bool)
                for place, part in zip(places, parts):
                    where = partial(_place, path, form, place, begin, block)
                    part.append(_floats(columns[place], where, form.comma, form.units[place],
                                        good if left_out is not None else None, left_out))
                if not good.all():
                    for part in parts:
                        part[-1] = part[-1][good]
                for place, cells in (texts or {}).items():
                    cells += (cell for cell, fine in zip(columns[place], good) if fine)
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror}') from error
    except UnicodeError as error:
        raise InputError(f'{path} is not text throughout: {error}') from error
    return [np.concatenate(part) if part else np.empty(0) for part in parts]


def _blocks(path: Path, file: TextIO, form: Form, width: int,
            ) -> Iterator[tuple[int, list[list[str]]]]:
    """Yield rows, with the number of the line before the first of them."""
    lines = chain.from_iterable(_lines(path, file, form))
    for _ in islice(lines, form.skip):
        pass
    reader = csv.reader(lines, delimiter=form.delimiter, strict=True, skipinitialspace=True)
    while True:
        before = reader.line_num
        try:
            rows = list(islice(reader, _BLOCK))
        except csv.Error as error:
            raise InputError(f'{path}:{form.skip + reader.line_num}: {error}: close each quote '
                             'in its line') from error
        if not rows:
            return
        if reader.line_num - before > len(rows):
            for k, row in enumerate(rows):
                if any(line.count(form.delimiter) >= width - 1
                       for cell in row for line in cell.splitlines()[1:]):
                    raise InputError(
                        f'{path}:{_line(form.skip + before, rows, k)}: whole lines before this '
                        'one are within a quote: close each quote in its line')
        yield form.skip + before, rows


def _lines(path: Path, file: TextIO, form: Form) -> Iterator[list[str]]:
    """Yield lines, a chunk at a time; comments are blank."""
    rest, number = '', 0
    while text := file.read(_CHUNK):
        lines = io.StringIO(rest + text).readlines()
        rest = '' if lines[-1].endswith('\n') else lines.pop()
        if max(map(len, lines), default=0) > MOST_OF_LINE or len(rest) > MOST_OF_LINE:
            long = next((k for k, one in enumerate(lines) if len(one) > MOST_OF_LINE), len(lines))
            raise InputError(f'{path}:{number + long + 1}: the line has more than '
                             f'{MOST_OF_LINE} characters')
        number += len(lines)
        yield _without_comments(lines, form, text)
    if rest:
        yield _without_comments([rest], form, rest)


def _without_comments(lines: list[str], form: Form, text: str) -> list[str]:
    if '#' in text:
        lines = ['\n' if line.lstrip().startswith('#') else line for line in lines]
    return _prepared(lines, form.delimiter, form.comma)


def _line(before: int, rows: list[list[str]], k: int) -> int:
    """Return the number of the line where a row of a block ends."""
    return before + k + 1 + sum(cell.count('\n') for row in rows[:k + 1] for cell in row)


def _fitting(path: Path, rows: list[list[str]], width: int, last: int, form: Form, begin: int,
             left_out: list[str] | None) -> list[list[str]]:
    """Return the rows that are not blank, all of one width."""
    for k, row in enumerate(rows):
        wrong, blank = '', not any(cell.strip() for cell in row)
        if len(row) > width and any(cell.strip() for cell in row[width:]):
            wrong = (f'{path}:{_line(begin, rows, k)}: {len(row)} cells, and the header names '
                     f'{width} columns: mend the line; the decimal mark is a point')
        elif not blank and len(row) <= last:
            wrong = (f'{path}:{_line(begin, rows, k)}: the line ends before column '
                     f"'{form.names[last]}'")
        if wrong and left_out is None:
            raise InputError(wrong)
        if wrong or blank:
            # It stays in the block, so that line numbers can be counted.
            row.clear()
        if wrong and left_out is not None:
            left_out.append(wrong)
    return [row[:last + 1] for row in rows if row]


def _floats(cells: Sequence[str], where: Callable[[int], str], comma: bool, stated: str,
            good: npt.NDArray[np.bool_] | None, left_out: list[str] | None) -> FloatArray:
    """
    Return cells as numbers (where: words for the place of one; stated: their unit).

    A bad one is an InputError; if `good` is there, its line is marked, and `left_out` gets the
    error, once a line.
    """
    try:
        values = np.fromiter(map(float, cells), np.float64, len(cells))
        # As in `plain_number`.
        if '_' not in (text := ''.join(cells)) and text.isascii():
            return values
    except ValueError:
        pass
    found = array('d')
    for k, cell in enumerate(cells):
        try:
            value, unit = number_of(cell)
        except ValueError:
            value, unit = math.nan, ''
        if value == value and unit in ('', stated):
            found.append(value)
        elif cell.strip().lower() in MISSING:
            found.append(math.nan)
        else:
            if comma:
                cell = cell.replace('.', '\0').replace(',', '.').replace('\0', ',')
            mark = _MARK if cell.count(',') == 1 and not comma else (
                ': the decimal mark is a comma' * comma)
            wrong = f"{where(k)} holds '{shown(cell)}', not a number{mark}"
            if good is None or left_out is None:
                raise InputError(wrong)
            if good[k]:
                left_out.append(wrong)
            good[k] = False
            found.append(math.nan)
    return np.array(found, dtype=np.float64)


def _place(path: Path, form: Form, place: int, begin: int, rows: list[list[str]], k: int) -> str:
    """Return the place of a cell in words."""
    filled = [j for j, row in enumerate(rows) if row]
    at = _line(begin, rows, filled[k] if k < len(filled) else k)
    return f"{path}:{at}: column '{form.names[place]}'"


def shown(text: str) -> str:
    """Return the part that fits in one line: an open quote makes the rest of a file one cell."""
    shown = text.strip()
    return shown if len(shown) <= _LONGEST else shown[:_LONGEST] + '...'


# Maximum columns listed; loggers of autopilots write some hundred.
MOST_COLUMNS = 300
# Share of backward steps above which a column is not a time.
_BACK = 0.25
# A time without a unit has the coarsest unit with steps, and span, of at most these, s.
_USUAL_STEP, _USUAL_SPAN = 2.0, 43200.0
# Rows from which repeated stamps are the resolution of a clock.
_FEW_ROWS = 8
# A voltage without a unit above this is in mV: no craft's pack has that many volts.
_MOST_VOLTS = 1000.0


# Quantity -> patterns of the end of a column's name without its unit, the best first; small
# letters, other characters as '_'.  From the exports named in test_csv_exports.py.
_TIME_NAME, _INDEX_NAME = 'time', r'sequence|index|sample|no|n|x|point|'
_PATTERNS = {
    _TIME_NAME: (
        r'time_s',
        r'(?:__|_)?time|t|zeit|ms_today|millis|micros|elapsed(?:_time)?|x_axis|x_value|seconds?',
        r'timestamp|date_?time|datum_?(?:und_)?(?:uhr)?zeit|temps|tiempo|tempo|uhrzeit',
        r'.*(?:time|zeit|stamp).*', r'date|datum'),
    logs.VOLTAGE: (
        r'voltage_v',
        r'v_?bat(?:t|tery)?(?:_?latest|_?filtered|_?voltage|_?v)?|batt?(?:ery)?_?(?:v|volt|volts|'
        r'voltage)|pack_?voltage|(?:input|inp|bus|supply|rail|main|link)_?(?:v|volt|voltage)'
        r'|v_?bus|rxbt|vfas|voltage_?(?:battery|batt?|raw)|bat_?spannung|akku_?spannung|pm_vbat',
        r'u|v|volts?|voltage|spannung|tension|tensione|voltaje|[UVuv]\(.*\)',
        r'volt(?:age)?_?filtered(?:_v)?',
        r'(?!.*(?:axis|cell|temp|limit|zelle|motor|servo|rssi|phase|cpu|mcu|5v|sag)).*(?:volt|'
        r'spannung|vbat).*'),
    logs.THROTTLE: (
        r'throttle', r'thr(?:ottle)?_?(?:out|cmd|command|pct|percent)?|gas|duty(?:_cycle)?|tho?o|'
        r'tastgrad|tastverh.*',
        r'rc_?command_3', r'pwm|thrust|gas_?kanal|esc(?:_signal)?|'
        r'(?!.*(?:limit|trim|max|min)).*throttle.*'),
    logs.CURRENT: (
        r'current_a', r'amperage(?:_?latest)?|current_in|i_?bat(?:t|tery)?|'
        r'batt?(?:ery)?_?(?:i|curr(?:ent)?|amps?)|current_?batt?(?:ery)?|'
        r'(?:.*_)?(?:bus|input|supply|main|pack)_?current|i_?bus|curr',
        r'i|amps?|current|strom|courant|corriente'),
}
# Column that identifies a program -> units of its columns, not stated there.  Betaflight's
# blackbox explorer writes the numbers of the log: us, 0.01 V and 0.01 A from version 4.0 on.
_MAKERS: dict[str, dict[str, tuple[float, str]]] = {
    'loopIteration': {'time': (1e-6, 'us'), 'vbatLatest': (0.01, '0.01 V'),
                      'amperageLatest': (0.01, '0.01 A'), 'rcCommand[3]': (0.0, 'us')}}
# Fields of MAVLink's SYS_STATUS, BATTERY_STATUS and POWER_STATUS (common.xml): factor to V or A,
# unit, and the number that stands for unknown.  All are whole numbers.
_MAVLINK = {'voltage_battery': (1e-3, 'mV', 65535.0), 'voltages[0]': (1e-3, 'mV', 65535.0),
            'vcc': (1e-3, 'mV', 0.0), 'vservo': (1e-3, 'mV', 0.0),
            'current_battery': (1e-2, '10 mA', -1.0)}
_CELLS = re.compile(r'(.*voltages\[)0\]', re.IGNORECASE)
_DAY = 86400.0  # s


class _Column(NamedTuple):
    """A selected column."""

    place: tuple[int, ...]  # Its cells: two for a date and a time; none: rows are counted
    name: str
    unit: str  # As stated or given, '' if neither
    scale: float  # Factor if the maker's is known; 0: by the unit


class _Table(NamedTuple):
    """The data read from a file, in SI units."""

    form: Form
    t: FloatArray
    found: dict[str, tuple[_Column, FloatArray]]  # By quantity
    named: dict[str, FloatArray]  # Other requested columns, as written
    note: str  # How the file was read; '' if nothing was detected


def read_csv(path: Path, columns: CsvColumns | None = None, *, partial: bool = False,
             ) -> RawColumns:
    """Read the samples of a supply, unsorted and with NaN kept; partial: without bad lines."""
    left_out: list[str] | None = [] if partial else None
    table = _table(path, columns or CsvColumns(), needed=True, left_out=left_out)
    said = [table.note] if table.note else []
    if left_out:
        if len(left_out) > WILD * table.t.size:
            raise InputError(f'{left_out[0]} ({len(left_out)} such lines, too many to leave out)')
        first = left_out[0].removeprefix(str(path)).lstrip(': ')
        said.append(Note(
            f'{counted(len(left_out), "bad line")} left out, such as '
            f'{"line " * first[0].isdigit()}{first}.', Defect.DAMAGED_FILE))
    (column, volts), nothing = table.found[logs.VOLTAGE], np.full(table.t.shape, np.nan)
    name = printable(path.name)
    held = {quantity: values for quantity, (_, values) in table.found.items()}
    source = {'file': name, 'format': 'csv'}
    if column.name != VOLTAGE:
        source |= {quantity: printable(one.name) for quantity, (one, _) in table.found.items()
                   if quantity != logs.CURRENT}
    # A blank cell is not a message: the last command holds.
    return RawColumns(table.t, volts, hold(held.get(logs.THROTTLE, nothing)),
                      held.get(logs.CURRENT, nothing), name, source, tuple(said))


def read(path: Path, request: Request) -> Log:
    """Read the columns of a supply, and the requested ones."""
    one_flight(path, request)
    table = _table(path, request.columns or CsvColumns(), more=request.names)
    header, t = [name for name in table.form.names if name], table.t
    if not t.size:
        raise InputError(f'{path} holds a header and no line below it')
    taken = {column.name: quantity for quantity, (column, _) in table.found.items()}
    series = [Series(column.name, quantity, t, values, '1', 'column', 0)
              for quantity, (column, values) in table.found.items()]
    series += [Series(name, ANY, t, values, '1', 'column')
               for name, values in table.named.items() if name not in taken]
    notes: list[str] = [table.note] if table.note else []
    late = int(np.count_nonzero(np.diff(t) < 0.0))
    if late:
        notes.append(Note(f'{counted(late, "line")} came after a later stamp: sorted '
                          'by stamp.', Defect.UNORDERED))
        order = np.argsort(t, kind='stable')
        series = [replace(one, t=t[order], values=one.values[order]) for one in series]
    if request.everything:
        known = {one.name for one in series} | {
            table.form.names[place] for place in _time_of(path, table.form, CsvColumns()).place}
        others = [name for name in dict.fromkeys(header) if name not in known]
        if len(others) > MOST_COLUMNS:
            notes.append(f'{len(others) - MOST_COLUMNS} more columns are not listed.')
        # One pass each: a column of text stops only its own pass.
        for name in others[:MOST_COLUMNS]:
            try:
                values, = numbers(path, table.form, [table.form.names.index(name)])
            except InputError:
                notes.append(f"Column '{name}' does not hold numbers.")
                continue
            series.append(Series(name, ANY, t, values, '1', 'column'))
    return Log('csv', tuple(series), {}, tuple(notes), names=tuple(header))


def read_column(path: Path, name: str, columns: CsvColumns | None = None,
                ) -> tuple[FloatArray, FloatArray]:
    """Return the stamps, s, and one column of a CSV as written, NaN kept."""
    table = _table(path, columns or CsvColumns(), more=(name,))
    if name not in table.named:
        raise InputError(_absent(path, table.form, name))
    return table.t, table.named[name]


def holds_supply(path: Path) -> bool:
    """Return whether columns of time and voltage are found in the first lines of a file."""
    try:
        form = form_of(path, CsvColumns())
        return bool(_time_of(path, form, CsvColumns()) and _choose(form, logs.VOLTAGE))
    except InputError:
        return False


def _table(path: Path, wanted: CsvColumns, *, more: Iterable[str] = (), needed: bool = False,
           left_out: list[str] | None = None) -> _Table:
    """
    Read time, the columns of a supply, and others by name (needed: a voltage must be there).

    left_out as in `numbers`.
    """
    form = form_of(path, wanted)
    time = _time_of(path, form, wanted)
    found = _supply_of(path, form, wanted, time, needed)
    others = {name: form.names.index(name) for name in more if name in form.names}
    for name, place in others.items():
        if place in time.place:
            raise InputError(f"{path}: '{name}' is the time, not a signal")
    cells = _CELLS.fullmatch(found[logs.VOLTAGE].name) if logs.VOLTAGE in found else None
    places = [*(one.place[0] for one in found.values()), *others.values(), *(
        k for k, name in enumerate(form.names) if cells and re.fullmatch(
            re.escape(cells[1]) + r'[1-9]\]', name))]
    for place in (*time.place, *places):
        if form.names.count(form.names[place]) > 1:
            raise InputError(f"{path}:{form.line}: column '{form.names[place]}' is there twice")
    t, values = _read(path, form, time, places, left_out)
    volts = next(zip(found, values), (None, t))[1] if logs.VOLTAGE in found else t
    if time.place:
        _check_backwards(path, t, volts, time.name, found)
    t, words = _stamps(path, t, form, wanted, time)
    units = {'voltage': wanted.unit, 'throttle': wanted.throttle_unit}
    scaled, guesses = {}, {_TIME_NAME: words}
    for (quantity, column), column_values in zip(found.items(), values):
        if quantity == logs.VOLTAGE:
            # Cells of a pack; those that are not there are unknown.
            column_values = column_values + sum(np.where(np.isfinite(cell) & (
                cell != 65535.0), cell, 0.0) for cell in values[len(found) + len(others):])
        si, guesses[quantity] = _of_mavlink(
            column, column_values, wanted.unit, guesses.get(logs.VOLTAGE, '')) or _in_si(
                quantity, column, column_values, units.get(quantity), volts)
        scaled[quantity] = column, si
    note = _read_note(form, time, found, guesses, wanted.throttle is None)
    return _Table(form, t, scaled, dict(zip(others, values[len(found):])), note)


def _absent(path: Path, form: Form, name: str, option: str = '') -> str:
    """Return the error for a missing column."""
    hint = nearest(name, form.names) if form.line else (
        f'the first line holds numbers; add a header {TIME},{VOLTAGE}[,{THROTTLE}] or give '
        "'column 1'")
    return f"{path}:{form.line or form.skip + 1}: no column '{name}': {hint}" + option


def _column_place(path: Path, form: Form, name: str, option: str) -> int:
    if name not in form.names:
        raise InputError(_absent(path, form, name, f' ({option} names another)'))
    return form.names.index(name)


def _choose(form: Form, quantity: str, taken: Sequence[int] = ()) -> list[int]:
    """Return the candidate columns of a quantity, the first of the best pattern first."""
    plain = [re.sub(r'\W+', '_', unit_of(name)[0].strip().lower()).strip('_') if name else None
             for name in form.names[:form.width]]
    plain = [name if name is None else name or 'time' if form.names[k].strip('_% ') else name
             for k, name in enumerate(plain)]
    ends = [name if name is None else re.sub(r'\W+', '_', re.split(
        r'[/.](?=[^/.])', form.names[k].strip().lower())[-1]).strip('_')
        for k, name in enumerate(plain)]
    kinds: dict[str, dict[str, str]] = {
        _TIME_NAME: TIME_WORDS, logs.VOLTAGE: VOLT_WORDS, logs.CURRENT: AMPERE_WORDS}
    right = kinds.get(quantity, {})
    free = [k for k in range(len(plain)) if k not in taken and plain[k] is not None
            and _of_kind(form, k, quantity == _TIME_NAME)]
    for pattern in _PATTERNS[quantity]:
        for texts in ([form.names[k].strip() for k in range(len(plain))], plain, ends):
            found = [k for k in free if re.fullmatch(pattern, texts[k] or ' ')
                     and (not right or form.units[k] in right or not form.units[k])]
            if found:
                return found
    others = '|'.join(pattern for name, patterns in _PATTERNS.items() if name != quantity
                      for pattern in patterns[:3])
    found = [k for k in free if right and form.units[k] in right
             and not re.fullmatch(others, plain[k] or ' ')]
    if not found and quantity == logs.VOLTAGE:
        found = [k for k in free if CHANNEL.fullmatch(plain[k] or ' ')]
    return found


def _of_kind(form: Form, place: int, clock: bool) -> bool:
    """Return whether the first cells of a column are numbers (clock: or dates or times)."""
    cells = [row[place] for row in form.rows if place < len(row) and row[place]
             and row[place].lower() not in MISSING]
    return not cells or any(is_value(cell) if clock else is_number(cell) for cell in cells)


def _time_of(path: Path, form: Form, wanted: CsvColumns) -> _Column:
    """Return the column of the time, or that rows are counted."""
    if wanted.sample_interval is not None:
        return _Column((), '--sample-interval', 's', wanted.sample_interval)
    if wanted.time is not None:
        return _unit_column(form, _column_place(path, form, wanted.time, '--time-column'),
                            wanted.time_unit)
    numbered = bool(form.rows) and form.width > 1 and re.fullmatch(
        _INDEX_NAME, unit_of(form.names[0])[0].strip('# ').lower()) is not None
    found = [] if numbered and math.isfinite(form.step) else (
        _choose(form, _TIME_NAME) or _clock_columns(form))
    if found:
        first = _finest(form, found[0])
        beside = [k for k in range(min(form.width, len(form.names))) if k != first and any(
            k < len(row) and _has_day(row[k]) and ':' not in row[k] for row in form.rows[:3])]
        cells = [row[first] for row in form.rows if first < len(row)]
        if (parts := _parts_of_second(form, first)) is not None:
            return _Column((first, parts), f'{form.names[first]}, {form.names[parts]}', 's', 0.0)
        if beside and cells and ':' in cells[0] and not _has_day(cells[0]):
            return _Column((beside[0], first),
                           f'{form.names[beside[0]]}, {form.names[first]}', 's', 0.0)
        return _unit_column(form, first, wanted.time_unit)
    filled = _nameless_columns(form)
    if len(filled) > 1 and _rises(form, filled[0]):
        return _unit_column(form, filled[0], wanted.time_unit)
    if not math.isfinite(form.step):
        raise InputError(_absent(
            path, form, TIME, ' (--time-column or --sample-interval)'))
    return _Column((), form.stated, 's', form.step)


def _finest(form: Form, first: int) -> int:
    """Return a time that tells the rows apart if the chosen one, in whole seconds, does not."""
    named = [k for k in range(min(form.width, len(form.names)))
             if re.search('time|zeit', form.names[k].lower()) and not re.search(
                 'step|lap|interval', form.names[k].lower()) and _of_kind(form, k, True)]
    return first if _tells_apart(form, first) else next(
        (k for k in named if _tells_apart(form, k) and _rises(form, k)), first)


def _tells_apart(form: Form, place: int) -> bool:
    """Return whether most of the first rows differ in a column."""
    cells = [row[place] for row in form.rows if place < len(row)]
    return 2 * len(set(cells)) > len(cells) or len(cells) < _FEW_ROWS


def _parts_of_second(form: Form, clock: int) -> int | None:
    """Return the column of milliseconds beside a clock in whole seconds, if there is one."""
    cells = [row[clock] for row in form.rows if clock < len(row)]
    if _tells_apart(form, clock) or not all(re.search(r':\d\d:\d\d$', cell) for cell in cells):
        return None
    return next((k for k, name in enumerate(form.names[:form.width])
                 if name.strip().lower() in ('ms', 'millis', 'milliseconds') and all(
                     k < len(row) and re.fullmatch(r'\d{1,3}', row[k]) for row in form.rows)),
                None)


def _nameless_columns(form: Form) -> list[int]:
    """Return the columns without a name that hold a number in each of the first rows."""
    return [] if form.line else [k for k in range(form.width) if form.rows and all(
        k < len(row) and is_value(row[k]) for row in form.rows)]


def _clock_columns(form: Form) -> list[int]:
    """Return the columns that hold a time of the day in each of the first rows."""
    return [k for k in range(min(form.width, len(form.names))) if form.rows and all(
        k < len(row) and ':' in row[k] and is_clock(row[k]) for row in form.rows)]


def _rises(form: Form, place: int) -> bool:
    """Return whether a column without a name never falls in the first rows."""
    cells = [row[place] for row in form.rows]
    return not all(map(is_number, cells)) or bool(
        (np.diff([number_of(cell)[0] for cell in cells]) >= 0.0).all())


def _has_day(cell: str) -> bool:
    found = CLOCK.fullmatch(swapped(cell)) if is_clock(cell) else None
    return found is not None and (found[1] or found[4]) is not None


def _unit_column(form: Form, place: int, unit: str | None) -> _Column:
    name = form.names[place]
    maker = next((units for column, units in _MAKERS.items() if column in form.names), {})
    if unit is None and name in maker:
        return _Column((place,), name, maker[name][1], maker[name][0])
    return _Column((place,), name, unit or form.units[place], 0.0)


def _supply_of(path: Path, form: Form, wanted: CsvColumns, time: _Column, needed: bool,
               ) -> dict[str, _Column]:
    """Return the columns of voltage, throttle and current that exist."""
    names = {logs.VOLTAGE: (wanted.voltage, '--voltage-column', wanted.unit),
             logs.THROTTLE: (wanted.throttle, '--throttle-column', wanted.throttle_unit),
             logs.CURRENT: (wanted.current, '--current-column', None)}
    given = [form.names.index(name) for name in (
        wanted.time, *(name for name, *_ in names.values())) if name in form.names]
    taken = [*time.place, *given]
    found: dict[str, _Column] = {}
    for quantity, (name, option, unit) in names.items():
        if name == NONE and quantity != logs.VOLTAGE:
            continue
        if name is not None:
            found[quantity] = _unit_column(form, _column_place(path, form, name, option), unit)
            continue
        places = _choose(form, quantity, taken)
        if not places and quantity == logs.VOLTAGE:
            # It may be what another option took, which is refused below.
            places = [k for k in _choose(form, quantity) if k in given]
        if not places and quantity == logs.VOLTAGE:
            rest = [k for k in _nameless_columns(form) if k not in taken]
            places = rest if len(rest) == 1 else []
        if places:
            found[quantity] = _unit_column(form, places[0], unit)
            taken.append(places[0])
    owners = dict.fromkeys(time.place, 'time')
    for quantity, column in found.items():
        place = column.place[0]
        if place in owners:
            raise InputError(f"{path}: column '{column.name}' cannot be both {owners[place]} and "
                             f'{quantity}: name another with --{quantity}-column or '
                             f'--{owners[place]}-column')
        owners[place] = quantity
    if needed and logs.VOLTAGE not in found:
        raise InputError(_absent(path, form, VOLTAGE, ' (--voltage-column)'))
    return found


def _read(path: Path, form: Form, time: _Column, places: list[int],
          left_out: list[str] | None = None) -> tuple[FloatArray, list[FloatArray]]:
    """Return the time as written, days and clocks in s, and columns of numbers."""
    sample = [row[time.place[0]] for row in form.rows
              if time.place and time.place[0] < len(row) and row[time.place[0]]]
    if not time.place:
        if not LEAST_STEP <= time.scale <= LONGEST_STEP:
            raise InputError(f"{path}: '{time.name}' says rows {time.scale:g} s apart, outside "
                             f'{LEAST_STEP:g} to {LONGEST_STEP:g} s')
        values = numbers(path, form, places or [0], left_out=left_out)
        return time.scale * np.arange(float(values[0].size)) + form.start * (
            time.name == form.stated), values
    if sample and not is_number(sample[0]) and is_clock(sample[0]):
        clocks: list[list[str]] = [[] for _ in time.place]
        values = numbers(path, form, places, dict(zip(time.place, clocks)), left_out)
        cells = clocks[0]
        if len(clocks) > 1 and all(map(str.isdigit, clocks[1])):
            cells = [f'{clock}.{part:0>3}' for clock, part in zip(*clocks)]
        elif len(clocks) > 1:
            cells = [' '.join(pair) for pair in zip(*clocks)]
        return _clock(path, [swapped(cell) for cell in cells], time.name, left_out), values
    t, *values = numbers(path, form, [time.place[0], *places], left_out=left_out)
    return t, values


@lru_cache(maxsize=64)
def _days(year: int, month: int, day: int) -> int:
    return date(year + (2000 if year < 100 else 0), month, day).toordinal() - 719163


def _clock(path: Path, cells: list[str], name: str, left_out: list[str] | None) -> FloatArray:
    """Return dates and times in s since 1970; without a date since the first midnight."""
    found = [None if not cell.strip() else CLOCK.fullmatch(cell) for cell in cells]
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
    # In 04/05 either may be the day: choose the shorter recording.
    t = either[0] if spans[0] <= spans[1] else either[1]
    if any(one is not None and not (one[1] or one[4]) for one in found):
        t = t + _DAY * np.concatenate(([0.0], np.cumsum(np.diff(t) < -0.5 * _DAY)))
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


def _check_backwards(path: Path, t: FloatArray, voltage: FloatArray, name: str,
                     found: dict[str, _Column]) -> None:
    """Refuse a time that is the voltage."""
    step = np.diff(t)
    step = step[np.isfinite(step)]
    if step.size and logs.VOLTAGE in found and float(np.mean(step < 0.0)) > _BACK and (
            np.diff(voltage) > 0.0).all():
        raise InputError(f"{path}: '{name}' runs backwards, and '{found[logs.VOLTAGE].name}' only "
                         'ever rises: are the two columns swapped?')


def _stamps(path: Path, t: FloatArray, form: Form, wanted: CsvColumns, time: _Column,
            ) -> tuple[FloatArray, str]:
    """Return the time in s, and its unit in words."""
    if not time.place:
        return t, f'{time.scale:g} s'
    if len(time.place) > 1 or form.rows and time.place[0] < len(form.rows[0]) \
            and not is_number(form.rows[0][time.place[0]]) \
            and is_clock(form.rows[0][time.place[0]]):
        return t, 'dates and times'
    if time.scale:
        return t * time.scale, time.unit
    known = t[np.isfinite(t)]
    usual = float(np.median(np.abs(np.diff(known)))) if known.size > 1 else 0.0
    if time.unit:
        unit, words = time.unit if wanted.time_unit else TIME_WORDS[time.unit], ''
    else:
        # Clocks that count from 1970 show their unit by their size.
        size = float(np.median(np.abs(known))) if known.size else 0.0
        span = float(np.ptp(known)) if known.size else 0.0
        unit = clock_unit(size)
        if not unit or usual * TIME_UNITS[unit] > LONGEST_STEP:
            unit = next((name for name, scale in TIME_UNITS.items() if (
                usual * scale <= _USUAL_STEP and span * scale <= _USUAL_SPAN)), 's')
        words = '' if unit == 's' else ', a guess: --time-unit'
    t = t * TIME_UNITS[unit]
    if usual * TIME_UNITS[unit] > LONGEST_STEP:
        raise InputError(f'{path}: the samples are {usual * TIME_UNITS[unit]:g} s apart by '
                         f"'{time.name}': is it in ms, us or ns? --time-unit says so")
    return t, unit + words


def _of_mavlink(column: _Column, values: FloatArray, given: str | None, beside: str,
                ) -> tuple[FloatArray, str] | None:
    """
    Return values of a field of MAVLink in V or A, and their unit; None if it is another.

    given: the unit of the voltage; beside: the words of the voltage's unit, for a current.
    """
    name = re.split(r'[./:]', column.name.strip().lower())[-1]
    if name not in _MAVLINK or given == 'V' or column.unit and given is None or beside == 'V':
        return None
    scale, unit, unknown = _MAVLINK[name]
    known = values[np.isfinite(values) & (values != unknown)]
    # A tool that has converted them writes fractions; a supply has volts.
    if (known != np.rint(known)).any() or unit == 'mV' and not (
            known.size and float(np.median(known)) >= _MOST_VOLTS):
        return None
    return np.where(values == unknown, np.nan, values * scale), (
        f'{unit} by MAVLink, {unknown:g} is unknown: --unit V for V and A')


def _in_si(quantity: str, column: _Column, values: FloatArray, given: str | None,
           volts: FloatArray) -> tuple[FloatArray, str]:
    """Return values in V, 0..1 or A, and their unit in words."""
    known = np.abs(values[np.isfinite(values)])
    if quantity == logs.THROTTLE:
        unit = given or SHARE_WORDS.get(column.unit) or ('us' if column.unit == 'us' else None)
        words = ''
        if unit is None:
            unit = _throttle_unit(values[np.isfinite(values)], volts)
            words = '' if unit == '1' else ', a guess: --throttle-unit'
        zero, scale = THROTTLE_UNITS[unit]
        return (values - zero) * scale if unit != '1' else values, (
            '0..1' if unit == '1' else unit) + words
    if column.scale:
        return values * column.scale, column.unit
    if quantity == logs.CURRENT:
        unit = AMPERE_WORDS.get(column.unit, 'A')
        return values * CURRENT_UNITS[unit] if unit != 'A' else values, unit
    unit, words = given or VOLT_WORDS.get(column.unit) or '', ''
    if not unit:
        wild = known.size > 0 and float(np.median(known)) > _MOST_VOLTS
        unit, words = ('mV', ', a guess: --unit') if wild else ('V', '')
    return values * VOLTAGE_UNITS[unit] if unit != 'V' else values, unit + words


def _throttle_unit(values: FloatArray, volts: FloatArray) -> str:
    """Return the unit suggested by the sizes of a throttle; '1' by default."""
    known = np.abs(values)
    beyond = known[known > MOST_THROTTLE]
    # With a voltage within 0 to 1 it may be the voltage: `check_throttle` reports it.
    if beyond.size <= WILD * known.size or float(np.nanmax(np.abs(volts), initial=0.0)) <= 1.0:
        return '1'
    low, high = (float(np.quantile(known, q)) for q in (WILD, 1.0 - 0.1 * WILD))
    if high <= 110.0:
        return '%'
    if low >= 800.0 and high <= 2200.0:
        return 'us'
    if high <= 1024.0 and float(np.mean(values < -MOST_THROTTLE)) > WILD:
        return '1024'
    # Other counts end at 10 000 at most, and 16 bits hold whole numbers.
    return '65535' if 10000.0 < high <= 65535.0 and values.min() >= 0.0 and (
        values == np.rint(values)).all() else '1'


def _read_note(form: Form, time: _Column, found: dict[str, _Column], units: dict[str, str],
               search: bool) -> str:
    """Return in one line how a file was read; '' if nothing was detected."""
    if time.name == TIME and not form.comma and form.encoding in ('utf-8', 'utf-8-sig') and all(
            column.name == {logs.VOLTAGE: VOLTAGE, logs.THROTTLE: THROTTLE,
                            logs.CURRENT: CURRENT}[quantity] for quantity, column in found.items()
    ) and not any('guess' in words for words in units.values()):
        return ''
    names = {',': 'commas', ';': 'semicolons', '\t': 'tabs', ' ': 'blanks'}
    between = names.get(form.delimiter, f"'{form.delimiter}'")
    parts = [f"time from '{time.name}' ({units[_TIME_NAME]})"]
    parts += [f"{quantity} from '{column.name}' ({units[quantity]})"
              for quantity, column in found.items()]
    others = [form.names[k] for k in _choose(form, logs.VOLTAGE, time.place)[1:3]
              if form.names[k] not in {column.name for column in found.values()}]
    also = f'; also there: {", ".join(others)} (--voltage-column)' if others else ''
    if search and logs.THROTTLE not in found:
        # A throttle by another name is not lost in silence.
        used = {*time.place, *(column.place[0] for column in found.values())}
        rest = [name for k, name in enumerate(form.names[:form.width]) if form.line
                and k not in used and name not in others
                and not re.fullmatch(_INDEX_NAME, name.strip('# ').lower())
                and all(k < len(row) and is_number(row[k]) for row in form.rows[:2])]
        also += f'; not read: {some(rest, 3)} (--throttle-column)' if rest else ''
    return (f"Read {', '.join(parts)}{also}; cells between {between}, decimal "
            f"{'comma' if form.comma else 'point'}"
            + (f', {form.encoding}' if form.encoding not in ('utf-8', 'utf-8-sig') else '')
            + f', numbers from line {form.skip + 1} on.')
