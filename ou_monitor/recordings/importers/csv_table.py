"""
Read a table of text, such as a CSV: time, voltage and, where present, throttle and current.

Limits: a file is one flight; all rows have the same number of cells.  If rows hold a value and
the name of its series, each series is read as a column of that name.  Columns and units are found
by names and sizes and reported in one note; fields of `CsvColumns` override them.  A unit in a
name or in a line of units is taken as stated; an unstated unit is guessed from the values.
`time_s`, `voltage_v`, `throttle` and `current_a` are taken first and need no note.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
import math
from pathlib import Path
import re
from typing import NamedTuple

import numpy as np
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.importers import log as logs
from ou_monitor.recordings.importers.csv_cells import (
    AMPERE_WORDS, CHANNEL, clock_times, factor_of, first_word, has_day, is_clock, is_missing,
    is_number, is_value, number_of, OTHER_WORDS, SCALES, SHARE_WORDS, shown, TIME_WORDS, unit_of,
    VOLT_WORDS, WORDS)
from ou_monitor.recordings.importers.csv_form import (
    Form, form_of, has_unit_beside, numbers, THROTTLE, TIME, VOLTAGE)
from ou_monitor.recordings.importers.log import (
    ANY, CsvColumns, Log, RawColumns, Request, Series)
from ou_monitor.records import (
    clock_unit, Defect, FloatArray, LEAST_STEP, LONGEST_STEP, Note, TIME_UNITS)
from ou_monitor.text import counted, printable, some
from ou_monitor.timeline import hold, MOST_THROTTLE, WILD

CURRENT = 'current_a'
NONE = 'none'
# Unit -> ends of the throttle; other ends are written LOW:HIGH.
THROTTLE_UNITS = {'1': (0.0, 1.0), '%': (0.0, 100.0), 'us': (1000.0, 2000.0), 'ms': (1.0, 2.0)}
_PULSE_WORDS = {word: unit for word, unit in TIME_WORDS.items() if unit in THROTTLE_UNITS}
# Ends of sticks that are centred at 0: EdgeTX, DJI, 16 bits.
_STICKS = (1024, 10000, 32768)
# Ends of the stick in the flight logs of DJI, by the names that CsvView and PhantomHelp write.
_DJI = '364:1684'
# Maximum columns listed; autopilots log a few hundred.
MOST_COLUMNS = 300
# Share of backward steps above which a column is not a time.
_BACK = 0.25
# Maximum step and span of a time, s; an unstated unit is the coarsest one within both.
_USUAL_STEP, _USUAL_SPAN = 2.0, 43200.0
# Number of the first day of 1970 in Excel and MATLAB; days from there to 2100.
_OF_1970, _TO_2100 = (25569.0, 719529.0), 47482.0
# Values of a counter of 32 bits.
_COUNTS = 2.0**32
# Minimum rows before repeated stamps are put down to a coarse clock.
_FEW_ROWS = 8
# To spread rows that share stamps: minimum mean number of rows per stamp; maximum relative
# deviation of that number; stamps per straight piece (with ten rows per stamp, a row is 1 %).
_LEAST_SHARED, _UNSTEADY, _EVEN = 1.5, 0.2, 10
# Change by rounding; standard errors above which a mean change is significant.
_ROUNDING, _SURE = 1e-6, 4.0
# A voltage without a unit above this is in mV: no craft's pack has that many volts.
_MOST_VOLTS = 1000.0
# Maximum of an unknown throttle up to which it is not taken as percent: levers give up to 5 V.
_LEAST_PERCENT = 5.5


# Quantity -> patterns of the end of a column's name without its unit, the best first; in lower
# case, other characters as '_'.  From the exports named in test_csv_exports.py.
_VALUE_NAME = r'_?(?:values?|reading|data|ampl(?:itude)?|wert|messwert)?'
_TIME_NAME, _INDEX_NAME = 'time', r'sequence|index|sample|no|n|x|point|'
_PATTERNS = {
    _TIME_NAME: (
        r'time_s',
        r'(?:__|_)?time|t|zeit|ms_today|millis|micros|elapsed(?:_time)?|x_axis|x_value|'
        r'(?:milli|micro)?seconds?',
        r'timestamp|date_?time|datum_?(?:und_)?(?:uhr)?zeit|temps|tiempo|tempo|uhrzeit|ora|heure|'
        r'时间',
        r'.*(?:time|zeit|stamp).*', r'date|datum'),
    logs.VOLTAGE: (
        r'voltage_v',
        r'[uv]_?bat(?:t|tery)?(?:_?latest|_?filtered|_?voltage|_?v)?|batt?(?:ery)?_?(?:v|volt|'
        r'volts|voltage)|pack_?voltage|(?:input|inp|bus|supply|rail|main|link)_?(?:v|volt|voltage)'
        r'|v_?bus|vfas|cels|voltage_?(?:battery|batt?|raw)|bat_?spannung|akku_?spannung|pm_vbat',
        r'u|v|volts?|voltage|spannung|tension|tensione|voltaje|电压|[UVuv]\(.*\)|'
        r'[uv](?:rms|dc|mean|mn)?_?1?',
        r'volt(?:age)?_?filtered(?:_v)?|rxbt',
        r'(?!.*(?:axis|cell|temp|limit|zelle|motor|servo|rssi|phase|cpu|mcu|5v|sag)).*(?:volt|'
        r'spannung|vbat).*'),
    logs.THROTTLE: (
        r'throttle', r'thr(?:ottle)?_?(?:out|cmd|command|pct|percent)?|ga[sz]|'
        r'acelerador|油门|duty(?:_cycle)?|tho?o|tps|tastgrad|tastverh.*',
        r'rc_?command_3',
        r'rc_?data_3|rc_?out?(?:_?ch?_?3)?|servo3_raw',
        r'pwm|rc_?out?_?ch?_?1|thrust|gas_?(?:kanal|stellung|hebel)|esc(?:_signal|_pwm)?|'
        r'(?!.*(?:limit|trim|max|min)).*throttle.*'),
    logs.CURRENT: (
        r'current_a', r'amperage(?:_?latest)?|current_in|i_?bat(?:t|tery)?|'
        r'batt?(?:ery)?_?\d?_?(?:i|curr(?:ent)?|amps?)|current_?batt?(?:ery)?|'
        r'(?:.*_)?(?:bus|input|supply|main|pack|total|bms)_?current|i_?bus|curr',
        r'(?:i(?:rms|dc|mn)?|curr(?:ent)?|amps?|strom|courant|corriente|电流)'
        r'(?:_?(?:avg|average|mean))?(?:_?1)?|'
        r'(?!.*(?:max|min|limit)).*_batt?(?:ery)?_current'),
}
_UNITS = {_TIME_NAME: TIME_WORDS, logs.VOLTAGE: VOLT_WORDS, logs.CURRENT: AMPERE_WORDS,
          logs.THROTTLE: {**SHARE_WORDS, **_PULSE_WORDS}}
# Exports with unscaled numbers.  Column that reveals the program ('': any program) -> end of a
# column's name, in lower case -> factor, unit, and the number that stands for "unknown".
# Betaflight's blackbox explorer: us, 0.01 V and 0.01 A, as logged from version 4.0 on.  MAVLink:
# SYS_STATUS, BATTERY_STATUS and POWER_STATUS (common.xml).
_RAW: dict[str, dict[str, tuple[float, str, float]]] = {
    'loopIteration': {'time': (0.0, 'us', math.nan), 'rccommand[3]': (0.0, 'us', math.nan), **{
        f'{name}{end}': (0.01, unit, math.nan) for name, unit in (
            ('vbat', '0.01 V'), ('amperage', '0.01 A')) for end in ('', 'latest')}},
    '': {name: (scale, f'{unit} by MAVLink, {unknown:g} is unknown: --unit V for V and A', unknown)
         for name, scale, unit, unknown in (
             ('voltage_battery', 1e-3, 'mV', 65535.0), ('voltages[0]', 1e-3, 'mV', 65535.0),
             ('vcc', 1e-3, 'mV', 0.0), ('vservo', 1e-3, 'mV', 0.0),
             ('current_battery', 1e-2, '10 mA', -1.0))}}
_CELLS = re.compile(r'(.*voltages\[)0\]', re.IGNORECASE)


class _Column(NamedTuple):
    """A selected column."""

    place: tuple[int, ...]  # Its cells: two for a date and a time; none: rows are counted
    name: str
    unit: str  # As stated or given, '' if neither
    scale: float  # Factor by the maker's definition; 0: by the unit
    unknown: float = math.nan  # Number that stands for "unknown"


class _Table(NamedTuple):
    """The data read from a file, in SI units."""

    form: Form
    time: _Column  # Without a place if rows name their series
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
        first = printable(left_out[0].removeprefix(str(path)).lstrip(': '))
        said.append(Note(
            f'{counted(len(left_out), "bad line")} left out, such as '
            f'{"line " * first[0].isdigit()}{first}.', Defect.DAMAGED_FILE))
    t, (column, volts) = table.t, table.found[logs.VOLTAGE]
    nothing = np.full(t.shape, np.nan)
    name = printable(path.name)
    held = {quantity: values for quantity, (_, values) in table.found.items()}
    source = {'file': name, 'format': 'csv', **{
        quantity: printable(one.name) for quantity, (one, _) in table.found.items()}}
    if table.time.unit not in ('', 's'):
        source['time_unit'] = table.time.unit
    current = held.get(logs.CURRENT, nothing)
    if 2 * np.isfinite(current[np.isfinite(volts)]).sum() < np.isfinite(volts).sum():
        # Most rows with a voltage have no current: hold the last current.
        current = hold(current)
    filled = np.ones(volts.shape, dtype=bool)
    if np.isnan(volts).any():
        cells = _cells(path, table.form, column.place[0], volts.size)
        filled[:len(cells)] = [bool(cell.strip()) for cell in cells]
        if not filled.all() and filled.any():
            said.append(f"{counted(int((~filled).sum()), 'row')} left out: the cell of "
                        f"'{printable(column.name)}' is empty.")
    # A blank throttle cell means no new command: hold the last one.
    throttle = hold(held.get(logs.THROTTLE, nothing))
    if filled.any():
        t, volts, throttle, current = (one[filled] for one in (t, volts, throttle, current))
    if t.size >= _FEW_ROWS and 2 * np.unique(t).size < t.size:
        said.append('Most rows repeat the stamp before: if evenly spaced, give --sample-interval.')
    return RawColumns(t, volts, throttle, current, name, source, tuple(said))


def read(path: Path, request: Request) -> Log:
    """Read the columns of a supply, and the requested ones."""
    table = _table(path, request.columns or CsvColumns(), more=request.names)
    header, t = [name for name in table.form.names if name], table.t
    if not t.size:
        raise InputError(f'{path} holds a header and no line below it')
    taken = {column.name: quantity for quantity, (column, _) in table.found.items()}
    series = [Series(column.name, quantity, t, values, '1', 'column', 0)
              for quantity, (column, values) in table.found.items()]
    words = {name for name, values in table.named.items()
             if name not in request.names and not np.isfinite(values).any()}
    series += [Series(name, ANY, t, values, '1', 'column')
               for name, values in table.named.items() if name not in {*taken, *words}]
    notes: list[str] = [table.note] if table.note else []
    notes += [f"Column '{name}' does not hold numbers." for name in sorted(words)]
    late = int(np.count_nonzero(np.diff(t) < 0.0))
    if late:
        notes.append(Note(f'{counted(late, "line")} came after a later stamp: sorted '
                          'by stamp.', Defect.UNORDERED))
        order = np.argsort(t, kind='stable')
        series = [replace(one, t=t[order], values=one.values[order]) for one in series]
    if request.everything:
        known = {one.name for one in series} | words | {
            table.form.names[place] for place in table.time.place}
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


def read_throttle_alone(path: Path, columns: CsvColumns | None = None,
                        ) -> tuple[FloatArray, FloatArray]:
    """Return the stamps, s, and the throttle, 0..1, of a CSV that needs no voltage."""
    table = _table(path, columns or CsvColumns())
    if logs.THROTTLE not in table.found:
        raise InputError(_absent(path, table.form, THROTTLE, ' (--throttle-column)'))
    return table.t, table.found[logs.THROTTLE][1]


def holds_supply(path: Path, columns: CsvColumns | None = None) -> bool:
    """Return whether the first lines, or the header of a damaged file, have time and voltage."""
    wanted = columns or CsvColumns()
    for header in (False, True):
        with suppress(InputError):
            form = form_of(path, wanted, header=header)
            time = _time_of(path, form, wanted)
            if not _series_of(path, form, wanted, time):
                _supply_of(path, form, wanted, time, needed=True)
            return True
    return False


def _table(path: Path, wanted: CsvColumns, *, more: Iterable[str] = (), needed: bool = False,
           left_out: list[str] | None = None) -> _Table:
    """Read time, the columns of a supply, and others by name (needed: with a voltage)."""
    raw = form = form_of(path, wanted)
    time = clock = _time_of(path, form, wanted)
    if series := _series_of(path, form, wanted, time):
        form, label, value = series
        asked = {*more}
        more, time = form.names, time._replace(place=())
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
            raise InputError(f"{path}:{form.line}: column '{form.names[place]}' occurs twice")
    if series:
        labels: list[str] = []
        t, (mixed,) = _read(path, raw, clock, [value], left_out, {label: labels}, (
            label, frozenset(asked.union(column.name for column in found.values()))))
        mine, *others_of = (np.array(labels) == form.names[place] for place in places)
        _check_one_series(path, raw, t, raw.names[value], np.where(mine, mixed, np.nan))
        values, stamps, t = [mixed[mine]], t, t[mine]
        for rows in others_of:
            # The last value of each series at the stamps of the voltage.
            part = np.flatnonzero(rows)
            part = part[np.argsort(stamps[part], kind='stable')]
            values.append(np.append(mixed[part], np.nan)[
                np.searchsorted(stamps[part], t, side='right') - 1])
    else:
        t, values = _read(path, form, time, places, left_out)
    volts = next(zip(found, values), (None, t))[1] if logs.VOLTAGE in found else t
    if time.place and (np.diff(t) < 0.0).sum() > _BACK * t.size and (np.diff(volts) > 0.0).all():
        raise InputError(f"{path}: '{time.name}' runs backwards, and '{found[logs.VOLTAGE].name}' "
                         'only ever rises: are the two columns swapped?')
    if logs.VOLTAGE in found and wanted.voltage is None and t.size and not np.nan_to_num(
            volts).any() and len(form.names) > 2:
        raise InputError(f"{path}: '{found[logs.VOLTAGE].name}' is 0 or blank in every row, as "
                         'without its sensor: name another column by --voltage-column')
    t, words = _stamps(path, t, raw, wanted, clock)
    units = {'voltage': wanted.unit, 'throttle': wanted.throttle_unit}
    scaled, guesses = {}, {_TIME_NAME: words}
    for (quantity, column), column_values in zip(found.items(), values):
        if quantity == logs.VOLTAGE:
            # Add the cells of a pack; absent ones read as unknown.
            column_values = column_values + sum(np.where(np.isfinite(cell) & (
                cell != 65535.0), cell, 0.0) for cell in values[len(found) + len(others):])
        column_values = column_values * factor_of(column.name)
        si, guesses[quantity] = _in_si(quantity, column, column_values, units.get(quantity), volts,
                                       guesses.get(logs.VOLTAGE, ''))
        scaled[quantity] = column, si
    if logs.VOLTAGE in scaled and not series:
        column, si = scaled[logs.VOLTAGE]
        _check_one_series(path, form, t, column.name, si)
    spread = _spread(t, volts)
    if not np.array_equal(spread, t, equal_nan=True):
        guesses[_TIME_NAME] += ', equal stamps spread evenly, a guess: --sample-interval'
    note = _read_note(form, time, found, guesses, wanted)
    return _Table(form, time, spread, scaled, dict(zip(others, values[len(found):])), note)


def _absent(path: Path, form: Form, name: str, option: str = '') -> str:
    """Return the error for a missing column."""
    if not form.line and sum(len(row) != form.width for row in form.rows) > _BACK * len(form.rows):
        hint, option = ('its lines have different numbers of cells: keep those of one kind in a '
                        'file of their own'), ''
    else:
        hint = nearest(name, form.names) if form.line else (
            f'the first line holds numbers; add a header {TIME},{VOLTAGE}[,{THROTTLE}] or give '
            "'column 1'")
    return f"{path}:{form.line or form.skip + 1}: no column '{name}': {hint}" + option


def _column_place(path: Path, form: Form, name: str, option: str) -> int:
    if name not in form.names:
        raise InputError(_absent(path, form, name, f' ({option} names another)'))
    return form.names.index(name)


def _plain_names(form: Form) -> list[str]:
    """Return the names without units, as the patterns have them."""
    return [re.sub(r'\W+', '_', unit_of(name)[0].strip().lower()).strip('_') or 'time' * bool(
        unit) for name, unit in zip(form.names[:form.width], form.units)]


def _choose(form: Form, quantity: str, taken: Sequence[int] = (), text: bool = False
            ) -> list[int]:
    """Return the candidate columns of a quantity, the best first (text: those of words)."""
    plain = _plain_names(form)
    ends = [re.sub(r'\W+', '_', re.split(
        r'[/.:](?=[^/.:])(?![^\[(]*[\])]$)', name.strip().lower())[-1]).strip('_')
        for name in form.names[:form.width]]
    right = _UNITS[quantity]
    free = [k for k in range(len(plain)) if k not in taken and form.names[k]
            and _holds_numbers(form, k, quantity == _TIME_NAME) is not text]
    for pattern in _PATTERNS[quantity]:
        found = list(dict.fromkeys(
            k for texts in ([form.names[k].strip() for k in range(len(plain))], plain, ends)
            for k in free if re.fullmatch(pattern, texts[k] or ' ')
            and (form.units[k] in right or not form.units[k])))
        if found:
            # Stated units decide between names: `v [V]` before `u`.
            return sorted(found, key=lambda k: form.units[k] not in right)
    others = '|'.join(pattern for name, patterns in _PATTERNS.items() if name != quantity
                      for pattern in patterns[:3])
    found = [k for k in free if quantity != logs.THROTTLE and form.units[k] in right
             and not re.fullmatch(others, plain[k] or ' ')]
    if not found and quantity == logs.VOLTAGE:
        # A column of 0 and 1 only is a line of a logic analyser.
        found = [k for k in free if CHANNEL.fullmatch(plain[k] or ' ')
                 and not {*form.cells(k)} <= {'0', '1'}]
    return found


def _holds_numbers(form: Form, place: int, clock: bool) -> bool:
    """Return whether the first cells of a column are numbers (clock: or dates or times)."""
    cells = [cell for cell in form.cells(place) if not is_missing(cell)]
    return not cells or any(is_value(cell) if clock else is_number(cell) for cell in cells)


def _holds_clocks(form: Form, place: int) -> bool:
    """Return whether the first cell of a column is a date or a time, and no number."""
    return any(not is_number(cell) and is_clock(cell) for cell in form.cells(place)[:1])


def _time_of(path: Path, form: Form, wanted: CsvColumns) -> _Column:
    """Return the column of the time, or that rows are counted."""
    if wanted.sample_interval is not None:
        return _Column((), '--sample-interval', 's', wanted.sample_interval)
    if wanted.time is not None:
        return _unit_column(form, _column_place(path, form, wanted.time, '--time-column'),
                            wanted.time_unit)
    numbered = bool(form.rows) and form.width > 1 and re.fullmatch(
        _INDEX_NAME, unit_of(form.names[0])[0].strip('# ').lower()) is not None
    found = [] if numbered and math.isfinite(form.step) else _choose(form, _TIME_NAME) or [
        k for k in range(min(form.width, len(form.names))) if form.rows and all(
            k < len(row) and ':' in row[k] and is_clock(row[k]) for row in form.rows)]
    if form.rows:
        found = [k for k in found if form.cells(k)]
    if found:
        first = _finest(form, found[0])
        beside = [k for k in range(min(form.width, len(form.names))) if k != first and any(
            k < len(row) and has_day(row[k]) and ':' not in row[k] for row in form.rows[:3])]
        if parts := _parts_of_second(form, first):
            return parts
        cells = form.cells(first)
        if beside and ':' in cells[0] and not has_day(cells[0]):
            return _Column((beside[0], first),
                           f'{form.names[beside[0]]}, {form.names[first]}', 's', 0.0)
        return _unit_column(form, first, wanted.time_unit)
    filled = _nameless_columns(form)
    if len(filled) > 1 and _rises(form, filled[0]):
        return _parts_of_second(form, filled[0]) or _unit_column(
            form, filled[0], wanted.time_unit)
    if not math.isfinite(form.step):
        raise InputError(_absent(path, form, TIME, ' (--time-column or --sample-interval)'))
    return _Column((), form.stated, 's', form.step)


def _finest(form: Form, first: int) -> int:
    """Return another time if the chosen one starts anew or does not tell the rows apart."""
    named = [k for k in range(min(form.width, len(form.names)))
             if (re.search('time|zeit', form.names[k].lower()) or form.units[k] in TIME_WORDS)
             and not re.search(
                 'step|lap|interval', form.names[k].lower()) and _holds_numbers(form, k, True)]
    # A time with decimals and a unit is finer than a clock of whole seconds.
    whole = all(re.search(r':\d\d:\d\d$', cell) for cell in form.cells(first))
    finer = [k for k in named if whole and form.units[k] in TIME_WORDS and any(
        '.' in cell and is_number(cell) for cell in form.cells(k))]
    # A new start falls to the first time or below it; a late line does not, and is sorted later.
    t = _times(form, first)
    anew = bool(((np.diff(t)[1:] < 0.0) & (t[2:] <= t[0])).any()) if t.size else False
    return next((k for k in (*finer, first, *named) if (
        not anew if k == first else _rises(form, k)) and (
        2 * len({*form.cells(k)}) > len(form.rows) or len(form.rows) < _FEW_ROWS)), first)


def _parts_of_second(form: Form, clock: int) -> _Column | None:
    """Return a time in whole seconds with the column of ms or ns beside it, if there is one."""
    cells = form.cells(clock)
    if all(map(str.isdigit, cells)):
        unit, pattern = 'ns', r'.*n(?:ano)?_?se?cs?'
        rest = [clock + 1] if not form.line and clock_unit(float(cells[0])) == 's' else []
    elif all(re.search(r':\d\d:\d\d$', cell) for cell in cells):
        unit, pattern, rest = 'ms', 'ms|millis|milliseconds?|frac.* sec.*', []
    else:
        return None
    most = 3 if unit == 'ms' else 9
    return next((_Column((clock, k), f'{form.names[clock]}, {form.names[k]}', unit, 0.0)
                 for k, name in enumerate(form.names[:form.width])
                 if k != clock and (k in rest or re.fullmatch(pattern, name.strip().lower()))
                 and all(k < len(row) and re.fullmatch(rf'0?\.\d+|\d{{1,{most}}}', row[k])
                         for row in form.rows)), None)


def _nameless_columns(form: Form) -> list[int]:
    """Return the columns without a telling name whose first cells are numbers."""
    filled = [k for k in range(form.width) if form.rows and len(form.cells(k)) == len(
        form.rows) and all(map(is_value, form.cells(k)))]
    # In a file with names, only a single column beside the time; others may hold several series.
    return filled if not form.line else [k for k in filled[1:] if form.width == 2 and re.fullmatch(
        _VALUE_NAME, re.split('[./]', form.names[k].lower())[-1])]


def _steadiest(form: Form, places: list[int]) -> list[int]:
    """Return the only column, or the first of several if its relative variation is smallest."""
    # A load changes a supply's voltage by a few percent, and its current by far more.  Constant
    # columns, and those anywhere below 1, are not compared.
    if len(places) < 2 or form.line or len(form.rows) < _FEW_ROWS:
        return places if len(places) == 1 else []
    values = np.array([[number_of(row[k])[0] if is_number(row[k]) else math.nan for k in places]
                       for row in form.rows])
    spread = np.ptp(values, axis=0) / np.maximum(values.mean(axis=0), 1e-9)
    able = np.flatnonzero((values.min(axis=0) >= 1.0) & (spread > 0.0) & (spread < 1.0))
    least = able.size and np.argmin(spread[able]) == 0
    return [places[k] for k in able] if least else []


def _times(form: Form, place: int) -> FloatArray:
    """Return the times in a column in the first rows: numbers as written, clocks in s."""
    cells = form.cells(place)
    return np.array([number_of(cell)[0] for cell in cells]) if all(map(is_number, cells)) else (
        clock_times(Path(), cells, form.names[place], []))


def _rises(form: Form, place: int) -> bool:
    """Return whether the times in a column never fall in the first rows."""
    return not (np.diff(_times(form, place)) < 0.0).any()


def _unit_column(form: Form, place: int, unit: str | None) -> _Column:
    name, stated = form.names[place], form.units[place]
    end = re.split('[./:]', name.strip().lower())[-1]
    raw = next((units[end] for column, units in _RAW.items()
                if column in ('', *form.names) and end in units), None)
    if raw and raw[1].startswith(unit or '') and not (stated and unit is None):
        if end == 'vbatlatest' and re.search(r'Betaflight 3\.[1-9]|Cleanflight [2-9]', form.above):
            raw = 0.1, '0.1 V', math.nan
        return _Column((place,), name, raw[1], raw[0], raw[2])
    return _Column((place,), name, unit or stated, 0.0)


def _stem(name: str) -> str:
    """Return a name without the words for voltage, current and their units."""
    return re.sub(r'volt(?:age)?s?|curr(?:ent)?|amp(?:erage|s)?|spannung|strom', '', unit_of(
        name)[0].lower())


def _supply_of(path: Path, form: Form, wanted: CsvColumns, time: _Column, needed: bool,
               ) -> dict[str, _Column]:
    """Return the columns of voltage, throttle and current that exist."""
    names = {logs.VOLTAGE: (wanted.voltage, '--voltage-column', wanted.unit),
             logs.THROTTLE: (wanted.throttle, '--throttle-column', wanted.throttle_unit),
             logs.CURRENT: (wanted.current, '--current-column', None)}
    given = [form.names.index(name) for name in (
        wanted.time, *(name for name, *_ in names.values())) if name in form.names]
    taken = [*time.place, *given]
    currents = {_stem(form.names[k]) for k in _choose(form, logs.CURRENT, taken)}
    found: dict[str, _Column] = {}
    for quantity, (name, option, unit) in names.items():
        if name == NONE and quantity != logs.VOLTAGE:
            continue
        if name is not None:
            place = _column_place(path, form, name, option)
            found[quantity] = _unit_column(form, place, unit)
            continue
        places = _choose(form, quantity, taken)
        if not places and quantity == logs.VOLTAGE:
            # Another option may have taken it; that is refused below.
            places = [k for k in _choose(form, quantity) if k in given]
        if quantity == logs.VOLTAGE:
            # Prefer a voltage that has a current of the same name.
            places.sort(key=lambda k: _stem(form.names[k]) not in currents)
        if not places and quantity == logs.VOLTAGE:
            places = _steadiest(form, [k for k in _nameless_columns(form) if k not in taken])
        if places:
            found[quantity] = _unit_column(form, places[0], unit)
            taken.append(places[0])
    owners = dict.fromkeys(time.place, 'time')
    for quantity, column in found.items():
        if (place := column.place[0]) in owners:
            raise InputError(f"{path}: column '{column.name}' cannot be both {owners[place]} and "
                             f'{quantity}: name another with --{quantity}-column or '
                             f'--{owners[place]}-column')
        owners[place] = quantity
        stated = form.units[place] or ''.join(
            re.split(r'[\[({]', column.name.lower())[1:][-1:]).rstrip('])} ')
        name, _, unit = names[quantity]
        if name and not unit and stated in {*WORDS, *OTHER_WORDS} - {'', '-', *_UNITS[quantity]}:
            kind = next((f'a unit of {one} (--{one}-column)' for one, words in _UNITS.items()
                         if stated in words), f"the unit '{stated}'")
            more = {logs.VOLTAGE: ', or give --unit',
                    logs.THROTTLE: ', or give its ends by --throttle-unit LOW:HIGH'}
            raise InputError(f"{path}: '{name}' has {kind}: name a column of "
                             f'{quantity}{more.get(quantity, "")}')
    if needed and logs.VOLTAGE not in found:
        raise InputError(_absent(path, form, VOLTAGE, ' (--voltage-column)'))
    return found


def _series_of(path: Path, form: Form, wanted: CsvColumns, time: _Column,
               ) -> tuple[Form, int, int] | None:
    """Return the form of the series that rows name, and the columns of their names and values."""
    named = _choose(form, logs.VOLTAGE, time.place)
    if not form.line or not time.place or (
            named if wanted.voltage is None else wanted.voltage in form.names):
        return None
    places = [k for k in range(min(form.width, len(form.names))) if k not in time.place]
    value = [k for k in places if _holds_numbers(form, k, False) and re.fullmatch(
        rf'(?=.)(?:{_VALUE_NAME}|state)', form.names[k].lower())] or named
    for place in (k for k in places if value and not _holds_numbers(form, k, True)):
        labels: list[str] = []
        stated: list[str] = []
        beside = has_unit_beside(form.names, value[0]) and value[0] + 1 != place
        numbers(path, form, [], {place: labels} | ({value[0] + 1: stated} if beside else {}), [])
        names = tuple(sorted({*labels} - {''}))
        own = {name: first_word(unit) for name, unit in zip(labels, stated)}
        series = form._replace(names=names, width=len(names), rows=(), units=tuple(
            unit_of(name)[1] or (word if (word := own.get(name, '')) in WORDS else '')
            or unit_of(form.names[value[0]])[1] for name in names))
        if wanted.voltage in names or len(names) <= MOST_COLUMNS and _choose(
                series, logs.VOLTAGE):
            return series, place, value[0]
    return None


def _read(path: Path, form: Form, time: _Column, places: list[int],
          left_out: list[str] | None = None, texts: dict[int, list[str]] | None = None,
          only: tuple[int, frozenset[str]] | None = None) -> tuple[FloatArray, list[FloatArray]]:
    """Return the time as written, days and clocks in s, and columns; texts as in `numbers`."""
    if not time.place:
        if not LEAST_STEP <= time.scale <= LONGEST_STEP:
            raise InputError(f"{path}: by '{time.name}' the rows are {time.scale:g} s apart, not "
                             f'within {LEAST_STEP:g} to {LONGEST_STEP:g} s')
        values = numbers(path, form, places or [0], left_out=left_out)
        return time.scale * np.arange(float(values[0].size)), values
    if _holds_clocks(form, time.place[0]):
        clocks: list[list[str]] = [[] for _ in time.place]
        values = numbers(path, form, places, dict(zip(time.place, clocks)) | (texts or {}),
                         left_out, only)
        cells = list(map(' '.join, zip(*clocks)))
        if len(clocks) > 1 and all(re.fullmatch(r'[\d.]+', part) for part in clocks[1]):
            cells = [f"{clock}.{part.split('.')[-1] if '.' in part else f'{part:0>3}'}"
                     for clock, part in zip(*clocks)]
        return clock_times(path, cells, time.name, left_out), values
    t, *values = numbers(path, form, [*time.place, *places], texts, left_out, only)
    if len(time.place) > 1:
        part, *values = values
        t = t + part * TIME_UNITS[time.unit]
    return _unwrapped(t) * factor_of(time.name), values


def _unwrapped(t: FloatArray) -> FloatArray:
    """Unwrap a 32-bit counter of a time; micros() wraps after 72 minutes."""
    known = np.isfinite(t)
    if ((t[known] >= 0.0) & (t[known] < _COUNTS)).all():
        on = np.unwrap(t[known], period=_COUNTS)
        # A restart of the logger is not a wrap: unwrapped, it would leave an unusually long step.
        if (np.diff(on) <= 2.0 * np.diff(t[known]).max(initial=0.0)).all():
            t[known] = on
    return t


def _check_one_series(path: Path, form: Form, t: FloatArray, column: str, values: FloatArray,
                      ) -> None:
    """Raise InputError if a column of text names several series that share a column of values."""
    # Stamps rise within each series.  Several series are likely if stamps go back (they overlap),
    # or if the column of values has a general name.
    known = np.isfinite(t) & np.isfinite(values)
    stamps = t[known]
    overlap = np.count_nonzero(
        stamps[1:] <= np.maximum.accumulate(stamps)[:-1]) > WILD * stamps.size
    if not overlap and not re.fullmatch(_VALUE_NAME, column.lower()):
        return
    for place, label in enumerate(form.names[:form.width]):
        first = form.cells(place)
        cells = [] if not first or any(map(is_value, first)) or has_unit_beside(
            form.names, place - 1) else _cells(path, form, place, t.size)
        if not cells:
            continue
        names, which = np.unique(np.array(cells)[known], return_inverse=True)
        if not 1 < names.size <= which.size / _FEW_ROWS:
            continue
        order = np.argsort(which, kind='stable')
        within = np.diff(stamps[order])[np.diff(which[order]) == 0]
        if np.mean(within <= 0.0) <= WILD and (overlap or np.mean(np.diff(which) != 0) > _BACK):
            raise InputError(
                f"{path}: '{column}' holds several series, named in '{label}': "
                f'{shown(some(map(printable, names), 3))}; '
                f'{"name one with --voltage-column, or " * bool(form.line)}keep the rows of one')


def _cells(path: Path, form: Form, place: int, size: int) -> list[str]:
    """Return the cells of a column as written; none if bad lines change their number."""
    cells: list[str] = []
    numbers(path, form, [], {place: cells}, [])
    return cells if len(cells) == size else []


def _stamps(path: Path, t: FloatArray, form: Form, wanted: CsvColumns, time: _Column,
            ) -> tuple[FloatArray, str]:
    """Return the time in s, and its unit in words."""
    if not time.place:
        return t, f'{time.scale:g} s'
    if _holds_clocks(form, time.place[0]):
        return t, 'dates and times'
    known = t[np.isfinite(t)]
    steps = np.abs(np.diff(known))
    usual = float(np.median(steps[steps > 0.0])) if steps.any() else 0.0
    if len(time.place) > 1:
        unit, words = 's', ''
    elif time.unit:
        unit, words = time.unit if wanted.time_unit else TIME_WORDS[time.unit], ''
    else:
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
    # A unit of minutes or more is no mistake for a finer one; a unit from the user is accepted.
    if usual * SCALES[unit] > LONGEST_STEP and SCALES[unit] <= 1.0 and not wanted.time_unit:
        raise InputError(f'{path}: the samples are {usual * SCALES[unit]:g} s apart by '
                         f"'{time.name}': is it in ms, us or ns? Give --time-unit")
    return t, unit + words


def _spread(t: FloatArray, volts: FloatArray) -> FloatArray:
    """Spread rows with equal stamps evenly, if their number per stamp is steady."""
    # The first row of a stamp is at the stamp, unless rows are missing before it.
    known = np.flatnonzero(np.isfinite(t) & np.isfinite(volts))
    stamps, change = t[known], np.diff(volts[known])
    begin = np.flatnonzero(np.diff(stamps, prepend=math.inf))
    step, rows = np.diff(stamps[begin]), np.diff(begin)[1:]
    if step.size and (step < 0.0).all():
        return _spread(t[::-1], volts[::-1])[::-1]
    if rows.size < 2 or _LEAST_SHARED * begin.size > known.size or (step < 0.0).any():
        return t
    usual, first = float(np.median(rows)), change[begin[1:] - 1]
    # Leave the stamps if the voltage changes only where the stamp does (repeated rows), or always
    # in one direction where it does (several series in turn).
    if np.mean(np.abs(rows - usual) > max(1.0, _UNSTEADY * usual)) > WILD or np.count_nonzero(
            first) > (1.0 - WILD) * np.count_nonzero(change) or abs(
                np.mean(first) - np.mean(change)) > _ROUNDING + np.std(first) * max(
                    1.0, _SURE / math.sqrt(first.size)):
        return t
    row, even = np.arange(float(known.size)), stamps.copy()
    pauses = np.flatnonzero(step > 1.5 * np.median(step)) + 1
    for part in np.split(begin, pauses):
        end = begin[begin > part[-1]].min(initial=known.size)
        # The first and the last stamp may lack rows.
        x = np.unique(np.append(part[1::_EVEN], part[-1]))
        rate = np.ptp(stamps[x]) / np.ptp(x) if x.size > 1 else np.median(step) / usual
        here = row[part[0]:end]
        even[part[0]:end] = np.interp(here, x, stamps[x]) + rate * (
            np.minimum(here - x[0], 0.0) + np.maximum(here - x[-1], 0.0))
    return t if (np.diff(even) <= 0.0).any() else np.where(
        np.isfinite(t), np.interp(np.arange(float(t.size)), known, even), t)


def _in_si(quantity: str, column: _Column, values: FloatArray, given: str | None,
           volts: FloatArray, beside: str) -> tuple[FloatArray, str]:
    """Return values in V, 0..1 or A, and their unit in words (beside: the voltage's unit)."""
    known = np.abs(values[np.isfinite(values)])
    if quantity == logs.THROTTLE:
        unit = given or SHARE_WORDS.get(column.unit) or _PULSE_WORDS.get(column.unit)
        guess = unit is None
        if guess and column.name.lower() == 'rc.throttle' and known.size and known.max() > 100.0:
            unit = _DJI
        unit = unit or _throttle_unit(values[np.isfinite(values)], volts)
        # Percentages below 0 are of a stick, except a duty, which is of a motor in reverse.
        if given is None and unit == '%' and np.mean(values < -MOST_THROTTLE) > WILD and not (
                re.search('duty|pwm', column.name.lower())):
            guess, unit = True, '-100:100'
        words = ', a guess: --throttle-unit' if guess and unit != '1' else ''
        if unit in ('us', 'ms'):
            # 0: an output without pulses.
            values = np.where(values == 0.0, THROTTLE_UNITS[unit][0], values)
        low, high = THROTTLE_UNITS.get(unit) or map(float, unit.split(':'))
        return (values - low) / (high - low), (
            '0..1' if unit == '1' else unit) + words
    # Use the maker's factor, unless it makes a supply of less than 1 V: then the numbers were
    # converted already, under the same names.
    if column.scale and 'V' not in (given, beside) and (
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
        unit, words = ('mV', ', a guess: --unit') if known.size and np.median(
            known) > _MOST_VOLTS else ('V', '')
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
    # With a voltage within 0 to 1 it may be the voltage: `check_throttle` reports it.
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


def _read_note(form: Form, time: _Column, found: dict[str, _Column], units: dict[str, str],
               wanted: CsvColumns) -> str:
    """Return in one line how a file was read; '' if nothing was detected."""
    encoding = '' if form.encoding in ('utf-8', 'utf-8-sig') else f', {form.encoding}'
    used = {*time.place, *(column.place[0] for column in found.values())}
    lacking = [quantity for quantity in (logs.THROTTLE, logs.CURRENT)
               if quantity not in found and getattr(wanted, quantity) is None]
    # Columns whose names fit, but whose cells are words.
    words_of = [f'{form.names[k]} (text)' for quantity in lacking if form.line
                for k in _choose(form, quantity, sorted(used), text=True)[:1]]
    if time.name == TIME and not form.comma and not encoding and {
            column.name for column in found.values()} <= {VOLTAGE, THROTTLE, CURRENT} and not any(
                'guess' in words for words in units.values()) and not words_of:
        return ''
    between = {',': 'commas', ';': 'semicolons', '\t': 'tabs', ' ': 'blanks'}.get(
        form.delimiter, f"'{form.delimiter}'")
    parts = [f"time from '{time.name}' ({units[_TIME_NAME]})"]
    parts += [f"{quantity} from '{column.name}' ({units[quantity]})"
              for quantity, column in found.items()]
    places = _choose(form, logs.VOLTAGE, time.place)[1:3] if form.line else _steadiest(
        form, [k for k in _nameless_columns(form) if k not in time.place])[:3]
    others = [form.names[k] for k in places
              if form.names[k] not in {column.name for column in found.values()}]
    also = f'; also found: {", ".join(others)} (--voltage-column)' if others else ''
    if lacking:
        # Mention columns that may be a throttle or current under another name.
        plain = _plain_names(form)
        rest = [*words_of, *(
            name for k, name in enumerate(form.names[:form.width])
            if k not in used and name not in others
            and not any(re.fullmatch(one, plain[k] or ' ') for one in _PATTERNS[_TIME_NAME])
            and form.units[k] not in TIME_WORDS.keys() - _PULSE_WORDS.keys()
            and (logs.THROTTLE in lacking or re.search('curr|amps|strom|cour', name.lower()))
            and not re.fullmatch(_INDEX_NAME, name.strip('# ').lower())
            and (not form.rows or any(
                is_number(cell) and not is_missing(cell) for cell in form.cells(k))))]
        options = ' or '.join(f'--{quantity}-column' for quantity in lacking)
        also += f'; not read: {some(rest, 3)} ({options})' if rest else ''
    return (f"Read {', '.join(parts)}{also}; cells between {between}, decimal "
            f"{'comma' if form.comma else 'point'}{encoding}, numbers from line "
            f'{form.skip + 1} on{", without rows of outer tables" * (form.indent > 0)}.')
