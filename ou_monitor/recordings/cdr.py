"""
Read fields of many CDR messages as arrays, by layouts that are learned from single messages.

CDR has no fixed offsets, because the length of a text or a sequence shifts everything after it.
But in a recording the same lengths recur. So one message is walked field by field, and its layout
is used for all messages of the same size that state the same lengths. A message with a new layout
is walked by itself; one that does not fit its type is refused.  Texts are skipped, whatever they
hold.

Plain CDR version 1 (OMG DDS-XTypes 7.4.3): alignment is counted from after the 4-byte header.
The fields come from the definition in a bag or from the message class.  Limits: a type with a
wstring is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError, nearest
from ou_monitor.records import FloatArray
from ou_monitor.stream.config import FieldPath, FieldSpec, parse_field_path

IntArray = npt.NDArray[np.int64]
TimeArray = npt.NDArray[np.uint64]

# ROS name -> NumPy type, without its byte order.
PRIMITIVES = {
    'bool': '?', 'byte': 'u1', 'char': 'i1', 'int8': 'i1', 'uint8': 'u1', 'int16': 'i2',
    'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4', 'int64': 'i8', 'uint64': 'u8',
    'float32': 'f4', 'float64': 'f8',
}
TEXT = 'string'

Rows = npt.NDArray[np.uint8]

# Representation identifier and options.
_HEADER = 4

# Limits of a walk: steps beyond 4 per byte (few bytes may state 2^32 empty elements), and depth of
# nested types.
_FREE_STEPS, _MOST_DEPTH = 1000, 50
# Maximum number of layouts kept for messages of one size, and of length words in a kept layout; a
# topic with more has no recurring layout.
MOST_LAYOUTS, _MOST_WORDS = 16, 64


@dataclass(frozen=True)
class Field:
    """One field of a message."""

    name: str
    # A key of `PRIMITIVES`, `TEXT`, or 'package/Type'.
    type: str  # noqa: A003
    array: bool = False
    size: int | None = None  # Length of a fixed-size array; None if each message states it


# package/Type -> its fields.
Definitions = dict[str, tuple[Field, ...]]

# Definitions of types that a bag need not carry.
_TIME = (Field('sec', 'uint32'), Field('nanosec', 'uint32'))
DEFAULTS: Definitions = {
    'builtin_interfaces/Time': _TIME, 'builtin_interfaces/Duration': _TIME}


def short_name(kind: str) -> str:
    """Return 'package/Type' for 'package/msg/Type'."""
    words = kind.split('/')
    return f'{words[0]}/{words[-1]}'


def _find(spec: FieldSpec, text: str, definitions: Definitions) -> tuple[FieldPath, Field]:
    """Parse a path; return it and the field at its end."""
    path, at = parse_field_path(text), Field('', short_name(spec.type))
    for step in path:
        if isinstance(step, int):
            if not at.array:
                raise InputError(f"field path '{text}' of {spec.type}: [{step}] asks for an "
                                 'element of something that is not an array')
            at = replace(at, array=False)
            continue
        inside = {} if at.array else {one.name: one for one in definitions.get(at.type, ())}
        if step not in inside:
            raise InputError(f"field path '{text}' is not in {spec.type}: no '{step}' there; "
                             + nearest(step, inside))
        at = inside[step]
    return path, at


def value_path(spec: FieldSpec, definitions: Definitions) -> FieldPath:
    """Return the path of a number, or, if the spec has a sample rate, of an array of numbers."""
    path, found = _find(spec, spec.field, definitions)
    if found.type not in PRIMITIVES:
        raise InputError(f"field '{spec.field}' of {spec.type} holds a {found.type}, not a "
                         'number: name a numeric field in the msg config')
    if found.array and spec.sample_rate is None:
        raise InputError(
            f"field '{spec.field}' of {spec.type} is an array: name one element, "
            f"'{spec.field}[0]', or give sample_rate if it is a block of samples")
    return path


def stamp_paths(spec: FieldSpec, definitions: Definitions) -> tuple[FieldPath, ...]:
    """Return the paths of a stamp's seconds and nanoseconds, or of its number; (): no stamp."""
    if spec.stamp_field is None:
        return ()
    path, found = _find(spec, spec.stamp_field, definitions)
    if not found.array:
        parts = {one.name: one for one in definitions.get(found.type, ())}
        if found.type in PRIMITIVES:
            return (path,)
        if all(name in parts and parts[name].type in PRIMITIVES and not parts[name].array
               for name in ('sec', 'nanosec')):
            return (*path, 'sec'), (*path, 'nanosec')
    raise InputError(f"stamp_field '{spec.stamp_field}' of {spec.type} is a {found.type}"
                     + '[]' * found.array + ', not a builtin_interfaces/Time or a number')


@dataclass(frozen=True)
class Place:
    """The place of numbers in a message."""

    offset: int  # Byte of the first one
    kind: str  # NumPy type of each
    size: int | None = None  # Number of elements; None for a single number that is not an array

    def column(self, rows: Rows) -> FloatArray:
        """Return the numbers of many messages, NaN where not finite."""
        raw = self.view(rows)
        found = (raw != 0 if self.kind.endswith('?') else raw).astype(np.float64)
        if not (finite := np.isfinite(raw)).all():
            found[~finite] = np.nan
        return found

    def view(self, rows: Rows) -> npt.NDArray[Any]:
        """Return the numbers of many messages as they lie there."""
        kind = np.dtype('u1' if self.kind.endswith('?') else self.kind)
        shape = rows.shape[:1] if self.size is None else (rows.shape[0], self.size)
        if 0 in shape:
            return np.empty(shape)
        return np.ndarray(shape, kind, rows, self.offset,
                          (rows.shape[1], kind.itemsize)[:len(shape)])


class Layout:
    """The layout of one message, walked front to back; ValueError if it does not fit its type."""

    def __init__(self, data: bytes, kind: str, definitions: Definitions,
                 wanted: frozenset[FieldPath]) -> None:
        if len(data) < _HEADER or data[0] != 0 or data[1] > 1:
            # Other encodings have another alignment.
            raise ValueError('it is not plain CDR')
        # (offset, value) of every uint32 that states a length.
        self.words: list[tuple[int, int]] = []
        # Places of the wanted fields, except elements beyond the end of their array.
        self.places: dict[FieldPath, Place] = {}
        self._order = '<' if data[1] else '>'
        self._word_of = struct.Struct(f'{self._order}I')
        self._data, self._definitions, self._wanted = data, definitions, wanted
        self._at, self._left = _HEADER, 4 * len(data) + _FREE_STEPS
        self._message(kind, (), 0)
        # The layout is kept, the message is not.
        self._data = b''

    def holds_for(self, rows: Rows) -> npt.NDArray[np.bool_]:
        """Return which messages of the same size have this layout."""
        same: npt.NDArray[np.bool_] = (rows[:, 0] == 0) & (rows[:, 1] == (self._order == '<'))
        for offset, value in self.words:
            word: npt.NDArray[np.uint32] = np.ndarray(
                rows.shape[:1], f'{self._order}u4', rows, offset, rows.strides[:1])
            same &= word == value
        return same

    def _message(self, kind: str, path: FieldPath, depth: int) -> None:
        fields = self._definitions.get(kind)
        if fields is None:
            raise ValueError(f"type '{kind}' in it is not defined")
        if depth > _MOST_DEPTH:
            raise ValueError('its types are nested too deep')
        if not fields:
            # A message without fields is sent as one byte.
            self._take(1, 1)
        for field in fields:
            self._step(1)
            here = (*path, field.name)
            if not field.array:
                self._one(field.type, here, depth)
                continue
            size = self._word() if field.size is None else field.size
            if field.type in PRIMITIVES:
                self._numbers(field.type, here, size)
                continue
            self._step(size)
            for k in range(size):
                self._one(field.type, (*here, k), depth)

    def _step(self, number: int) -> None:
        self._left -= number
        if self._left < 0:
            raise ValueError('it states more elements than it has bytes')

    def _one(self, kind: str, path: FieldPath, depth: int) -> None:
        if kind == TEXT:
            self._take(self._word(), 1)
        elif kind in PRIMITIVES:
            self._numbers(kind, path)
        else:
            self._message(kind, path, depth + 1)

    def _numbers(self, kind: str, path: FieldPath, size: int | None = None) -> None:
        """Skip a number, or the `size` numbers of an array."""
        item = self._order + PRIMITIVES[kind]
        width = np.dtype(item).itemsize
        # An empty array is not aligned.
        begin = self._take(width if size is None else size * width, 1 if size == 0 else width)
        if path in self._wanted:
            self.places[path] = Place(begin, item, size)
        if not size:
            return
        for wanted in self._wanted:
            k = wanted[-1]
            if wanted[:-1] == path and isinstance(k, int) and k < size:
                self.places[wanted] = Place(begin + k * width, item)

    def _word(self) -> int:
        begin = self._take(4, 4)
        value = int(self._word_of.unpack_from(self._data, begin)[0])
        self.words.append((begin, value))
        return value

    def _take(self, size: int, align: int) -> int:
        """Skip some bytes; return their start."""
        begin = self._at + (_HEADER - self._at) % align
        self._at = begin + size
        if self._at > len(self._data):
            raise ValueError('it is shorter than its own lengths state')
        return begin


# Called with the log time, ns, of a message that does not fit its type, and the reason.
Broken = Callable[[int, str], None]


@dataclass(frozen=True, eq=False)
class MessageTable:
    """Messages in a block of bytes, in the order of the file."""

    data: bytes  #: The block
    channel: npt.NDArray[np.uint16]  #: Channel of each message
    log_time: TimeArray  #: Log times, ns
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
        found = gather(self.data, self.begin[picked], f'V{length}') if length else np.empty(0)
        return found.view(np.uint8).reshape(picked.size, length)


def joined(tables: Sequence[MessageTable]) -> MessageTable:
    """Concatenate one or more tables."""
    if len(tables) == 1:
        return tables[0]
    begins = np.cumsum([0, *(len(table.data) for table in tables[:-1])])
    return MessageTable(
        b''.join(table.data for table in tables),
        np.concatenate([table.channel for table in tables]),
        np.concatenate([table.log_time for table in tables]),
        np.concatenate([table.begin + at for table, at in zip(tables, begins)]),
        np.concatenate([table.end + at for table, at in zip(tables, begins)]))


def gather(data: bytes, at: IntArray, kind: str) -> npt.NDArray[Any]:
    """Return the items of NumPy type `kind` at offsets `at` of a block of bytes."""
    size = np.dtype(kind).itemsize
    if not at.size:
        return np.empty(0, kind)
    # A view with an item at every byte: indexing it is far faster than combining single bytes.
    everywhere: npt.NDArray[Any] = np.ndarray(
        (len(data) - size + 1,), kind, data, 0, (1,))
    return everywhere[at]


class FieldColumn(NamedTuple):
    """The values of a field in many messages, and of a second field, if wanted."""

    log_time: TimeArray  # Log times, ns; shape (m,)
    # Stamps of the messages (of the LAST sample of a block), s; the log time where a message has
    # none; shape (m,).
    stamp: FloatArray
    stamped: npt.NDArray[np.bool_]  # Whether the message carries its stamp; shape (m,)
    counts: IntArray  # Values in each message: 1, unless the field is a block; shape (m,)
    # Values in SI units; NaN where missing or not finite; shape (counts.sum(),).
    values: FloatArray
    # The second field in SI units; NaN where missing, not finite or not requested; shape (m,).
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
        """Return the number of messages before a log time, ns; they must be in time order."""
        return int(np.searchsorted(self.log_time, np.uint64(log_time), 'left'))

    def in_time_order(self) -> FieldColumn:
        """Return the messages by log time; equal times keep their order."""
        if (self.log_time[1:] >= self.log_time[:-1]).all():
            return self
        return self.take(np.argsort(self.log_time, kind='stable'))


_NO_MESSAGE = FieldColumn(np.empty(0, np.uint64), np.empty(0), np.empty(0, np.bool_),
                          np.empty(0, np.int64), np.empty(0), np.empty(0))


class ColumnBuffer:
    """The columns of many parts, joined as they come; views of one value stay views."""

    def __init__(self) -> None:
        self._columns: list[npt.NDArray[Any]] = [column.copy() for column in _NO_MESSAGE]

    def add(self, part: FieldColumn) -> None:
        """Append a part."""
        for k, (column, piece) in enumerate(zip(self._columns, part)):
            size = column.size + piece.size
            if piece.size and not piece.strides[0] and (not column.size or not (
                    column.strides[0]) and np.array_equal(column[:1], piece[:1], equal_nan=True)):
                self._columns[k] = np.broadcast_to(piece[0], size)
            elif piece.size:
                if not column.flags.owndata:
                    column = self._columns[k] = column.copy()
                # A large array grows in place: joining the parts at the end would copy them.
                column.resize(size, refcheck=False)
                column[size - piece.size:] = piece

    def whole(self) -> FieldColumn:
        """Return all parts as one."""
        return FieldColumn(*self._columns)


def seconds(log_time: TimeArray) -> FloatArray:
    """Convert ns to s, whole seconds separately: ns since 1970 exceed a float64's precision."""
    whole, rest = np.divmod(log_time, np.uint64(1_000_000_000))
    return whole + rest * 1e-9


def _spread(begin: IntArray, count: IntArray) -> IntArray:
    """Return begin[k], begin[k] + 1, ..., count[k] of them, for each k in turn."""
    ends = np.cumsum(count)
    places: IntArray = np.repeat(begin - (ends - count), count)
    return places + np.arange(places.size)


class FieldReader:
    """
    Reads one field of messages of one type, and their stamps.

    `beside` is a second field, with one number in each message. The `nan` rules are not applied: a
    missing or non-finite value is NaN. A message that does not fit its type is reported to
    `broken` and left out. Raises InputError if the type has no such field, or the field is not a
    number.
    """

    def __init__(self, spec: FieldSpec, definitions: Definitions, broken: Broken,
                 beside: FieldSpec | None = None) -> None:
        """Check the paths; layouts are learned from messages."""
        self.spec = spec
        self._definitions, self._broken = definitions, broken
        self._kind = short_name(spec.type)
        self._fields = [(one, value_path(one, definitions))
                        for one in (spec, beside) if one is not None]
        # Whether a zero of each field means "not measured"; it may end with the first value.
        self._no_zero = [one.zero != 'value' for one, _ in self._fields]
        self._stamp = stamp_paths(spec, definitions)
        self._wanted = frozenset((*self._stamp, *(path for _, path in self._fields)))
        # Size of the message -> layouts found so far.
        self._layouts: dict[int, list[Layout]] = {}

    def read(self, table: MessageTable) -> FieldColumn:
        """Return the field of the messages of a table, in its order."""
        n = table.n
        stamp, count = np.full(n, np.nan), np.zeros(n, np.int64)
        beside = nothing = np.broadcast_to(np.nan, n)
        # Indices of messages of one layout, shape (k,); their values, shape (k, values in each).
        blocks: list[tuple[IntArray, FloatArray]] = []
        kept, refused = np.ones(n, np.bool_), dict[int, str]()
        # A damaged message may hold a signalling NaN, of which NumPy would warn.
        with np.errstate(invalid='ignore'):
            for picked, rows, layout in self._groups(table, refused):
                stamp[picked] = self._stamps(layout, rows)
                block, *other = (self._values(layout, rows, *field) for field in self._fields)
                blocks.append((picked, block))
                count[picked] = block.shape[1]
                # Values that are not measured take no memory.
                if other and other[0].shape[1] == 1 and not np.isnan(other[0]).all():
                    beside = np.full(n, np.nan) if beside is nothing else beside
                    beside[picked] = other[0][:, 0]
        for k, why in sorted(refused.items()):
            self._broken(int(table.log_time[k]), why)
            kept[k] = False
        stamped = ~np.isnan(stamp)
        if stamped.all():
            stamped = np.broadcast_to(np.True_, n)
        else:
            stamp[~stamped] = seconds(table.log_time[~stamped])
        if len(blocks) == 1 and blocks[0][0].size == n:
            values = blocks[0][1].reshape(-1)
        else:
            begin = np.cumsum(count) - count
            values = np.empty(int(count.sum()))
            for picked, block in blocks:
                values[begin[picked][:, None] + np.arange(block.shape[1])] = block
        column = FieldColumn(table.log_time, stamp, stamped, count, values, beside)
        if refused:
            column = column.take(np.flatnonzero(kept))
        elif self.spec.sample_rate is None:
            column = column._replace(counts=np.broadcast_to(np.int64(1), n))
        return column._replace(values=self._measured(0, column.values),
                               beside=self._measured(-1, column.beside))

    def _measured(self, which: int, values: FloatArray) -> FloatArray:
        """Return values in order of arrival with zeros as NaN, by `zero` of a msg config."""
        if not self._no_zero[which]:
            return values
        nothing = values == 0.0
        if self._fields[which][0].zero == 'unknown_at_first':
            something = np.flatnonzero(np.isfinite(values) & ~nothing)
            if something.size:
                self._no_zero[which] = False
                nothing[int(something[0]):] = False
        return np.where(nothing, np.nan, values) if nothing.any() else values

    def _groups(self, table: MessageTable, refused: dict[int, str],
                ) -> Iterator[tuple[IntArray, Rows, Layout]]:
        """Yield messages by layout (indices, rows, layout); record why others are refused."""
        lengths = table.end - table.begin
        one_length = lengths.size and lengths.min() == lengths.max()
        for length in (lengths[:1] if one_length else np.unique(lengths)).tolist():
            left = np.nonzero(lengths == length)[0]
            rows = table.rows(left, length)
            known = self._layouts.setdefault(length, [])
            tried = 0
            while left.size:
                if tried < len(known):
                    layout, tried = known[tried], tried + 1
                    fits = layout.holds_for(rows)
                else:
                    try:
                        layout = Layout(rows[0].tobytes(), self._kind, self._definitions,
                                        self._wanted)
                    except ValueError as error:
                        refused[int(left[0])] = str(error)
                        left, rows = left[1:], rows[1:]
                        continue
                    if len(known) == MOST_LAYOUTS or len(layout.words) > _MOST_WORDS:
                        yield left[:1], rows[:1], layout
                        left, rows = left[1:], rows[1:]
                        continue
                    known.append(layout)
                    continue
                if fits.all():
                    yield left, rows, layout
                    break
                if fits.any():
                    yield left[fits], rows[fits], layout
                    left, rows = left[~fits], rows[~fits]

    def _stamps(self, layout: Layout, rows: Rows) -> FloatArray | float:
        """Return the stamps in messages, s; NaN where one is missing or zero."""
        if not self._stamp or any(path not in layout.places for path in self._stamp):
            return np.nan
        whole, *nano = (layout.places[path].column(rows) for path in self._stamp)
        own = whole + 1e-9 * nano[0] if nano else whole * self.spec.stamp_factor
        own[own == 0.0] = np.nan
        return own

    @staticmethod
    def _values(layout: Layout, rows: Rows, spec: FieldSpec, path: FieldPath) -> FloatArray:
        """Return a field in SI units, shape (messages, values in each); NaN if not finite."""
        place = layout.places.get(path)
        if place is None:
            # The element is beyond its array: no values for a block, NaN for a single number.
            return np.full((rows.shape[0], int(spec.sample_rate is None)), np.nan)
        block = place.column(rows).reshape(rows.shape[0], -1)
        if spec.sign * spec.unit_factor != 1.0:
            block *= spec.sign * spec.unit_factor
        if spec.offset:
            block += spec.offset
        return block
