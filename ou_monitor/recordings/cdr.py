"""
CDR messages as arrays: the layout of one message, verified in all others.

CDR has no fixed offsets: a text or a sequence shifts all that follows. But in a recording the same
texts and lengths recur. So the layout is derived once from one message, with every length word
that it depends on, and holds for all messages of the same size with the same length words: their
fields are columns. The general decoder reads all others one by one, and refuses what it would
refuse anyway; the result is the same, bit for bit.

Plain CDR version 1, little endian (OMG DDS-XTypes 7.4.3): alignment is counted
from after the 4-byte header.  The fields come from the definition in a bag or from the message
class; a type that is not in `PRIMITIVES` gives no layout.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.records import FloatArray
from ou_monitor.stream.config import (
    Extractor, FieldPath, FieldSpec, parse_field_path, ZeroRule)

IntArray = npt.NDArray[np.int64]
TimeArray = npt.NDArray[np.uint64]

# ROS name -> NumPy type, little endian, as the general decoder reads it.
PRIMITIVES = {
    'bool': '?', 'byte': 'u1', 'char': 'i1', 'int8': 'i1', 'uint8': 'u1', 'int16': '<i2',
    'uint16': '<u2', 'int32': '<i4', 'uint32': '<u4', 'int64': '<i8', 'uint64': '<u8',
    'float32': '<f4', 'float64': '<f8',
}
TEXT = 'string'

Rows = npt.NDArray[np.uint8]

# Representation identifier CDR_LE; the two bytes after it are options.
_LITTLE_ENDIAN = b'\x00\x01'
_HEADER = 4

# Limits of the walk through a message; beyond them the general decoder is as quick.
_MOST_STEPS = 2000
_MOST_WORDS = 64
_MOST_DEPTH = 50


@dataclass(frozen=True)
class Field:
    """One field of a message."""

    name: str
    # A key of `PRIMITIVES`, `TEXT`, or 'package/Type'.
    type: str  # noqa: A003
    array: bool = False
    # Elements of an array of fixed size; None when a message states them.
    size: int | None = None


# package/Type -> its fields.
Definitions = dict[str, tuple[Field, ...]]

# Definitions that the general decoder uses where a bag carries none.
_TIME = (Field('sec', 'uint32'), Field('nanosec', 'uint32'))
DEFAULTS: Definitions = {
    'builtin_interfaces/Time': _TIME, 'builtin_interfaces/Duration': _TIME}


def short_name(kind: str) -> str:
    """Return 'package/Type' for 'package/msg/Type'."""
    words = kind.split('/')
    return f'{words[0]}/{words[-1]}'


class _NoLayoutError(ValueError):
    """The message exceeds its own length, or the limits of the walk."""


@dataclass(frozen=True)
class Place:
    """Where numbers are in a message."""

    # Byte of the first one.
    offset: int
    # NumPy type of each.
    kind: str
    # How many; None for a single number that is not an array.
    size: int | None = None

    def column(self, rows: Rows) -> FloatArray:
        """Return the numbers of many messages."""
        kind = np.dtype('u1' if self.kind == '?' else self.kind)
        shape = rows.shape[:1] if self.size is None else (rows.shape[0], self.size)
        if not rows.shape[0] or self.size == 0:
            return np.empty(shape)
        strides = (rows.shape[1], kind.itemsize)[:len(shape)]
        raw: npt.NDArray[np.generic] = np.ndarray(shape, kind, rows, self.offset, strides)
        return (raw != 0 if self.kind == '?' else raw).astype(np.float64)


@dataclass(frozen=True)
class Layout:
    """The layout of one message."""

    # Bytes of the message.
    length: int
    # (offset, value) of every uint32 that states a length.
    words: tuple[tuple[int, int], ...]
    # (offset, bytes) of every text, its closing zero left out.
    texts: tuple[tuple[int, int], ...]
    # Where the fields asked for are.
    places: dict[FieldPath, Place]

    def holds_for(self, rows: Rows) -> npt.NDArray[np.bool_]:
        """Return which messages have this layout."""
        same: npt.NDArray[np.bool_] = (rows[:, 0] == 0) & (rows[:, 1] == 1)
        for offset, value in self.words:
            word: npt.NDArray[np.uint32] = np.ndarray(
                rows.shape[:1], '<u4', rows, offset, rows.strides[:1])
            same &= word == value
        high = np.zeros(rows.shape[0], np.uint8)
        for offset, size in self.texts:
            # By columns, which are long; rows are short.
            for k in range(offset, offset + size):
                high |= rows[:, k]
        same &= high < 0x80
        return same


def layout_of(
    message: bytes, kind: str, definitions: Definitions, wanted: Iterable[FieldPath],
) -> Layout | None:
    """Return the layout of one message."""
    if message[:2] != _LITTLE_ENDIAN or len(message) < _HEADER:
        return None
    walk = _Walk(message, definitions, frozenset(wanted))
    try:
        walk.message(kind, (), 0)
    except _NoLayoutError:
        return None
    return Layout(len(message), tuple(walk.words), tuple(walk.texts), walk.places)


class _Walk:
    """Reads one message from front to back, noting where things are."""

    def __init__(
        self, data: bytes, definitions: Definitions, wanted: frozenset[FieldPath], *,
        most_steps: int = _MOST_STEPS, most_words: int = _MOST_WORDS,
    ) -> None:
        self.words: list[tuple[int, int]] = []
        self.texts: list[tuple[int, int]] = []
        self.places: dict[FieldPath, Place] = {}
        self._data = data
        self._definitions = definitions
        self._wanted = wanted
        self._at = _HEADER
        self._left, self._most_words = most_steps, most_words
        self._length = struct.Struct('<I' if data[1:2] in (b'\x01', b'\x03') else '>I')

    def message(self, kind: str, path: FieldPath, depth: int) -> None:
        fields = self._definitions.get(kind)
        if fields is None:
            raise _NoLayoutError('a type in it is not defined')
        if depth > _MOST_DEPTH:
            raise _NoLayoutError('its types are nested too deep')
        if not fields:
            # A message without fields is sent as one byte.
            self._take(1, 1)
        for field in fields:
            self._field(field, (*path, field.name), depth)

    def _field(self, field: Field, path: FieldPath, depth: int) -> None:
        self._step(1)
        if not field.array:
            self._one(field.type, path, depth)
            return
        size = self._word() if field.size is None else field.size
        if field.type in PRIMITIVES:
            self._numbers(field.type, size, path)
            return
        self._step(size)
        for k in range(size):
            self._one(field.type, (*path, k), depth)

    def _step(self, number: int) -> None:
        self._left -= number
        if self._left < 0:
            raise _NoLayoutError('it states more elements than it has bytes')

    def _one(self, kind: str, path: FieldPath, depth: int) -> None:
        if kind == TEXT:
            self._text()
        elif kind in PRIMITIVES:
            item = PRIMITIVES[kind]
            width = np.dtype(item).itemsize
            begin = self._take(width, width)
            if path in self._wanted:
                self.places[path] = Place(begin, item)
        else:
            self.message(kind, path, depth + 1)

    def _numbers(self, kind: str, size: int, path: FieldPath) -> None:
        item = PRIMITIVES[kind]
        width = np.dtype(item).itemsize
        # An empty array is not aligned.
        begin = self._take(size * width, width if size else 1)
        for wanted in self._wanted:
            # Arrays of bytes are bytes to the general decoder, not numbers.
            if wanted == path and item != 'u1':
                self.places[wanted] = Place(begin, item, size)
            elif len(wanted) == len(path) + 1 and wanted[:-1] == path:
                k = wanted[-1]
                if isinstance(k, int) and k < size:
                    self.places[wanted] = Place(begin + k * width, item)

    def _text(self) -> None:
        length = self._word()
        begin = self._take(length, 1)
        if length > 1:
            self.texts.append((begin, length - 1))

    def _word(self) -> int:
        begin = self._take(4, 4)
        if len(self.words) == self._most_words:
            raise _NoLayoutError('it states too many lengths')
        (value,) = self._length.unpack_from(self._data, begin)
        self.words.append((begin, value))
        return int(value)

    def _take(self, size: int, align: int) -> int:
        """Skip some bytes; return their start."""
        begin = self._at + (_HEADER - self._at) % align
        self._at = begin + size
        if self._at > len(self._data):
            raise _NoLayoutError('it is shorter than its own lengths state')
        return begin


# Arrays that the general decoder slices without checking that enough bytes exist.
_SLICED = frozenset(('uint8', 'byte'))
_FREE_STEPS = 1000


def endless(kind: str, definitions: Definitions) -> bool:
    """
    Whether a few bytes of a type can keep the general decoder busy for ever.

    It reads elements of a type that takes no bytes, or none that it checks, as often as a
    length word says; identifiers such as ``uint8[16] uuid`` are of that kind.
    """
    least: dict[str, int] = {}

    def bytes_checked(name: str) -> int:
        if name not in least:
            # A type within itself ends by its own depth.
            least[name] = 1
            fields = definitions.get(name, ())
            least[name] = sum(map(of_field, fields)) if fields else 1
        return least[name]

    def of_field(field: Field) -> int:
        one = 1 if field.type in PRIMITIVES or field.type == TEXT else bytes_checked(field.type)
        if not field.array:
            return one
        if field.size is None:
            return 4
        return 0 if field.type in _SLICED else one * field.size

    bytes_checked(kind)
    return any(count == 0 for name, count in least.items() if name != kind)


def check_extent(message: bytes, kind: str, definitions: Definitions) -> None:
    """Raise ValueError where a message of a type as of `endless` goes on beyond its end."""
    _Walk(message, definitions, frozenset(), most_steps=4 * len(message) + _FREE_STEPS,
          most_words=len(message)).message(kind, (), 0)


# Maximum layouts for messages of one length; a topic with more has no recurring layout.
MOST_LAYOUTS = 16

Broken = Callable[[int, InputError], None]


@dataclass(frozen=True, eq=False)
class MessageTable:
    """Messages in a block of bytes, in the order of the file."""

    #: The block.
    data: bytes
    #: Channel of each message.
    channel: npt.NDArray[np.uint16]
    #: Log times, ns.
    log_time: TimeArray
    #: Start and end of the serialized messages in `data`.
    begin: IntArray
    end: IntArray

    @property
    def n(self) -> int:
        """Return the number of messages."""
        return int(self.begin.size)

    def where(self, mask: npt.NDArray[np.bool_]) -> MessageTable:
        """Return the messages for which `mask`, shape (n,), is true."""
        if mask.all():
            return self
        return MessageTable(self.data, self.channel[mask], self.log_time[mask], self.begin[mask],
                            self.end[mask])

    def rows(self, picked: IntArray, length: int) -> Rows:
        """Return messages of one length in bytes as rows."""
        return gather(self.data, self.begin[picked], f'V{length}').view(np.uint8).reshape(
            -1, length)


def gather(data: bytes, at: IntArray, kind: str) -> npt.NDArray[Any]:
    """Return items of a kind from anywhere in a block of bytes."""
    size = np.dtype(kind).itemsize
    if not at.size:
        return np.empty(0, kind)
    # One item at every byte: NumPy picks from such a view far faster than it
    # puts single bytes together.
    everywhere: npt.NDArray[Any] = np.ndarray(
        (len(data) - size + 1,), kind, data, 0, (1,))
    return everywhere[at]


class FieldColumn(NamedTuple):
    """A field of many messages, and a second one of each."""

    # Log times, ns; shape (m,).
    log_time: TimeArray
    # Stamps of the messages (of the LAST sample of a block), s; the log time where a message has
    # none; shape (m,).
    stamp: FloatArray
    # Whether the message carries its stamp; shape (m,).
    stamped: npt.NDArray[np.bool_]
    # Values in each message: 1, unless the field is a block; shape (m,).
    counts: IntArray
    # Values in SI units; NaN where missing or not finite; shape (counts.sum(),).
    values: FloatArray
    # The second field in SI units; NaN where missing, not finite or not asked for; shape (m,).
    beside: FloatArray

    @property
    def n(self) -> int:
        """Return the number of messages."""
        return int(self.stamp.size)

    def take(self, order: IntArray) -> FieldColumn:
        """Return the messages of given indices, shape (k,), in their order."""
        begins = np.cumsum(self.counts) - self.counts
        return FieldColumn._make(
            column[_spread(begins[order], self.counts[order]) if column is self.values else order]
            for column in self)

    def split(self, at: int) -> tuple[FieldColumn, FieldColumn]:
        """Return the first `at` messages, and the rest."""
        cut = [int(self.counts[:at].sum()) if column is self.values else at for column in self]
        return (FieldColumn._make(column[:k] for column, k in zip(self, cut)),
                FieldColumn._make(column[k:] for column, k in zip(self, cut)))

    def place(self, log_time: int) -> int:
        """Return how many of the messages, in order, are before a log time, ns."""
        return int(np.searchsorted(self.log_time, np.uint64(log_time), 'left'))

    def in_time_order(self) -> FieldColumn:
        """Return the messages by log time; equal times keep their order."""
        if (self.log_time[1:] >= self.log_time[:-1]).all():
            return self
        return self.take(np.argsort(self.log_time, kind='stable'))


def join(parts: Sequence[FieldColumn]) -> FieldColumn:
    """Return columns, one or more, one after another."""
    return parts[0] if len(parts) == 1 else FieldColumn._make(map(np.concatenate, zip(*parts)))


def seconds(log_time: TimeArray) -> FloatArray:
    """Return ns as s; whole seconds apart, for an epoch in ns does not fit a float64."""
    whole, rest = np.divmod(log_time, np.uint64(1_000_000_000))
    return whole + rest * 1e-9


def _spread(begin: IntArray, count: IntArray) -> IntArray:
    """Return begin[0], begin[0] + 1, ..., `count` of each, one after another."""
    ends = np.cumsum(count)
    places: IntArray = np.repeat(begin - (ends - count), count)
    return places + np.arange(places.size)


class _Found:
    """What messages hold, while they are read."""

    def __init__(self, n: int) -> None:
        self.stamp, self.beside = np.full(n, np.nan), np.full(n, np.nan)
        # Indices of messages alike, shape (k,), and their values, shape (k, values in each).
        self.blocks: list[tuple[IntArray, FloatArray]] = []


class FieldReader:
    """
    Reads one field, and its stamp, of messages of one type (definitions: None where unreadable).

    `beside` is a second field, of one number in each message.  The `nan` rules are not applied: a
    value that is missing or not finite is NaN.  `decoder` returns the general decoder, and is
    asked only when needed; `broken` is called with the log time, ns, of a message that cannot be
    decoded and the error.  `general` counts messages that went that way.
    """

    def __init__(
        self, spec: FieldSpec, definitions: Definitions | None,
        decoder: Callable[[], Callable[[bytes], Any]],
        broken: Callable[[int, InputError], None] | None = None, beside: FieldSpec | None = None,
    ) -> None:
        """Prepare the paths; layouts are learned from messages."""
        self.spec = spec
        self.general = 0
        # Field, its path, its general way and its zeros; the second one where it is asked for.
        self._fields = [(one, parse_field_path(one.field),
                         Extractor(replace(one, nan='unknown', zero='value')), ZeroRule(one.zero))
                        for one in (spec, beside) if one is not None]
        self._decoder = decoder
        self._broken = broken
        self._decode: Callable[[bytes], Any] | None = None
        self._kind = short_name(spec.type)
        self._definitions = definitions
        self._stamp: FieldPath | None = None
        self._paths = [path for _, path, _, _ in self._fields]
        if spec.stamp_field is not None:
            self._stamp = parse_field_path(spec.stamp_field)
            self._paths += [self._stamp, (*self._stamp, 'sec'), (*self._stamp, 'nanosec')]
        # Length of the message -> layouts met.
        self._layouts: dict[int, list[Layout]] = {}

    def read(self, table: MessageTable) -> FieldColumn:
        """Return the field of the messages of a table, in its order."""
        # A damaged message may hold a signalling NaN, of which NumPy would warn.
        with np.errstate(invalid='ignore'):
            column = self._read(table)
        zero, *other = (rule for _, _, _, rule in self._fields)
        return column._replace(values=zero.apply(column.values),
                               beside=other[0].apply(column.beside) if other else column.beside)

    def _read(self, table: MessageTable) -> FieldColumn:
        """Return the field with zeros as they are."""
        found = _Found(table.n)
        rest: list[IntArray] = []
        lengths = table.end - table.begin
        # A comparison costs a tenth of a sort, and most messages of a topic are of one length.
        alike = lengths.size > 0 and bool((lengths == lengths[0]).all())
        for length in (lengths[:1] if alike else np.unique(lengths)).tolist():
            left = np.nonzero(lengths == length)[0]
            if self._definitions is not None and length:
                left = self._in_bulk(table, left, length, found)
            rest.append(left)
        kept = np.ones(table.n, dtype=bool)
        for k in np.sort(np.concatenate([np.empty(0, np.int64), *rest])).tolist():
            kept[k] = self._one(table, k, found)
        stamp, count = found.stamp, np.zeros(table.n, np.int64)
        for picked, block in found.blocks:
            count[picked] = block.shape[1]
        stamped = ~np.isnan(stamp)
        if not stamped.all():
            stamp[~stamped] = seconds(table.log_time[~stamped])
        if len(found.blocks) == 1 and kept.all():
            # All alike, and in order.
            values = found.blocks[0][1].reshape(-1)
        else:
            begin = np.cumsum(count) - count
            values = np.empty(int(count.sum()))
            for picked, block in found.blocks:
                values[begin[picked][:, None] + np.arange(block.shape[1])] = block
        column = FieldColumn(table.log_time, stamp, stamped, count, values, found.beside)
        return column if kept.all() else column.take(np.flatnonzero(kept))

    def _in_bulk(self, table: MessageTable, left: IntArray, length: int, found: _Found,
                 ) -> IntArray:
        """Read messages of one length by layouts; return those that have none."""
        known = self._layouts.setdefault(length, [])
        rows = table.rows(left, length)
        for layout in known:
            left, rows = self._by_layout(layout, left, rows, found)
            if not left.size:
                return left
        strange: list[IntArray] = []
        while left.size and len(known) < MOST_LAYOUTS and len(strange) < MOST_LAYOUTS:
            learned = self._learn(rows[0].tobytes())
            if learned is None or not learned.holds_for(rows[:1])[0]:
                strange.append(left[:1])
                left, rows = left[1:], rows[1:]
                continue
            known.append(learned)
            left, rows = self._by_layout(learned, left, rows, found)
        return np.concatenate([*strange, left])

    def _by_layout(self, layout: Layout, left: IntArray, rows: Rows, found: _Found,
                   ) -> tuple[IntArray, Rows]:
        """Read the messages with a layout; return the others."""
        fits = layout.holds_for(rows)
        if not fits.any():
            return left, rows
        everything = bool(fits.all())
        picked, mine = (left, rows) if everything else (left[fits], rows[fits])
        # A slice is written far faster than places are.
        at = slice(None) if picked.size == found.stamp.size else picked
        own = self._stamps(layout, mine)
        if own is not None:
            own[~np.isfinite(own) | (own == 0.0)] = np.nan
            found.stamp[at] = own
        block, *other = (_scaled(layout.places[path].column(mine).reshape(picked.size, -1), spec)
                         for spec, path, _, _ in self._fields)
        found.blocks.append((picked, block))
        if other and other[0].shape[1] == 1:
            found.beside[at] = other[0][:, 0]
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
        for spec, path, _, _ in self._fields:
            # An array is a block of samples, or an error that the general decoder reports.
            if path not in found or (found[path].size is not None and spec.sample_rate is None):
                return None
        if self._stamp is not None:
            number = found.get(self._stamp)
            time = [found.get((*self._stamp, part)) for part in ('sec', 'nanosec')]
            if any(place is None or place.size is not None
                   for place in ([number] if number is not None else time)):
                return None
        return layout

    def _one(self, table: MessageTable, k: int, found: _Found) -> bool:
        """Read one message the general way; False: it is to be left out."""
        if self._decode is None:
            self._decode = self._decoder()
        try:
            decoded = self._decode(bytes(table.data[table.begin[k]:table.end[k]]))
        except InputError as error:
            if self._broken is None:
                raise
            self._broken(int(table.log_time[k]), error)
            return False
        self.general += 1
        field, *other = (extractor.extract(decoded) for _, _, extractor, _ in self._fields)
        if field.stamp is not None:
            found.stamp[k] = field.stamp
        missing = self.spec.sample_rate is None and not field.values.size
        found.blocks.append((np.array([k]), np.array([[np.nan]]) if missing
                             else field.values[None, :]))
        if other and other[0].values.size == 1:
            found.beside[k] = other[0].values[0]
        return True


def _scaled(block: FloatArray, spec: FieldSpec) -> FloatArray:
    """Return raw numbers, changed in place, in SI units; NaN where one is not finite."""
    block *= spec.sign * spec.unit_factor
    block += spec.offset
    finite = np.isfinite(block)
    if not finite.all():
        block[~finite] = np.nan
    return block
