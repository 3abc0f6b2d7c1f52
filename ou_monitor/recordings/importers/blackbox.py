"""
Read Betaflight and INAV blackbox logs, with orangebox.

Limits: the ADC is read more slowly than the log is written, so most voltages are repeats.  After a
damaged frame, frames are left out up to the next key frame.  orangebox is under GPL-3; importers
of other formats do not load it.  Betaflight's axes (x forwards, y left, z up) match `base_link`.

Scales come from Betaflight's viewer (flightlog_parser, flightlog_fields_presenter) and from
the header: `gyro_scale`, `acc_1G`, `motor_poles`, `blackbox_high_resolution`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import math
from operator import itemgetter
from pathlib import Path
import re
import struct
from typing import Any

import numpy as np
from orangebox import Parser
from orangebox.reader import Reader
from orangebox.types import FrameType
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.log import (
    CURRENT, DEGREE, GRAVITY, gyro_of, Log, log_of, Request, RPM, Series,
    SIGNAL, speeds_of, three_axes, THROTTLE, UNKNOWN, VOLTAGE)
from ou_monitor.records import Defect, FloatArray, Note
from ou_monitor.text import counted

# The clock counts us in 32 bits.
WRAP = 2**32

# Maximum step between frames, s; a longer one is a pause of the log.
_PAUSE = 10.0
# Minimum number of frames after a jump of the time; fewer are corrupt bytes, not flight.
_PART = 16

GYRO, UNFILTERED, DEBUG, ACCELEROMETER = 'gyroADC', 'gyroUnfilt', 'debug', 'accSmooth'
# debug_mode GYRO_SCALED of Betaflight 4.0 to 4.5: the gyro before its filters, deg/s.
_GYRO_SCALED, _FIRST, _LAST = 6, (4, 0, 0), (4, 6, 0)
# A gyro scale below this is in rad/us, as in Baseflight, not in deg/s.
_BASEFLIGHT = 1e-3

Fields = dict[str, FloatArray]
Headers = dict[str, Any]
# Field without its index -> factor to SI, SI unit, description.
Units = dict[str, tuple[float, str, str]]

_FIRMWARE = re.compile(r'(Betaflight|Cleanflight|INAV|EmuFlight)\s+(\d+)\.(\d+)\.?(\d*)', re.I)


def read(path: Path, request: Request) -> Log:
    """Read one flight of a blackbox file, by default the largest."""
    pointers = Reader(str(path), None, True).log_pointers
    # Size of each flight in bytes, found without decoding it.
    held = np.diff([*pointers, path.stat().st_size]).tolist()
    wanted = request.flight or (held.index(max(held)) + 1 if held else 1)
    notes = []
    if not 1 <= wanted <= len(held):
        raise InputError(f'{path} has no flight {wanted}: it holds {len(held)}')
    parser = Parser.load(str(path), wanted, True)
    headers = parser.headers
    main = parser.reader.field_defs
    if FrameType.INTRA not in main or FrameType.INTER not in main:
        raise InputError(f'{path}: the header of flight {wanted} does not say which fields '
                         'are logged: it is damaged')
    names = [one.name for one in main[FrameType.INTRA]]
    fields = _wanted(names, request)
    if 'time' not in names:
        raise InputError(f'{path}: flight {wanted} has no field time: it is damaged')
    table, dropped = _frames(parser, [names.index(name) for name in fields], request)
    end, size = parser.reader.tell(), len(parser.reader)
    rest = parser.reader._frame_data[end:].removeprefix(b'End of log\0')
    broken = int(parser._ctx.invalid_frame_count)
    if dropped:
        notes.append(f'At least {counted(dropped, "frame")} dropped: no intact key frame before '
                     'them.')
    if broken:
        notes.append(f'Left out: {counted(broken, "piece")} that orangebox cannot read, broken '
                     'bytes or events of newer firmware.')
    if not parser._end_of_log:
        notes.append(Note(f'Flight {wanted} has no end mark, so it was probably cut off; '
                          f'{end} of {size} bytes of frames were read.', Defect.DAMAGED_FILE))
    elif rest.strip(b'\xff\0'):
        # Bytes of erased flash and padding of cards do not count.
        notes.append(f'{len(rest)} of {size} bytes after the end mark of flight {wanted} were '
                     'not read.')
    table, odd = _in_time(table)
    if odd:
        notes.append(f'{counted(odd, "frame")} dropped: out of order, or isolated in time.')
    columns = {name: table[:, k] for k, name in enumerate(fields)}
    facts = _facts(headers)
    if len(held) > 1:
        facts['flight'] = f'{wanted} of {len(held)}'
    t = columns['time'] * 1e-6
    if request.flight is None and len(held) > 1:
        # Only this flight is decoded; the others' lengths are estimated from their bytes.
        pace = float(t[-1] - t[0]) / max(held[wanted - 1], 1) if t.size else 0.0
        lengths = '; '.join(f'{k + 1}: about {pace * size:.0f} s'
                            for k, size in enumerate(held))
        notes.insert(0, f'The file holds {len(held)} flights ({lengths}); this is flight '
                     f'{wanted}, the largest: --flight N chooses another.')
    series = [*_battery(t, columns, headers, notes), *_throttles(t, columns, headers)]
    units = _units(headers)
    series += _signals(t, columns, units, {one.name for one in series})
    series += _gyros(t, columns, headers, units, notes)
    series += _speeds(t, columns, headers, notes, request.poles)
    return log_of('blackbox', series, facts, notes, (name for name in names if name != 'time'))


def _wanted(names: list[str], request: Request) -> list[str]:
    kinds = ('vbatLatest', 'vbat', 'sagCompensatedVBat', 'amperageLatest', 'amperage',
             'rcCommand[3]', 'setpoint[3]')
    arrays = r'(motor|gyroADC|gyroUnfilt|accSmooth|eRPM|debug)\[\d+\]'
    return ['time', *[name for name in names if name != 'time' and (
        request.everything or name in kinds or name in request.names
        or re.fullmatch(arrays, name))]]


def _frames(parser: Any, places: list[int], request: Request) -> tuple[FloatArray, int]:
    """Return the wanted fields of sound frames, shape (n, fields), and the number dropped."""
    pick = itemgetter(*places) if len(places) > 1 else (lambda data: (data[places[0]],))
    reader, context = parser.reader, parser._ctx
    rows: list[tuple[int, ...]] = []
    dropped, invalid, sound = 0, 0, False
    count = 0
    before = -1
    # The parser stops at bytes it cannot parse; it is restarted behind them.
    while reader.tell() < len(reader) and reader.tell() > before and not parser._end_of_log:
        before = reader.tell()
        try:
            for frame in parser.frames():
                if context.invalid_frame_count != invalid:
                    invalid, sound = context.invalid_frame_count, False
                # A key frame is complete; the others are differences from the frame before.
                sound = sound or frame.type == FrameType.INTRA
                if sound:
                    rows.append(pick(frame.data))
                else:
                    dropped += 1
                count += 1
                if request.progress is not None and count % 1024 == 0:
                    request.progress(reader.tell() / max(1, len(reader)))
        except (TypeError, IndexError, KeyError, ValueError, ZeroDivisionError,
                AttributeError, StopIteration, OverflowError, RuntimeError):
            # At the end, or in broken bytes; a note reports the bytes read.
            sound = False
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(places))
    return table, dropped


def _in_time(table: FloatArray) -> tuple[FloatArray, int]:
    """Return the frames in order of unwrapped time, and the number of frames dropped."""
    if len(table) < 2:
        return table, 0
    time = np.unwrap(np.mod(table[:, 0], WRAP), period=WRAP)
    steps = np.diff(time) * 1e-6
    starts = np.concatenate(([0], np.flatnonzero((steps <= 0.0) | (steps > _PAUSE)) + 1))
    lengths = np.diff(np.append(starts, len(table)))
    good = np.repeat((lengths >= min(_PART, int(lengths.max()))), lengths)
    table = table.copy()
    table[:, 0] = time
    kept = table[good]
    # Frames that go back in time do not belong to this flight.
    ahead = np.ones(len(kept), dtype=bool)
    ahead[1:] = kept[1:, 0] > np.maximum.accumulate(kept[:-1, 0])
    kept = kept[ahead]
    return kept, len(table) - len(kept)


def _facts(headers: Headers) -> dict[str, str]:
    facts = {}
    for fact, key in (('firmware', 'Firmware revision'), ('vehicle', 'Craft name'),
                      ('board', 'Board information'), ('started', 'Log start datetime')):
        value = headers.get(key)
        # If the autopilot has no clock, the date is in the year 0.
        if value not in (None, '') and not str(value).startswith('0000-'):
            facts[fact] = str(value)
    return facts | _cells(headers)


def _cells(headers: Headers) -> dict[str, str]:
    """Return the number of cells, counted as in the firmware, and a cell's lowest voltage, V."""
    words = [re.findall(r'\d+', str(headers.get(key, '')))
             for key in ('vbatcellvoltage', 'vbatref')]
    if len(words[0]) != 3 or len(words[1]) != 1:
        return {}
    low, _, high = (float(word) for word in words[0])
    # Unit: 0.01 V from Betaflight 4.0 on, 0.1 V before; INAV: 0.1 V for cells, 0.01 V for packs.
    fine = high > 100.0
    reference = float(words[1][0]) * (0.01 if fine or float(words[1][0]) >= 300.0 else 0.1)
    low, high = (value * (0.01 if fine else 0.1) for value in (low, high))
    if not 2.0 < low < high < 5.0 or reference < low:
        return {}
    return {'cells': f'{math.ceil(reference / high - 1e-9)}', 'cell_minimum': f'{low:g}'}


def _version(headers: Headers) -> tuple[str, tuple[int, int, int]]:
    """Return the firmware and its version; ('', (0, 0, 0)) when unknown."""
    found = _FIRMWARE.search(str(headers.get('Firmware revision', '')))
    if found is None:
        return '', (0, 0, 0)
    major, minor, patch = (int(found[k] or 0) for k in (2, 3, 4))
    return found[1].lower(), (major, minor, patch)


def _battery_scales(headers: Headers) -> tuple[float | None, float | None]:
    """Return V and A per logged unit, as in blackbox-log-viewer; None: unknown."""
    name, version = _version(headers)
    if name == 'inav' and version >= (2, 0, 0):
        return 0.01, 0.01
    if name == 'betaflight' and version >= (3, 1, 0):
        return 0.01 if version >= (4, 0, 0) else 0.1, 0.01 if version >= (3, 1, 7) else None
    if name == 'cleanflight' and version >= (2, 0, 0):
        return 0.1, 0.01
    cell = headers.get('vbatcellvoltage')
    highest = cell[-1] if isinstance(cell, list) else None
    scale = headers.get('vbat_scale')
    if name not in ('betaflight', 'cleanflight') and isinstance(highest, (int, float)):
        return (0.01 if 300 <= highest <= 500 else 0.1 if 30 <= highest <= 50 else None), None
    if isinstance(scale, (int, float)) and scale > 0:
        # The raw ADC: 12 bits of 3.3 V, behind a divider of scale / 10.
        return 3.3 / 4095 * scale / 10.0, None
    return None, None


def _battery(t: FloatArray, columns: Fields, headers: Headers,
             notes: list[str]) -> Iterator[Series]:
    volts, amperes = _battery_scales(headers)
    for field, quantity, words, rank in (
            ('vbatLatest', VOLTAGE, 'battery', 0), ('vbat', VOLTAGE, 'battery', 0),
            ('sagCompensatedVBat', VOLTAGE, 'battery, sag compensated by INAV', None),
            ('amperageLatest', CURRENT, 'battery', 0), ('amperage', CURRENT, 'battery', 0)):
        if field not in columns:
            continue
        scale = volts if quantity == VOLTAGE else amperes
        if scale is None:
            notes.append(f'{field} was left out: its unit is not known for the firmware '
                         f"'{headers.get('Firmware revision', 'unknown')}'.")
            continue
        one = Series(field, quantity, t, columns[field] * scale, f'{scale:.6g}', words, rank,
                     'battery')
        yield replace(one, words=f'{words}, always 0: no sensor', rank=None) if (
            one.silent) else one


def _throttles(t: FloatArray, columns: Fields,
               headers: Headers) -> Iterator[Series]:
    motors = [name for name in columns if name.startswith('motor[')]
    low, high = _pair(headers.get('motorOutput')) or _pair(
        [headers.get('minthrottle'), headers.get('maxthrottle')]) or (1000.0, 2000.0)
    if motors:
        mean = np.mean([columns[name] for name in motors], axis=0)
        yield Series('motors', THROTTLE, t, (mean - low) / (high - low),
                     f'(mean of {len(motors)} motors - {low:g}) / {high - low:g}',
                     f'mean of {len(motors)} motors', 0)
    if 'rcCommand[3]' in columns:
        finer = _high_resolution(headers)
        yield Series('rcCommand[3]', THROTTLE, t,
                     (_signed(columns['rcCommand[3]']) / finer - 1000.0) / 1000.0,
                     f'(x / {finer:g} - 1000) / 1000' if finer > 1.0 else '(x - 1000) / 1000',
                     'stick', 1)
    if 'setpoint[3]' in columns:
        yield Series('setpoint[3]', THROTTLE, t, columns['setpoint[3]'] / 1000.0, '0.001',
                     'throttle command', 2)
    for name in motors:
        yield Series(name, THROTTLE, t, (columns[name] - low) / (high - low),
                     f'(x - {low:g}) / {high - low:g}', 'one motor')


def _signed(value: FloatArray) -> FloatArray:
    """Restore the sign of counts logged as unsigned (a stick below its lowest pulse)."""
    value = np.where(value >= 2.0 ** 31, value - 2.0 ** 32, value)
    return np.where((value >= 2.0 ** 15) & (value < 2.0 ** 16), value - 2.0 ** 16, value)


def _pair(value: Any) -> tuple[float, float] | None:
    """Return a list of two rising numbers as a pair; None for any other value."""
    if isinstance(value, list) and len(value) == 2 and all(
            isinstance(x, (int, float)) for x in value) and value[1] > value[0]:
        return float(value[0]), float(value[1])
    return None


def _high_resolution(headers: Headers) -> float:
    """Return the extra scale of gyro, sticks and setpoints: 1 or 10."""
    return 10.0 if _number(headers, 'blackbox_high_resolution') else 1.0


def _units(headers: Headers) -> Units:
    """Return the units of fields, as far as the header states them."""
    units = {'setpoint': (DEGREE / _high_resolution(headers), 'rad/s', 'rate command'),
             'BaroAlt': (0.01, 'm', 'altitude by the barometer')}
    gyro, one_g = _gyro_scale(headers), _number(headers, 'acc_1G')
    if gyro is not None:
        units |= dict.fromkeys((GYRO, UNFILTERED), (gyro, 'rad/s', 'gyro'))
    if one_g:
        units[ACCELEROMETER] = GRAVITY / one_g, 'm/s^2', 'accelerometer'
    firmware, version = _version(headers)
    if firmware == 'betaflight' and _FIRST <= version < _LAST and (
            headers.get('debug_mode') == _GYRO_SCALED):
        units[DEBUG] = DEGREE, 'rad/s', 'gyro before the filters'
    return units


def _gyros(t: FloatArray, columns: Fields, headers: Headers, units: Units, notes: list[str],
           ) -> Iterator[Series]:
    """Yield the gyros that the log holds, with the accelerometer (t in s)."""
    forces = _three(columns, ACCELEROMETER)
    words = 'no accelerometer'
    if forces is not None and ACCELEROMETER in units:
        forces *= units[ACCELEROMETER][0]
        words = f'accSmooth {GRAVITY:g} / {_number(headers, "acc_1G"):g}'
    elif forces is not None:
        notes.append('accSmooth was left out of /imu: the header does not state acc_1G.')
        forces = None
    for rank, (name, what) in enumerate((
            (GYRO, "gyro after the autopilot's filters"), (UNFILTERED, 'gyro before the filters'),
            (DEBUG, 'gyro before the filters (debug_mode GYRO_SCALED)'))):
        rates = _three(columns, name)
        if rates is not None and name in units:
            scale = units[name][0]
            yield from gyro_of(name, t, rates * scale, forces, f'{name} {scale:.6g}, {words}',
                               what, rank)
        elif rates is not None and name != DEBUG:
            notes.append(f'{name} was left out of /imu: the header does not state gyro_scale.')


def _three(columns: Fields, name: str) -> FloatArray | None:
    return three_axes(columns, [f'{name}[{axis}]' for axis in range(3)], 1.0)


def _gyro_scale(headers: Headers) -> float | None:
    """Return rad/s per unit of the gyro; None if the header does not state it."""
    raw: Any = headers.get('gyro_scale', headers.get('gyro.scale'))
    try:
        # The bits of a float, written as a whole number.
        bits = int(raw, 16) if isinstance(raw, str) else int(raw)
        scale = float(struct.unpack('<f', struct.pack('<I', bits))[0])
    except (TypeError, ValueError, struct.error, OverflowError):
        return None
    if not (math.isfinite(scale) and scale > 0.0):
        return None
    if scale < _BASEFLIGHT:
        return scale * 1e6
    return scale * DEGREE / _high_resolution(headers)


def _signals(t: FloatArray, columns: Fields, units: Units, known: set[str]) -> Iterator[Series]:
    """Yield the remaining fields, in SI where their unit is known (t in s)."""
    for name, values in columns.items():
        if name != 'time' and name not in known:
            # Only the first three debug fields hold the gyro.
            found = None if name == f'{DEBUG}[3]' else units.get(name.partition('[')[0])
            scale, unit, words = found or (1.0, UNKNOWN, 'as logged')
            yield Series(name, SIGNAL, t, values * scale, f'{scale:.6g}', words, own_unit=unit)


def _speeds(t: FloatArray, columns: Fields, headers: Headers, notes: list[str],
            poles: int | None) -> Iterator[Series]:
    places = sorted(int(found[1]) for name in columns
                    if (found := re.fullmatch(r'eRPM\[(\d+)\]', name)))
    if not places:
        return
    stated = _number(headers, 'motor_poles')
    count = poles or int(stated)
    if count < 2:
        notes.append('eRPM was left out: the header does not state motor_poles; give --poles N, '
                     'the magnets of a rotor (14 is common).')
        return
    # eRPM is logged in hundreds; each pair of poles makes one electrical turn per turn of the
    # shaft.
    scale = 100.0 * RPM * 2.0 / count
    origin = '--poles' if poles else 'the header'
    yield from speeds_of(t, [columns[f'eRPM[{k}]'] for k in places], scale, 'eRPM',
                         f'rotor speed, {count} poles by {origin}', places)


def _number(headers: Headers, key: str) -> float:
    """Return a positive number of the header; 0 if missing."""
    value = headers.get(key)
    return float(value) if isinstance(value, (int, float)) and 0.0 < value < math.inf else 0.0
