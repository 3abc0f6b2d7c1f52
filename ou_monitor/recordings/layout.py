"""
Where a field is within serialized messages: the layout of one, verified in all others.

CDR has no fixed places: a text or a sequence moves all that comes after it.  But
in a recording the same texts and lengths come again and again.  So the layout is
worked out once on one message, with every length word that it rests on, and
holds for all messages of the same size with the same words there.  What remains
is for the general decoder, and so is everything that it would refuse.

Plain CDR version 1, little endian (OMG DDS-XTypes 7.4.3): alignment is counted
from after the 4-byte header.  The fields come from the definition of the type
(ros2msg text) as `rosidl` writes it into bags; one with anything else in it gives
no layout.  https://docs.ros.org/en/jazzy/Concepts/Basic/About-Interfaces.html
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
import re
import struct

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from ou_monitor.stream.config import FieldPath

# ROS name -> NumPy type, little endian, as the general decoder reads it.
PRIMITIVES = {
    'bool': '?', 'byte': 'u1', 'char': 'i1', 'int8': 'i1', 'uint8': 'u1', 'int16': '<i2',
    'uint16': '<u2', 'int32': '<i4', 'uint32': '<u4', 'int64': '<i8', 'uint64': '<u8',
    'float32': '<f4', 'float64': '<f8',
}
TEXT = 'string'

_SEPARATOR = re.compile(r'^={3,}$', re.MULTILINE)
_NAME = re.compile(r'MSG:\s+([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)')
_CONSTANT = re.compile(r'\w+(?:<=\d+)?\s+[A-Z]\w*\s*=')
_FIELD = re.compile(
    r'(?:([A-Za-z]\w*)/)?([A-Za-z]\w*)(?:<=\d+)?(\[(?:<=\d+|\d*)\])?\s+([a-z]\w*)'
    r'(?:\s+[^=\s][^=]*)?')

Rows = npt.NDArray[np.uint8]

# Representation identifier CDR_LE; the two bytes after it are options.
_LITTLE_ENDIAN = b'\x00\x01'
_HEADER = 4

# Beyond these the general decoder is as quick, and no message can make the walk long.
_MOST_STEPS = 2000
_MOST_WORDS = 64
_MOST_DEPTH = 50


@dataclass(frozen=True)
class Field:
    """
    One field of a message.

    Attributes
    ----------
    name : str
        Its name.
    type : str
        A key of `PRIMITIVES`, `TEXT`, or 'package/Type'.
    array : bool
        Whether it is an array.
    size : int or None
        Elements of an array of fixed size; None when a message states them.

    """

    name: str
    type: str  # noqa: A003
    array: bool = False
    size: int | None = None


# package/Type -> its fields.
Definitions = dict[str, tuple[Field, ...]]

# What the general decoder takes where a bag does not carry these.
_TIME = (Field('sec', 'uint32'), Field('nanosec', 'uint32'))
DEFAULTS: Definitions = {
    'builtin_interfaces/Time': _TIME, 'builtin_interfaces/Duration': _TIME}


def short_name(kind: str) -> str:
    """Return 'package/Type' for 'package/msg/Type'."""
    words = kind.split('/')
    return f'{words[0]}/{words[-1]}'


def parse_definition(kind: str, text: str) -> Definitions | None:
    """Return the fields of a type and of those that it uses."""
    found = dict(DEFAULTS)
    name = short_name(kind)
    for part in _SEPARATOR.split(text.replace('\r', '')):
        lines = [line.strip() for line in part.splitlines()]
        lines = [line for line in lines if line]
        if lines and (match := _NAME.fullmatch(lines[0])):
            name = f'{match[1]}/{match[2]}'
            lines = lines[1:]
        fields = []
        for line in lines:
            if '#' in line and ('"' in line or "'" in line.partition('#')[0]):
                return None
            line = line.partition('#')[0].strip()
            if not line or _CONSTANT.match(line):
                continue
            field = _field(line, name.partition('/')[0])
            if field is None:
                return None
            fields.append(field)
        found[name] = tuple(fields)
    return found if short_name(kind) in found else None


def _field(line: str, package: str) -> Field | None:
    match = _FIELD.fullmatch(line)
    if match is None:
        return None
    other, kind, array, name = match.groups()
    if other is not None:
        kind = f'{other}/{kind}'
    elif kind[0].isupper():
        kind = f'{package}/{kind}'
    elif kind not in PRIMITIVES and kind != TEXT:
        return None
    if array is None:
        return Field(name, kind)
    inside = array[1:-1]
    return Field(name, kind, True, int(inside) if inside.isdigit() else None)


class _NoLayoutError(Exception):
    """The message is for the general decoder."""


@dataclass(frozen=True)
class Place:
    """
    Where numbers are in a message.

    Attributes
    ----------
    offset : int
        Byte of the first one.
    kind : str
        NumPy type of each.
    size : int or None
        How many; None for a single number that is not an array.

    """

    offset: int
    kind: str
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
    """
    The layout of one message.

    Attributes
    ----------
    length : int
        Bytes of the message.
    words : tuple of (int, int)
        (offset, value) of every uint32 that states a length.
    texts : tuple of (int, int)
        (offset, bytes) of every text, its closing zero left out.
    places : dict of FieldPath to Place
        Where the fields asked for are.

    """

    length: int
    words: tuple[tuple[int, int], ...]
    texts: tuple[tuple[int, int], ...]
    places: dict[FieldPath, Place]

    def holds_for(self, rows: Rows) -> npt.NDArray[np.bool_]:
        """Return which messages have this layout."""
        same: npt.NDArray[np.bool_] = (rows[:, 0] == 0) & (rows[:, 1] == 1)
        for offset, value in self.words:
            word: npt.NDArray[np.uint32] = np.ndarray(
                rows.shape[:1], '<u4', rows, offset, rows.strides[:1])
            same &= word == value
        for offset, size in self.texts:
            same &= (rows[:, offset:offset + size] < 0x80).all(axis=1)
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
        self, data: bytes, definitions: Definitions, wanted: frozenset[FieldPath],
    ) -> None:
        self.words: list[tuple[int, int]] = []
        self.texts: list[tuple[int, int]] = []
        self.places: dict[FieldPath, Place] = {}
        self._data = data
        self._definitions = definitions
        self._wanted = wanted
        self._at = _HEADER
        self._steps = 0

    def message(self, kind: str, path: FieldPath, depth: int) -> None:
        fields = self._definitions.get(kind)
        if fields is None or depth > _MOST_DEPTH:
            raise _NoLayoutError
        if not fields:
            # A message without fields is sent as one byte.
            self._take(1, 1)
        for field in fields:
            self._field(field, (*path, field.name), depth)

    def _field(self, field: Field, path: FieldPath, depth: int) -> None:
        self._steps += 1
        if self._steps > _MOST_STEPS:
            raise _NoLayoutError
        if not field.array:
            self._one(field.type, path, depth)
            return
        size = self._word() if field.size is None else field.size
        if field.type in PRIMITIVES:
            self._numbers(field.type, size, path)
            return
        if size > _MOST_STEPS:
            raise _NoLayoutError
        for k in range(size):
            self._steps += 1
            self._one(field.type, (*path, k), depth)

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
        if len(self.words) == _MOST_WORDS:
            raise _NoLayoutError
        (value,) = struct.unpack_from('<I', self._data, begin)
        self.words.append((begin, value))
        return int(value)

    def _take(self, size: int, align: int) -> int:
        """Pass over some bytes; return where they begin."""
        begin = self._at + (_HEADER - self._at) % align
        self._at = begin + size
        if self._at > len(self._data):
            raise _NoLayoutError
        return begin


# Arrays that the general decoder slices, without a look whether so many bytes are there.
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
    word = struct.Struct('<I' if message[1:2] in (b'\x01', b'\x03') else '>I')
    left = len(message) + _FREE_STEPS
    at = _HEADER

    def take(size: int, align: int) -> int:
        nonlocal at
        begin = at + (_HEADER - at) % align
        at = begin + size
        if at > len(message):
            raise ValueError('it is shorter than what it says of itself')
        return begin

    def length() -> int:
        (value,) = word.unpack_from(message, take(4, 4))
        return int(value)

    def one(name: str) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise ValueError('it states more elements than it has bytes')
        if name == TEXT:
            take(length(), 1)
        elif name in PRIMITIVES:
            width = np.dtype(PRIMITIVES[name]).itemsize
            take(width, width)
        elif name not in definitions:
            raise ValueError('a type in it is not defined')
        elif not definitions[name]:
            take(1, 1)
        else:
            for field in definitions[name]:
                if field.array:
                    several(field)
                else:
                    one(field.type)

    def several(field: Field) -> None:
        count = length() if field.size is None else field.size
        if field.type in PRIMITIVES:
            width = np.dtype(PRIMITIVES[field.type]).itemsize
            take(count * width, width if count else 1)
            return
        for _ in range(count):
            one(field.type)

    one(kind)
