"""
Write what was taken from a log as a bag: `/voltage`, `/throttle`, `/current`.

Limits first: every series keeps its own stamps, counted from the start of the
log; messages hold float32 (but std_msgs/Float64), and 10 ns of a day.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import heapq
from pathlib import Path

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.recordings import cdr
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.importers.choose import Chosen
from ou_monitor.recordings.importers.log import Series, UNITS
from ou_monitor.recordings.write import as_nanoseconds, LAST_HEADER_NS, TYPES

# Messages encoded at once; bounds memory.
SLICE = 4096

# An adc_block: rate of its samples, Hz, and how many there are in one.
BLOCK_RATE = 10000.0
BLOCK = 100

Timed = tuple[int, int, bytes]


def write_log(
    chosen: Chosen, path: Path, about: Mapping[str, str], *, kind: str = 'battery_state',
    progress: Callable[[float], None] | None = None,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Write a bag (progress 0..1)."""
    # At one instant what holds for the sample goes before it, the voltage last.
    held = [(name, series) for name, series in (
        ('throttle', chosen.throttle), ('current', chosen.current)) if series is not None]
    held.append(('voltage', chosen.voltage))
    first = min(float(series.t[0]) for _, series in held)
    shift = max(0, -round(first * 1e9))
    notes = (f'Stamps were moved by {shift * 1e-9:.9f} s: a bag cannot hold negative ones.',
             ) if shift else ()
    total = sum(series.n for _, series in held)
    topics: dict[str, str] = {}
    # Refused before anything is on disk.
    stamps = [as_nanoseconds(series.t, series.name) + shift for _, series in held]
    if kind == 'adc_block':
        _check_steady(chosen.voltage, stamps[-1])
    elif kind == 'battery_state' and stamps[-1][-1] > LAST_HEADER_NS:
        raise InputError(f"'{chosen.voltage.name}' has stamps after 2^31 s, which a header "
                         'cannot hold: use another type')
    whole = {**about}
    for name, series in held:
        whole |= _origin(name, series)
    with BagWriter(path, about=whole) as bag:
        # The order of the table of contents: the voltage first.
        for name, series in reversed(held):
            message = TYPES[kind] if name == 'voltage' else cdr.FLOAT32
            rate = BLOCK_RATE if message == cdr.FLOAT32_ARRAY else None
            topics[bag.add_topic(name, message, sample_rate=rate,
                                 origin={**about, **_origin(name, series)})] = message
        streams = [_messages(k, stamps[k], series.values, topics['/' + name])
                   for k, (name, series) in enumerate(held)]
        for done, (t, k, data) in enumerate(heapq.merge(*streams)):
            bag.write('/' + held[k][0], t, data)
            if progress is not None and done % SLICE == 0:
                progress(done / total)
    return topics, notes


def _origin(name: str, series: Series) -> dict[str, str]:
    """Return where a series came from, by keys that are its own."""
    return {f'{name}_field': series.name, f'{name}_unit': UNITS[name],
            f'{name}_scale': series.scale, f'{name}_what': series.words}


def _messages(place: int, stamps: npt.NDArray[np.int64], values: npt.NDArray[np.float64],
              kind: str) -> Iterator[Timed]:
    if kind == cdr.FLOAT32_ARRAY:
        for first in range(0, stamps.size, BLOCK):
            part = slice(first, first + BLOCK)
            yield int(stamps[part][-1]), place, cdr.encode_block(values[part])
        return
    for first in range(0, stamps.size, SLICE):
        part = slice(first, first + SLICE)
        data = (cdr.encode_battery(stamps[part], values[part]) if kind == cdr.BATTERY_STATE
                else cdr.encode_scalars(kind, values[part]))
        for t, message in zip(stamps[part].tolist(), data, strict=True):
            yield t, place, message


def _check_steady(series: Series, stamps: npt.NDArray[np.int64]) -> None:
    """Refuse what blocks without stamps cannot hold: any spacing but the stated one."""
    grid = np.arange(series.n) * (1e9 / BLOCK_RATE)
    if np.abs(stamps - stamps[0] - grid).max() > 0.5e9 / BLOCK_RATE:
        raise InputError(f"'{series.name}' is not sampled at a steady {BLOCK_RATE:g} Hz, as "
                         'blocks of samples need it: use another type')
