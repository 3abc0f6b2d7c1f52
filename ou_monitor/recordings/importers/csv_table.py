"""
Read a table of text, such as a CSV: time, voltage and, where present, throttle and current.

Limits: a file is one flight; all rows have the same number of cells; a column holds one series.
Columns and units are found by names and by the sizes of values, and reported in one note; fields
of `CsvColumns` override them. A unit in a name or in a line of units is taken as stated; an
unstated unit is guessed from the values. `time_s`, `voltage_v`, `throttle` and `current_a` are
taken first and need no note.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, islice
import math
from pathlib import Path
import re
from typing import NamedTuple

import numpy as np
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.importers import log as logs
from ou_monitor.recordings.importers.csv_cells import (
    AMPERE_WORDS, BadLine, CHANNEL, clock_times, factor_of, FileColumn, has_day, in_si, is_clock,
    is_missing, is_number, is_value, lower_rows, MOST_VOLTS, number_of, OTHER_WORDS, PULSE_WORDS,
    SCALES, SHARE_WORDS, shown, stamps_of, TIME_WORDS, unit_of, unwrapped, VOLT_WORDS, WORDS)
from ou_monitor.recordings.importers.csv_form import (
    Form, form_of, has_unit_beside, holds_clocks, holds_numbers, numbers, THROTTLE, TIME, VOLTAGE)
from ou_monitor.recordings.importers.log import (
    ANY, CsvColumns, Log, Request, Series)
from ou_monitor.records import (
    clock_unit, Defect, FloatArray, LEAST_STEP, LONGEST_STEP, Note, Recording, TIME_UNITS)
from ou_monitor.text import counted, printable, some
from ou_monitor.timeline import check_stamps, held_words, hold, plausible_stamps, WILD

CURRENT = 'current_a'
NONE = 'none'
# Maximum columns listed; autopilots log a few hundred.
MOST_COLUMNS = 300
# Share of backward steps above which a column is not a time.
_BACK = 0.25
# Maximum number of series whose names are whole numbers: MAVLink has up to nine batteries.
_MOST_SERIES = 9
# Minimum number of rows to compare, for example to detect repeated stamps.
_FEW_ROWS = 8


# Quantity -> patterns of the end of a column's name without its unit, the best first; names are in
# lower case, with '_' for other characters. From the exports named in test_csv_exports.py.
_VALUE_NAME = r'_?(?:values?|reading|data|ampl(?:itude)?|wert|messwert)?'
_TIME_NAME, _INDEX_NAME = 'time', r'sequence|index|sample|no|n|x|point|'
# Words in names of columns that are not the supply's voltage.
_OTHERS = 'axis|cell|temp|limit|zelle|motor|servo|rssi|phase|cpu|mcu|5v|sag'
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
        r'u|v|vol|volts?|voltage|spannung|tension|tensione|voltaje|电压|[UVuv]\(.*\)|'
        r'[uv](?:rms|dc|mean|mn)?_?1?|[uv]_1_[uv](?:rms|dc|mean|mn)',
        r'volt(?:age)?_?filtered(?:_v)?|rxbt',
        rf'(?!.*(?:{_OTHERS})).*(?:volt|spannung|vbat).*', r'[uv]?_?(?:akku|supply|rail)|spg'),
    logs.THROTTLE: (
        r'throttle|(?:.*_)?actuator_motors(?:_\d+)?_control_0+',
        r'thr(?:ottle)?_?(?:out|cmd|command|pct|percent)?|(?:commande_)?ga[sz]|'
        r'acelerador|油门|duty(?:_cycle)?|tho?o|tps|tastgrad|tastverh.*',
        r'rc_?command_3',
        r'rc_?data_3|rc_?out?(?:_?ch?_?3)?|servo3_raw',
        r'pwm|rc_?out?_?ch?_?1|thrust|gas_?(?:kanal|stellung|hebel)|esc(?:_signal|_pwm)?|'
        r'(?!.*(?:limit|trim|max|min)).*throttle.*', r'accelerator_pedal(?:_pos(?:ition)?)?'),
    logs.CURRENT: (
        r'current_a', r'amperage(?:_?latest)?|current_in|i_?bat(?:t|tery)?|'
        r'batt?(?:ery)?_?\d?_?(?:i|curr(?:ent)?|amps?)|current_?batt?(?:ery)?|'
        r'(?:.*_)?(?:bus|input|supply|main|pack|total|bms)_?current|i_?bus|curr',
        r'(?:i(?:rms|dc|mn)?|curr(?:ent)?|amps?|strom|courant|corriente|电流)'
        r'(?:_?(?:avg|average|mean))?(?:_?1)?|i_1_i(?:rms|dc|mn)|'
        r'(?!.*(?:max|min|limit)).*_batt?(?:ery)?_current'),
}
_UNITS = {_TIME_NAME: TIME_WORDS, logs.VOLTAGE: VOLT_WORDS, logs.CURRENT: AMPERE_WORDS,
          logs.THROTTLE: {**SHARE_WORDS, **PULSE_WORDS}}
# Exports with unscaled numbers.  Column that reveals the program ('': any program) -> end of a
# column's name, in lower case -> factor, unit, and the number that stands for "unknown".
# Betaflight's blackbox explorer: us, 0.01 V and 0.01 A, as logged from version 4.0 on.  MAVLink:
# SYS_STATUS, BATTERY_STATUS and POWER_STATUS (common.xml).
_RAW: dict[str, dict[str, tuple[float, str, float]]] = {
    'loopIteration': {'time': (0.0, 'us', math.nan), 'rccommand[3]': (0.0, 'us', math.nan), **{
        f'{name}{end}': (0.01, unit, math.nan) for name, unit in (
            ('vbat', '0.01 V'), ('amperage', '0.01 A')) for end in ('', 'latest')}},
    '': {name: (scale, f'{unit} by MAVLink, {unknown:g} means unknown; for V and A: --unit V',
                unknown)
         for name, scale, unit, unknown in (
             ('voltage_battery', 1e-3, 'mV', 65535.0), ('voltages[0]', 1e-3, 'mV', 65535.0),
             ('vcc', 1e-3, 'mV', 0.0), ('vservo', 1e-3, 'mV', 0.0),
             ('current_battery', 1e-2, '10 mA', -1.0))}}
# Names of the first of several columns: cells of a pack are added, motors of PX4 averaged.
_FIRST_OF = {
    logs.VOLTAGE: re.compile(r'(.*voltages\[)0(\])', re.IGNORECASE),
    logs.THROTTLE: re.compile(r'(.*actuator_motors(?:\.\d+)?[/.]control[.\[]0?)0(\]?)')}


class _Table(NamedTuple):
    """The data read from a file, in SI units."""

    form: Form
    time: FileColumn  # Without a place if only the interval is stated
    t: FloatArray
    found: dict[str, tuple[FileColumn, FloatArray]]  # By quantity
    named: dict[str, FloatArray]  # Other requested columns, as written
    notes: list[str]  # How the file was read, if anything was detected; rows left out


def read_csv(path: Path, columns: CsvColumns | None = None, *, partial: bool = False,
             ) -> Recording:
    """Read the samples of a supply, unsorted, with NaN kept (partial: leave out bad lines)."""
    left_out: list[BadLine] | None = [] if partial else None
    table = _table(path, columns or CsvColumns(), left_out=left_out)
    said = [*table.notes]
    if left_out:
        if len(left_out) > WILD * table.t.size:
            raise InputError(f'{left_out[0].error(path)} ({len(left_out)} such lines, too many to '
                             'leave out)')
        line, why = left_out[0]
        said.append(Note(
            f'{counted(len(left_out), "bad line")} left out, such as '
            f'{"" if line is None else f"line {line}: "}{printable(why)}.', Defect.DAMAGED_FILE))
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
    throttle = held.get(logs.THROTTLE, nothing)
    said += filter(None, [held_words(t, t[np.isfinite(throttle)])])
    throttle = hold(throttle)
    if filled.any():
        t, volts, throttle, current = (one[filled] for one in (t, volts, throttle, current))
    if t.size >= _FEW_ROWS and 2 * np.unique(t).size < t.size:
        said.append('Most rows repeat the last stamp: if evenly spaced, give --sample-interval.')
    return Recording(plausible_stamps(name, t), volts, throttle, name, source, tuple(said),
                     current)


def read(path: Path, request: Request) -> Log:
    """Read the columns of a supply, and the requested ones."""
    table = _table(path, request.columns or CsvColumns(), more=request.names, needed=(
        '' if request.names or request.everything else ' (--voltage, see convert LOG --list)'))
    header, t = [name for name in table.form.names if name], table.t
    if not t.size:
        raise InputError(f'{path} holds a header and no line below it')
    if logs.VOLTAGE in table.found:
        check_stamps(printable(path.name), t, table.found[logs.VOLTAGE][1])
    taken = {column.name: quantity for quantity, (column, _) in table.found.items()}
    series = [Series(column.name, quantity, t, values, '1', 'column', 0)
              for quantity, (column, values) in table.found.items()]
    words = {name for name, values in table.named.items()
             if name not in request.names and not np.isfinite(values).any()}
    series += [Series(name, ANY, t, values, '1', 'column')
               for name, values in table.named.items() if name not in {*taken, *words}]
    notes = [*table.notes]
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
        # Read each column in a pass of its own, because a column of text stops the pass.
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
    table = _table(path, columns or CsvColumns(), more=(name,), needed='')
    if name not in table.named:
        raise InputError(_absent(path, table.form, name))
    return table.t, table.named[name]


def read_throttle_alone(path: Path, columns: CsvColumns | None = None,
                        ) -> tuple[FloatArray, FloatArray]:
    """Return the stamps, s, and the throttle, 0..1, of a CSV that needs no voltage."""
    table = _table(path, columns or CsvColumns(), needed='')
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
            _supply_of(path, form, wanted, time, ' (--voltage-column)')
            return True
    return False


def _table(path: Path, wanted: CsvColumns, *, more: Iterable[str] = (),
           needed: str = ' (--voltage-column)', left_out: list[BadLine] | None = None) -> _Table:
    """Read time, supply and named columns (needed: hint if no voltage is found; '': optional)."""
    form = form_of(path, wanted)
    time = _time_of(path, form, wanted)
    found = _supply_of(path, form, wanted, time, needed)
    if wanted.decimal is None and _has_thousands(form, time, found):
        return _table(path, replace(wanted, decimal=','), more=more, needed=needed,
                      left_out=left_out)
    others = {name: place for name in more if (place := _place_of(form, name)) is not None}
    for name, place in others.items():
        if place in time.place:
            raise InputError(f"{path}: '{name}' is the time, not a signal")
    group = {quantity: _rest_of_group(form, quantity, column, wanted)
             for quantity, column in found.items()}
    places = [*(one.place[0] for one in found.values()), *others.values(),
              *chain.from_iterable(group.values())]
    for place in (*time.place, *places):
        same = [k for k, name in enumerate(form.names) if name == form.names[place]]
        if len(same) > 1 and not (place in time.place and all(
                form.cells(k) == form.cells(place) for k in same)):
            raise InputError(f"{path}:{form.line}: column '{form.names[place]}' occurs twice" + (
                ', with other times: give --sample-interval' * (place in time.place)))
    t, values = _read(path, form, time, places, left_out)
    volts = next(zip(found, values), (None, t))[1] if logs.VOLTAGE in found else t
    if time.place and (np.diff(t) < 0.0).sum() > _BACK * t.size and (np.diff(volts) > 0.0).all():
        raise InputError(f"{path}: '{time.name}' runs backwards, and '{found[logs.VOLTAGE].name}' "
                         'only ever rises: are the two columns swapped?')
    if logs.VOLTAGE in found and wanted.voltage is None and t.size and not np.nan_to_num(
            volts).any() and len(form.names) > 2:
        raise InputError(f"{path}: '{found[logs.VOLTAGE].name}' is 0 or blank in every row, as if "
                         'it had no sensor: name another column by --voltage-column')
    if logs.VOLTAGE in found:
        _check_one_series(path, form, t, found[logs.VOLTAGE].name, volts, (*time.place, *places))
    t, words = stamps_of(path, t, time, wanted.time_unit is not None,
                         bool(time.place) and holds_clocks(form, time.place[0]))
    rows, notes = lower_rows(t, volts)
    volts, values = volts[rows], [one[rows] for one in values]
    units = {'voltage': wanted.unit, 'throttle': wanted.throttle_unit}
    scaled, guesses = {}, {_TIME_NAME: words}
    rest = iter(values[len(found) + len(others):])
    for (quantity, column), column_values in zip(found.items(), values):
        several = [column_values, *islice(rest, len(group[quantity]))]
        if quantity == logs.VOLTAGE:
            # Cells that the pack does not have read 65535 (unknown).
            column_values = column_values + sum(np.where(np.isfinite(cell) & (
                cell != 65535.0), cell, 0.0) for cell in several[1:])
        elif len(several) > 1:
            # The motors that ever run; one that is stopped counts as 0, as for a ULog.
            used = np.array([one for one in several if np.isfinite(one).any()] or several[:1])
            column_values = np.where(np.isfinite(used).any(axis=0),
                                     np.nansum(used, axis=0) / len(used), np.nan)
        column_values = column_values * factor_of(column.name)
        si, guesses[quantity] = in_si(path, quantity, column, column_values,
                                      units.get(quantity), volts, guesses.get(logs.VOLTAGE, ''))
        if quantity == logs.VOLTAGE and (form.delimiter, form.mark, wanted.decimal) == (
                ',', '.', None) and (most := np.fmax.reduce(si, initial=0.0)) > MOST_VOLTS:
            raise InputError(f"{path}: '{column.name}' reaches {most:.5g} V if commas within "
                             'quotes separate thousands: give --decimal . if they do, else write '
                             'points as decimal marks')
        if quantity == logs.THROTTLE and len(several) > 1:
            guesses[quantity] += f', mean of {len(several)} motors'
        scaled[quantity] = column, si
    note = _read_note(form, time, found, guesses, wanted)
    return _Table(form, time, t[rows], scaled, dict(zip(others, values[len(found):])),
                  [note] * bool(note) + notes)


def _has_thousands(form: Form, time: FileColumn, found: dict[str, FileColumn]) -> bool:
    """Return whether points separate thousands: else times would fall, or volts be below 0.1."""
    pointed = [cell for row in form.rows for cell in row if '.' in cell and is_number(cell)]
    if form.delimiter not in ';\t' or form.comma or form.mark or not pointed or not all(
            re.fullmatch(r'-?[1-9]\d{0,2}\.\d{3}', cell) for cell in pointed):
        return False
    whole = form._replace(rows=tuple(
        tuple(cell.replace('.', '') for cell in row) for row in form.rows))
    column = found.get(logs.VOLTAGE, time)
    scale = SCALES.get(VOLT_WORDS.get(column.unit.lower(), ''), math.inf)
    return any(not holds_clocks(form, k) and _rises(whole, k) > _rises(form, k)
               for k in time.place) or scale < math.inf and bool(
        scale * np.nanmedian(_times(form, column.place[0])) < 0.1)


def _rest_of_group(form: Form, quantity: str, column: FileColumn, wanted: CsvColumns) -> list[int]:
    """Return the other columns of a group if the column is its first."""
    first = _FIRST_OF[quantity].fullmatch(column.name) if quantity in _FIRST_OF else None
    if first is None or quantity == logs.THROTTLE and wanted.throttle is not None:
        return []
    others = re.compile(re.escape(first[1]) + '[1-9]' + re.escape(first[2]))
    return [k for k, name in enumerate(form.names) if others.fullmatch(name)]


def _absent(path: Path, form: Form, name: str, option: str = '') -> str:
    """Return the error for a missing column."""
    if name in form.names and (cells := form.cells(form.names.index(name))):
        return (f"{path}:{form.skip + 1}: column '{name}' holds '{shown(cells[0])}', not a "
                'number: is its decimal mark another than in the other columns?')
    if sum(len(row) != form.width for row in form.rows) > _BACK * len(form.rows):
        hint, option = ('its lines have different numbers of cells, as messages of several kinds '
                        'have: keep those of one kind in a file of their own'), ''
    else:
        hint = nearest(name, form.names) if form.line else (
            f'the first line holds numbers; add a header {TIME},{VOLTAGE}[,{THROTTLE}] or give '
            "'column 1'")
    return f"{path}:{form.line or form.skip + 1}: no column '{name}': {hint}" + option


def _place_of(form: Form, name: str | None) -> int | None:
    """Return the place of a column by its name, or by 'column 1' and so on; None: it is absent."""
    if name in form.names:
        return form.names.index(name)
    found = re.fullmatch(r'column ([1-9]\d{0,8})', name or '')
    return int(found[1]) - 1 if found and int(found[1]) <= len(form.names) else None


def _column_place(path: Path, form: Form, name: str, option: str) -> int:
    place = _place_of(form, name)
    if place is None:
        raise InputError(_absent(path, form, name, f' ({option} names another)'))
    return place


def _plain_names(form: Form) -> list[str]:
    """Return the names without units, in the form that the patterns expect."""
    return [re.sub(r'\W+', '_', unit_of(name)[0].strip().lower()).strip('_') or 'time' * bool(
        unit) for name, unit in zip(form.names[:form.width], form.units)]


def _choose(form: Form, quantity: str, taken: Sequence[int] = (), text: bool = False
            ) -> list[int]:
    """Return the candidate columns of a quantity, the best first (text: columns of words)."""
    plain = _plain_names(form)
    ends = [re.sub(r'\W+', '_', re.split(
        r'[/.:](?=[^/.:])(?![^\[(]*[\])]$)', name.strip().lower())[-1]).strip('_')
        for name in form.names[:form.width]]
    right = _UNITS[quantity]
    free = [k for k in range(len(plain)) if k not in taken and form.names[k]
            and holds_numbers(form, k, quantity == _TIME_NAME) is not text]
    for pattern in _PATTERNS[quantity]:
        found = list(dict.fromkeys(
            k for texts in ([form.names[k].strip() for k in range(len(plain))], plain, ends)
            for k in free if re.fullmatch(pattern, texts[k] or ' ')
            and (form.units[k] in right or not form.units[k])))
        if found:
            # Names with a stated unit come first: `v [V]` before `u`.
            return sorted(found, key=lambda k: form.units[k] not in right)
    others = '|'.join(pattern for name, patterns in _PATTERNS.items() if name != quantity
                      for pattern in patterns[:3])
    found = [k for k in free if quantity != logs.THROTTLE and form.units[k] in right
             and not re.fullmatch(others, plain[k] or ' ')]
    if not found and quantity == logs.VOLTAGE:
        # A column of 0 and 1 only is a line of a logic analyser.
        found = sorted((k for k in free if CHANNEL.fullmatch(plain[k] or ' ')
                        and not {*form.cells(k)} <= {'0', '1'}),
                       key=lambda k: not _range_of(form, k) < 1.0)
    return found


def _time_of(path: Path, form: Form, wanted: CsvColumns) -> FileColumn:
    """Return the column of the time; it has no place if rows are counted."""
    if wanted.sample_interval is not None:
        return FileColumn((), '--sample-interval', 's', wanted.sample_interval)
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
            return FileColumn((beside[0], first),
                              f'{form.names[beside[0]]}, {form.names[first]}', 's', 0.0)
        return _unit_column(form, first, wanted.time_unit)
    if 'sec' in form.names and (parts := _parts_of_second(form, form.names.index('sec'))):
        return parts
    filled = [] if form.line else _nameless_columns(form)
    if len(filled) > 1 and _rises(form, filled[0]):
        return _parts_of_second(form, filled[0]) or _unit_column(
            form, filled[0], wanted.time_unit)
    if not math.isfinite(form.step):
        raise InputError(_absent(path, form, TIME, ' (--time-column or --sample-interval)'))
    return FileColumn((), form.stated, 's', form.step)


def _finest(form: Form, first: int) -> int:
    """Return another time column if the chosen one is coarse, starts anew or often repeats."""
    named = [k for k in range(min(form.width, len(form.names)))
             if (re.search('time|zeit', form.names[k].lower()) or form.units[k] in TIME_WORDS)
             and not re.search(
                 'step|lap|interval', form.names[k].lower()) and holds_numbers(form, k, True)]
    # A time with decimals and a unit is finer than a clock of whole seconds.
    whole = all(re.search(r':\d\d:\d\d$', cell) for cell in form.cells(first))
    finer = [k for k in named if whole and form.units[k] in TIME_WORDS and any(
        '.' in cell and is_number(cell) for cell in form.cells(k))]
    # If a clock starts anew, it falls back to the first time or below.  A late line falls less,
    # and is sorted later.
    t = _times(form, first)
    anew = bool(((np.diff(t)[1:] < 0.0) & (t[2:] <= t[0])).any()) if t.size else False
    return next((k for k in (*finer, first, *named) if (
        not anew if k == first else _rises(form, k)) and (
        2 * len({*form.cells(k)}) > len(form.rows) or len(form.rows) < _FEW_ROWS)), first)


def _parts_of_second(form: Form, clock: int) -> FileColumn | None:
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
    return next((FileColumn((clock, k), f'{form.names[clock]}, {form.names[k]}', unit, 0.0)
                 for k, name in enumerate(form.names[:form.width])
                 if k != clock and (k in rest or re.fullmatch(pattern, name.strip().lower()))
                 and all(k < len(row) and re.fullmatch(rf'0?\.\d+|\d{{1,{most}}}', row[k])
                         for row in form.rows)), None)


def _nameless_columns(form: Form) -> list[int]:
    """Return the columns of numbers; with a header, only the one beside the time."""
    # An open quote makes one name of a line of names.
    filled = [k for k in range(min(form.width, len(form.names) or form.width)) if form.rows
              and len(form.cells(k)) == len(form.rows) and all(map(is_value, form.cells(k)))]
    return filled if not form.line else [
        k for k in filled[1:] if form.width == 2 and not form.units[k] and re.fullmatch(
            _VALUE_NAME, re.split('[./]', form.names[k].lower())[-1])]


def _range_of(form: Form, place: int) -> float:
    """Return the range of a column's first cells relative to their mean; inf if one is below 1."""
    # A load changes a supply's voltage by a few percent, and its current by far more.
    found = np.array([number_of(cell)[0] for cell in form.cells(place) if is_number(cell)])
    return float(np.ptp(found) / found.mean()) if found.size and found.min() >= 1.0 else math.inf


def _times(form: Form, place: int) -> FloatArray:
    """Return the times in a column in the first rows: numbers as written, clocks in s."""
    cells = form.cells(place)
    return np.array([number_of(cell)[0] for cell in cells]) if all(map(is_number, cells)) else (
        clock_times(Path(), cells, form.names[place], []))


def _rises(form: Form, place: int) -> bool:
    """Return whether the times in a column never fall in the first rows."""
    return not (np.diff(_times(form, place)) < 0.0).any()


def _unit_column(form: Form, place: int, unit: str | None) -> FileColumn:
    name, stated = form.names[place], form.units[place]
    end = re.split('[./:]', name.strip().lower())[-1]
    raw = next((units[end] for column, units in _RAW.items()
                if column in ('', *form.names) and end in units), None)
    if raw and raw[1].startswith(unit or '') and not (stated and unit is None):
        if end == 'vbatlatest' and re.search(r'Betaflight 3\.[1-9]|Cleanflight [2-9]', form.above):
            raw = 0.1, '0.1 V', math.nan
        return FileColumn((place,), name, raw[1], raw[0], raw[2])
    return FileColumn((place,), name, unit or stated, 0.0)


def _stem(name: str) -> str:
    """Return a name without the words for voltage, current and their units."""
    return re.sub(r'volt(?:age)?s?|curr(?:ent)?|amp(?:erage|s)?|spannung|strom', '', unit_of(
        name)[0].lower())


def _supply_of(path: Path, form: Form, wanted: CsvColumns, time: FileColumn, needed: str,
               ) -> dict[str, FileColumn]:
    """Return the columns of voltage, throttle and current that exist."""
    names = {logs.VOLTAGE: (wanted.voltage, '--voltage-column', wanted.unit),
             logs.THROTTLE: (wanted.throttle, '--throttle-column', wanted.throttle_unit),
             logs.CURRENT: (wanted.current, '--current-column', None)}
    given = [place for name in (wanted.time, *(name for name, *_ in names.values()))
             if (place := _place_of(form, name)) is not None]
    taken = [*time.place, *given]
    currents = {_stem(form.names[k]) for k in _choose(form, logs.CURRENT, taken)}
    found: dict[str, FileColumn] = {}
    for quantity, (name, option, unit) in names.items():
        if name == NONE and quantity != logs.VOLTAGE:
            continue
        if name is not None:
            place = _column_place(path, form, name, option)
            found[quantity] = _unit_column(form, place, unit)
            continue
        places = _choose(form, quantity, taken)
        guess = not places or CHANNEL.fullmatch(unit_of(form.names[places[0]])[0]) is not None
        if not places and quantity == logs.VOLTAGE:
            # If another option names the voltage's column, the check below reports it.
            places = [k for k in _choose(form, quantity) if k in given]
        if quantity == logs.VOLTAGE:
            # Prefer a voltage that has a current of the same name.
            places.sort(key=lambda k: _stem(form.names[k]) not in currents)
        if not places and quantity == logs.VOLTAGE:
            # Of several columns without a telling name, none is taken.
            rest = [k for k in _nameless_columns(form) if k not in taken]
            places = rest if len(rest) == 1 else []
        if places:
            found[quantity] = _unit_column(form, places[0], unit)._replace(guess=guess)
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
        # Lines of a logic analyser hold the digits 0 and 1.
        rest = [k for k in range(form.width) if k not in taken and holds_numbers(form, k, False)
                and not {*''.join(form.cells(k))} <= {'0', '1'}]
        if form.line and not rest and not _choose(form, logs.VOLTAGE, text=True):
            raise InputError(f'{path} holds no voltage, only '
                             f'{some(list(filter(None, form.names)), 9)}')
        raise InputError(_absent(path, form, VOLTAGE, needed))
    return found


def _read(path: Path, form: Form, time: FileColumn, places: list[int],
          left_out: list[BadLine] | None = None) -> tuple[FloatArray, list[FloatArray]]:
    """Return the time as written (dates and clocks in s), and columns."""
    if not time.place:
        if not LEAST_STEP <= time.scale <= LONGEST_STEP:
            raise InputError(f"{path}: by '{time.name}' the rows are {time.scale:g} s apart, not "
                             f'within {LEAST_STEP:g} to {LONGEST_STEP:g} s')
        values = numbers(path, form, places or [0], left_out=left_out)
        return time.scale * np.arange(float(values[0].size)), values
    if holds_clocks(form, time.place[0]):
        clocks: list[list[str]] = [[] for _ in time.place]
        values = numbers(path, form, places, dict(zip(time.place, clocks)), left_out)
        cells = list(map(' '.join, zip(*clocks)))
        if len(clocks) > 1 and all(re.fullmatch(r'[\d.]+', part) for part in clocks[1]):
            cells = [f"{clock}.{part.split('.')[-1] if '.' in part else f'{part:0>3}'}"
                     for clock, part in zip(*clocks)]
        return clock_times(path, cells, time.name, left_out), values
    t, *values = numbers(path, form, [*time.place, *places], left_out=left_out)
    if len(time.place) > 1:
        part, *values = values
        t = t + part * TIME_UNITS[time.unit]
    return unwrapped(t) * factor_of(time.name), values


def _check_one_series(path: Path, form: Form, t: FloatArray, column: str, values: FloatArray,
                      taken: Iterable[int]) -> None:
    """Raise InputError if an unused column shows that `values` holds several series."""
    # Stamps rise within each series.  Several series are likely if stamps go back or repeat, if
    # the column of values has a general name, or if the series alternate and have ids or differ
    # in level.  A random load alternates in up to 2/3 of the rows, so levels count only if they
    # alternate in more than 3/4.
    known = np.isfinite(t) & np.isfinite(values)
    stamps, levels = t[known], values[known]
    overlap = np.count_nonzero(
        stamps[1:] <= np.maximum.accumulate(stamps)[:-1]) > WILD * stamps.size
    general = overlap or re.fullmatch(_VALUE_NAME, column.lower())
    for place in {*range(min(form.width, len(form.names)))}.difference(taken):
        label, first = form.names[place], form.cells(place)
        words = not any(map(is_value, first))
        if not first or has_unit_beside(form.names, place - 1) or not (words and general or (
                words or all(map(str.isdigit, first))) and 1 < len({*first}) <= _MOST_SERIES):
            continue
        names, which = np.unique(np.array(
            _cells(path, form, place, t.size) or known.size * [''])[known], return_inverse=True)
        if not 1 < names.size <= which.size / _FEW_ROWS:
            continue
        within = np.concatenate([np.diff(stamps[which == k]) for k in range(names.size)])
        turns, apart = np.mean(np.diff(which) != 0), np.array([np.quantile(
            levels[which == k], (WILD, 0.5, 1.0 - WILD)) for k in range(names.size)]).T
        if np.mean(within <= 0.0) <= WILD and (words and overlap or turns > _BACK and (
                overlap or words and general or re.fullmatch(
                    '(.*[ _])?(id|inst(ance)?|batt(ery)?|pack)', label.lower()))
                or turns > 1.0 - _BACK and np.ptp(apart[1]) > (apart[2] - apart[0]).max()):
            raise InputError(
                f"{path}: '{column}' holds several series, named in '{label}': "
                f'{shown(some(map(printable, names), 3))}; ' + (
                    '' if words else 'if these are a load, give --throttle-column; else ')
                + 'keep the rows of one')


def _cells(path: Path, form: Form, place: int, size: int) -> list[str]:
    """Return the cells of a column as written; none if bad lines change their number."""
    cells: list[str] = []
    numbers(path, form, [], {place: cells}, [])
    return cells if len(cells) == size else []


def _read_note(form: Form, time: FileColumn, found: dict[str, FileColumn], units: dict[str, str],
               wanted: CsvColumns) -> str:
    """Return in one line how a file was read; '' if nothing was detected."""
    encoding = '' if form.encoding in ('utf-8', 'utf-8-sig') else f', {form.encoding}'
    thousands = ', points between thousands (--decimal)' * (form.mark == ',')
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
    others = [form.names[k] for k in _choose(form, logs.VOLTAGE, time.place)[1:3]
              if form.names[k] not in {column.name for column in found.values()}]
    also = f'; also found: {", ".join(others)} (--voltage-column)' if others else ''
    if lacking:
        # Mention columns that may be a throttle or current under another name.
        plain = _plain_names(form)
        rest = [*words_of, *(
            name for k, name in enumerate(form.names[:form.width])
            if k not in used and name not in others
            and not any(re.fullmatch(one, plain[k] or ' ') for one in _PATTERNS[_TIME_NAME])
            and form.units[k] not in TIME_WORDS.keys() - PULSE_WORDS.keys()
            and (logs.THROTTLE in lacking or re.search('curr|amps|strom|cour', name.lower()))
            and not re.fullmatch(_INDEX_NAME, name.strip('# ').lower())
            and (not form.rows or any(
                is_number(cell) and not is_missing(cell) for cell in form.cells(k))))]
        options = ' or '.join(f'--{quantity}-column' for quantity in lacking)
        also += f'; not read: {some(rest, 3)} ({options})' if rest else ''
    return (f"Read {', '.join(parts)}{also}; cells between {between}, decimal "
            f"{'comma' if form.comma else 'point'}{thousands}{encoding}, numbers from line "
            f'{form.skip + 1} on.')
