"""
The frame of an MCAP file: records one after another, each with its length.

Walking the frame is what tells *where* a file is damaged, which the library's
readers do not say (they take a short read at the end for a whole record).
https://mcap.dev/spec
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import enum
import struct
from typing import BinaryIO

MAGIC = b'\x89MCAP0\r\n'
RECORD_HEAD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')

# Record, its head and the magic at the end.
FOOTER_LENGTH = RECORD_HEAD.size + 20 + len(MAGIC)


class Op(enum.IntEnum):
    """Opcodes that matter here; others up to 0x0F, and from 0x80 on, are valid and skipped."""

    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    DATA_END = 0x0F


class Damage(Exception):
    """A place in the file where it stops making sense."""

    def __init__(self, offset: int, why: str) -> None:
        """Keep the byte offset and the reason."""
        super().__init__(f'at byte {offset}: {why}')
        self.offset = offset


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

    """

    start_ns: int
    end_ns: int
    offset: int
    length: int
    chunk: bool
    channels: frozenset[int] | None = None


def walk(file: BinaryIO, start: int, size: int) -> Iterator[Record]:
    """
    Yield the records of a file one after another, the footer last.

    Parameters
    ----------
    file : binary file
        Seekable; only the heads of records are read.
    start : int
        Offset of the first record.
    size : int
        Size of the file, bytes.

    Yields
    ------
    Record
        Every whole record.

    Raises
    ------
    Damage
        When the file ends before its footer, or a record cannot be one.

    """
    offset = start
    while True:
        file.seek(offset)
        head = file.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            raise Damage(offset, 'the file ends without a footer')
        opcode, length = RECORD_HEAD.unpack(head)
        record = Record(offset, opcode, length)
        if opcode == 0 or Op.DATA_END < opcode < 0x80:
            raise Damage(offset, f'no record begins with 0x{opcode:02x}')
        if record.end > size:
            raise Damage(offset, f'a record of {length} bytes is cut off after '
                         f'{size - record.content}')
        yield record
        if opcode == Op.FOOTER:
            return
        offset = record.end


def inner_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """
    Yield (opcode, begin, end) of the content of each record in a chunk or run.

    Raises
    ------
    Damage
        At the offset within `data` where a record does not fit.

    """
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


def kind_of_foreign(head: bytes) -> str:
    """Return what a file that is not MCAP seems to be, and what to do with it."""
    if head.startswith(b'SQLite format 3'):
        return ("it is an SQLite rosbag2 (.db3): convert it with 'ros2 bag convert' to the "
                'storage mcap')
    if head.startswith(b'#ROSBAG'):
        return "it is a ROS 1 bag: convert it with 'rosbags-convert'"
    if head.startswith(b'\x28\xb5\x2f\xfd'):
        return "it is compressed as a whole: unpack it with 'zstd -d' first"
    if head.startswith(b'ULog'):
        return 'it is a PX4 ULog'
    if head[:1] and all(byte in b'\t\n\r' or 32 <= byte < 127 for byte in head):
        return 'it is text'
    return 'its first bytes are ' + (head[:8].hex(' ') or 'missing')
