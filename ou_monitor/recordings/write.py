"""
Write a `Recording` as a bag that `replay`, `ros2 bag play` and `analyze` take.

Limits first: messages hold float32 (but std_msgs/Float64), 0.5 uV at 5 V.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import heapq
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings import cdr
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.records import Recording

# What `type` may be -> message type of the voltage.
TYPES = {
    'battery_state': cdr.BATTERY_STATE, 'float32': cdr.FLOAT32, 'float64': cdr.FLOAT64,
    'adc_block': cdr.FLOAT32_ARRAY,
}

# Messages encoded at once; bounds memory.
SLICE = 16384

# An unchanged throttle is repeated this often, so that a subscriber that comes
# late, or a bag played from the middle, knows it soon.
THROTTLE_PERIOD_NS = 1_000_000_000

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

    Parameters
    ----------
    rec : Recording
        What to write.
    path : str or path
        Ends in .mcap for one file; else a rosbag2 directory.
    type : {'battery_state', 'float32', 'float64', 'adc_block'}
        Message of the voltage.  Throttle is std_msgs/Float32, at the first
        sample, at each change, and at least once a second.
    start_ns : int
        Added to every stamp, ns.
    sample_rate : float
        Rate of the samples, Hz, for 'adc_block' (which has no stamps of its
        own but that of the last sample of each block).
    block : int
        Samples in a block.
    progress : callable, optional
        Called with the share done, 0..1.

    Returns
    -------
    tuple of str
        What was changed on the way, one sentence each.

    Raises
    ------
    InputError
        When the target cannot be written, or the recording does not fit the
        type.

    """
    if type not in TYPES:
        raise InputError(f"no bag type '{type}': {nearest(type, TYPES)}")
    if rec.n == 0:
        raise InputError(f"'{rec.name}' holds no sample: there is nothing to write")
    notes: list[str] = []
    stamps = np.rint(rec.t * 1e9).astype(np.int64) + start_ns
    if stamps[0] < 0:
        notes.append(f'Stamps were moved by {-stamps[0] * 1e-9:.9f} s: a bag cannot hold '
                     'negative ones.')
        stamps = stamps - stamps[0]
    if type == 'battery_state' and stamps[-1] > LAST_HEADER_NS:
        raise InputError(f"'{rec.name}' has stamps after 2^31 s, which a header cannot hold: use "
                         'another type')
    if type == 'adc_block':
        _check_uniform(rec, stamps, sample_rate)
    with BagWriter(path) as bag:
        topics = {VOLTAGE: bag.add_topic('voltage', TYPES[type])}
        streams = [_voltage(stamps, rec, type, block)]
        if rec.has_throttle:
            topics[THROTTLE] = bag.add_topic('throttle', cdr.FLOAT32)
            streams.append(_throttle(stamps, rec))
        last = 0
        for t, topic, data in heapq.merge(*streams):
            bag.write(topics[topic], t, data)
            if progress is not None and t - last > 100_000_000:
                last = t
                progress((t - int(stamps[0])) / max(1, int(stamps[-1] - stamps[0])))
    return tuple(notes)


def _voltage(
    stamps: npt.NDArray[np.int64], rec: Recording, type: str, block: int,  # noqa: A002
) -> Iterator[Timed]:
    if type == 'adc_block':
        for first in range(0, rec.n, block):
            samples = rec.voltage[first:first + block]
            yield int(stamps[first + samples.size - 1]), VOLTAGE, cdr.encode_block(samples)
        return
    for first in range(0, rec.n, SLICE):
        part = slice(first, first + SLICE)
        if type == 'battery_state':
            messages = cdr.encode_battery(stamps[part], rec.voltage[part])
        else:
            messages = cdr.encode_scalars(TYPES[type], rec.voltage[part])
        for t, message in zip(stamps[part].tolist(), messages, strict=True):
            yield t, VOLTAGE, message


def _throttle(stamps: npt.NDArray[np.int64], rec: Recording) -> Iterator[Timed]:
    known = np.isfinite(rec.throttle)
    times, values = stamps[known], rec.throttle[known].astype(np.float32)
    changed = np.ones(values.size, dtype=bool)
    changed[1:] = values[1:] != values[:-1]
    # One sample a period is sent whatever it says.
    changed[1:] |= np.diff(times // THROTTLE_PERIOD_NS) > 0
    for t, message in zip(times[changed].tolist(),
                          cdr.encode_scalars(cdr.FLOAT32, values[changed]), strict=True):
        yield t, THROTTLE, message


def _check_uniform(rec: Recording, stamps: npt.NDArray[np.int64], sample_rate: float) -> None:
    """Refuse what blocks without stamps cannot hold: any spacing but the stated one."""
    if not sample_rate > 0.0:
        raise InputError(f'sample_rate must be above 0 Hz, got {sample_rate}')
    grid = np.arange(rec.n) * (1e9 / sample_rate)
    worst = np.abs((stamps - stamps[0]) - grid).max()
    if worst > 0.5e9 / sample_rate:
        raise InputError(
            f"'{rec.name}' is not sampled at a steady {sample_rate:g} Hz, as blocks of samples "
            'need it: use another type')
