"""
Write a `Recording`, or the series of a log, as a bag.

`replay`, `ros2 bag play` and `analyze` read such bags. Limits: messages hold float32 (except
std_msgs/Float64), which resolves 0.5 uV at 5 V.

Every series of a log keeps its own stamps, counted from the start of the log, to within 10 ns over
a day. Gyros are sensor_msgs/Imu, motor speeds sensor_msgs/JointState (velocity, rad/s), named
series std_msgs/Float64; the metadata of the bag have their units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import heapq
from itertools import repeat
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.importers.choose import ChosenSeries
from ou_monitor.recordings.importers.log import Series, SPEEDS
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_blocks, encode_imu, encode_joints, encode_scalars,
    FLOAT32, FLOAT32_ARRAY, FLOAT64, IMU, JOINT_STATE)
from ou_monitor.records import FloatArray, Recording

# Value of `type` -> message type of the voltage.
TYPES = {
    'battery_state': BATTERY_STATE, 'float32': FLOAT32, 'float64': FLOAT64,
    'adc_block': FLOAT32_ARRAY,
}

# Topic of a log -> message type; of a named series FLOAT64.
_KINDS = {'voltage': BATTERY_STATE, 'throttle': FLOAT32, 'current': FLOAT32, 'imu': IMU,
          SPEEDS: JOINT_STATE}

# Maximum samples encoded at once, which limits memory; a multiple of BLOCK.
SLICE = 1000

# Usual rate of the samples in an adc_block, Hz, and samples per block.
BLOCK_RATE = 10000.0
BLOCK = 100

# Period, ns, after which an unchanged load is repeated, for late subscribers and bags played
# from the middle.
LOAD_PERIOD_NS = 1_000_000_000

# Largest stamp, ns: half the range of 64-bit stamps, as a margin for shifts.
_LAST_NS = 2.0**62

# The header's stamp counts seconds in an int32.
LAST_HEADER_NS = (2**31) * 1_000_000_000 - 1

Stamps = npt.NDArray[np.int64]
# Log time (ns), index of the topic, message.  At equal times the voltage comes last, because the
# loads hold for the voltage of that time.
Timed = tuple[int, int, bytes]
LOADS, VOLTAGE = ('throttle', 'current'), 2


def write_recording(
    rec: Recording | Iterable[Recording], path: str | Path, *,
    type: str = 'battery_state',  # noqa: A002
    start_ns: int = 0, sample_rate: float = BLOCK_RATE,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """
    Write topics `/voltage` and, if they are known, `/throttle` and `/current`.

    rec: a recording or its pieces, of which only one is held in memory; start_ns: added to the
    stamps, ns; sample_rate in Hz.  Returns the topics with their message types, and notes on
    changes.  If anything fails, the bag is removed.
    """
    if type not in TYPES:
        raise InputError(f"no bag type '{type}': {nearest(type, TYPES)}")
    blocks = type == 'adc_block'
    if blocks and not sample_rate > 0.0:
        raise InputError(f'sample_rate must be above 0 Hz, got {sample_rate}')
    if isinstance(rec, Recording) and rec.n == 0:
        raise InputError(f"'{rec.name}' holds no sample: there is nothing to write")
    kind, count, first = TYPES[type], 0, 0
    notes: tuple[str, ...] = ()
    # Samples of an incomplete block; value and period of each load's last message.
    rest: tuple[Stamps, FloatArray] = np.empty(0, np.int64), np.empty(0)
    held = dict.fromkeys(LOADS, (math.nan, -1))
    with BagWriter(path) as bag:
        bag.add_topic('voltage', kind, sample_rate=sample_rate if blocks else None)
        for piece in _pieces(rec):
            stamps = as_nanoseconds(piece.t, piece.name) + start_ns
            if not count:
                shift = max(0, -int(stamps[0]))
                notes, start_ns, stamps = _moved(shift), start_ns + shift, stamps + shift
                first = int(stamps[0])
            _check_header(kind, piece.name, stamps)
            volts = piece.voltage
            whole = stamps.size
            times = stamps
            if blocks:
                # Blocks hold no stamps of samples: the spacing must be the stated one.
                grid = (count + np.arange(stamps.size)) * (1e9 / sample_rate)
                if np.abs(stamps - first - grid).max() > 0.5e9 / sample_rate:
                    raise InputError(f"'{piece.name}' is not sampled at a steady {sample_rate:g} "
                                     'Hz, which blocks of samples need: use another type')
                stamps, volts = np.append(rest[0], stamps), np.append(rest[1], volts)
                whole = stamps.size - stamps.size % BLOCK
                rest = stamps[whole:], volts[whole:]
            count += piece.n
            streams = [_encoded(VOLTAGE, kind, stamps[:whole], volts[:whole])]
            for k, name in enumerate(LOADS):
                load = getattr(piece, name)
                known = np.isfinite(load) if load is not None else np.zeros(piece.n, np.bool_)
                if not known.any():
                    continue
                if f'/{name}' not in bag.topics:
                    bag.add_topic(name, FLOAT32)
                at, values = times[known], load[known].astype(np.float32)
                # One sample per period is written even if unchanged.
                periods = at // LOAD_PERIOD_NS
                sent = (np.diff(values, prepend=np.float32(held[name][0])) != 0.0) | (
                    np.diff(periods, prepend=held[name][1]) > 0)
                held[name] = float(values[-1]), int(periods[-1])
                streams.append(_encoded(k, FLOAT32, at[sent], values[sent]))
            for t, topic, data in heapq.merge(*streams):
                bag.write(f"/{(*LOADS, 'voltage')[topic]}", t, data)
        for t, _, data in _encoded(VOLTAGE, kind, *rest):
            bag.write('/voltage', t, data)
    return bag.topics, notes


def _pieces(rec: Recording | Iterable[Recording]) -> Iterator[Recording]:
    if not isinstance(rec, Recording):
        yield from (piece for piece in rec if piece.n)
        return
    for first in range(0, rec.n, SLICE):
        part = slice(first, first + SLICE)
        yield Recording(rec.t[part], rec.voltage[part], rec.throttle[part], rec.name,
                        current=None if rec.current is None else rec.current[part])


def _moved(shift: int) -> tuple[str, ...]:
    return (f'Stamps were moved by {shift * 1e-9:.9f} s: a bag cannot hold negative ones.',
            ) if shift else ()


def _check_header(kind: str, name: str, stamps: Stamps) -> None:
    if kind in (BATTERY_STATE, IMU, JOINT_STATE) and stamps[-1] > LAST_HEADER_NS:
        raise InputError(f"'{name}' has stamps after 2^31 s, which a header cannot hold")


def as_nanoseconds(t: FloatArray, name: str) -> npt.NDArray[np.int64]:
    """Return stamps as a bag holds them (t in s)."""
    stamps = np.rint(t * 1e9)
    far = float(np.abs(stamps).max(initial=0.0))
    if far > _LAST_NS:
        raise InputError(f"'{name}' has stamps up to {far * 1e-9:.4g} s, and a bag holds "
                         f'{_LAST_NS * 1e-9:.2g} s: are they in ms or us?')
    return stamps.astype(np.int64)


def write_log(
    chosen: ChosenSeries, extras: Mapping[str, Series], path: Path, about: Mapping[str, str], *,
    progress: Callable[[float], None] | None = None,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Write a bag (extras: by topic; progress 0..1)."""
    # At equal times the voltage comes last, after the values that hold for it.
    held = {'throttle': chosen.throttle, 'current': chosen.current, **extras,
            'voltage': chosen.voltage}
    streams = {topic: one for topic, one in held.items() if one is not None}
    kinds = {topic: _KINDS.get(topic, FLOAT64) for topic in streams}
    first = min(float(one.t[0]) for one in streams.values())
    shift = max(0, -round(first * 1e9))
    total = sum(one.t.size for one in streams.values())
    # Check the stamps before anything is written to disk.
    stamps = {topic: as_nanoseconds(one.t, one.name) + shift for topic, one in streams.items()}
    whole = {**about}
    for topic, one in streams.items():
        _check_header(kinds[topic], one.name, stamps[topic])
        whole |= {f'{topic}_field': one.name, f'{topic}_unit': one.unit,
                  f'{topic}_scale': one.scale, f'{topic}_what': one.words}
    with BagWriter(path, about=whole) as bag:
        # Add the voltage first, so that it is the first topic in listings.
        for topic in reversed(streams):
            bag.add_topic(topic, kinds[topic])
        names = [f'/{topic}' for topic in streams]
        parts = [_messages(k, kinds[topic], stamps[topic], one)
                 for k, (topic, one) in enumerate(streams.items())]
        for done, (t, k, data) in enumerate(heapq.merge(*parts)):
            bag.write(names[k], t, data)
            if progress is not None and done % SLICE == 0:
                progress(done / total)
    return bag.topics, _moved(shift)


def _messages(place: int, kind: str, stamps: Stamps, one: Series) -> Iterator[Timed]:
    motors = one.name.split(', ')
    for first in range(0, stamps.size, SLICE):
        part = slice(first, first + SLICE)
        yield from _encoded(place, kind, stamps[part], one.values[part], motors)


def _encoded(topic: int, kind: str, stamps: Stamps, values: FloatArray,
             motors: Sequence[str] = ()) -> Iterator[Timed]:
    """Yield messages with their log times (of a block: of its last sample)."""
    if kind == FLOAT32_ARRAY:
        whole = stamps.size - stamps.size % BLOCK
        yield from zip(stamps[BLOCK - 1:whole:BLOCK].tolist(), repeat(topic),
                       encode_blocks(values[:whole].reshape(-1, BLOCK)))
        if whole < stamps.size:
            yield int(stamps[-1]), topic, encode_blocks(values[None, whole:])[0]
        return
    yield from zip(stamps.tolist(), repeat(topic), (
        encode_battery(stamps, values) if kind == BATTERY_STATE else
        encode_imu(stamps, values) if kind == IMU else
        encode_joints(stamps, motors, values) if kind == JOINT_STATE else
        encode_scalars(kind, values)))
