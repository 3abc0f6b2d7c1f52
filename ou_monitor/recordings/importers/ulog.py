"""
Read PX4 ULog files, with pyulog.

Limits: ULog has no end mark and no checksums, so a log truncated
between two messages looks complete.  PX4 may have low-passed the voltage
(`BATn_V_FILT`).  The log does not say which `actuator_outputs` are motors: one
is used only if the user names it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import io
from pathlib import Path
import re
from typing import Any

import numpy as np
from ou_monitor.recordings.importers.log import (
    CURRENT, FRD_TO_FLU, gyro_of, Log, log_of, Progress, quiet, Request, RPM,
    Series, SIGNAL, SPEEDS, speeds_of, started, three_axes, THROTTLE, TURNED, UNKNOWN, VOLTAGE)
from ou_monitor.records import Defect, FloatArray, Note
from ou_monitor.text import counted
from pyulog import ULog

# Field -> values over time.
Columns = dict[str, FloatArray]

CLOCK, UTC = 'vehicle_gps_position', 'time_utc_usec'

# Topic, fields of the gyro and of the accelerometer (front, right, down), rank, words.
GYROS = (
    ('sensor_combined', [f'gyro_rad[{k}]' for k in range(3)],
     [f'accelerometer_m_s2[{k}]' for k in range(3)], 0, 'gyro and accelerometer'),
    ('vehicle_angular_velocity', [f'xyz[{k}]' for k in range(3)], (), 1,
     "gyro after the autopilot's filters"),
    ('sensor_gyro', 'xyz', (), 2, 'one gyro, along the axes of its board'),
)
# Endings of names of fields that state a unit.
ENDINGS = (('_m_s2', 'm/s^2'), ('_rad', 'rad/s'), ('_m_s', 'm/s'), ('_v', 'V'), ('_a', 'A'),
           ('_rpm', 'rpm'), ('_pa', 'Pa'), ('_celsius', 'deg C'), ('_celcius', 'deg C'),
           ('_us', 'us'), ('_ms', 'ms'), ('_hz', 'Hz'), ('_meter', 'm'))

# Topic, field, quantity, rank, words.  The battery comes first; a rail must be named.
PLAIN = (
    ('battery_status', 'voltage_v', VOLTAGE, 0, 'battery'),
    ('battery_status', 'voltage_filtered_v', VOLTAGE, None, 'battery, low-passed by PX4'),
    ('battery_status', 'current_a', CURRENT, 0, 'battery'),
    ('battery_status', 'current_filtered_a', CURRENT, None, 'battery, low-passed by PX4'),
    ('system_power', 'voltage5v_v', VOLTAGE, None, '5 V rail'),
    ('system_power', 'voltage3v3_v', VOLTAGE, None, '3.3 V rail'),
    ('system_power', 'voltage_payload_v', VOLTAGE, None, 'payload rail'),
    ('power_monitor', 'voltage_v', VOLTAGE, None, 'power monitor'),
    ('power_monitor', 'current_a', CURRENT, None, 'power monitor'),
    ('actuator_controls_0', 'control[3]', THROTTLE, 3, 'thrust command to the mixer'),
    ('manual_control_setpoint', 'z', THROTTLE, 4, 'stick'),
)
TOPICS = (CLOCK, 'esc_status', 'actuator_motors', 'vehicle_thrust_setpoint', 'actuator_outputs',
          *(row[0] for row in (*PLAIN, *GYROS)))


# Bytes before the content of a message: its length and its kind.
HEAD = 3
KINDS = frozenset(b'BFIMPQARDLCSO')
# pyulog takes a larger message of unknown kind for damage, and continues one byte after its start.
LARGEST = 10_000


class _WatchedFile(io.BufferedReader):
    """A file that records which bytes pyulog skips silently, and avoids two faults of pyulog."""

    # First, an endless loop: pyulog steps back by the stated length of a message even if the file
    # ended within it.  Second, it rereads the rest of the file at each byte of a damaged part.

    progress: Progress | None = None
    size = 1
    reads = 0
    cut_at: int | None = None
    unknown_at: int | None = None
    end = 0
    # Last read: bytes returned, and bytes missing.
    had = missing = 0
    broken = False

    def read(self, size: int | None = -1, /) -> bytes:
        """Read, and record the first message of unknown kind and a truncated message."""
        if self.broken and size is not None and size > LARGEST:
            self.had, self.missing, self.broken = 0, size, False
            return bytes(size)
        data = super().read(size)
        self.had, self.missing = len(data), max(size or 0, len(data)) - len(data)
        at = self.tell()
        self.end = max(self.end, at)
        self.reads += 1
        if self.progress is not None and self.reads % 16384 == 0:
            self.progress(at / self.size)
        # The head of a message has 3 bytes: reading none is the regular end.
        if size is not None and len(data) < size and (data or size != HEAD):
            self.cut_at = at - len(data)
        elif data:
            self.cut_at = None
        self.broken = size == HEAD == len(data) and data[2] not in KINDS
        if self.broken and self.unknown_at is None:
            self.unknown_at = at - HEAD
        return data

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Move; a step back beyond the last read counts from the position that pyulog assumes."""
        if whence == io.SEEK_CUR and -offset > self.had:
            offset += self.missing
        return super().seek(offset, whence)


def read(path: Path, request: Request) -> Log:
    """Read a ULog."""
    size = path.stat().st_size
    with quiet(path, 'pyulog') as said:
        with _WatchedFile(io.FileIO(path)) as file:
            file.size, file.progress = size, request.progress
            ulog = ULog(file, None if request.everything else list(dict.fromkeys(
                (*TOPICS, *(re.split(r'[.\[]', name)[0] for name in request.names)))))
    notes: list[str] = []
    if file.cut_at is not None:
        notes.append(Note(f'The log was cut off within its last message, at byte {file.cut_at} '
                          f'of {size}; all before that was read.', Defect.DAMAGED_FILE))
    elif file.end < size:
        notes.append(Note(f'Only {file.end} of {size} bytes were read: the log is damaged.',
                          Defect.DAMAGED_FILE))
    if ulog.file_corruption or file.unknown_at is not None or said.getvalue():
        where = '' if file.unknown_at is None else f' from byte {file.unknown_at} of {size} on'
        notes.append(Note(f'The log is damaged{where}: messages that pyulog could not read are '
                          'missing, later ones were read.', Defect.DAMAGED_FILE))
    lost = sum(one.duration for one in ulog.dropouts) * 1e-3
    if ulog.dropouts:
        notes.append(f'The logger lost data {counted(len(ulog.dropouts), "time")}, {lost:.3f} s '
                     'in all.')
    series: list[Series] = []
    motion: list[Series] = []
    for data in ulog.data_list:
        columns = {field: np.asarray(values, dtype=np.float64)
                   for field, values in data.data.items() if not field.startswith('_padding')}
        if 'timestamp' in columns:
            t, name = columns.pop('timestamp') * 1e-6, f'{data.name}[{data.multi_id}]'
            found = list(_series(name, data.name, t, columns))
            series += [*found, *_other_fields(name, data.name, t, columns,
                                              {one.name for one in found})]
            motion += _gyros(name, data.name, t, columns)
            if not any(one.quantity == SPEEDS for one in motion):
                motion += _speeds(data.name, t, columns)
    return log_of('ulog', [*series, *motion], _facts(ulog) | _started(ulog), notes,
                  (*(one.name for one in series), *_declared(ulog)), ulog.start_timestamp * 1e-6)


def _declared(ulog: Any) -> Iterator[str]:
    """Yield the names of all fields that the log defines, as instance 0."""
    for topic, form in ulog.message_formats.items():
        for _, size, field in form.fields:
            if field != 'timestamp' and not field.startswith('_padding'):
                yield f'{topic}[0].{field}' + ('[0]' if size else '')


def _other_fields(name: str, topic: str, t: FloatArray, columns: Columns, known: set[str],
                  ) -> Iterator[Series]:
    """Yield the fields that no other series uses, as logged."""
    rates = ('vehicle_angular_velocity', 'sensor_gyro')
    for field, values in columns.items():
        if f'{name}.{field}' in known:
            continue
        stem = field.split('[')[0].split('.')[-1]
        unit = next((unit for ending, unit in ENDINGS if stem.endswith(ending)), UNKNOWN)
        if topic in rates and stem in ('xyz', 'x', 'y', 'z'):
            unit = 'rad/s'
        elif unit == 'rad/s' and not stem.startswith('gyro'):
            unit = 'rad'
        yield Series(f'{name}.{field}', SIGNAL, t, values, '1', 'as logged', group=name,
                     own_unit=unit)


def _gyros(name: str, topic: str, t: FloatArray, columns: Columns) -> Iterator[Series]:
    """Yield gyro and accelerometer of a topic along front, left and up."""
    for source, gyro, acc, rank, words in GYROS:
        if source == topic:
            rates, forces = (three_axes(columns, fields, FRD_TO_FLU) for fields in (gyro, acc))
            yield from gyro_of(name, t, rates, forces, TURNED, words, rank)


def _speeds(topic: str, t: FloatArray, columns: Columns) -> Iterator[Series]:
    found = {k: np.abs(columns[f'esc[{k}].esc_rpm']) for k in range(16)
             if np.any(columns.get(f'esc[{k}].esc_rpm', 0.0))}
    if topic == 'esc_status' and found:
        yield from speeds_of(t, [*found.values()], RPM, 'rpm', 'speed reported by the ESC', found)


def _facts(ulog: Any) -> dict[str, str]:
    info = ulog.msg_info_dict
    version = ulog.get_version_info_str() or ''
    branch, commit = str(info.get('ver_sw_branch', '')), str(info.get('ver_sw', ''))[:10]
    firmware = ' '.join(word for word in (str(info.get('sys_name', 'PX4')), version or branch,
                                          commit) if word)
    facts = {'firmware': firmware}
    board, uuid = str(info.get('ver_hw', '')), str(info.get('sys_uuid', ''))
    if uuid.strip('0'):
        facts['vehicle'] = f'{board} {uuid}'.lstrip()
    elif board:
        # There is no serial number (simulators state 0), and many vehicles have the same board.
        facts['board'] = board
    given = ulog.initial_parameters
    cells = given.get('BAT1_N_CELLS', given.get('BAT_N_CELLS', 0))
    empty = given.get('BAT1_V_EMPTY', given.get('BAT_V_EMPTY', 0.0))
    if cells > 0:
        facts['cells'] = f'{int(cells)}'
        if 2.0 < empty < 4.0:
            facts['cell_minimum'] = f'{empty:g}'
    return facts


def _started(ulog: Any) -> dict[str, str]:
    for data in ulog.data_list:
        if data.name == CLOCK and UTC in data.data:
            known = np.flatnonzero(data.data[UTC])
            if known.size:
                k = known[0]
                return started(1e-6 * (float(data.data[UTC][k]) - float(
                    data.data['timestamp'][k]) + ulog.start_timestamp))
    return {}


def _series(name: str, topic: str, t: FloatArray, columns: Columns) -> Iterator[Series]:
    connected = columns.get('connected')
    # A battery that was never connected is used only if the user names it.
    there = connected is None or bool(np.any(connected))
    for source, field, quantity, rank, words in PLAIN:
        if source != topic or field not in columns:
            continue
        values = columns[field]
        if quantity == CURRENT:
            # The message uses -1 for "unknown".
            values = np.where(values == -1.0, np.nan, values)
        one = Series(f'{name}.{field}', quantity, t, values, '1', words, rank, name)
        yield replace(one, words=f'{words}, not connected', rank=None) if (
            quantity != THROTTLE and (one.silent or not there)) else one
    if topic == 'manual_control_setpoint' and 'throttle' in columns:
        yield Series(f'{name}.throttle', THROTTLE, t, (columns['throttle'] + 1.0) / 2.0,
                     '(x + 1) / 2', 'stick', 4, name)
    more = {'actuator_motors': _motors, 'vehicle_thrust_setpoint': _thrust,
            'actuator_outputs': _outputs, 'esc_status': _escs}
    if topic in more:
        yield from more[topic](name, t, columns)


def _stack(columns: Columns, stem: str) -> FloatArray:
    rows: list[FloatArray] = []
    while f'{stem}[{len(rows)}]' in columns:
        rows.append(columns[f'{stem}[{len(rows)}]'])
    return np.array(rows)


def _motors(name: str, t: FloatArray, columns: Columns) -> Iterator[Series]:
    control = _stack(columns, 'control')
    # NaN: motor missing or stopped.
    used = control[np.isfinite(control).any(axis=1)] if control.size else control
    if used.size:
        known = np.isfinite(used).sum(axis=0)
        mean = np.nansum(used, axis=0) / len(used)
        yield Series(name, THROTTLE, t, np.where(known > 0, mean, np.nan),
                     f'mean of control[0..{len(used) - 1}], a stopped motor counts as 0',
                     f'mean of {len(used)} motors', 0, name)


def _thrust(name: str, t: FloatArray, columns: Columns) -> Iterator[Series]:
    for axis, sign, words, rank in ((2, -1.0, 'thrust upwards', 1),
                                    (0, 1.0, 'thrust forwards', 2)):
        field = f'xyz[{axis}]'
        if field in columns:
            one = Series(f'{name}.{field}', THROTTLE, t, sign * columns[field], f'{sign:g}', words,
                         rank, name)
            if not one.silent:
                yield one


def _outputs(name: str, t: FloatArray, columns: Columns) -> Iterator[Series]:
    output = _stack(columns, 'output')
    count = int(np.max(columns['noutputs'])) if 'noutputs' in columns else len(output)
    for k, values in enumerate(output[:count]):
        low, high = float(values.min()), float(values.max())
        share, scale = values, '1'
        if 800.0 <= low and high <= 2200.0:
            share, scale = (values - 1000.0) / 1000.0, '(x - 1000 us) / 1000 us'
        elif not (0.0 <= low and 0.0 < high <= 1.0):
            continue
        yield Series(f'{name}.output[{k}]', THROTTLE, t, share, scale,
                     'one output, motor or servo', None, name)


def _escs(name: str, t: FloatArray, columns: Columns) -> Iterator[Series]:
    for field in columns:
        quantity = {'esc_voltage': VOLTAGE, 'esc_current': CURRENT}.get(field.split('.')[-1])
        if quantity is not None:
            one = Series(f'{name}.{field}', quantity, t, columns[field], '1', 'at the ESC', None,
                         f'{name}.{field.split(".")[0]}')
            if not one.silent:
                yield one
