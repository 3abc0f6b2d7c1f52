"""
Read Crazyflie logs of the micro-SD deck, without a library.

Limits: the battery is read at 100 Hz or less, so a faster log repeats it. The format has one
checksum over the whole file, so a mismatch, which a note reports, does not locate the wrong bytes.
Events other than `fixedFrequency` are used only if named.

As written by bitcraze/crazyflie-firmware (src/deck/drivers/src/usddeck.c; decoded by
tools/usdlog/cfusdlog.py), little-endian: byte 0xBC, version and number of events (2 x uint16);
for each event its number (uint16), name (ending in 0), number of variables (uint16), and each
variable as ``group.name(type)`` (ending in 0), the type a letter of Python's `struct`; then
records: an event's number, a stamp (version 1: uint32, ms; 2: uint64, us), the variables; at the
end the CRC-32 of everything before.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import struct
from typing import NamedTuple
from zlib import crc32

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.log import (
    CURRENT, DEGREE, GRAVITY, gyro_of, IMU, Log, log_of, Request, Series, SIGNAL,
    three_axes, THROTTLE, UNKNOWN, VOLTAGE)
from ou_monitor.records import Defect, FloatArray, Note
from ou_monitor.stream.files import open_regular
from ou_monitor.text import counted

# Version -> type of the stamp, and its unit in s.
_STAMPS = {1: ('<u4', 1e-3), 2: ('<u8', 1e-6)}
_TYPES = frozenset('bBhHiIqQefd')
# Event of the variables that are logged at a steady rate; their names have no prefix.
_STEADY = 'fixedFrequency'

# Variable -> quantity, factor, rank, words, group.  Log groups `pm`, `motor` and `stabilizer`.
_PLAIN = {
    'pm.vbat': (VOLTAGE, 1.0, 0, 'battery', 'pm'),
    'pm.vbatMV': (VOLTAGE, 1e-3, 1, 'battery', 'pm'),
    'pm.extVbat': (VOLTAGE, 1.0, None, 'external voltage of a BigQuad deck', 'pm.ext'),
    'pm.extVbatMV': (VOLTAGE, 1e-3, None, 'external voltage of a BigQuad deck', 'pm.ext'),
    'pm.extCurr': (CURRENT, 1.0, None, 'external current of a BigQuad deck', 'pm.ext'),
    'stabilizer.thrust': (THROTTLE, 1.0 / 65535.0, 1, 'thrust command to the mixer', ''),
    **{f'motor.m{k}': (THROTTLE, 1.0 / 65535.0, None, 'one motor', '') for k in range(1, 5)},
}
# Groups of three axes: forwards, left, up, as in `base_link`.
_GYRO, _FORCE = 'gyro', 'acc'
_UNITS = {**{f'{_GYRO}.{axis}': ('rad/s', DEGREE) for axis in 'xyz'},
          **{f'{_FORCE}.{axis}': ('m/s^2', GRAVITY) for axis in 'xyz'}}


class _Event(NamedTuple):

    name: str
    row: np.dtype[np.void]
    variables: tuple[str, ...]


def read(path: Path, request: Request) -> Log:
    """Read a log."""
    with open_regular(path) as file:
        data = file.read()
    version, number = struct.unpack_from('<HH', data, 1)
    stamp, unit = _STAMPS[version]
    events, begin = _events(path, data, number, stamp)
    sound = len(data) >= begin + 4 and crc32(data[:-4]) == int.from_bytes(data[-4:], 'little')
    end = len(data) - 4 if sound else len(data)
    found, read_to = _places(data, begin, end, events)
    notes: list[str] = []
    if not sound:
        notes.append(Note('The checksum does not match: the log was cut off or is damaged, and '
                          'wrong values cannot be detected.', Defect.DAMAGED_FILE))
    # Up to four bytes may be a damaged or truncated checksum.
    if end - read_to > (0 if sound else 4):
        notes.append(f'{counted(end - read_to, "byte")} from byte {read_to} on were not read: '
                     'they are not records of this log.')
    series: list[Series] = []
    for key, event in events.items():
        size = event.row.itemsize
        rows = np.frombuffer(b''.join(data[at:at + size] for at in found[key]), dtype=event.row)
        t = rows['stamp'].astype(np.float64) * unit
        columns = {name: rows[f'v{k}'].astype(np.float64)
                   for k, name in enumerate(event.variables)}
        prefix = '' if event.name == _STEADY else f'{event.name}.'
        series += _series(prefix, t, columns)
        rates, forces = (three_axes(columns, [f'{group}.{axis}' for axis in 'xyz'], factor)
                         for group, factor in ((_GYRO, DEGREE), (_FORCE, GRAVITY)))
        series += gyro_of(
            f'{prefix}{_GYRO}', t, rates, forces,
            f'{_GYRO} {DEGREE:.6g}' + ('' if forces is None else f', {_FORCE} {GRAVITY:g}'),
            "gyro after the autopilot's filters", None if prefix else 0)
    return log_of('crazyflie', series, {}, notes, (
        one.name for one in series if one.quantity != IMU))


def _events(path: Path, data: bytes, number: int, stamp: str) -> tuple[dict[int, _Event], int]:
    at = 5
    events: dict[int, _Event] = {}

    def text() -> str:
        nonlocal at
        begin, at = at, data.index(b'\0', at) + 1
        return data[begin:at - 1].decode('utf-8', 'replace')

    try:
        for _ in range(number):
            key, at = int.from_bytes(data[at:at + 2], 'little'), at + 2
            name, count = text(), int(struct.unpack_from('<H', data, at)[0])
            at += 2
            variables = [text() for _ in range(count)]
            if wrong := [one for one in variables if one[-3:-2] != '(' or one[-2:-1] not in _TYPES
                         or one[-1:] != ')']:
                raise InputError(f"{path}: the header has no type for '{wrong[0]}': it is damaged")
            if key in events:
                raise InputError(f'{path}: the header has two events {key}: it is damaged')
            events[key] = _Event(name, np.dtype([('id', '<u2'), ('stamp', stamp), *(
                (f'v{k}', f'<{one[-2]}') for k, one in enumerate(variables))]), tuple(
                    one[:-3] for one in variables))
    except (ValueError, struct.error) as error:
        raise InputError(f'{path}: the header does not end: the log was cut off') from error
    return events, at


def _places(data: bytes, begin: int, end: int, events: dict[int, _Event],
            ) -> tuple[dict[int, list[int]], int]:
    """Return the starts of the records of each event, and the end of the last record."""
    found: dict[int, list[int]] = {key: [] for key in events}
    sizes = {key: event.row.itemsize for key, event in events.items()}
    at = begin
    while at + 2 <= end:
        key = data[at] | data[at + 1] << 8
        size = sizes.get(key)
        if size is None or at + size > end:
            break
        found[key].append(at)
        at += size
    return found, at


def _series(prefix: str, t: FloatArray, columns: dict[str, FloatArray]) -> Iterator[Series]:
    """Yield each variable in SI, and the mean of the motors."""
    # Variables of other events are never the default: they have no steady rate.
    ranked = not prefix
    motors = [f'motor.m{k}' for k in range(1, 5)]
    if all(name in columns for name in motors):
        values = np.mean([columns[name] for name in motors], axis=0) / 65535.0
        yield Series(f'{prefix}motors', THROTTLE, t, values, 'mean of motor.m1..m4 / 65535',
                     'mean of 4 motors', 0 if ranked else None)
    for name, values in columns.items():
        if name in _PLAIN:
            quantity, scale, rank, words, group = _PLAIN[name]
            yield Series(f'{prefix}{name}', quantity, t, values * scale, f'{scale:.6g}', words,
                         rank if ranked else None, group and prefix + group)
        else:
            own, scale = _UNITS.get(name, (UNKNOWN, 1.0))
            yield Series(f'{prefix}{name}', SIGNAL, t, values * scale, f'{scale:.6g}',
                         'as logged' if own == UNKNOWN else name.partition('.')[0], own_unit=own)
