"""
Fields of a bag in pieces, in the order of log times: what `read` is made of.

Memory holds the chunks that overlap in time, and no more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagReader
from ou_monitor.recordings.columns import Column, FieldReader, join
from ou_monitor.recordings.framing import moment
from ou_monitor.stream.config import FieldSpec

Broken = Callable[[int, InputError], None]


def field_reader(bag: BagReader, spec: FieldSpec, broken: Broken | None = None) -> FieldReader:
    """Return the reader of a field of a topic of a bag; `broken` as of `batches`."""
    def refuse(log_time: int, error: InputError) -> None:
        raise InputError(f'{error} ({moment(log_time, bag.start_ns)}); use --partial to leave it '
                         'out') from error

    return FieldReader(spec, bag.definition(spec.type), partial(bag.decoder, spec.type),
                       broken or refuse)


def batches(
    bag: BagReader, specs: Mapping[str, FieldSpec], *, start_ns: int | None = None,
    end_ns: int | None = None, progress: Callable[[float], None] | None = None,
    broken: Broken | None = None,
) -> Iterator[dict[str, Column]]:
    """Yield fields of a bag, batch by batch (start_ns, end_ns in ns, progress 0..1)."""
    readers = {name: field_reader(bag, spec, broken) for name, spec in specs.items()}
    pending: dict[str, list[Column]] = {name: [] for name in specs}
    counts = dict.fromkeys(specs, 0)
    topics = [spec.topic for spec in specs.values()]
    for part in bag.tables(topics, start_ns=start_ns, end_ns=end_ns):
        ready = {}
        for name, reader in readers.items():
            table = part.tables.get(reader.spec.topic)
            if table is not None:
                counts[name] += table.n
                pending[name].append(reader.read(table))
            if not pending[name]:
                continue
            column = join(pending[name]).in_time_order()
            if part.later_ns is not None:
                until = np.searchsorted(column.log_time, np.uint64(part.later_ns), 'left')
                column, left = column.split(int(until))
                pending[name] = [left] if left.n else []
            if column.n:
                ready[name] = column
        if progress is not None:
            progress(part.done)
        if ready:
            yield ready
    if start_ns is None and end_ns is None:
        for name, spec in specs.items():
            _check_count(bag, spec.topic, counts[name])


def _check_count(bag: BagReader, topic: str, found: int) -> None:
    stated = bag.info[topic].count
    if found < stated:
        raise InputError(
            f"{bag.path} is damaged: it states {stated} messages of topic '{topic}', {found} were "
            'found; use --partial to take what it still holds')


def last_before(bag: BagReader, spec: FieldSpec, before_ns: int,
                broken: Broken | None = None) -> Column:
    """
    Return messages of a topic up to the last one before a log time that says something.

    before_ns in ns.
    """
    reader = field_reader(bag, spec, broken)
    found: list[Column] = []
    newest = -1
    for table, older in bag.tables_before(spec.topic, before_ns):
        column = reader.read(table)
        found.append(column)
        says = column.count > 0
        if spec.nan == 'drop':
            finite = np.add.reduceat(np.append(np.isfinite(column.values), False),
                                     np.cumsum(column.count) - column.count) > 0
            says &= finite
        if says.any():
            newest = max(newest, int(column.log_time[says].max()))
        if newest > older:
            break
    return join(found[::-1]).in_time_order()
