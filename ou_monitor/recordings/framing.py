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
from pathlib import Path
import shlex
import struct
from typing import BinaryIO
import zlib

MAGIC = b'\x89MCAP0\r\n'
RECORD_HEAD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')

# Record, its head and the magic at the end.
FOOTER_LENGTH = RECORD_HEAD.size + 20 + len(MAGIC)


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

    """

    start_ns: int
    end_ns: int
    offset: int
    length: int
    chunk: bool
    channels: frozenset[int] | None = None
    index_length: int = 0


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
    if record.opcode not in (Op.MESSAGE_INDEX, Op.ATTACHMENT, Op.METADATA):
        return
    file.seek(record.content)
    content = file.read(record.length)
    if record.opcode == Op.MESSAGE_INDEX:
        fits = len(content) >= 6 and (len(content) - 6) % 16 == 0 and (
            int.from_bytes(content[2:6], 'little') == len(content) - 6)
    elif record.opcode == Op.ATTACHMENT:
        stated = int.from_bytes(content[-4:], 'little')
        fits = len(content) >= 36 and stated in (0, zlib.crc32(content[:-4]))
    else:
        name = int.from_bytes(content[:4], 'little')
        rest = content[4 + name:]
        fits = len(rest) >= 4 and int.from_bytes(rest[:4], 'little') == len(rest) - 4
    if not fits:
        raise Damage(record.offset, f'a record 0x{record.opcode:02x} of {record.length} bytes '
                     'does not hold what it should')


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


# First bytes of the logs that `ou-monitor convert` reads; CSV is read as it is.
_LOGS = (
    (b'ULog', 'a PX4 ULog'), (b'\xa3\x95\x80', 'an ArduPilot dataflash log'),
    (b'FMT,', 'an ArduPilot log'), (b'H Product:Blackbox', 'a blackbox log'))


def kind_of_foreign(head: bytes, path: Path = Path('LOG')) -> str:
    """Return what a file that is not MCAP seems to be, and what to do with it."""
    if head.startswith(b'SQLite format 3'):
        return ("it is an SQLite rosbag2 (.db3): convert it with 'ros2 bag convert' to the "
                'storage mcap')
    if head.startswith(b'#ROSBAG'):
        return "it is a ROS 1 bag: convert it with 'rosbags-convert'"
    if head.startswith(b'\x28\xb5\x2f\xfd'):
        return "it is compressed as a whole: unpack it with 'zstd -d' first"
    for begin, log in _LOGS:
        if head.startswith(begin):
            command = shlex.join(['ou-monitor', 'convert', str(path), path.stem])
            return f'it is {log}, not a recording: convert it first, with {command}'
    if head[:1] and all(byte in b'\t\n\r' or 32 <= byte < 127 for byte in head):
        return 'it is text'
    return 'its first bytes are ' + (head[:8].hex(' ') or 'missing')
