"""
Write a `Recording`, or the series of a log, as a bag.

`replay`, `ros2 bag play` and `analyze` read it.  Limits: messages hold float32 (except
std_msgs/Float64), 0.5 uV at 5 V.

Every series of a log keeps its own stamps, counted from the start of the log, to 10 ns in a
day.  Gyros are sensor_msgs/Imu, motor speeds sensor_msgs/JointState (velocity, rad/s), named
series std_msgs/Float64; the metadata of each topic have its unit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
import heapq
import math
from pathlib import Path
from types import TracebackType

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.importers.choose import Chosen, Extras, SPEEDS
from ou_monitor.recordings.importers.log import Motion, Series, VELOCITY
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_blocks, encode_imu, encode_joints, encode_scalars,
    FLOAT32, FLOAT32_ARRAY, FLOAT64, IMU, JOINT_STATE)
from ou_monitor.records import FloatArray, Recording

# Names of `type` -> message type of the voltage.
TYPES = {
    'battery_state': BATTERY_STATE, 'float32': FLOAT32, 'float64': FLOAT64,
    'adc_block': FLOAT32_ARRAY,
}

# Maximum samples encoded at once; limits memory.  Whole blocks.
SLICE = 1000

# An adc_block of a log: rate of its samples, Hz, and samples per block.
BLOCK_RATE = 10000.0
BLOCK = 100

# Period, s, after which an unchanged throttle is repeated, for late subscribers and bags played
# from the middle.
THROTTLE_PERIOD_NS = 1_000_000_000

# Range of 64-bit stamps, with a margin for shifts.
_LAST_NS = 2.0**62

# The header's stamp counts seconds in an int32.
LAST_HEADER_NS = (2**31) * 1_000_000_000 - 1

Stamps = npt.NDArray[np.int64]
# Log time (ns), topic index, message.  At equal times the throttle comes first: it holds for that
# sample.
Timed = tuple[int, int, bytes]
THROTTLE, VOLTAGE = 0, 1


def write_recording(
    rec: Recording, path: str | Path, *,
    type: str = 'battery_state',  # noqa: A002
    start_ns: int = 0, sample_rate: float = 10000.0, block: int = 100,
    progress: Callable[[float], None] | None = None,
) -> tuple[str, ...]:
    """
    Write topics `/voltage` and, if throttle is known, `/throttle`.

    start_ns in ns, sample_rate in Hz, progress 0..1.
    """
    if rec.n == 0:
        raise InputError(f"'{rec.name}' holds no sample: there is nothing to write")
    with RecordingWriter(path, type=type, start_ns=start_ns, sample_rate=sample_rate,
                         block=block) as writer:
        for first in range(0, rec.n, SLICE):
            part = slice(first, first + SLICE)
            writer.write(Recording(rec.t[part], rec.voltage[part], rec.throttle[part], rec.name))
            if progress is not None:
                progress(min(1.0, (first + SLICE) / rec.n))
    return writer.notes


def as_nanoseconds(t: FloatArray, name: str) -> npt.NDArray[np.int64]:
    """Return stamps as a bag holds them (t in s)."""
    stamps = np.rint(t * 1e9)
    far = float(np.abs(stamps).max(initial=0.0))
    if far > _LAST_NS:
        raise InputError(f"'{name}' has stamps up to {far * 1e-9:.4g} s, and a bag holds "
                         f'{_LAST_NS * 1e-9:.2g} s: are they in ms or us?')
    return stamps.astype(np.int64)


class RecordingWriter:
    """
    Writes a recording that comes in pieces, as `write_recording`; memory does not grow with them.

    A context manager; if its block fails, the bag is removed.  `topics`: their message
    types; `notes`: changes made, one sentence each.
    """

    def __init__(self, path: str | Path, *, type: str = 'battery_state',  # noqa: A002
                 start_ns: int = 0, sample_rate: float = 10000.0, block: int = 100) -> None:
        if type not in TYPES:
            raise InputError(f"no bag type '{type}': {nearest(type, TYPES)}")
        if type == 'adc_block' and not sample_rate > 0.0:
            raise InputError(f'sample_rate must be above 0 Hz, got {sample_rate}')
        self._type, self._block, self._rate = type, block, sample_rate
        self._shift = start_ns
        self._first: int | None = None
        self._written = 0
        self._throttle = math.nan
        self._period = -1
        self._rest: tuple[npt.NDArray[np.int64], FloatArray] = (
            np.empty(0, dtype=np.int64), np.empty(0))
        self.notes: tuple[str, ...] = ()
        self.topics: dict[str, str] = {}
        self._bag = BagWriter(path)
        self._names = {VOLTAGE: self._add('voltage', TYPES[type], sample_rate
                                          if type == 'adc_block' else None)}

    def _add(self, name: str, kind: str, sample_rate: float | None = None) -> str:
        topic = self._bag.add_topic(name, kind, sample_rate=sample_rate)
        self.topics[topic] = kind
        return topic

    def write(self, piece: Recording) -> None:
        """Write the next samples."""
        if not piece.n:
            return
        stamps = as_nanoseconds(piece.t, piece.name) + self._shift
        if self._first is None:
            if stamps[0] < 0:
                self.notes += (f'Stamps were moved by {-stamps[0] * 1e-9:.9f} s: a bag cannot '
                               'hold negative ones.',)
                self._shift -= int(stamps[0])
                stamps = stamps - stamps[0]
            self._first = int(stamps[0])
        if self._type == 'battery_state' and stamps[-1] > LAST_HEADER_NS:
            raise InputError(f"'{piece.name}' has stamps after 2^31 s, which a header cannot "
                             'hold: use another type')
        if self._type == 'adc_block':
            check_steady(piece.name, stamps - self._first, self._written, self._rate)
        if THROTTLE not in self._names and piece.has_throttle:
            self._names[THROTTLE] = self._add('throttle', FLOAT32)
        self._written += piece.n
        self._send(self._voltage(stamps, piece.voltage), self._throttles(stamps, piece.throttle))

    def _send(self, *streams: Iterator[Timed]) -> None:
        for t, topic, data in heapq.merge(*streams):
            self._bag.write(self._names[topic], t, data)

    def close(self) -> None:
        """Finish the bag."""
        stamps, samples = self._rest
        self._rest = stamps[:0], samples[:0]
        self._send(self._messages(VOLTAGE, TYPES[self._type], stamps, samples))
        self._bag.close()

    def __enter__(self) -> RecordingWriter:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish the bag, or remove it when the block failed."""
        if kind is None:
            try:
                self.close()
            except BaseException as failure:
                self._bag.__exit__(type(failure), failure, failure.__traceback__)
                raise
        self._bag.__exit__(kind, error, trace)

    def _messages(self, topic: int, kind: str, stamps: Stamps, values: FloatArray,
                  ) -> Iterator[Timed]:
        for t, message in encode(kind, stamps, values, self._block):
            yield t, topic, message

    def _voltage(self, stamps: Stamps, voltage: FloatArray) -> Iterator[Timed]:
        whole = stamps.size
        if self._type == 'adc_block':
            stamps = np.concatenate((self._rest[0], stamps))
            voltage = np.concatenate((self._rest[1], voltage))
            whole = stamps.size - stamps.size % self._block
            self._rest = stamps[whole:], voltage[whole:]
        return self._messages(VOLTAGE, TYPES[self._type], stamps[:whole], voltage[:whole])

    def _throttles(self, stamps: npt.NDArray[np.int64], throttle: FloatArray) -> Iterator[Timed]:
        known = np.isfinite(throttle)
        times, values = stamps[known], throttle[known].astype(np.float32)
        if not values.size:
            return
        changed = np.diff(values, prepend=np.float32(self._throttle)) != 0.0
        # One sample a period is written even if unchanged.
        periods = times // THROTTLE_PERIOD_NS
        changed |= np.diff(periods, prepend=self._period) > 0
        self._throttle, self._period = float(values[-1]), int(periods[-1])
        yield from self._messages(THROTTLE, FLOAT32, times[changed], values[changed])


def check_steady(name: str, since_first: npt.NDArray[np.int64], before: int,
                 sample_rate: float) -> None:
    """Refuse a spacing other than the stated one, because blocks have no stamps for it."""
    grid = (before + np.arange(since_first.size)) * (1e9 / sample_rate)
    if np.abs(since_first - grid).max() > 0.5e9 / sample_rate:
        raise InputError(
            f"'{name}' is not sampled at a steady {sample_rate:g} Hz, as blocks of samples "
            'need it: use another type')


@dataclass(frozen=True, eq=False)
class _Stream:
    """One topic: stamps (s), messages of a part of them, and their origin."""

    topic: str
    kind: str
    t: FloatArray
    encode: Callable[[Stamps, slice], Iterable[tuple[int, bytes]]]
    origin: dict[str, str]


def write_log(
    chosen: Chosen, path: Path, about: Mapping[str, str], *, kind: str = 'battery_state',
    extras: Extras | None = None, progress: Callable[[float], None] | None = None,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Write a bag (progress 0..1)."""
    # At equal times the voltage comes last, after the values that hold for it.
    streams = [_of_series(name, FLOAT32, series) for name, series in (
        ('throttle', chosen.throttle), ('current', chosen.current)) if series is not None]
    if extras is not None:
        streams += [_of_motion(name, one) for name, one in extras.inertial.items()]
        if extras.speeds is not None:
            streams.append(_of_motion(SPEEDS, extras.speeds))
        streams += [_of_series(name, FLOAT64, one) for name, one in extras.signals.items()]
    streams.append(_of_series('voltage', TYPES[kind], chosen.voltage))
    first = min(float(stream.t[0]) for stream in streams)
    shift = max(0, -round(first * 1e9))
    notes = (f'Stamps were moved by {shift * 1e-9:.9f} s: a bag cannot hold negative ones.',
             ) if shift else ()
    total = sum(stream.t.size for stream in streams)
    topics: dict[str, str] = {}
    # Refused before anything is written to disk.
    stamps = [as_nanoseconds(stream.t, stream.origin[f'{stream.topic}_field']) + shift
              for stream in streams]
    if kind == 'adc_block':
        check_steady(chosen.voltage.name, stamps[-1] - stamps[-1][0], 0, BLOCK_RATE)
    for stream, own in zip(streams, stamps):
        if stream.kind in (BATTERY_STATE, IMU, JOINT_STATE) and own[-1] > LAST_HEADER_NS:
            raise InputError(f"'{stream.origin[f'{stream.topic}_field']}' has stamps after 2^31 "
                             's, which a header cannot hold'
                             + (': use another type' if stream.kind == BATTERY_STATE else ''))
    whole = {**about}
    for stream in streams:
        whole |= stream.origin
    with BagWriter(path, about=whole) as bag:
        # Topics in the order of the table of contents: the voltage first.
        for stream in reversed(streams):
            rate = BLOCK_RATE if stream.kind == FLOAT32_ARRAY else None
            topics[bag.add_topic(stream.topic, stream.kind, sample_rate=rate,
                                 origin={**about, **stream.origin})] = stream.kind
        parts = [_messages(k, own, stream) for k, (own, stream) in enumerate(zip(stamps, streams))]
        for done, (t, k, data) in enumerate(heapq.merge(*parts)):
            bag.write('/' + streams[k].topic, t, data)
            if progress is not None and done % SLICE == 0:
                progress(done / total)
    return topics, notes


def encode(kind: str, stamps: Stamps, values: FloatArray, block: int = BLOCK,
           ) -> Iterator[tuple[int, bytes]]:
    """Yield messages of numbers with their log times, ns (a block's: its last sample's)."""
    if kind == FLOAT32_ARRAY:
        whole = stamps.size - stamps.size % block
        yield from zip(stamps[block - 1:whole:block].tolist(),
                       encode_blocks(values[:whole].reshape(-1, block)), strict=True)
        if whole < stamps.size:
            yield int(stamps[-1]), encode_blocks(values[None, whole:])[0]
        return
    yield from zip(stamps.tolist(), encode_battery(stamps, values) if kind == BATTERY_STATE
                   else encode_scalars(kind, values), strict=True)


def _origin(topic: str, name: str, unit: str, scale: str, words: str) -> dict[str, str]:
    """Return the origin of a topic, by keys of its own."""
    return {f'{topic}_field': name, f'{topic}_unit': unit, f'{topic}_scale': scale,
            f'{topic}_what': words}


def _of_series(topic: str, kind: str, series: Series) -> _Stream:
    return _Stream(topic, kind, series.t,
                   lambda stamps, part: encode(kind, stamps, series.values[part]),
                   _origin(topic, series.name, series.unit, series.scale, series.words))


def _of_motion(topic: str, one: Motion) -> _Stream:
    def messages(stamps: Stamps, part: slice) -> Iterable[tuple[int, bytes]]:
        held = {field: values[part] for field, values in one.vectors.items()}
        return zip(stamps.tolist(), encode_joints(stamps, one.motors, held[VELOCITY])
                   if one.motors else encode_imu(stamps, held), strict=True)
    return _Stream(
        topic, JOINT_STATE if one.motors else IMU, one.t, messages,
        _origin(topic, ', '.join(one.motors) or one.name,
                'rad/s' if one.motors else 'rad/s, m/s^2', one.scale, one.words))


def _messages(place: int, stamps: Stamps, stream: _Stream) -> Iterator[Timed]:
    for first in range(0, stamps.size, SLICE):
        part = slice(first, first + SLICE)
        for t, message in stream.encode(stamps[part], part):
            yield t, place, message
