"""
Detect the format of a table of text, such as a CSV, and read its columns of numbers.

The format (encoding, delimiter, decimal mark, header lines, stated units) is detected in the first
64 kB: it is the one by which most cells are numbers, dates or times.

The csv module of the standard library reads the rows, in blocks whose columns are converted to
numbers at once. This takes 1.1 s of CPU for 10^6 rows of 3 columns; row by row it would take 3.2
s. `numpy.loadtxt` and the CSV reader of pyarrow take 0.3 s, but `loadtxt` rejects blank cells and
text, and pyarrow rejects rows of another width, gives no line numbers, and takes 100 MB.
"""

from __future__ import annotations

from array import array
import codecs
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
import csv
import io
from itertools import accumulate, chain, islice
import math
from pathlib import Path
import re
from typing import NamedTuple, TextIO

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.csv_cells import (
    AMPERE_WORDS, BadLine, is_clock, is_missing, is_number, is_value, number_of, OTHER_WORDS,
    SCALES, shown, TIME_WORDS, unit_of, unit_word, VOLT_WORDS, WORDS)
from ou_monitor.recordings.importers.formats import Foreign, is_text, kind_of_foreign
from ou_monitor.recordings.importers.log import CsvColumns
from ou_monitor.records import FloatArray
from ou_monitor.stream.files import opened

TIME, VOLTAGE, THROTTLE = 'time_s', 'voltage_v', 'throttle'

# Endings of errors: about a cell with a decimal comma; about a single bad line.
_MARK = ': the decimal mark is a point (with --decimal . a comma separates thousands)'
_PARTIAL = '; --partial leaves bad lines out'
# Maximum characters of a line: a log of 1000 columns has lines of about 10 000.
MOST_OF_LINE = 65536
# Bytes and lines in which the format is detected; characters and rows that are read at once.
_HEAD, _HEAD_LINES, _CHUNK, _BLOCK = 65536, 200, 1 << 20, 8192
# A byte that does not occur in text.
_DAMAGE = re.compile(rb'[^\t\n\r\f -\xff]')
# Consecutive rows of numbers that mark the beginning of the data.
_IN_A_ROW = 8
# Minimum leap of the first column after a row of column numbers, as a multiple of later steps.
_LEAP = 10.0

# Columns of `ros2 topic echo --csv` of a sensor_msgs/BatteryState, up to its cells.
_BATTERY_STATE = ('sec nanosec frame_id voltage temperature current charge capacity '
                  'design_capacity percentage status health technology present').split()

# First characters of a comment line.
COMMENTS = ('#', '%')
DELIMITERS = {'tab': '\t', 'space': ' '}
# Label before the names of channels.
_OF_NAMES = re.compile('name|trace|label|channel', re.IGNORECASE)
_NAMES = re.compile(r'[^\s\[(]+(?: ?[\[(][^\])]*[\])])?')
# A number with points or commas between thousands, which is not part of a date or a clock.
_OF_POINT, _OF_COMMA = (re.compile(rf'(?<![\d.,:])[1-9]\d{{,2}}(?:{mark}\d{{3}})+(?![\d{mark}:])')
                        for mark in (r'\.', ','))
_OF_QUOTED = re.compile(r'"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d+)?[^",\d]*"')
# A number that shows that the decimal mark is a point.
_OF_PLAIN = re.compile(r'(?:^|,)[-+]?\d+\.(?!\d{3}(?!\d))\d+(?=,|$)', re.MULTILINE)
# A number with both marks shows which of them separates thousands.
_BOTH_MARKS = {'.': r'\d{1,3}(?:,\d{3})+\.\d+', ',': r'\d{1,3}(?:\.\d{3})+,\d+'}
# A blank or ' between thousands, as spreadsheets write it, which does not separate cells.
_BLANK = re.compile("(?<=\\d)[\xa0\u2007\u2009\u202f'\u2019](?=\\d{3}(?!\\d))")
# A number whose decimal comma is within quotes, and does not separate thousands.
_QUOTED = re.compile(r'"[-+]?\d+,(?!\d{3}(?!\d))\d+[^",]*"')
# Lines above the data that state the time between rows, or its inverse.
_NUMBER = r'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?'
# Possessive quantifiers: matching takes time proportional to the length of a line of blanks.
_INTERVAL = re.compile(
    r'((?:sampl(?:e|ing)|time)[ _]*(?:interval|period)|sampl(?:e|ing)[ _]*time|'
    r't_?inc(?:rement)?|x[ _-]?inc(?:rement)?|increment|delta[ _]?[tx]|h_?resolution|'
    rf'clock(?=\W*{_NUMBER}[nuµm]?s\b)|sampl(?:e|ing)[ _]*(?:rate|frequency))\b'
    r'["\s]*+(?:[\[(](\w+)[\])])?+'
    rf'[\s"=:,;]*+(?:\w+:)?[\s"]*+({_NUMBER})\s*+([a-zµμ]*+)(/?)',
    re.IGNORECASE)
# A prefix of units, in any letter case except for m and M.
_PREFIX = {'n': 1e-9, 'u': 1e-6, 'μ': 1e-6, 'm': 1e-3, 'k': 1e3, 'M': 1e6, 'g': 1e9, '': 1.0}


class Form(NamedTuple):
    """The format of a file."""

    encoding: str
    delimiter: str
    comma: bool  # Whether the decimal mark is a comma
    mark: str  # Decimal mark if the other one is known to separate thousands, else ''
    skip: int  # Lines above the first row of numbers
    line: int  # Number of the line with the names; 0: there is none
    above: str  # The lines above the rows
    names: tuple[str, ...]  # Names of the columns as written, else 'column 1' and so on
    units: tuple[str, ...]  # As stated, '' if not stated
    width: int  # Cells of a row
    rows: tuple[tuple[str, ...], ...]  # The first rows
    step: float  # From row to row, s; NaN: not stated
    stated: str  # Words that state the step

    def cells(self, place: int) -> list[str]:
        """Return the cells of a column in the first rows that are not blank."""
        return [row[place] for row in self.rows if place < len(row) and row[place]]


def form_of(path: Path, wanted: CsvColumns, *, header: bool = False) -> Form:
    """Detect the format from the first lines (header: the first one alone, up to any damage)."""
    with opened(path) as file:
        head = file.read(_HEAD)
    if header:
        head = _DAMAGE.split(head.split(b'\n')[0])[0]
    encoding = _encoding(path, head)
    text = head.decode(encoding, 'ignore')
    lines = io.StringIO(text, newline=None).readlines()[:_HEAD_LINES]
    if len(head) == _HEAD and 1 < len(lines) < _HEAD_LINES:
        lines.pop()
    if max(map(len, lines), default=0) >= min(MOST_OF_LINE, _HEAD - 3):
        raise InputError(f'{path}:1: the line has more than {MOST_OF_LINE} characters')
    if not any(line.strip() and not line.lstrip().startswith(COMMENTS) for line in lines):
        raise InputError(f'{path} is empty: expected a header with {TIME},{VOLTAGE}[,{THROTTLE}]')
    given = DELIMITERS.get(wanted.delimiter or '', wanted.delimiter)
    if given is not None and (len(given) != 1 or given in '"\r\n'):
        raise InputError(f"--delimiter: '{shown(given)}' is not one character that separates "
                         "cells, 'tab' or 'space'")
    best: tuple[float, Form] | None = None
    for delimiter in (',', ';', '\t', '|', ' ') if given is None else (given,):
        known = wanted.decimal or ''
        if not known and delimiter == ',':
            known = next((mark for mark, both in _BOTH_MARKS.items() if re.search(
                f'"[-+]?{both}[^",]*"', text)), '') or '.' * bool(
                    _OF_QUOTED.search(text) and _OF_PLAIN.search(text))
        # Where commas do not separate cells, the other mark may separate thousands.
        for mark, known in [(mark, known) for mark in known or '.,'] + [
                (mark, mark) for mark in ',.' if not known and delimiter != ',']:
            if mark == delimiter and not (known or _QUOTED.search(text)) or (
                    best and delimiter == ' ' and best[1].width > 1):
                continue
            found = _score_form(lines, encoding, delimiter, mark == ',', known, wanted.skip_rows)
            if found and (best is None or found[0] > best[0]):
                best = found
    if best is None and not any(is_number(cell) for cell in re.split(r'[,;|"\s]+', text) if cell):
        raise InputError(f'{path} holds no numbers: expected rows of time and voltage')
    if best is None:
        raise InputError(f'{path}: no table with a header was found: if there is one, '
                         '--delimiter, --decimal and --skip-rows say how it is written')
    return best[1]


def _encoding(path: Path, head: bytes) -> str:
    for mark, name in ((codecs.BOM_UTF8, 'utf-8-sig'), (codecs.BOM_UTF16_LE, 'utf-16'),
                       (codecs.BOM_UTF16_BE, 'utf-16')):
        if head.startswith(mark):
            return name
    if head[1:2] == b'\0' != head[:1] and head[3:4] == b'\0':
        return 'utf-16-le'
    kind, words = kind_of_foreign(head, path)
    # A logger that lost power leaves NUL bytes at the end; `numbers` names their line.
    nul = b'\0' in head and not (b'\n' in head and is_text(head.rstrip(b'\0')))
    damage = _DAMAGE.search(head)
    if nul and damage and kind is Foreign.UNKNOWN and is_text(head[:damage.start()][:8]) and (
            damage.start() >= 8):
        line = head.count(b'\n', 0, damage.start()) + 1
        raise InputError(f'{path}:{line}: the byte 0x{damage[0].hex()} is not text: the file is '
                         'damaged from there on')
    if nul or kind is Foreign.NAMED:
        raise InputError(f'{path} is not a table: {words}')
    # A Chinese character takes two bytes; the µ and ° of an older Windows program take one.  Some
    # bytes of Japanese names do not exist in cp1252; Latin-1 has all bytes.
    runs = [len(run) for run in re.findall(rb'[\x80-\xff]+', head)]
    chinese = max(runs, default=0) >= 4 and not any(run % 2 for run in runs)
    for name in ('utf-8', *(['gb18030'] if chinese else []), 'cp1252', 'cp932'):
        with suppress(UnicodeDecodeError):
            codecs.getincrementaldecoder(name)().decode(head)
            return name
    return 'latin-1'


def _score_form(lines: list[str], encoding: str, delimiter: str, comma: bool, mark: str,
                skip_rows: int | None) -> tuple[float, Form] | None:
    """Return how well a delimiter and a decimal mark fit, and the form; None if they do not."""
    skip = skip_rows or 0
    rows = _split(lines, delimiter, comma, mark)
    # A quoted field may hold line breaks; the rest of it is not a row of the format.
    filled = [row for row in rows[skip:] if any(row)]
    widths = Counter(len(row) for row in filled[len(filled) // 3:])
    if not widths:
        return None
    width = max(widths, key=lambda size: (widths[size], size))
    full = [row for row in filled if len(row) == width]
    good = [[is_value(row[k]) for row in full if row[k]] for k in range(width)]
    places = [k for k, ok in enumerate(good) if ok and (ok[-1] or 2 * sum(ok) >= len(ok))]
    first = _first_of_data(rows, skip, width, places)
    if first is None:
        # No rows: accept a header alone.
        first = len(rows)
        if len(filled) != 1 or any(map(is_value, filled[0])):
            return None
    names, words, at = _header(rows, lines, first, width, delimiter, skip)
    if not at and any(
            len(row) > 2 and all(row) and not any(map(is_value, row))
            for row in rows[skip:first]):
        # The names do not fit the columns: rows have lost or gained cells.
        return None
    first += _numbering(rows[first:]) if at else 0
    cells = [cell for row in rows[first:] for cell in row if cell]
    fit = sum(map(is_value, cells)) / max(len(cells), 1)
    above = lines[:max(first, 20)]
    step, stated = _stated_step(list(map(_with_point, above)) if comma else above, rows[:first])
    first_rows = tuple(tuple(row) for row in rows[first:] if any(row))
    return fit * (1.0 if width > 1 else 0.4) + 0.01 * min(width, 20) / 20, Form(
        encoding, delimiter, comma, mark, first, at, ''.join(lines[:first]), tuple(names),
        _units_of(names, words, rows, first, at), width, first_rows, step, stated)


def _split(lines: list[str], delimiter: str, comma: bool, mark: str) -> list[list[str]]:
    # Line by line, so that an open quote takes no other line with it.
    rows = [[cell.strip() for cell in next(csv.reader(
        _prepared([line], delimiter, comma, mark), delimiter=delimiter, skipinitialspace=True),
        [])] for line in lines]
    return [list(map(_with_point, row)) for row in rows] if comma and delimiter == ',' else rows


def _trimmed(row: list[str]) -> list[str]:
    return row[:max((k + 1 for k, cell in enumerate(row) if cell), default=0)]


def _first_of_data(rows: list[list[str]], skip: int, width: int, places: list[int]) -> int | None:
    """Return the first row of numbers (places: their columns); None: there is none."""
    numeric = {k: any(row[j:j + 1] and is_value(row[j]) for j in places)
               for k, row in enumerate(rows)
               if k >= skip and any(row) and len(row) >= min(width, 2)}
    fits = [k for k, found in numeric.items() if found and all(
        not rows[k][j:j + 1] or is_value(rows[k][j]) or is_missing(rows[k][j]) for j in places)]
    if not fits:
        return None
    # A number may stand above the data: more rows with numbers must follow it.
    first = next((k for k in fits if all(numeric[j] for j in islice(
        (j for j in numeric if j >= k), _IN_A_ROW))), fits[0])
    return _after_names(rows, skip, first, width, places)


def _after_names(rows: list[list[str]], skip: int, first: int, width: int, places: list[int],
                 ) -> int:
    """Return the first row of data below the names (first: the first row without a bad cell)."""
    filled = [k for k in range(skip, first) if any(rows[k])]
    numeric = [k for k in filled if len(rows[k]) == width and any(
        is_value(rows[k][place]) for place in places)]
    names = max(set(filled).difference(numeric), default=first)
    if names == first or len(rows[names]) != width or not all(rows[names][k] for k in places):
        return first
    return next((k for k in numeric if k > names and not _are_units(rows[k])), first)


def _numbering(rows: list[list[str]]) -> int:
    """Return the number of rows to skip if the first one numbers the columns, else 0."""
    # Such a row is 0, 1, 2 ... or 1, 2, 3 ...; below it is a blank line, or the first column goes
    # back or leaps.
    row = _trimmed(rows[0]) if rows else []
    if len(row) < 2 or row not in ([f'{k + one}' for k in range(len(row))] for one in (0, 1)):
        return 0
    below = [k for k, row in enumerate(rows) if k and any(row)]
    t = [number_of(rows[k][0])[0] if is_number(rows[k][0]) else math.nan for k in (0, *below)]
    leap = len(t) > 2 and (t[1] < t[0] or t[1] - t[0] > _LEAP * max(
        abs(after - before) for before, after in zip(t[1:], t[2:])))
    return below[0] if below and (below[0] > 1 or leap) else 0


def _prepared(lines: list[str], delimiter: str, comma: bool, mark: str) -> list[str]:
    """Return lines with decimal points, without comments, and with single blanks as delimiters."""
    lines = ['\n' if line.lstrip().startswith(COMMENTS) else line
             if line.isascii() and "'" not in line else _BLANK.sub('', line) for line in lines]
    if mark:
        groups, between = (_OF_POINT, '.') if mark == ',' else (
            _OF_QUOTED if delimiter == ',' else _OF_COMMA, ',')
        lines = [groups.sub(lambda found: found[0].replace(between, ''), line) for line in lines]
    if comma and delimiter != ',':
        lines = [_with_point(line) for line in lines]
    return [' '.join(line.split()) + '\n' for line in lines] if delimiter == ' ' else lines


def _with_point(text: str) -> str:
    """Swap points and commas, so that a thousands separator is not taken for a decimal mark."""
    return text.replace('.', '\0').replace(',', '.').replace('\0', ',')


def _header(rows: list[list[str]], lines: list[str], first: int, width: int, delimiter: str,
            skip: int) -> tuple[list[str], list[str], int]:
    """Return names, the words of a line of units, and the number of the line of the names."""
    # A line of decimal numbers, such as a battery tester's on a charging step, has no names.
    plain = [(k, rows[k]) for k in range(skip, first) if any(rows[k]) and 2 * sum(
        '.' in cell and is_number(cell) for cell in rows[k]) <= len(rows[k])]
    needed = {k for row in rows[first:] for k, cell in enumerate(row[:width]) if cell}
    # The names may be in a comment: delimited like the data, or by blanks with units in brackets.
    comments = []
    for k in (k for k in range(skip, first) if lines[k].lstrip().startswith(COMMENTS)):
        text = lines[k].lstrip('#% \t')
        either = next(csv.reader([text], delimiter=delimiter), []), _NAMES.findall(text)
        comments += [(k, [cell.strip() for cell in cells])
                     for cells in either if len(cells) == width > 1][:1]
    names, units, line = next((found for above in (plain, comments) if (
        found := _names_and_units(above, width, needed))), ([], [], 0))
    names = names or _names_in_rows([row for row in rows[first:] if any(row)], width)
    # A label before the names is not a column's name if another line has a label before its
    # numbers.
    some = _trimmed(names)
    labelled = needed and needed == {*range(len(some) - 1)} and _OF_NAMES.search(some[0]) and any(
        list(map(is_value, _trimmed(row))) == [False] + [True] * len(needed)
        for row in rows[skip:first])
    return some[1:] if labelled else names, units, line


def _names_in_rows(rows: list[list[str]], width: int) -> list[str]:
    """Return names for the columns of rows without a header, as far as the rows show them."""
    numbered = [f'column {k + 1}' for k in range(width)]
    if rows and all(map(_is_battery_state, rows)):
        return _BATTERY_STATE + numbered[len(_BATTERY_STATE):]
    # MAVLink dumps name each number in the cell to its left; a single such name may be a frame's.
    before = [{row[k] if is_number(row[k + 1]) else '' for row in rows}
              for k in range(min(map(len, rows), default=0) - 1)]
    named = {k + 1: name for k, words in enumerate(before) if len(words) == 1 and re.fullmatch(
        r'[A-Za-z]\w+', name := min(words)) and not is_missing(name)
        and name.lower() not in {*WORDS, *OTHER_WORDS}}
    return [named.get(k, name) for k, name in enumerate(numbered)] if (
        1 < len(named) == len({*named.values()})) else numbered


def _is_battery_state(row: list[str]) -> bool:
    counts = [*row[:2], *row[10:13]]
    return row[13:14] in (['True'], ['False']) and all(map(str.isdigit, counts)) and all(
        is_number(cell) or is_missing(cell) for cell in row[3:10])


def _names_and_units(above: list[tuple[int, list[str]]], width: int, needed: set[int],
                     ) -> tuple[list[str], list[str], int] | None:
    """Return what `_header` does; None if no line names all columns."""
    units: list[str] = []

    def names_all(row: list[str]) -> bool:
        named = {row[k] for k in needed if k < len(row)} - {''}
        return len(named) == len(needed) and not any(map(is_value, named))

    if above and not names_all(above[-1][1]):
        # A line with the source of each column may follow the line of units.
        above = next((above[:k + 1] for k in range(len(above) - 1, 0, -1) if _are_units(
            above[k][1]) and names_all(above[k - 1][1])), above)
    # A fact with a decimal number is not a line of names.
    if len(above) > 1 and _are_units(above[-1][1]) and len(above[-2][1]) >= min(
            width, len(above[-1][1])) and not any(
                '.' in cell and is_number(cell) for cell in above[-2][1]):
        units = [cell.strip('[](){} ').lower() for cell in above.pop()[1]]
    if not above:
        return None
    line, names = above[-1]
    if len(needed) > 1 and len(names) == 1 and re.fullmatch(r'[A-Za-z][^,;\t|]*', names[0]):
        # A title.
        return None
    for _, over in reversed(above[:-1]):
        # Names in several lines: the cell above replaces a blank name and precedes a repeated one.
        if len(over) != len(names) or any(map(is_value, over)):
            break
        count = Counter(names)
        names = [f'{more} {name}'.strip() if k and count[name] > 1 else name or more
                 for k, (name, more) in enumerate(zip(names, over))]
    # An index at the left and a few other columns may lack names; a line of facts has few names.
    blank = [k for k in range(1, width) if k in needed and names[k:k + 1] == ['']]
    if blank and (2 * len(blank) >= len(needed - {0}) or any(map(is_value, filter(None, names)))):
        return None
    names = [f'column {k + 1}' if k in blank else name for k, name in enumerate(names)]
    return names, units, line + 1


def _units_of(names: list[str], words: list[str], rows: list[list[str]], first: int, at: int,
              ) -> tuple[str, ...]:
    """Return the stated unit of each column (words: the line of units), '' if there is none."""
    # Names such as V beside A are units.
    bare = {'V', 'mV', 'A', 'mA'}.intersection(names)
    stated = [words[k] if k < len(words) and words[k] in WORDS else name.lower()
              if name in bare and len(bare) > 1 else unit_of(name)[1]
              for k, name in enumerate(names)]
    # Else the unit of a channel in a line above.
    begin = int(rows[at - 1][1:len(names) + 1] != names)
    above = _units_above(names, begin, rows[:first])
    stated = [unit or other for unit, other in zip(stated, above)]
    # Else the unit behind the first number of the column.
    for k, unit in enumerate(stated):
        cell = next((row[k] for row in rows[first:] if k < len(row) and is_number(row[k])), '0')
        stated[k] = unit or number_of(cell)[1] or _unit_beside(names, rows[first:], k)
    return tuple(stated)


def _units_above(names: list[str], begin: int, above: list[list[str]]) -> list[str]:
    """Return the unit of volts or amperes of each column in the lines above; '' if none."""
    # The unit is at the end of the channel's own line ('CH2,DC,50mV,A'), or in a line of units
    # ('Vertical Units,V,CH2:A'), below the channel's name or in the order of the columns.
    rows = [row for row in map(_trimmed, above) if row]
    labels: dict[str, int] = {}
    for row in rows:
        for p, cell in enumerate(row[1:], 1):
            labels.setdefault(cell, p)
    found = [''] * len(names)
    for row in rows:
        of_units = 'unit' in row[0].lower()
        # If blank cells separate the units, count only the units.
        units = [cell for cell in row[1:] if cell]
        counted = len(units) == len(names) - begin < len(row) - 1
        for k in range(begin, len(names)):
            place = k + 1 - begin
            if found[k] or not (of_units or row[0] == names[k]):
                continue
            cells = [row[-1]] if k and len(row) > 1 else []
            if of_units:
                label = labels.get(names[k], place)
                cells = [units[place - 1]] if counted else [
                    *row[label:label + 1], *row[place:place + 1]]
            found[k] = next((word for cell in cells if (
                word := cell.split(':')[-1].strip().lower()) in {*VOLT_WORDS, *AMPERE_WORDS}), '')
    return found


def has_unit_beside(names: Sequence[str], place: int) -> bool:
    """Return whether the next column has the unit of each row, as meters write it."""
    return re.fullmatch(r'(?:.*[ _])?units?|einheit',
                        ''.join(names[place + 1:place + 2]).lower()) is not None


def _unit_beside(names: Sequence[str], rows: list[list[str]], place: int) -> str:
    """Return the unit in the next column, if that is a column of units; '' if mixed."""
    words = [unit_word(row[place + 1]) for row in rows if any(row[place + 1:place + 2])
             ] if has_unit_beside(names, place) else []
    kinds = {WORDS.get(word, word)[-1:] for word in words}
    return words[0] if len(kinds) == 1 and words[0] in WORDS else ''


def _are_units(row: list[str]) -> bool:
    """Return whether a row states units: one alone, or several and at most as many other words."""
    words = [cell.strip('[](){} ').lower() for cell in row]
    some = sum(word in WORDS for word in words)
    others = sum(word not in WORDS and word not in OTHER_WORDS and not is_number(word)
                 and cell[0] not in '[({' for cell, word in zip(row, words))
    return some > 1 and some >= others or some == 1 and not others


def _stated_step(lines: list[str], above: list[list[str]]) -> tuple[float, str]:
    """Return the stated time between rows, s, and the words that state it."""
    for name, cell in chain.from_iterable(map(zip, above, above[1:])):
        if name.lower() == 'increment' and is_number(cell):
            return float(cell), name
    for line in lines:
        if found := _INTERVAL.search(line):
            words, unit, number, word, per = found.groups()
            # Some loggers call the time between rows a rate: 10 ms.
            rate = re.search('rate|frequency', words, re.IGNORECASE) and (
                per or TIME_WORDS.get(word, 's') == 's')
            prefix = word[:1] if re.match('s|hz|$', word[1:].lower()) else ''
            value = float(number) * (
                SCALES[TIME_WORDS[word.casefold()]] if not rate and word.casefold() in TIME_WORDS
                else _PREFIX.get(prefix if prefix == 'M' else prefix.casefold(), 1.0))
            if unit and unit.lower() in TIME_WORDS:
                value *= SCALES[TIME_WORDS[unit.lower()]]
            if rate:
                value = 1.0 / value if value else math.nan
            if value > 0.0:
                return value, ' '.join(words.split())
    return math.nan, ''


def holds_numbers(form: Form, place: int, clock: bool) -> bool:
    """Return whether the first cells of a column are numbers (clock: or dates or times)."""
    cells = [cell for cell in form.cells(place) if not is_missing(cell)]
    return not cells or any(is_value(cell) if clock else is_number(cell) for cell in cells)


def holds_clocks(form: Form, place: int) -> bool:
    """Return whether the first cell of a column is a date or a time, and no number."""
    return any(not is_number(cell) and is_clock(cell) for cell in form.cells(place)[:1])


def numbers(path: Path, form: Form, places: Sequence[int],
            texts: dict[int, list[str]] | None = None,
            left_out: list[BadLine] | None = None) -> list[FloatArray]:
    """Return columns of numbers, NaN where blank; `texts` gets cells as written."""
    # A bad line raises InputError, or with `left_out` is dropped and appended there.
    parts: list[list[FloatArray]] = [[] for _ in places]
    with_unit = [place for place in places if has_unit_beside(form.names, place)]
    last = max([*places, *(texts or {}), *(place + 1 for place in with_unit)])
    width = len(form.names)
    try:
        with opened(path) as raw, io.TextIOWrapper(raw, form.encoding, (
                'strict' if form.encoding.startswith('utf') else 'replace'), None) as file:
            for lines, rows in _blocks(path, file, form, width):
                if len(rows[0]) <= last or len(rows[0]) > width or len(set(map(len, rows))) > 1:
                    lines, rows = _fitting(path, lines, rows, width, last, form, left_out)
                columns = list(zip(*rows))
                if not columns:
                    continue
                good = np.ones(len(rows), dtype=bool)
                for place, part in zip(places, parts):
                    cells = columns[place]
                    if place in with_unit:
                        cells = _with_units(cells, columns[place + 1], form.units[place])
                    part.append(_floats(path, lines, cells, form, place,
                                        good if left_out is not None else None, left_out))
                if not good.all():
                    for k in np.flatnonzero(~good).tolist():
                        _check_same_names(f'{path}:{lines[k]}', rows[k], form.names)
                    for part in parts:
                        part[-1] = part[-1][good]
                for place, text in (texts or {}).items():
                    text += (cell for cell, fine in zip(columns[place], good) if fine)
    except UnicodeDecodeError as error:
        why = ('it is cut off in the middle of a character'
               if re.search('truncated|unexpected end', error.reason) else error)
        raise InputError(f'{path} is not text throughout: {why}') from error
    return [np.concatenate(part) if part else np.empty(0) for part in parts]


def _check_same_names(where: str, row: list[str], names: Sequence[str]) -> None:
    """Raise InputError if a bad line is a header that begins another table."""
    cells = [cell.strip() for cell in row]
    others = [k for k, (cell, name) in enumerate(zip(cells, names)) if cell != name]
    if others and not any(map(is_value, cells)) and (
            set(cells) & {*names} - {''} or len({*cells}) == len(cells) > 1 and all(
                cell[:1].isalpha() and not is_missing(cell) for cell in cells)):
        raise InputError(f"{where}: column '{names[others[0]]}' becomes "
                         f"'{shown(cells[others[0]])}': another table begins there; move it to a "
                         'file of its own')


def _with_units(cells: Sequence[str], units: Sequence[str], stated: str) -> tuple[str, ...]:
    """Return cells, followed by the unit of their row where it differs from the column's."""
    return tuple(cell if is_missing(cell) or unit_word(unit) in ('', stated)
                 else ' '.join([cell, *sorted(unit.split(), key=lambda one: not unit_word(one))])
                 for cell, unit in zip(cells, units))


def _blocks(path: Path, file: TextIO, form: Form, width: int,
            ) -> Iterator[tuple[Sequence[int], list[list[str]]]]:
    """Yield rows, with the numbers of the lines in which they end."""
    text = islice(chain.from_iterable(_lines(path, file, form)), form.skip, None)
    reader = csv.reader(text, delimiter=form.delimiter, strict=True, skipinitialspace=True)
    while True:
        before = form.skip + reader.line_num
        rows: list[list[str]] = []
        try:
            rows.extend(islice(reader, _BLOCK))
        except csv.Error as error:
            # `rows` holds the rows before the bad one.
            first = before + 1 + sum(map(_lines_of, rows))
            raise InputError(f'{path}:{first}: {error} in the row that begins there: close each '
                             'quote in its line') from error
        if not rows:
            return
        lines: Sequence[int] = range(before + 1, before + 1 + len(rows))
        if form.skip + reader.line_num > lines[-1]:
            lines = list(accumulate(map(_lines_of, rows), initial=before))[1:]
            for line, row in zip(lines, rows):
                if any(part.count(form.delimiter) >= width - 1
                       for cell in row for part in cell.splitlines()[1:]):
                    raise InputError(f'{path}:{line + 1 - _lines_of(row)}: whole lines after this '
                                     'one are within a quote: close each quote in its line')
        if form.comma and form.delimiter == ',':
            rows = [list(map(_with_point, row)) for row in rows]
        yield lines, rows


def _lines_of(row: list[str]) -> int:
    """Return the number of lines that a row takes."""
    return 1 + sum(cell.count('\n') for cell in row)


def _lines(path: Path, file: TextIO, form: Form) -> Iterator[list[str]]:
    """Yield prepared lines, a chunk at a time."""
    rest, number = '', 0
    while text := file.read(_CHUNK):
        lines = io.StringIO(rest + text).readlines()
        rest = '' if lines[-1].endswith('\n') else lines.pop()
        if max(map(len, lines), default=0) > MOST_OF_LINE or len(rest) > MOST_OF_LINE:
            long = next((k for k, one in enumerate(lines) if len(one) > MOST_OF_LINE), len(lines))
            raise InputError(f'{path}:{number + long + 1}: the line has more than '
                             f'{MOST_OF_LINE} characters')
        number += len(lines)
        yield _prepared(lines, form.delimiter, form.comma, form.mark)
    if rest:
        yield _prepared([rest], form.delimiter, form.comma, form.mark)


def _fitting(path: Path, lines: Sequence[int], rows: list[list[str]], width: int, last: int,
             form: Form, left_out: list[BadLine] | None) -> tuple[Sequence[int], list[list[str]]]:
    """Return the rows that are not blank, all of one width, and their lines."""
    kept: list[int] = []
    for k, row in enumerate(rows):
        wrong, blank = '', not any(cell.strip() for cell in row)
        if any(cell.strip() for cell in row[width:]):
            wrong = (f'{len(row)} cells, and the header names {width} columns: mend the line; '
                     'the decimal mark is a point')
        elif not blank and len(row) <= last:
            wrong = f"the line ends before column '{form.names[last]}'"
        if wrong:
            bad = BadLine(lines[k], wrong)
            if left_out is None:
                raise InputError(bad.error(path) + _PARTIAL)
            left_out.append(bad)
        elif not blank:
            kept.append(k)
    return [lines[k] for k in kept], [rows[k][:last + 1] for k in kept]


def _floats(path: Path, lines: Sequence[int], cells: Sequence[str], form: Form, place: int,
            good: npt.NDArray[np.bool_] | None, left_out: list[BadLine] | None) -> FloatArray:
    """Return the cells of a column as numbers."""
    # A bad cell raises InputError; with `good`, its line is marked as bad, and appended once.
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
            value *= _ratio(unit, form.units[place])
        except ValueError:
            value = math.nan
        if value != value and not is_missing(cell):
            if form.comma:
                cell = _with_point(cell)
            mark = ': the decimal mark is a comma (--decimal)' if form.comma else (
                _MARK * (cell.count(',') == 1))
            bad = BadLine(lines[k], (
                f"column '{form.names[place]}' holds '{shown(cell)}', not a number{mark}"))
            if good is None or left_out is None:
                raise InputError(bad.error(path) + _PARTIAL * (not mark))
            if good[k]:
                left_out.append(bad)
            good[k] = False
        found.append(value)
    return np.array(found, dtype=np.float64)


def _ratio(unit: str, stated: str) -> float:
    """Return the factor from the unit of a cell to its column's; NaN: another quantity."""
    one, other = WORDS.get(unit, ''), WORDS.get(stated, '')
    return 1.0 if not unit or unit == stated else (
        SCALES[one] / SCALES[other] if one[-1:] == other[-1:] else math.nan)
