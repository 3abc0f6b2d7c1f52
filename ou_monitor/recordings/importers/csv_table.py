"""
Read a CSV: `time_s`, `voltage_v` and, where present, `throttle` and `current_a`.

Limits first: one header line is required; the decimal mark is a point.  Other
columns are ignored unless they are named, as are blank lines and lines that begin
with '#'; commas, semicolons or tabs separate.  A line with more cells than the
header has names is refused: with decimal commas 5,01 would be the two numbers 5
and 1.  `convert` takes the stamps from `time_s` as they stand, and values as V,
0..1 and A.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
import csv
from dataclasses import dataclass, replace
import io
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.importers import log as logs
from ou_monitor.recordings.importers.log import (
    ANY, Log, one_flight, RawColumns, Request, Series)
from ou_monitor.records import FloatArray
from ou_monitor.stream.files import open_regular
from ou_monitor.text import printable
from ou_monitor.timeline.line import hold

TIME, VOLTAGE, THROTTLE, CURRENT = 'time_s', 'voltage_v', 'throttle', 'current_a'

_DELIMITERS = ',;\t'
# What loggers write for a number they do not have.
_MISSING = frozenset(('', 'nan', 'null', 'none', 'na', 'n/a'))
# Added where a cell looks like it.
_MARK = ': the decimal mark is a point'
# Characters of a cell that are shown.
_LONGEST = 40
# A log of 1000 columns has lines of some 10 000 characters.
MOST_OF_LINE = 65536
# RawColumns listed at most; loggers of autopilots write some hundred.
MOST_COLUMNS = 300
# Column -> quantity, when no name is given.
_KNOWN = {VOLTAGE: logs.VOLTAGE, THROTTLE: logs.THROTTLE, CURRENT: logs.CURRENT}
# Share of steps back in what is no time; a supply is not read less often, s.
_BACK, _LONGEST_STEP = 0.25, 100.0


@dataclass(frozen=True)
class CsvColumns:
    """Which columns of a CSV are meant, and what their numbers are."""

    # Names of columns; None: ``time_s``, ``voltage_v`` and ``throttle``, if it is there.
    time: str | None = None
    voltage: str | None = None
    throttle: str | None = None
    # Unit of the voltage: V or mV.
    unit: str = 'V'
    # Unit of the time: s, ms, us or ns.
    time_unit: str = 's'


# What to say of a column that is not there.
_OPTIONS = {TIME: '--time-column', VOLTAGE: '--voltage-column'}
VOLTAGE_UNITS = {'V': 1.0, 'mV': 1e-3}
TIME_UNITS = {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9}


def read_csv(path: Path, columns: CsvColumns | None = None) -> RawColumns:
    """Read the samples of a supply, unsorted and with NaN kept."""
    wanted = columns or CsvColumns()
    time, voltage = wanted.time or TIME, wanted.voltage or VOLTAGE
    # A column that was named must be there.
    throttle = ((), (THROTTLE,)) if wanted.throttle is None else ((wanted.throttle,), ())
    named = [time, voltage, *throttle[0]]
    if len(set(named)) < len(named):
        raise InputError(f'{path}: one column cannot be two of time, voltage and throttle: '
                         f"{', '.join(named)}")
    optional = throttle[1] if CURRENT in named else (*throttle[1], CURRENT)
    t, v, u, *current = _columns(path, (time, voltage, *throttle[0]), optional)
    _check_time(path, t * TIME_UNITS[wanted.time_unit], v, (time, voltage))
    name = printable(path.name)
    # A blank cell is no message: what was commanded last holds.
    return RawColumns(t * TIME_UNITS[wanted.time_unit], v * VOLTAGE_UNITS[wanted.unit], hold(u),
                      current[0] if current else np.full(t.shape, np.nan), name,
                      {'file': name, 'format': 'csv'})


def read(path: Path, request: Request) -> Log:
    """Read the columns known by name, and those asked for."""
    one_flight(path, request)
    header = [name for name in column_names(path, TIME) if name and name != TIME]
    wanted = [name for name in dict.fromkeys(header) if name in _KNOWN or name in request.names]
    t, *columns = read_columns(path, [TIME, *wanted])
    if not t.size:
        raise InputError(f'{path} holds a header and no line below it')
    series = [Series(name, _KNOWN.get(name, ANY), t, values, '1', 'column',
                     0 if name in _KNOWN else None)
              for name, values in zip(wanted, columns)]
    notes = []
    late = int(np.count_nonzero(np.diff(t) < 0.0))
    if late:
        notes.append(f'{late} line{"s" * (late != 1)} came before the stamp ahead of them: '
                     'sorted by stamp.')
        order = np.argsort(t, kind='stable')
        series = [replace(one, t=t[order], values=one.values[order]) for one in series]
    if request.everything:
        others = [name for name in dict.fromkeys(header) if name not in wanted]
        if len(others) > MOST_COLUMNS:
            notes.append(f'{len(others) - MOST_COLUMNS} more columns are not listed.')
        # One pass each: a column of text ends the reading of its pass only.
        for name in others[:MOST_COLUMNS]:
            try:
                values = read_columns(path, [TIME, name])[1]
            except InputError:
                notes.append(f"Column '{name}' does not hold numbers.")
                continue
            series.append(Series(name, ANY, t, values, '1', 'column'))
    return Log('csv', tuple(series), {}, tuple(notes), names=tuple(header))


def _check_time(path: Path, t: FloatArray, voltage: FloatArray, names: tuple[str, str]) -> None:
    """Refuse a time that cannot be one in seconds, or that is the voltage (t in s)."""
    step = np.diff(t)
    step = step[np.isfinite(step)]
    if not step.size:
        return
    if float(np.mean(step < 0.0)) > _BACK and (np.diff(voltage) > 0.0).all():
        raise InputError(f"{path}: '{names[0]}' runs backwards, and '{names[1]}' only ever rises: "
                         'are the two columns swapped?')
    usual = float(np.median(step))
    if usual > _LONGEST_STEP:
        raise InputError(f"{path}: the samples are {usual:g} s apart by '{names[0]}': is it in "
                         'ms, us or ns? --time-unit says so')


def read_column(path: Path, name: str, columns: CsvColumns | None = None,
                ) -> tuple[FloatArray, FloatArray]:
    """Return the stamps, s, and one column of a CSV as it stands, NaN kept."""
    wanted = columns or CsvColumns()
    time = wanted.time or TIME
    if name == time:
        raise InputError(f"{path}: '{time}' is the time, not a signal")
    t, values = _columns(path, (time, name), ())
    return t * TIME_UNITS[wanted.time_unit], values


def column_names(path: Path, needed: str) -> list[str]:
    """Return the names of the columns of a CSV (needed in A)."""
    try:
        with _open(path) as file:
            lines = _Lines(path, file)
            return _header(path, lines, next(iter(lines), None), (needed,))[0]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise _unreadable(path, error) from error


def read_columns(path: Path, names: Sequence[str]) -> list[FloatArray]:
    """Return columns of a CSV as they stand, NaN kept."""
    return _columns(path, names, ())


def _columns(path: Path, needed: Sequence[str], optional: Sequence[str]) -> list[FloatArray]:
    try:
        with _open(path) as file:
            return _read(path, file, needed, optional)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> InputError:
    if isinstance(error, OSError):
        return InputError(f'cannot read {path}: {error.strerror}')
    if isinstance(error, UnicodeDecodeError):
        return InputError(f'{path} is not text (byte {error.start} is not UTF-8)')
    return InputError(f'{path} is not a CSV: {error}')


def _open(path: Path) -> TextIO:
    return io.TextIOWrapper(open_regular(path), encoding='utf-8-sig', newline='')


class _Lines:
    """The lines that count, and the number of the last one handed out."""

    def __init__(self, path: Path, file: TextIO) -> None:
        self._path = path
        self._file = file
        self.number = 0

    def __iter__(self) -> Iterator[str]:
        """Yield lines that are neither blank nor comments."""
        read = self._file.readline
        while line := read(MOST_OF_LINE + 1):
            self.number += 1
            if len(line) > MOST_OF_LINE:
                raise InputError(f'{self._path}:{self.number}: the line has more than '
                                 f'{MOST_OF_LINE} characters')
            if line.strip() and not line.lstrip().startswith('#'):
                yield line


def _read(path: Path, file: TextIO, needed: Sequence[str], optional: Sequence[str],
          ) -> list[FloatArray]:
    lines = _Lines(path, file)
    texts = iter(lines)
    header, delimiter = _header(path, lines, next(texts, None), needed)
    for name in (*needed, *optional):
        if header.count(name) > 1:
            raise InputError(f"{path}:{lines.number}: column '{name}' is there twice")
    names = [name for name in (*needed, *optional) if name in header]
    places = [header.index(name) for name in names]
    columns = [array('d') for _ in names]
    for row in _rows(path, lines, csv.reader(texts, delimiter=delimiter, strict=True), header,
                     delimiter):
        for name, place, column in zip(names, places, columns):
            column.append(_cell(row, place, name, path, lines.number))
    found = {name: np.array(column, dtype=np.float64) for name, column in zip(names, columns)}
    missing = np.full(found[names[0]].shape, np.nan)
    return [found.get(name, missing) for name in (*needed, *optional)]


def _rows(path: Path, lines: _Lines, reader: Any, header: list[str], delimiter: str,
          ) -> Iterator[list[str]]:
    """Yield rows that fit the header, none of which holds another one in a quote."""
    before = 0
    try:
        for row in reader:
            if reader.line_num - before > 1 and any(
                    line.count(delimiter) >= len(header) - 1
                    for cell in row for line in cell.splitlines()[1:]):
                raise InputError(f'{path}:{lines.number}: whole lines before this one are within '
                                 'a quote: close each quote in its line')
            before = reader.line_num
            if len(row) > len(header) and any(cell.strip() for cell in row[len(header):]):
                raise InputError(
                    f'{path}:{lines.number}: {len(row)} cells, and the header names '
                    f'{len(header)} columns: mend the line; the decimal mark is a point')
            yield row
    except csv.Error as error:
        raise InputError(
            f'{path}:{lines.number}: {error}: close each quote in its line') from error


def _header(path: Path, lines: _Lines, first: str | None, needed: Sequence[str],
            ) -> tuple[list[str], str]:
    """Return the names in the first line, and what separates them."""
    if first is None:
        raise InputError(f'{path} is empty: expected a header with {TIME},{VOLTAGE}[,{THROTTLE}]')
    delimiter = max(_DELIMITERS, key=first.count)
    header = [name.strip() for name in next(csv.reader([first], delimiter=delimiter))]
    for name in needed:
        if name not in header:
            raise InputError(
                f"{path}:{lines.number}: no column '{name}': {_hint(name, header)}"
                + (f' ({_OPTIONS[name]} names another)' if name in _OPTIONS else ''))
    return header, delimiter


def _cell(row: list[str], place: int, name: str, path: Path, number: int) -> float:
    if place >= len(row):
        raise InputError(f"{path}:{number}: the line ends before column '{name}'")
    text = row[place]
    try:
        if '_' in text or not text.isascii():
            # To Python 5_01 is 501.
            raise ValueError(text)
        return float(text)
    except ValueError:
        if text.strip().lower() in _MISSING:
            return float('nan')
        raise InputError(f"{path}:{number}: column '{name}' holds '{_shown(text)}', not a "
                         'number' + _MARK * (text.count(',') == 1)) from None


def _shown(text: str) -> str:
    """Return what fits in one line: an open quote makes the rest of a file one cell."""
    shown = text.strip()
    return shown if len(shown) <= _LONGEST else shown[:_LONGEST] + '...'


def _hint(name: str, header: list[str]) -> str:
    try:
        [float(cell) for cell in header]
    except ValueError:
        return nearest(name, header)
    return f'the first line holds numbers; add a header line {TIME},{VOLTAGE}[,{THROTTLE}]'
