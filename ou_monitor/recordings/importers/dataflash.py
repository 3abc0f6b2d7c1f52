"""
Read ArduPilot dataflash logs, binary and text, with pymavlink.

Limits: ArduPilot averages the battery's ADC before logging it, by default
at 10 Hz.  The parameters `SERVOn_FUNCTION` of the log identify the motor
outputs; without them, an output is used only if the user names it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
import re
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.log import (
    CURRENT, FRD_TO_FLU, gyro_of, Log, log_of, quiet_process, Request,
    RPM, Series, SIGNAL, speeds_of, started, three_axes, THROTTLE, TURNED, UNKNOWN, VOLTAGE)
from ou_monitor.records import Defect, FloatArray, Note
from ou_monitor.stream.files import open_regular
from ou_monitor.text import counted
from pymavlink import DFReader

# Message, field, quantity, rank, words.
PLAIN = (
    ('BAT', 'Volt', VOLTAGE, 0, 'battery'),
    ('BAT', 'VoltR', VOLTAGE, None, 'battery, resting voltage as estimated by ArduPilot'),
    ('BAT', 'Curr', CURRENT, 0, 'battery'),
    ('BAT2', 'Volt', VOLTAGE, 0, 'second battery'),
    ('BAT2', 'Curr', CURRENT, 0, 'second battery'),
    ('CURR', 'Volt', VOLTAGE, 0, 'battery'),
    ('CURR', 'Curr', CURRENT, 0, 'battery'),
    # In old logs in mV.
    ('CURR', 'Vcc', VOLTAGE, None, '5 V rail'),
    ('CUR2', 'Volt', VOLTAGE, 0, 'second battery'),
    ('CUR2', 'Curr', CURRENT, 0, 'second battery'),
    ('POWR', 'Vcc', VOLTAGE, None, '5 V rail'),
    ('POWR', 'VServo', VOLTAGE, None, 'servo rail'),
    ('MCU', 'MVolt', VOLTAGE, None, 'microcontroller, 3.3 V rail'),
    ('ESC', 'Volt', VOLTAGE, None, 'at the ESC'),
    ('ESC', 'Curr', CURRENT, None, 'at the ESC'),
    ('CTUN', 'ThO', THROTTLE, 0, 'throttle output'),
    # Until 2015, in thousandths.
    ('CTUN', 'ThrOut', THROTTLE, 0, 'throttle output'),
    ('CURR', 'ThrOut', THROTTLE, 5, 'throttle output'),
    ('CURR', 'Throttle', THROTTLE, 5, 'throttle output'),
    ('QTUN', 'ThO', THROTTLE, 1, 'throttle output, lift motors'),
    ('MOTB', 'ThrOut', THROTTLE, 3, 'throttle output of the mixer'),
    ('RATE', 'AOut', THROTTLE, 4, 'throttle output'),
)
# Message -> rank of its first instance.  Axes are front, right, down.
GYROS = {'IMU': 0, 'GYR': 1, 'IMU2': None, 'IMU3': None}
RATES, FORCES = ('GyrX', 'GyrY', 'GyrZ'), ('AccX', 'AccY', 'AccZ')
# Units of the fields if the log does not state them (before 2018).
KNOWN_UNITS = {**dict.fromkeys(RATES, 'rad/s'), **dict.fromkeys(FORCES, 'm/s^2')}
SPEED = ('ESC', 'RPM')  # Message and field of the motor speeds
OUTPUTS = ('RCOU', 'RCO2', 'RCO3')  # Messages of the servo outputs
ALSO = ('PARM', 'MSG', 'VER')  # Messages of parameters, texts and the version
INSTANCES = ('Inst', 'Instance', 'I')  # Names of the field that numbers instances

# SERVOn_FUNCTION: motors 1..8, motors 9..12, throttle, left and right throttle.
MOTOR_FUNCTIONS = frozenset((*range(33, 41), *range(82, 86), 70, 73, 74))

# Field -> values; 't' holds the stamps, s.
Columns = dict[str, FloatArray]
# (message, instance) -> its columns, in order.
Table = dict[tuple[str, str], Columns]


def read(path: Path, request: Request) -> Log:
    """Read a dataflash log, binary or text."""
    with open_regular(path) as file:
        text = not file.read(2).startswith(b'\xa3\x95')
    with _plain_text(path, text) as (name, mended):
        reader = DFReader.DFReader_text if text else DFReader.DFReader_binary
        # `__init__` is called separately, so that the files can be closed if it fails.
        log: Any = reader.__new__(reader)
        try:
            with quiet_process():
                log.__init__(name)
            table, banner, bad = _collect(log, request)
            notes = mended + (_lost_text(log) if text else _lost_binary(log))
            parameters: dict[str, float] = dict(log.params)
            # Unix time of boot by GPS; 0: unknown.
            boot = float(getattr(log.clock, 'timebase', 0.0) or 0.0)
            # If damage repeats the name of a format, its first definition counts.
            forms = {one.name: one for one in reversed([*log.formats.values()])}
            names = tuple(f'{one.name}.{field}' for one in log.formats.values()
                          for field in _numbers(one))
        finally:
            _close(log)
    if bad:
        notes.append(f'{counted(bad, "message")} could not be read and were left out.')
    series: list[Series] = []
    for (kind, instance), columns in table.items():
        series += _listed_fields(_name(kind, instance), columns, forms[kind])
    series += _outputs(table, parameters)
    known = {one.name for one in series}
    for (kind, instance), columns in table.items():
        series += _other_fields(_name(kind, instance), columns, forms[kind], known)
    if not series:
        raise InputError(f'{path} holds none of the messages that carry a voltage or a throttle '
                         f'({", ".join(dict.fromkeys(row[0] for row in PLAIN))})'
                         + ''.join(f': {note}' for note in notes))
    names = (*(one.name for one in series), *names)
    series += [*_gyros(table), *_speeds(table)]
    return log_of('dataflash_text' if text else 'dataflash', series,
                  _facts(banner) | _cells(parameters) | started(boot + min(
                      columns['t'][0] for columns in table.values()) if boot else 0.0), notes,
                  names)


def _name(kind: str, instance: str) -> str:
    return f'{kind}[{instance}]' if instance else kind


@contextmanager
def _plain_text(path: Path, text: bool) -> Iterator[tuple[str, list[str]]]:
    """Yield the name of a log that pymavlink can decode, and notes on changes."""
    content = b''
    if text:
        with open_regular(path) as file:
            content = file.read()
    if content.isascii():
        yield str(path), []
        return
    with TemporaryDirectory() as folder:
        copy = Path(folder) / 'log'
        copy.write_bytes(content.translate(bytes(range(0x80)) + b'?' * 0x80))
        odd = len(content) - len(content.translate(None, bytes(range(0x80, 0x100))))
        yield str(copy), [f'{counted(odd, "byte")} beyond ASCII read as "?".']


def _close(log: Any) -> None:
    for name in ('data_map', 'filehandle'):
        # A memory map that a failed `__init__` still uses cannot be closed; it is freed with
        # `log`.
        with suppress(BufferError):
            if hasattr(log, name):
                getattr(log, name).close()


def _collect(log: Any, request: Request) -> tuple[Table, list[str], int]:
    """Return the wanted fields of all messages, the log's texts, and the count of bad messages."""
    fields: dict[str, list[str]] = {kind: [*RATES, *FORCES] for kind in GYROS}
    for kind, field, *_ in (*PLAIN, SPEED):
        fields.setdefault(kind, []).append(field)
    for name in request.names:
        kind, _, field = name.partition('.')
        fields.setdefault(kind.partition('[')[0], []).append(field)
    wanted = None if request.everything else {*fields, *OUTPUTS, *ALSO}
    table: dict[tuple[str, str], dict[str, list[float]]] = {}
    banner: list[str] = []
    bad = count = 0
    while (message := log.recv_match(type=wanted, strict=True)) is not None:
        count += 1
        if request.progress is not None and count % 4096 == 0:
            request.progress(log.percent / 100.0)
        kind = message.get_type()
        try:
            if kind == 'MSG':
                banner.append(str(message.Message))
            if kind in ALSO:
                continue
            columns = message.get_fieldnames()
            instance = next((str(int(getattr(message, name))) for name in INSTANCES
                             if name in columns), '')
            t = message.TimeUS * 1e-6 if 'TimeUS' in columns else message.TimeMS * 1e-3
            if kind in OUTPUTS:
                names = [name for name in columns if re.fullmatch(r'C\d+', name)]
            elif request.everything:
                names = _numbers(message.fmt)
            else:
                names = [name for name in columns if name in fields[kind]]
            row = [float(getattr(message, name)) for name in names]
        except (AttributeError, ValueError, TypeError, IndexError):
            bad += 1
            continue
        held = table.setdefault((kind, instance), {'t': [], **{name: [] for name in names}})
        if list(held) != ['t', *names]:
            bad += 1
            continue
        for column, value in zip(held.values(), [t, *row]):
            column.append(value)
    return {key: {field: np.array(values) for field, values in columns.items()}
            for key, columns in sorted(table.items())}, banner, bad


def _numbers(form: Any) -> list[str]:
    """Return the fields of a message that hold a number over time."""
    return [name for name, letter in zip(form.columns, form.format)
            if letter not in 'nNZa' and name not in ('TimeUS', 'TimeMS', *INSTANCES)]


def _lost_binary(log: Any) -> list[str]:
    """Return a note on the bytes of a binary log that belong to no message."""
    size = int(log.data_len)
    lost, end = size, 0
    for kind, offsets in enumerate(log.offsets):
        length = log.formats[kind].len if kind in log.formats else 0
        ends = [at + length for at in offsets if at + length <= size]
        lost -= length * len(ends)
        end = max([end, *ends])
    tail = bytes(log.data_map[end:size])
    # The last page of flash is padded with its erased value.
    if tail.strip(b'\xff') == b'' or tail.strip(b'\0') == b'':
        lost -= len(tail)
        tail = b''
    if lost <= 0:
        return []
    where = (f'cut off at byte {end}' if lost == len(tail) else
             f'damaged, its last whole message ends at byte {end}')
    return [Note(f'{lost} of {size} bytes belong to no message, so the log is {where}; '
                 'the other messages were read.', Defect.DAMAGED_FILE)]


def _lost_text(log: Any) -> list[str]:
    """Return notes on lines that pymavlink skips, and on an incomplete last one."""
    size = int(log.data_len)
    text = bytes(log.data_map[:size]).decode('ascii', 'replace')
    lost = 0
    for line in text.splitlines():
        cells = line.split(',')
        form = log.formats.get(cells[0].strip())
        lost += bool(line.strip()) and (form is None or len(cells) <= len(form.format))
    notes = []
    if lost:
        notes.append(f'Left out: {counted(lost, "line")} not in any format of this log.')
    if not text.endswith('\n'):
        notes.append(Note(f'The last line does not end: the log was cut off at byte {size}.',
                          Defect.DAMAGED_FILE))
    return notes


def _cells(parameters: dict[str, float]) -> dict[str, str]:
    """Return capacity, number of cells (from MOT_BAT_VOLT_MAX), and a cell's lowest voltage."""
    full, capacity = (parameters.get(name, 0.0) for name in ('MOT_BAT_VOLT_MAX', 'BATT_CAPACITY'))
    # The default, 3300, says nothing about the pack.
    facts = {'capacity_mah': f'{capacity:.0f}'} if capacity > 0.0 and capacity != 3300.0 else {}
    if not full > 3.0:
        return facts
    cells = round(full / 4.2)
    low = next((parameters[name] / cells for name in (
        'BATT_CRT_VOLT', 'BATT_LOW_VOLT', 'FS_BATT_VOLTAGE') if parameters.get(name, 0.0) > 0.0),
        0.0)
    return {**facts, 'cells': f'{cells}',
            **({'cell_minimum': f'{low:.4g}'} if 2.0 < low < 4.0 else {})}


def _facts(banner: list[str]) -> dict[str, str]:
    """Return firmware and board from the first messages of a log."""
    facts: dict[str, str] = {}
    for line in banner:
        if 'firmware' not in facts and re.match(r'(Ardu\w+|APM:\w+|Blimp|AntennaTracker)\b', line):
            facts['firmware'] = line
        elif 'vehicle' not in facts and re.search(r' [0-9A-F]{8} [0-9A-F]{8} [0-9A-F]{8}$', line):
            # The board and the serial number of its processor.
            facts['vehicle'] = line
    return facts


def _listed_fields(name: str, columns: Columns, form: Any) -> Iterator[Series]:
    """Yield the fields of a message that `PLAIN` lists."""
    # Integers without a multiplier of their own.
    whole = {field for field, letter in zip(form.columns, form.format) if letter in 'bBhHiI'}
    for source, field, quantity, rank, words in PLAIN:
        if source != form.name or field not in columns:
            continue
        values, scale = columns[field], 1.0
        if quantity == THROTTLE:
            scale = _throttle_scale(values)
        elif field in whole:
            # Integers: hundredths (before 2014), and for the rail millivolts (until 2015).
            scale = 0.001 if field == 'Vcc' else 0.01
        one = Series(f'{name}.{field}', quantity, columns['t'], values * scale, f'{scale:g}',
                     words, rank, name)
        yield replace(one, words=f'{words}, not connected', rank=None) if (
            quantity != THROTTLE and one.silent) else one


def _other_fields(name: str, columns: Columns, form: Any, known: set[str]) -> Iterator[Series]:
    """Yield the fields that no other series uses, as logged."""
    # Logs state units since 2018.
    units = KNOWN_UNITS | {field: unit.replace('/s/s', '/s^2') for field, unit in zip(
        form.columns, form.units or ()) if unit}
    for field, values in columns.items():
        if field != 't' and f'{name}.{field}' not in known:
            yield Series(f'{name}.{field}', SIGNAL, columns['t'], values, '1', 'as logged',
                         group=name, own_unit=units.get(field, UNKNOWN))


def _gyros(table: Table) -> Iterator[Series]:
    """Yield each gyro, with the accelerometer of its message, along front, left and up."""
    first: set[str] = set()
    for (kind, instance), columns in table.items():
        rates, forces = (three_axes(columns, fields, FRD_TO_FLU) for fields in (RATES, FORCES))
        if kind not in GYROS or rates is None:
            continue
        yield from gyro_of(_name(kind, instance), columns['t'], rates, forces, TURNED,
                           'gyro' if forces is None else 'gyro and accelerometer',
                           None if kind in first else GYROS[kind])
        first.add(kind)


def _speeds(table: Table) -> Iterator[Series]:
    """Yield the speeds that ESCs reported, at the stamps of the first one."""
    kind, field = SPEED
    found = {instance: columns for (name, instance), columns in table.items()
             if name == kind and np.any(columns.get(field, 0.0))}
    if not found:
        return
    t = next(iter(found.values()))['t']
    values = []
    for columns in found.values():
        # ESCs report in turn: the last report holds.
        last = np.maximum(np.searchsorted(columns['t'], t, 'right') - 1, 0)
        values.append(columns[field][last])
    yield from speeds_of(t, values, RPM, 'rpm', 'speed reported by the ESC, the last report held',
                         [instance or 0 for instance in found])


def _throttle_scale(values: FloatArray) -> float:
    """Return the factor to 0..1: from 0..1, percent (Plane), or thousandths (before 2016)."""
    finite = np.abs(values[np.isfinite(values)])
    highest = float(finite.max()) if finite.size else 0.0
    return 1.0 if highest <= 1.5 else 0.01 if highest <= 110.0 else 0.001


def _outputs(table: Table, parameters: dict[str, float]) -> Iterator[Series]:
    """Yield the mean of the outputs that the parameters name as motors, and each output."""
    found: dict[int, tuple[Series, bool]] = {}
    for (kind, _), columns in table.items():
        if kind not in OUTPUTS:
            continue
        shares: dict[str, FloatArray] = {}
        # The first column holds the stamps.
        for name in [*columns][1:]:
            number = int(name[1:])
            low, high = _span(number, parameters)
            one = Series(f'RCOU.C{number}', THROTTLE, columns['t'],
                         (columns[name] - low) / (high - low),
                         f'(x - {low:g} us) / {high - low:g} us', 'one output, motor or servo')
            found[number] = one, bool(columns[name].any())
            if int(parameters.get(f'SERVO{number}_FUNCTION', 0)) in MOTOR_FUNCTIONS:
                shares[name] = one.values
        if shares:
            yield Series(f'{kind}.motors', THROTTLE, columns['t'],
                         np.mean([*shares.values()], axis=0),
                         f"mean of {', '.join(shares)}, each from its lowest to its highest pulse",
                         f'mean of {len(shares)} motors', 2)
    for _, (one, used) in sorted(found.items()):
        if used:
            yield one


def _span(number: int, parameters: dict[str, float]) -> tuple[float, float]:
    """Return the pulses that mean 0 and 1, us."""
    low = parameters.get('MOT_PWM_MIN') or parameters.get(f'SERVO{number}_MIN') or 1000.0
    high = parameters.get('MOT_PWM_MAX') or parameters.get(f'SERVO{number}_MAX') or 2000.0
    return (low, high) if high > low else (1000.0, 2000.0)
