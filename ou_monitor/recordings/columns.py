"""
Fields of topics as arrays, whatever their types, in pieces in the order of log times.

Bulk where layouts allow: the outcome is that of the general decoder, bit for bit;
`layout.py` says when bulk applies, and every other message goes the general way, one
by one.  Memory holds the chunks that overlap in time, and no more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.recordings.layout import Layout, layout_of, parse_definition, Rows, short_name
from ou_monitor.recordings.mcap_records import IntArray, moment, Table, TimeArray
from ou_monitor.records import FloatArray
from ou_monitor.stream.config import FieldPath, FieldSpec, parse_field_path
from ou_monitor.stream.extract import Extracted, Extractor, ZeroRule

if TYPE_CHECKING:
    from ou_monitor.recordings.bag import BagReader

# Layouts that are tried for messages of one length; a topic with more of them
# is not one whose messages are alike.
MOST_LAYOUTS = 16

Broken = Callable[[int, InputError], None]


@dataclass(frozen=True, eq=False)
class Column:
    """
    A field of many messages.

    Attributes
    ----------
    log_time : ndarray of uint64, shape (m,)
        Log times, ns.
    stamp : ndarray, shape (m,)
        Stamps of the messages (of the LAST sample of a block), s; the log
        time where a message has none.
    stamped : ndarray of bool, shape (m,)
        Whether the message carries its stamp.
    count : ndarray of int64, shape (m,)
        Values in each message; 0 where the field's array is too short.
    values : ndarray, shape (count.sum(),)
        Values in SI units; NaN where one is not a finite number.

    """

    log_time: TimeArray
    stamp: FloatArray
    stamped: npt.NDArray[np.bool_]
    count: IntArray
    values: FloatArray

    @property
    def n(self) -> int:
        """Return the number of messages."""
        return int(self.stamp.size)

    def take(self, order: IntArray) -> Column:
        """Return the messages of given indices, shape (k,), in their order."""
        if (self.count == 1).all():
            values = self.values[order]
        else:
            begins = np.cumsum(self.count) - self.count
            values = self.values[_spread(begins[order], self.count[order])]
        return Column(self.log_time[order], self.stamp[order], self.stamped[order],
                      self.count[order], values)

    def split(self, at: int) -> tuple[Column, Column]:
        """Return the first `at` messages, and the rest."""
        cut = int(self.count[:at].sum())
        return (Column(self.log_time[:at], self.stamp[:at], self.stamped[:at], self.count[:at],
                       self.values[:cut]),
                Column(self.log_time[at:], self.stamp[at:], self.stamped[at:], self.count[at:],
                       self.values[cut:]))

    def in_time_order(self) -> Column:
        """Return the messages by log time; those of one time as they are."""
        if (self.log_time[1:] >= self.log_time[:-1]).all():
            return self
        return self.take(np.argsort(self.log_time, kind='stable'))


def join(parts: Sequence[Column]) -> Column:
    """Return columns one after another; an empty one for none."""
    if len(parts) == 1:
        return parts[0]
    return Column(
        np.concatenate([np.empty(0, np.uint64), *(part.log_time for part in parts)]),
        np.concatenate([np.empty(0), *(part.stamp for part in parts)]),
        np.concatenate([np.empty(0, np.bool_), *(part.stamped for part in parts)]),
        np.concatenate([np.empty(0, np.int64), *(part.count for part in parts)]),
        np.concatenate([np.empty(0), *(part.values for part in parts)]))


def seconds(log_time: TimeArray) -> FloatArray:
    """Return ns as s; whole seconds apart, for an epoch in ns does not fit a float64."""
    whole, rest = np.divmod(log_time, np.uint64(1_000_000_000))
    return whole + rest * 1e-9


def _spread(begin: IntArray, count: IntArray) -> IntArray:
    """Return begin[0], begin[0] + 1, ..., `count` of each, one after another."""
    ends = np.cumsum(count)
    places: IntArray = np.repeat(begin - (ends - count), count)
    return places + np.arange(places.size)


class FieldReader:
    """
    Reads one field, and its stamp, of messages of one type (ros2msg text `definition`).

    The `nan` rule of `spec` is not applied: what is not finite is NaN.  `decoder` returns the
    general decoder, and is asked only when needed; `broken` is called with the log time, ns, of a
    message that cannot be decoded and the error.  `general` counts messages that went that way.
    """

    def __init__(
        self, spec: FieldSpec, definition: str, decoder: Callable[[], Callable[[bytes], Any]],
        broken: Callable[[int, InputError], None] | None = None,
    ) -> None:
        """Parse the definition; layouts are learned from messages."""
        self.spec = spec
        self.general = 0
        self._extractor = Extractor(replace(spec, nan='unknown', zero='value'))
        self._zero = ZeroRule(spec.zero)
        self._decoder = decoder
        self._broken = broken
        self._decode: Callable[[bytes], Any] | None = None
        self._kind = short_name(spec.type)
        self._definitions = parse_definition(spec.type, definition)
        self._value = parse_field_path(spec.field)
        self._stamp: FieldPath | None = None
        self._paths = [self._value]
        if spec.stamp_field is not None:
            self._stamp = parse_field_path(spec.stamp_field)
            self._paths += [self._stamp, (*self._stamp, 'sec'), (*self._stamp, 'nanosec')]
        # Length of the message -> layouts met.
        self._layouts: dict[int, list[Layout]] = {}

    def read(self, table: Table) -> Column:
        """Return the field of the messages of a table, in its order."""
        # A damaged message may hold a signalling NaN, of which NumPy would warn.
        with np.errstate(invalid='ignore'):
            column = self._read(table)
        return replace(column, values=self._zero.apply(column.values))

    def _read(self, table: Table) -> Column:
        """Return the field with zeros as they are."""
        logged = seconds(table.log_time)
        stamp = np.full(table.n, np.nan)
        count = np.ones(table.n, np.int64)
        bulk: list[tuple[IntArray, FloatArray]] = []
        rest: list[IntArray] = []
        lengths = table.end - table.begin
        for length in np.unique(lengths).tolist():
            left = np.nonzero(lengths == length)[0]
            if self._definitions is not None and length:
                left = self._in_bulk(table, left, length, stamp, bulk)
            rest.append(left)
        for picked, block in bulk:
            count[picked] = block.shape[1]
        single = {}
        broken: list[int] = []
        for k in np.sort(np.concatenate([np.empty(0, np.int64), *rest])).tolist():
            found = self._one(
                bytes(table.data[table.begin[k]:table.end[k]]), int(table.log_time[k]))
            if found is None:
                broken.append(k)
                count[k] = 0
                continue
            single[k] = found.values
            count[k] = found.values.size
            if found.stamp is not None:
                stamp[k] = found.stamp
        self.general += len(single)
        stamped = ~np.isnan(stamp)
        stamp = np.where(stamped, stamp, logged)
        if not single and not broken and len(bulk) == 1:
            # All alike, and in order.
            return Column(table.log_time, stamp, stamped, count, bulk[0][1].reshape(-1))
        begin = np.cumsum(count) - count
        values = np.empty(int(count.sum()))
        for picked, block in bulk:
            values[begin[picked][:, None] + np.arange(block.shape[1])] = block
        for k, block in single.items():
            values[begin[k]:begin[k] + block.size] = block
        if not broken:
            return Column(table.log_time, stamp, stamped, count, values)
        kept = np.ones(table.n, dtype=bool)
        kept[broken] = False
        return Column(table.log_time[kept], stamp[kept], stamped[kept], count[kept], values)

    def _in_bulk(
        self, table: Table, left: IntArray, length: int, stamp: FloatArray,
        bulk: list[tuple[IntArray, FloatArray]],
    ) -> IntArray:
        """Read messages of one length by layouts; return those that have none."""
        known = self._layouts.setdefault(length, [])
        rows = table.rows(left, length)
        for layout in known:
            left, rows = self._by_layout(layout, left, rows, stamp, bulk)
            if not left.size:
                return left
        strange: list[IntArray] = []
        while left.size and len(known) < MOST_LAYOUTS and len(strange) < MOST_LAYOUTS:
            found = self._learn(rows[0].tobytes())
            if found is None or not found.holds_for(rows[:1])[0]:
                strange.append(left[:1])
                left, rows = left[1:], rows[1:]
                continue
            known.append(found)
            left, rows = self._by_layout(found, left, rows, stamp, bulk)
        return np.concatenate([*strange, left])

    def _by_layout(
        self, layout: Layout, left: IntArray, rows: Rows, stamp: FloatArray,
        bulk: list[tuple[IntArray, FloatArray]],
    ) -> tuple[IntArray, Rows]:
        """Read the messages with a layout; return the others."""
        fits = layout.holds_for(rows)
        if not fits.any():
            return left, rows
        everything = bool(fits.all())
        picked, mine = (left, rows) if everything else (left[fits], rows[fits])
        own = self._stamps(layout, mine)
        if own is not None:
            known = np.isfinite(own) & (own != 0.0)
            stamp[picked[known]] = own[known]
        block = layout.places[self._value].column(mine).reshape(picked.size, -1)
        block *= self.spec.sign * self.spec.unit_factor
        block += self.spec.offset
        finite = np.isfinite(block)
        if not finite.all():
            block[~finite] = np.nan
        bulk.append((picked, block))
        return (left[:0], rows[:0]) if everything else (left[~fits], rows[~fits])

    def _stamps(self, layout: Layout, rows: Rows) -> FloatArray | None:
        """Return the stamps in messages, s, by the formulas of `Extractor`."""
        if self._stamp is None:
            return None
        whole = layout.places.get((*self._stamp, 'sec'))
        if whole is None:
            return layout.places[self._stamp].column(rows) * self.spec.stamp_factor
        return whole.column(rows) + 1e-9 * layout.places[(*self._stamp, 'nanosec')].column(rows)

    def _learn(self, message: bytes) -> Layout | None:
        """Return the layout of a message when it gives all that is asked for."""
        assert self._definitions is not None
        layout = layout_of(message, self._kind, self._definitions, self._paths)
        if layout is None:
            return None
        found = layout.places
        value = found.get(self._value)
        # An array is a block of samples, or a mistake that the general way names.
        if value is None or (value.size is not None and self.spec.sample_rate is None):
            return None
        if self._stamp is not None:
            number = found.get(self._stamp)
            time = [found.get((*self._stamp, part)) for part in ('sec', 'nanosec')]
            if any(place is None or place.size is not None
                   for place in ([number] if number is not None else time)):
                return None
        return layout

    def _one(self, message: bytes, log_time: int) -> Extracted | None:
        """Return the field of one message the general way; None: it is to be left out."""
        if self._decode is None:
            self._decode = self._decoder()
        try:
            decoded = self._decode(message)
        except InputError as error:
            if self._broken is None:
                raise
            self._broken(log_time, error)
            return None
        return self._extractor.extract(decoded)


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
