"""
Index one .mcap file with the MCAP library: topics, places of their messages, and damage.

The file is walked record by record.  Chunks that an intact summary lists are unpacked later, when
their messages are read; all others (with `partial`, all chunks) are unpacked during the walk.
Every stated size is compared with its limit before anything is read or unpacked.  The message
indexes after a chunk are used only if the messages that they list, with the chunk's other records,
fill the chunk.  Damage is reported per chunk.
https://mcap.dev/spec

Limits: without checksums a wrong byte within a message is not detected.  A lost message is
detected only if the summary counts the messages, or the walk meets a broken record.
"""

from __future__ import annotations

from array import array
import bisect
from collections.abc import Mapping, Sequence
from contextlib import suppress
import io
import math
import os
from pathlib import Path
import struct
from typing import Any, BinaryIO, NamedTuple
import zlib

import lz4.frame
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, MessageIndex, Metadata, Schema
import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.recordings.cdr import gather, IntArray, joined, MessageTable
from ou_monitor.recordings.importers.formats import kind_of_foreign, MAGIC
from ou_monitor.records import Defect, Note
from ou_monitor.stream.files import opened, path_words, plain_texts
from ou_monitor.text import counted, printable
import zstandard

# Opcode and length of a record; channel, sequence, log time and publish time of a message.
_HEAD, _MESSAGE = struct.Struct('<BQ'), struct.Struct('<HIQQ')
# Unpacked size, checksum, and length of the compression's name, behind two log times.
_CHUNK = struct.Struct('<16xQII')
_FOOTER = _HEAD.size + 20 + len(MAGIC)
# Offset of the message in its record.
_DATA = _HEAD.size + _MESSAGE.size
# First opcode that is private to a writer.
_PRIVATE = 0x80
# Records allowed before the end of the data, and after it: a wrong bit in an opcode must not turn
# a record into one that is skipped.
_IN_DATA = {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK,
            Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END,
            Opcode.FOOTER}
_IN_SUMMARY = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX,
               Opcode.STATISTICS, Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET, Opcode.FOOTER}
_UNREAD: dict[int, Any] = {Opcode.ATTACHMENT: Attachment, Opcode.MESSAGE_INDEX: MessageIndex}
_LENGTHS = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}

# Key in a channel's metadata: rate of the samples within a block, Hz.
SAMPLE_RATE = 'sample_rate_hz'
# Name of our own metadata record, on the origin of the recording.
ABOUT = 'ou_monitor'
# Maximum bytes of a metadata record (all together: twice that).
_MOST_METADATA = 10_000_000
# Maximum size of a definition (usual: some kB) and of a name (DDS: 256 characters).
_MOST_DEFINITION, _MOST_OF_NAME = 256 * 1024, 256
# Maximum number of damaged places before the walk ends, of left-out topics that are named, and of
# records in a chunk that are not messages (a schema and a channel for each of 65536 identifiers).
_MOST_BREAKS, _MOST_NOTES, _MOST_OTHERS = 10_000, 20, 2 * 65536
# Block size for messages outside of chunks, bytes.
_BLOCK = 64 * 1024

# Limit of an unpacked chunk, bytes: rosbag2's hold 0.8 MB, or one message.
_MOST_OF_CHUNK = 64 * 1024 * 1024
# Maximum ratio of all unpacked chunks to the file: 20 to 30 for logs of a constant voltage, 30 000
# for zeros.
_MOST_RATIO = 256


class Damage(Exception):
    """A part of the file is damaged."""


class Span(NamedTuple):
    """A part of the file that is read at once: a chunk, or messages outside of chunks."""

    #: Log times of its first and last message, ns.
    start_ns: int
    end_ns: int
    #: Place of its content in the file, bytes, and whether it is a chunk.
    offset: int
    length: int
    chunk: bool
    channels: frozenset[int] | None = None  #: Channels with messages in it; None: unknown
    index_length: int = 0  #: Bytes of message indexes right behind it
    unpacked: int = 0  #: Bytes that the chunk unpacks to, as stated; 0: not stated


class Topic(NamedTuple):
    """A channel of ROS 2 messages."""

    name: str
    type: str  # noqa: A003
    schema: Any
    sample_rate: float | None  #: Rate of the samples within a block, Hz


def _over_limit(what: str, length: int, limit: int) -> str:
    return (f'{what} {length / 1e6:.4g} MB, and {limit / 1e6:.4g} MB is the limit: '
            "'ros2 bag convert' writes smaller chunks")


def moment(log_time_ns: int, origin_ns: int) -> str:
    """Return a log time in words: since the start of the recording, and as logged."""
    return (f'{(log_time_ns - origin_ns) / 1e9:.3f} s into the recording, log time '
            f'{log_time_ns // 10**9}.{log_time_ns % 10**9:09d} s')


class McapFile:
    """
    One .mcap file, its `topics` by channel, `counts` of messages, `spans` that hold them.

    `partial`: walk the whole file. `about` is the file's own metadata, `start_ns` and `end_ns` the
    log times of the first and last message, `origin_ns` the log time of the bag's first message.
    Raises InputError if the file is missing, empty or not MCAP.
    """

    def __init__(self, path: Path, partial: bool) -> None:
        """Index the file."""
        self.path = path
        self.topics: dict[int, Topic] = {}
        self.counts: dict[int, int] = {}
        self.spans: list[Span] = []
        # First byte and reason of each damage, in order.
        self.breaks: list[tuple[int, str]] = []
        self.about: dict[str, str] = {}
        self.notes: list[str] = []
        self.start_ns = self.end_ns = 0
        # Definitions by number, including unused topics.
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._unpacked = self._metadata = 0
        self._metadata_read = True  # Whether all of it could be read
        # Whether the summary counts the messages and lists the chunks, which are read later.
        self._trusted = False
        # One for all chunks, because creating it takes as long as unpacking a small chunk.
        self._zstd = zstandard.ZstdDecompressor()
        with opened(self.path) as file:
            self._size = file.seek(0, os.SEEK_END)
            self._limit_of_all = max(16 * _MOST_OF_CHUNK, _MOST_RATIO * self._size)
            if self._size == 0:
                raise InputError(f'{self.path} is empty (0 bytes)')
            file.seek(0)
            head = file.read(64)
            if not head.startswith(MAGIC):
                raise InputError(f'{self.path} is not an MCAP file: '
                                 f'{kind_of_foreign(head, self.path)[1]}')
            self._summary = self._read_summary(file)
            self._walk(file, self._use_summary(partial))
        self.origin_ns = self.start_ns

    @property
    def damage(self) -> str:
        """Return a description of the damage; '' for an intact file."""
        if not self.breaks:
            return ''
        (first, why), rest = self.breaks[0], len(self.breaks) - 1
        newest = max((span.end_ns for span in self.spans if span.offset <= first), default=None)
        words = f'at byte {first}: {why} (' + (
            'before the first message' if newest is None else
            moment(newest, self.origin_ns)) + ')'
        end = ', after which the search ended' if rest + 1 >= _MOST_BREAKS else ''
        return words + (f'; and at {counted(rest, "more place")}, the last at byte '
                        f'{self.breaks[-1][0]}{end}' if rest else '')

    def _break(self, offset: int, why: object) -> None:
        bisect.insort(self.breaks, (offset, str(why)))

    def _read_summary(self, file: BinaryIO) -> Any:
        file.seek(max(0, self._size - _FOOTER))
        footer = file.read(_FOOTER)
        if not (footer.startswith(_HEAD.pack(Opcode.FOOTER, 20)) and footer.endswith(MAGIC)):
            return None
        start, _, stated = struct.unpack_from('<QQI', footer, _HEAD.size)
        if start == 0:
            return None
        try:
            if not len(MAGIC) < start < self._size or self._size - start > 16 * _MOST_OF_CHUNK:
                raise Damage(f'it should begin at byte {start}')
            file.seek(start)
            if stated and _crc(file, self._size - start - len(MAGIC) - 4) != stated:
                raise Damage('its checksum is wrong')
            file.seek(0)
            return make_reader(file).get_summary()
        # The library raises errors of many kinds; all mean damage here.
        except Exception as error:
            self.notes.append(Note(
                f'The summary of {printable(self.path.name)} is damaged '
                f'({printable(error, 200) or type(error).__name__}): the whole file was scanned, '
                'without a count of its messages to compare with.', Defect.DAMAGED_FILE))
            return None

    def _use_summary(self, partial: bool) -> dict[int, Span]:
        """Take topics and counts from the summary; return its chunks by their first byte."""
        summary, end = self._summary, len(MAGIC)
        if summary is None:
            return {}
        spans: dict[int, Span] = {}
        # Chunks without messages have no index; files written without any index do not say which
        # chunks are empty.
        indexed = any(index.message_index_offsets for index in summary.chunk_indexes)
        for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
            if index.chunk_start_offset < end or index.chunk_length < _HEAD.size:
                # A chunk listed twice, or within another, would be read twice.
                return {}
            end = index.chunk_start_offset + index.chunk_length + index.message_index_length
            spans[index.chunk_start_offset] = Span(
                index.message_start_time, index.message_end_time,
                index.chunk_start_offset + _HEAD.size, index.chunk_length - _HEAD.size, True,
                frozenset(index.message_index_offsets) or (frozenset() if indexed else None),
                index.message_index_length, index.uncompressed_size)
        if end > self._size:
            return {}
        # With `partial` the statistics of the summary are not trusted.
        stated = None if partial else summary.statistics
        if stated is not None and bool(spans) == bool(stated.channel_message_counts) and (
                sum(stated.channel_message_counts.values()) == stated.message_count) and (
                    stated.channel_message_counts.keys() <= summary.channels.keys()):
            self._trusted = True
            self._schemas.update(summary.schemas)
            for channel in summary.channels.values():
                self._add_channel(channel)
        return spans

    def _walk(self, file: BinaryIO, chunks: Mapping[int, Span]) -> None:
        """Walk the file once; note the places of its messages and its damage."""
        starts = list(chunks)
        statistics: Any = None if self._summary is None else self._summary.statistics
        private = False
        at, op, in_data = len(MAGIC), 0, True
        while op != Opcode.FOOTER and len(self.breaks) < _MOST_BREAKS:
            place = bisect.bisect_right(starts, at)
            following = starts[place] if place < len(starts) else self._size
            try:
                op, length = (Opcode.CHUNK, chunks[at].length) if at in chunks else _frame(
                    file, at, self._size, in_data)
                end = at + _HEAD.size + length
                if end > following:
                    raise Damage('a record reaches into the next chunk')
            except Damage as error:
                self._break(at, error)
                if following == self._size:
                    break
                at, in_data = following, True
                continue
            try:
                if op == Opcode.MESSAGE:
                    end = min(self._walk_messages(file, at, end), following)
                elif op == Opcode.CHUNK:
                    span = chunks.get(at, Span(0, 0, at + _HEAD.size, length, True))
                    end += span.index_length
                    self._walk_chunk(file, span, at in chunks)
                elif op == Opcode.DATA_END:
                    # Then only the summary follows, which repeats schemas and channels.
                    in_data = False
                    stated = int.from_bytes(file.read(4), 'little')
                    file.seek(0)
                    # Chunks have checksums of their own.
                    if stated and not self.breaks and not (
                            self._trusted and all(span.chunk for span in self.spans)
                            ) and _crc(file, at) != stated:
                        self._break(len(MAGIC), f'the checksum of the data up to byte {at} is '
                                    'wrong: something in it was changed')
                elif op in (Opcode.SCHEMA, Opcode.CHANNEL):
                    if in_data:
                        self._learn(op, self._content(file, length, _MOST_OF_CHUNK))
                elif op == Opcode.METADATA:
                    self._learn_about(file, length)
                elif op in _UNREAD and statistics is None and not (
                        self.spans and self.spans[-1].chunk):
                    # Without a count of messages, check that a damaged opcode hides none.
                    _parse(_UNREAD[op], self._content(file, length, _MOST_OF_CHUNK))
                elif op >= _PRIVATE and statistics is None and not private:
                    private = True
                    raise Damage(f'a record of a private kind (0x{op:02x}) may have been a '
                                 'message, and no count shows whether one is missing')
            except Damage as error:
                # The frame is whole: later records may be intact.
                self._break(at, error)
            at = end
        if op == Opcode.FOOTER:
            file.seek(at)
            if file.read(len(MAGIC)) != MAGIC:
                self._break(at, 'the file ends without its closing mark')
            elif at + len(MAGIC) < self._size:
                self._break(at + len(MAGIC), f'{self._size - at - len(MAGIC)} bytes follow the '
                            'end of the recording; they may be another recording')
        if self._trusted:
            self.counts = {key: statistics.channel_message_counts.get(key, 0)
                           for key in self.topics}
            self.start_ns, self.end_ns = (statistics.message_start_time,
                                          statistics.message_end_time)
            return
        if statistics is not None and not self.breaks:
            for key, stated in statistics.channel_message_counts.items():
                found = self.counts.get(key, 0)
                if found != stated and (key in self.topics or key not in self._channels):
                    self._break(len(MAGIC), f'somewhere before byte {self._size} messages were '
                                f'changed: the summary counts {stated} of channel {key}, {found} '
                                'were found')
                    break
        self.start_ns = min((span.start_ns for span in self.spans), default=0)
        self.end_ns = max((span.end_ns for span in self.spans), default=0)

    def _content(self, file: BinaryIO, length: int, limit: int) -> bytes:
        """Return the content of the record whose head was just read."""
        if length > limit:
            raise Damage(f'a record has {length} bytes, more than the maximum of {limit}')
        return file.read(length)

    def _learn(self, op: int, content: bytes) -> None:
        kind: Any = Schema if op == Opcode.SCHEMA else Channel
        found = _parse(kind, content)
        known = (self._schemas if kind is Schema else self._channels).get(found.id, found)
        if known != found:
            raise Damage(f'{kind.__name__.lower()} {found.id} is defined a second time, '
                         'differently')
        if kind is Schema:
            self._schemas[found.id] = found
        else:
            self._add_channel(found)

    def _learn_about(self, file: BinaryIO, length: int) -> None:
        """Read the metadata record whose head was just read; note the first unreadable one."""
        try:
            self._metadata += length
            if self._metadata > 2 * _MOST_METADATA:
                raise Damage(f'metadata records exceed {2 * _MOST_METADATA} bytes')
            record = _parse(Metadata, self._content(file, length, _MOST_METADATA))
        except Damage as error:
            if self._metadata_read:
                self.notes.append(f'Metadata of {printable(self.path.name)} cannot be read '
                                  f'({error}).')
            self._metadata_read = False
            return
        if record.name == ABOUT:
            self.about |= plain_texts(record.metadata)

    def _add_channel(self, channel: Channel) -> None:
        if channel.id in self._channels:
            return
        self._channels[channel.id] = channel
        schema = self._schemas.get(channel.schema_id)
        if schema is None and self._summary is not None:
            # Its definition was in a damaged part of the file.
            schema = self._summary.schemas.get(channel.schema_id)
        encoding = 'none' if schema is None else schema.encoding
        why = ''
        if schema is None or channel.message_encoding != 'cdr' or encoding != 'ros2msg':
            why = (f"it is not ROS 2 (messages '{printable(channel.message_encoding, 40)}', "
                   f"schema '{printable(encoding, 40)}')")
        elif len(channel.topic) > _MOST_OF_NAME or len(schema.name) > _MOST_OF_NAME:
            why = f'ROS 2 has no names of more than {_MOST_OF_NAME} characters'
        elif len(schema.data) > _MOST_DEFINITION:
            why = f'its definition has more than {_MOST_DEFINITION // 1024} kB'
        # Names reach messages, tables and pages: here they become plain text.
        name = printable(channel.topic, _MOST_OF_NAME)
        if why:
            left_out = len(self._channels) - len(self.topics)
            if left_out <= _MOST_NOTES:
                self.notes.append(f"Topic '{name}' was left out: {why}."
                                  if left_out < _MOST_NOTES else 'More topics were left out.')
            return
        assert schema is not None
        self.topics[channel.id] = Topic(
            name, printable(schema.name), schema,
            _rate(channel.metadata.get(SAMPLE_RATE, '')))

    def _walk_chunk(self, file: BinaryIO, span: Span, listed: bool) -> None:
        """Add a chunk; unless it is listed in a trusted summary, unpack it to know its content."""
        if listed and self._trusted:
            self._unpacked += span.unpacked
            if self._unpacked > self._limit_of_all:
                raise InputError(f'{path_words(self.path)}: ' + _over_limit(
                    'its chunks hold', self._unpacked, self._limit_of_all))
            if span.channels != frozenset():
                self.spans.append(span)
            return
        try:
            data = self._data(file, span)
            self._unpacked += len(data)
            if self._unpacked > self._limit_of_all:
                raise Damage(_over_limit('it and the chunks before it hold', self._unpacked,
                                         self._limit_of_all))
            table = self._messages(data)
        except Damage as error:
            raise Damage(f'the chunk there is broken ({error})') from error
        self._add_span(table, span._replace(unpacked=len(data)))

    def _walk_messages(self, file: BinaryIO, at: int, end: int) -> int:
        """Count messages outside of chunks, the first from `at` to `end`; return their end."""
        if end - at > _MOST_OF_CHUNK:
            raise Damage(_over_limit('a message has', end - at, _MOST_OF_CHUNK))
        file.seek(at)
        data = file.read(max(end - at, _BLOCK))
        places, _, length = _records(data, messages_only=True)
        if not places.size:
            raise Damage('a message is shorter than its own head')
        self._add_span(_table(data, places), Span(0, 0, at, length, False))
        return at + length

    def _add_span(self, table: MessageTable, span: Span) -> None:
        keys, counts = np.unique(table.channel, return_counts=True)
        for key, n in zip(keys.tolist(), counts.tolist()):
            if key not in self._channels and self._summary is not None and (
                    key in self._summary.channels):
                self._add_channel(self._summary.channels[key])
            if key in self.topics:
                self.counts[key] = self.counts.get(key, 0) + n
            elif key not in self._channels:
                self._break(span.offset, f'{counted(n, "message")} of channel {key}, which is not '
                            'defined')
        found = frozenset(keys.tolist()) & self.topics.keys()
        if found:
            times = table.log_time[np.isin(table.channel, list(found))]
            self.spans.append(span._replace(start_ns=int(times.min()), end_ns=int(times.max()),
                                            channels=found))

    def _data(self, file: BinaryIO, span: Span) -> bytes:
        """Return the records of a span, unpacked and with its checksum verified."""
        if not 0 <= span.length <= _MOST_OF_CHUNK:
            raise Damage(_over_limit('it has', span.length, _MOST_OF_CHUNK))
        file.seek(span.offset)
        content = file.read(span.length)
        if len(content) < span.length:
            raise Damage(f'it is cut off after {len(content)} bytes')
        if not span.chunk:
            return content
        try:
            stated, crc, name = _CHUNK.unpack_from(content)
            begin = _CHUNK.size + name + 8
            packed, = struct.unpack_from('<Q', content, begin - 8)
        except struct.error as error:
            raise Damage('it is shorter than its own head') from error
        if packed != len(content) - begin:
            raise Damage(f'it holds {len(content) - begin} bytes in place of {packed}')
        if stated > _MOST_OF_CHUNK:
            raise Damage(_over_limit('it unpacks to', stated, _MOST_OF_CHUNK))
        try:
            data = _decompressed(content[_CHUNK.size:begin - 8].decode('latin-1'),
                                 memoryview(content)[begin:], stated, self._zstd)
        # zstd and lz4 raise their own errors.
        except Exception as error:
            raise Damage(printable(error, 200) or type(error).__name__) from error
        if len(data) != stated or span.unpacked not in (0, stated):
            raise Damage(f'{len(data)} bytes in place of {span.unpacked or stated}')
        if crc and crc != zlib.crc32(data):
            raise Damage('its checksum is wrong')
        return data

    def _messages(self, data: bytes, index: bytes = b'') -> MessageTable:
        places, others, reached = _by_index(data, index) or _records(data)
        if reached < len(data):
            raise Damage('a record within it is cut off')
        for op, begin, end in others:
            if op in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._learn(op, data[begin:end])
        return _table(data, places)

    def channels_of(self, wanted: set[str]) -> dict[int, str]:
        """Return the wanted topics by channel."""
        return {key: topic.name for key, topic in self.topics.items() if topic.name in wanted}

    def tables(self, spans: Sequence[Span], wanted: set[str]) -> dict[str, MessageTable]:
        """Return the messages of some spans by topic, in the order of the file."""
        with opened(self.path) as file:
            table = joined([self._table_of(file, span) for span in spans])
        topics: dict[str, npt.NDArray[np.bool_]] = {}
        for key, name in self.channels_of(wanted).items():
            mine = table.channel == key
            if mine.any():
                # Two publishers of one topic are two channels.
                topics[name] = topics[name] | mine if name in topics else mine
        return {name: table.where(mine) for name, mine in topics.items()}

    def _table_of(self, file: BinaryIO, span: Span) -> MessageTable:
        try:
            data = self._data(file, span)
            file.seek(span.offset + span.length)
            # Longest index: 15 bytes per channel, and 16 per message, of which each takes more in
            # `data`.
            index = file.read(min(span.index_length, len(data) + 15 * 65536))
            table = self._messages(data, index)
            if span.unpacked and ((table.log_time < span.start_ns)
                                  | (table.log_time > span.end_ns)).any():
                raise Damage('its messages do not have the times of its index')
        except Damage as error:
            raise InputError(
                f'{self.path} is damaged at byte {span.offset - _HEAD.size}: the chunk there '
                f'is broken ({error}) ({moment(span.start_ns, self.origin_ns)}); use '
                '--partial to read the intact part') from error
        return table


class _StrictStream(ReadDataStream):
    """The library's stream, extended to refuse a text longer than its record."""

    def read(self, length: int) -> bytes:
        """Return exactly `length` bytes."""
        data: bytes = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def _parse(kind: Any, content: bytes) -> Any:
    """Return a record as the library reads it."""
    stream = _StrictStream(io.BytesIO(content))
    what = f'a {kind.__name__.lower()} record cannot be read'
    try:
        found = kind.read(stream)
    except Exception as error:
        raise Damage(f'{what} ({error!r})') from error
    if stream.count < len(content):
        raise Damage(f'{what}: its content is shorter than its stated length')
    return found


def _rate(text: str) -> float | None:
    """Return a stated rate, Hz; None if missing or implausible."""
    with suppress(ValueError):
        if 0.0 < (rate := float(text)) < math.inf:
            return rate
    return None


def _frame(file: BinaryIO, at: int, size: int, in_data: bool) -> tuple[int, int]:
    """Return opcode and length of a record; Damage if it is not allowed there."""
    file.seek(min(at, size))
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise Damage('the file ends without a footer')
    op, length = _HEAD.unpack(head)
    if op == 0 or Opcode.DATA_END < op < _PRIVATE:
        raise Damage(f'no record starts with 0x{op:02x}')
    if at + _HEAD.size + length > size:
        raise Damage(f'a record of {length} bytes is cut off after {size - at - _HEAD.size}')
    if op < _PRIVATE and (op not in (_IN_DATA if in_data else _IN_SUMMARY)
                          or (op == Opcode.HEADER and at != len(MAGIC))
                          or length != _LENGTHS.get(Opcode(op), length)):
        raise Damage(f'a record 0x{op:02x} of {length} bytes does not belong there')
    return op, length


def _crc(file: BinaryIO, length: int) -> int:
    """Return the checksum of the next bytes of a file, up to its end."""
    found = 0
    while length > 0 and (block := file.read(min(1 << 20, length))):
        found = zlib.crc32(block, found)
        length -= len(block)
    return found


def _decompressed(compression: str, data: memoryview, stated: int,
                  zstd: zstandard.ZstdDecompressor) -> bytes:
    """Return the content of a chunk, unpacked to at most its stated size."""
    if compression == 'zstd':
        size = zstandard.frame_content_size(data)
        if size not in (-1, stated):
            raise Damage(f'{size} bytes in place of {stated}')
        plain: bytes = zstd.decompress(data, stated)
    elif compression == 'lz4':
        # The library would unpack a frame of any size.
        frame = lz4.frame.LZ4FrameDecompressor()
        plain = frame.decompress(data, stated)
        if not frame.eof:
            raise Damage(f'it does not unpack to {stated} bytes')
    elif compression == '':
        plain = bytes(data)
    else:
        # The library treats unknown compressions as plain bytes.
        raise Damage(f"unknown compression '{printable(compression, 40)}'")
    return plain


Others = list[tuple[int, int, int]]


def _records(data: bytes, at: int = 0, *, end: int | None = None, messages_only: bool = False,
             ) -> tuple[IntArray, Others, int]:
    """Return places of messages, (opcode, begin, end) of others, and the last end."""
    places = array('q')
    others: Others = []
    end = len(data) if end is None else end
    unpack, head, shortest, message = _HEAD.unpack_from, _HEAD.size, _MESSAGE.size, Opcode.MESSAGE
    while at + head <= end:
        op, length = unpack(data, at)
        behind = at + head + length
        if behind > end or messages_only and (op != message or length < shortest):
            break
        if op == message:
            if length < shortest:
                raise Damage('a message in it is shorter than its own head')
            places.append(at)
        else:
            if len(others) == _MOST_OTHERS:
                raise Damage(f'more than {_MOST_OTHERS} records in it are not messages')
            others.append((op, at + head, behind))
        at = behind
    return np.frombuffer(places, np.int64) if places else np.empty(0, np.int64), others, at


def _by_index(data: bytes, index: bytes) -> tuple[IntArray, Others, int] | None:
    """Return a chunk's records as `_records` does; None if its indexes do not describe them."""
    # Messages in the indexes and records of other kinds must fill the chunk from end to end.
    parts, at = [np.empty(0, np.int64)], 0
    while at < len(index):
        if at + _HEAD.size + 6 > len(index):
            return None
        op, length = _HEAD.unpack_from(index, at)
        count, odd = divmod(length - 6, 16)
        if op != Opcode.MESSAGE_INDEX or odd or count < 0 or (
                at + _HEAD.size + length > len(index)):
            return None
        parts.append(np.frombuffer(index, '<i8', 2 * count, at + _HEAD.size + 6)[1::2])
        at += _HEAD.size + length
    places = np.sort(np.concatenate(parts), kind='stable')
    if not places.size or places[0] < 0 or places[-1] > len(data) - _DATA:
        return None
    # A length of 2^63 or more is negative here, so its end fails the test too.
    ends = places + _HEAD.size + gather(data, places + 1, '<i8')
    if not ((gather(data, places, 'u1') == Opcode.MESSAGE) & (ends >= places + _DATA)
            & (ends <= len(data))).all():
        return None
    behind, ahead = np.append(0, ends), np.append(places, len(data))
    others: Others = []
    for gap in np.flatnonzero(behind != ahead).tolist():
        inside, more, end = _records(data, int(behind[gap]), end=int(ahead[gap]))
        if end != ahead[gap] or inside.size:
            return None
        others += more
    return places, others, len(data)


def _table(data: bytes, at: IntArray) -> MessageTable:
    """Return the messages whose records start at given offsets."""
    length = gather(data, at + 1, '<u8').astype(np.int64)
    return MessageTable(data, gather(data, at + _HEAD.size, '<u2'),
                        gather(data, at + _HEAD.size + 6, '<u8'), at + _DATA,
                        at + _HEAD.size + length)
