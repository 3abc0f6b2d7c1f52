"""
The records of an MCAP file: their frame, and the messages in a block as arrays.

Records stand one after another, each with its length.  Walking them tells *where* a
file is damaged, which the library's readers do not say (they take a short read at
the end for a whole record).  For the messages of a block two ways lead around that
walk: the message indexes that follow a chunk state every place, and a run of records
of one length is checked as a whole.  Both are verified byte by byte, never trusted:
what comes out is what the walk would have found.  https://mcap.dev/spec
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import enum
import struct
from typing import Any, BinaryIO
import zlib

import numpy as np
import numpy.typing as npt

MAGIC = b'\x89MCAP0\r\n'
RECORD_HEAD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')

# Record, its head and the magic at the end.
FOOTER_LENGTH = RECORD_HEAD.size + 20 + len(MAGIC)

IntArray = npt.NDArray[np.int64]
TimeArray = npt.NDArray[np.uint64]

_HEAD = RECORD_HEAD.size
_PAYLOAD = RECORD_HEAD.size + MESSAGE_HEAD.size

# A run of equal records is looked for this far ahead at first, then twice as far.
_FIRST_RUN = 32
# Records of a chunk that are no messages: as many schemas and channels as have numbers.
_MOST_OTHERS = 2 * 65536
# Records to walk one by one after a run that was not worth looking for: twice as
# many each time, up to this.
_LEAST_PAUSE, _MOST_PAUSE = 16, 2048


class Op(enum.IntEnum):
    """Opcodes of the specification; those from 0x80 on are private, and skipped."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


PRIVATE = 0x80

# Bytes read at once where no more is needed than a checksum.
_BLOCK = 1024 * 1024

# Which records may stand before the end of the data, and which after it.  A
# message whose opcode was hit by a wrong bit must not be skipped as something else.
_IN_DATA = {Op.HEADER, Op.SCHEMA, Op.CHANNEL, Op.MESSAGE, Op.CHUNK, Op.MESSAGE_INDEX,
            Op.ATTACHMENT, Op.METADATA, Op.DATA_END, Op.FOOTER}
_IN_SUMMARY = {Op.SCHEMA, Op.CHANNEL, Op.CHUNK_INDEX, Op.ATTACHMENT_INDEX, Op.STATISTICS,
               Op.METADATA_INDEX, Op.SUMMARY_OFFSET, Op.FOOTER}
_LENGTHS = {Op.DATA_END: 4, Op.FOOTER: 20}


class Damage(Exception):
    """A place in the file where it stops making sense."""

    def __init__(self, offset: int, why: str) -> None:
        """Keep the byte offset and the reason."""
        super().__init__(f'at byte {offset}: {why}')
        self.offset = offset
        self.why = why


def moment(log_time_ns: int, origin_ns: int) -> str:
    """Return a log time in words, also counted from the start of the recording."""
    return (f'{(log_time_ns - origin_ns) / 1e9:.3f} s into the recording, log time '
            f'{log_time_ns // 10**9}.{log_time_ns % 10**9:09d} s')


@dataclass(frozen=True)
class Record:
    """Where a record is: offset of its opcode, and the length of its content."""

    offset: int
    opcode: int
    length: int

    @property
    def content(self) -> int:
        """Offset of the content."""
        return self.offset + RECORD_HEAD.size

    @property
    def end(self) -> int:
        """Offset of the record after it."""
        return self.content + self.length


@dataclass(frozen=True)
class Span:
    """
    A part of the file that holds messages and is read in one go.

    Attributes
    ----------
    start_ns, end_ns : int
        Log times of its first and last message, ns.
    offset, length : int
        Bytes in the file: the content of a chunk, or a run of plain records.
    chunk : bool
        Which of the two.
    channels : frozenset of int or None
        Channels that have messages in it; None when not known.
    index_length : int
        Bytes of message indexes right after the chunk.
    unpacked : int
        Bytes that the chunk unpacks to, as stated; 0 where nobody states it.

    """

    start_ns: int
    end_ns: int
    offset: int
    length: int
    chunk: bool
    channels: frozenset[int] | None = None
    index_length: int = 0
    unpacked: int = 0


def record_at(file: BinaryIO, offset: int, size: int, in_data: bool) -> Record:
    """Return the record at an offset (size in bytes)."""
    file.seek(offset)
    head = file.read(RECORD_HEAD.size)
    if len(head) < RECORD_HEAD.size:
        raise Damage(offset, 'the file ends without a footer')
    opcode, length = RECORD_HEAD.unpack(head)
    record = Record(offset, opcode, length)
    if opcode == 0 or Op.DATA_END < opcode < PRIVATE:
        raise Damage(offset, f'no record begins with 0x{opcode:02x}')
    if record.end > size:
        raise Damage(offset, f'a record of {length} bytes is cut off after '
                     f'{size - record.content}')
    if opcode < PRIVATE and (
            opcode not in (_IN_DATA if in_data else _IN_SUMMARY)
            or (opcode == Op.HEADER and offset != len(MAGIC))
            or length != _LENGTHS.get(Op(opcode), length)):
        raise Damage(offset, f'a record 0x{opcode:02x} of {length} bytes does not belong there')
    return record


def check_passed_over(file: BinaryIO, record: Record) -> None:
    """Check that a record that is not needed is what its opcode says (record in A)."""
    file.seek(record.content)
    if record.opcode == Op.MESSAGE_INDEX:
        length = int.from_bytes(file.read(6)[2:], 'little')
        fits = record.length >= 6 and length % 16 == 0 and length == record.length - 6
    elif record.opcode == Op.ATTACHMENT:
        found = crc_of(file, record.length - 4)
        fits = record.length >= 36 and int.from_bytes(file.read(4), 'little') in (0, found)
    elif record.opcode == Op.METADATA:
        name = int.from_bytes(file.read(4), 'little')
        fits = record.length >= name + 8
        if fits:
            file.seek(record.content + 4 + name)
            fits = int.from_bytes(file.read(4), 'little') == record.length - name - 8
    else:
        return
    if not fits:
        raise Damage(record.offset, f'a record 0x{record.opcode:02x} of {record.length} bytes '
                     'does not hold what it should')


def crc_of(file: BinaryIO, length: int) -> int:
    """Return the checksum of the next bytes of a file, as many as there are."""
    found = 0
    while length > 0:
        block = file.read(min(_BLOCK, length))
        if not block:
            break
        found = zlib.crc32(block, found)
        length -= len(block)
    return found


def inner_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, begin, end) of the content of each record in a chunk or run."""
    at, size = 0, len(data)
    head, step = RECORD_HEAD.unpack_from, RECORD_HEAD.size
    while at < size:
        if at + step > size:
            raise Damage(at, 'a record within a chunk is cut off')
        opcode, length = head(data, at)
        begin = at + step
        at = begin + length
        if at > size:
            raise Damage(begin - step, 'a record within a chunk is cut off')
        if opcode == Op.MESSAGE and length < MESSAGE_HEAD.size:
            raise Damage(begin - step, 'a message is shorter than its own head')
        yield opcode, begin, at


@dataclass(frozen=True, eq=False)
class Table:
    """
    Messages in a block of bytes, in the order of the file.

    Attributes
    ----------
    data : bytes
        The block.
    channel : ndarray of uint16, shape (n,)
        Channel of each message.
    log_time : ndarray of uint64, shape (n,)
        Log times, ns.
    begin, end : ndarray of int64, shape (n,)
        Where the serialized message is in `data`.

    """

    data: bytes
    channel: npt.NDArray[np.uint16]
    log_time: TimeArray
    begin: IntArray
    end: IntArray

    @property
    def n(self) -> int:
        """Return the number of messages."""
        return int(self.begin.size)

    def where(self, mask: npt.NDArray[np.bool_]) -> Table:
        """Return the messages for which `mask`, shape (n,), is true."""
        if mask.all():
            return self
        return Table(self.data, self.channel[mask], self.log_time[mask], self.begin[mask],
                     self.end[mask])

    def first(self, n: int) -> Table:
        """Return the first `n` messages."""
        return Table(self.data, self.channel[:n], self.log_time[:n], self.begin[:n], self.end[:n])

    def rows(self, picked: IntArray, length: int) -> npt.NDArray[np.uint8]:
        """Return serialized messages of one length as rows; the length is in bytes."""
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


def find_messages(
    data: bytes, *, messages_only: bool = False,
) -> tuple[Table, list[tuple[int, int, int]], int]:
    """Find the messages in a chunk, or in a run of plain records."""
    found: list[IntArray] = []
    single: list[int] = []
    others: list[tuple[int, int, int]] = []
    at, size, last, pause, wait = 0, len(data), -1, 0, _LEAST_PAUSE
    head, shortest, opcode_of_message = RECORD_HEAD.unpack_from, MESSAGE_HEAD.size, int(Op.MESSAGE)
    while at < size:
        if at + _HEAD > size:
            if messages_only:
                break
            raise Damage(at, 'a record within a chunk is cut off')
        opcode, length = head(data, at)
        behind = at + _HEAD + length
        if opcode != opcode_of_message or length < shortest or behind > size:
            if messages_only:
                break
            if behind > size:
                raise Damage(at, 'a record within a chunk is cut off')
            if opcode == opcode_of_message:
                raise Damage(at, 'a message is shorter than its own head')
            if len(others) == _MOST_OTHERS:
                raise Damage(at, f'more than {_MOST_OTHERS} records that are no messages')
            others.append((opcode, at + _HEAD, behind))
            at, last = behind, -1
            continue
        pause -= 1
        if length != last or pause > 0:
            single.append(at)
            at, last = behind, length
            continue
        stride = behind - at
        run = _run(data, at, stride)
        if run < _FIRST_RUN:
            pause, wait = wait, min(2 * wait, _MOST_PAUSE)
        else:
            wait = _LEAST_PAUSE
        found += [np.array(single, dtype=np.int64),
                  at + stride * np.arange(run, dtype=np.int64)]
        single = []
        at += run * stride
    found.append(np.array(single, dtype=np.int64))
    return _table(data, np.concatenate(found)), others, at


def _run(data: bytes, at: int, stride: int) -> int:
    """Return how many records from `at` on are messages of one length."""
    most = (len(data) - at) // stride
    seen, ahead = 1, _FIRST_RUN
    while seen < most:
        ahead = min(ahead, most - seen)
        heads: npt.NDArray[np.uint8] = np.ndarray(
            (ahead, _HEAD), np.uint8, data, at + seen * stride, (stride, 1))
        same = (heads == np.frombuffer(data, np.uint8, _HEAD, at)).all(axis=1)
        if not same.all():
            return seen + int(np.argmin(same))
        seen += ahead
        ahead *= 2
    return seen


def _table(data: bytes, at: IntArray) -> Table:
    """Return the table of messages whose records begin at given offsets."""
    length = gather(data, at + 1, '<u8').astype(np.int64)
    return Table(data, gather(data, at + _HEAD, '<u2'), gather(data, at + _HEAD + 6, '<u8'),
                 at + _PAYLOAD, at + _HEAD + length)


def find_by_index(data: bytes, index: bytes) -> Table | None:
    """Find the messages of a chunk with the message indexes behind it."""
    parts: list[IntArray] = []
    at = 0
    while at < len(index):
        if at + _HEAD + 6 > len(index):
            return None
        opcode, length = RECORD_HEAD.unpack_from(index, at)
        count, odd = divmod(length - 6, 16)
        if opcode != Op.MESSAGE_INDEX or odd or count < 0 or at + _HEAD + length > len(index):
            return None
        pairs = np.frombuffer(index, '<u8', 2 * count, at + _HEAD + 6)
        parts.append(pairs[1::2].astype(np.int64))
        at += _HEAD + length
    if not parts:
        return None
    places = np.concatenate(parts)
    if len(parts) > 1 or (np.diff(places) < 0).any():
        places.sort()
    if not places.size or places[0] < 0 or places[-1] > len(data) - _PAYLOAD:
        return None
    table = _table(data, places)
    # A length of 2^63 or more is negative here; one beyond the chunk is too long.
    if not ((gather(data, places, 'u1') == Op.MESSAGE) & (table.end >= table.begin)
            & (table.end <= len(data))).all():
        return None
    behind = np.concatenate([np.zeros(1, np.int64), table.end])
    ahead = np.append(places, len(data))
    for gap in np.nonzero(behind != ahead)[0].tolist():
        if not _only_others(data, int(behind[gap]), int(ahead[gap])):
            return None
    return table


def _only_others(data: bytes, at: int, end: int) -> bool:
    """Whether whole records that are not messages fill a part of the chunk."""
    while at + _HEAD <= end:
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        if opcode == Op.MESSAGE:
            return False
        at += _HEAD + length
    return at == end
