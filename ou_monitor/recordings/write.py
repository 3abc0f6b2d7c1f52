"""
Write a `Recording` as a bag.

`replay`, `ros2 bag play` and `analyze` take it.  Limits: messages hold float32 (but
std_msgs/Float64), 0.5 uV at 5 V.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import heapq
import math
from pathlib import Path
from types import TracebackType

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_block, encode_scalars, FLOAT32, FLOAT32_ARRAY, FLOAT64)
from ou_monitor.records import FloatArray, Recording

# What `type` may be -> message type of the voltage.
TYPES = {
    'battery_state': BATTERY_STATE, 'float32': FLOAT32, 'float64': FLOAT64,
    'adc_block': FLOAT32_ARRAY,
}

# Samples encoded at once; bounds memory.
SLICE = 1024

# An adc_block of a log: rate of its samples, Hz, and how many there are in one.
BLOCK_RATE = 10000.0
BLOCK = 100

# An unchanged throttle is repeated this often, so that a subscriber that comes
# late, or a bag played from the middle, knows it soon.
THROTTLE_PERIOD_NS = 1_000_000_000

# Stamps of 64 bits with room to be moved.
_LAST_NS = 2.0**62

# The header's stamp counts seconds in an int32.
LAST_HEADER_NS = (2**31) * 1_000_000_000 - 1

# Log time (ns), which topic, message.  At one instant the throttle goes first:
# it holds for that sample.
Timed = tuple[int, int, bytes]
THROTTLE, VOLTAGE = 0, 1


def write_recording(
    rec: Recording, path: str | Path, *,
    type: str = 'battery_state',  # noqa: A002
    start_ns: int = 0, sample_rate: float = 10000.0, block: int = 100,
    progress: Callable[[float], None] | None = None,
) -> tuple[str, ...]:
    """
    Write topics `/voltage` and, where throttle is known, `/throttle`.

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
    Writes a recording that comes in pieces; memory does not grow with them.

    A context manager; what was written is removed when its block fails.

    Parameters
    ----------
    path, type, start_ns, sample_rate, block :
        As in `write_recording`.

    Attributes
    ----------
    topics : dict of str to str
        Topic -> message type, as written so far.
    notes : tuple of str
        What was changed on the way, one sentence each.

    Raises
    ------
    InputError
        As `write_recording`.

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
        if samples.size:
            self._bag.write(self._names[VOLTAGE], int(stamps[-1]), encode_block(samples))
            self._rest = stamps[:0], samples[:0]
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

    def _voltage(self, stamps: npt.NDArray[np.int64], voltage: FloatArray) -> Iterator[Timed]:
        if self._type == 'adc_block':
            stamps = np.concatenate((self._rest[0], stamps))
            voltage = np.concatenate((self._rest[1], voltage))
            whole = stamps.size - stamps.size % self._block
            self._rest = stamps[whole:], voltage[whole:]
            for first in range(0, whole, self._block):
                last = first + self._block
                yield int(stamps[last - 1]), VOLTAGE, encode_block(voltage[first:last])
            return
        if self._type == 'battery_state':
            messages = encode_battery(stamps, voltage)
        else:
            messages = encode_scalars(TYPES[self._type], voltage)
        for t, message in zip(stamps.tolist(), messages, strict=True):
            yield t, VOLTAGE, message

    def _throttles(self, stamps: npt.NDArray[np.int64], throttle: FloatArray) -> Iterator[Timed]:
        known = np.isfinite(throttle)
        times, values = stamps[known], throttle[known].astype(np.float32)
        if not values.size:
            return
        changed = np.diff(values, prepend=np.float32(self._throttle)) != 0.0
        # One sample a period is sent whatever it says.
        periods = times // THROTTLE_PERIOD_NS
        changed |= np.diff(periods, prepend=self._period) > 0
        self._throttle, self._period = float(values[-1]), int(periods[-1])
        for t, message in zip(times[changed].tolist(),
                              encode_scalars(FLOAT32, values[changed]), strict=True):
            yield t, THROTTLE, message


def check_steady(name: str, since_first: npt.NDArray[np.int64], before: int,
                 sample_rate: float) -> None:
    """Refuse what blocks without stamps cannot hold: any spacing but the stated one."""
    grid = (before + np.arange(since_first.size)) * (1e9 / sample_rate)
    if np.abs(since_first - grid).max() > 0.5e9 / sample_rate:
        raise InputError(
            f"'{name}' is not sampled at a steady {sample_rate:g} Hz, as blocks of samples "
            'need it: use another type')
