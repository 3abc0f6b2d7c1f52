"""
The messages of several files in the order of their log times, holding little in memory.

Only chunks that overlap in time are in memory at once.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from ou_monitor.recordings.framing import Span
from ou_monitor.recordings.mcap_file import McapFile, RawMessage
from ou_monitor.recordings.record_table import Table


class Part(NamedTuple):
    """
    The messages of one chunk or run.

    Attributes
    ----------
    tables : dict of str to Table
        Topic -> its messages, in the order of the file.
    later_ns : int or None
        Log time that no message of a later part is before, ns; None after the
        last part.
    done : float
        Share of the bytes to be read that are read, 0..1.

    """

    tables: dict[str, Table]
    later_ns: int | None
    done: float


def _spans(files: Iterable[McapFile], wanted: set[str]) -> list[tuple[Span, McapFile]]:
    """Return where the wanted topics are, in the order of the first log times."""
    spans: list[tuple[Span, McapFile]] = []
    for file in files:
        channels = set(file.channels_of(wanted))
        spans += [(span, file) for span in file.spans
                  if span.channels is None or span.channels & channels]
    return sorted(spans, key=lambda pair: pair[0].start_ns)


def in_parts(
    files: Iterable[McapFile], wanted: set[str], start_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[Part]:
    """Yield the messages of several files part by part."""
    spans = [(span, file) for span, file in _spans(files, wanted)
             if (start_ns is None or span.end_ns >= start_ns)
             and (end_ns is None or span.start_ns < end_ns)]
    total = sum(span.length for span, _ in spans)
    read = 0
    for place, (span, file) in enumerate(spans):
        tables = file.tables(span, wanted)
        if start_ns is not None and span.start_ns < start_ns:
            tables = _cut(tables, lambda table: table.log_time >= np.uint64(start_ns))
        if end_ns is not None and span.end_ns >= end_ns:
            tables = _cut(tables, lambda table: table.log_time < np.uint64(end_ns))
        read += span.length
        later = None if place + 1 == len(spans) else spans[place + 1][0].start_ns
        yield Part(tables, later, read / total)


def _cut(
    tables: dict[str, Table], inside: Callable[[Table], npt.NDArray[np.bool_]],
) -> dict[str, Table]:
    """Return what is inside of each table, and only tables that hold something."""
    parts = {name: table.where(inside(table)) for name, table in tables.items()}
    return {name: table for name, table in parts.items() if table.n}


def backwards(
    files: Iterable[McapFile], wanted: set[str], before_ns: int,
) -> Iterator[tuple[Table, int]]:
    """
    Yield the messages of a topic before a log time, the chunk that ends last first.

    before_ns in ns.
    """
    spans = [pair for pair in _spans(files, wanted) if pair[0].start_ns < before_ns]
    spans.sort(key=lambda pair: pair[0].end_ns, reverse=True)
    for place, (span, file) in enumerate(spans):
        older = spans[place + 1][0].end_ns if place + 1 < len(spans) else 0
        tables = _cut(file.tables(span, wanted),
                      lambda table: table.log_time < np.uint64(before_ns))
        yield from ((table, older) for table in tables.values())


def in_time_order(files: Iterable[McapFile], wanted: set[str]) -> Iterator[RawMessage]:
    """
    Yield the messages of several files in the order of their log times.

    Holds in memory only spans that overlap in time.
    """
    spans = _spans(files, wanted)
    pending: list[RawMessage] = []
    for place, (span, file) in enumerate(spans):
        pending += file.read(span, wanted)
        pending.sort(key=itemgetter(2))
        # What is older than all that is still to be read can go.
        ready = len(pending)
        if place + 1 < len(spans):
            ready = bisect.bisect_left(pending, spans[place + 1][0].start_ns, key=itemgetter(2))
        yield from pending[:ready]
        del pending[:ready]
