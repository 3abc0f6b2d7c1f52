"""
One .mcap file: its channels, and where its messages are.

Knows the frame and what a damaged one still holds; the contents of records are
left to the MCAP library, reached through a `Codec` (`bag.py` has the only one).
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
import math
from operator import itemgetter
import os
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Protocol
import zlib

from ou_monitor.errors import InputError
from ou_monitor.recordings.framing import (
    Damage, FOOTER_LENGTH, inner_records, kind_of_foreign, MAGIC, MESSAGE_HEAD, Op, Record,
    RECORD_HEAD, Span, walk)

# Unchunked files are read in runs of about this size.
RUN_SIZE = 1024 * 1024  # bytes


class RawMessage(NamedTuple):
    """One message as recorded; `data` is CDR, `log_time_ns` in ns."""

    topic: str
    type: str  # noqa: A003
    log_time_ns: int
    data: bytes


class Codec(Protocol):
    """Reads the contents of records; any exception means that they are damaged."""

    def unpack(self, chunk: bytes) -> bytes:
        """Return the records in a chunk, its checksum verified."""

    def schema(self, content: bytes) -> Any:
        """Return a schema with `id`, `name`, `encoding`, `data`."""

    def channel(self, content: bytes) -> Any:
        """Return a channel with `id`, `topic`, `schema_id`, `message_encoding`, `metadata`."""

    def summary(self, file: BinaryIO) -> Any:
        """Return the summary section, or None."""


# Where a channel's metadata holds the rate of the samples within a block, Hz.
SAMPLE_RATE = 'sample_rate_hz'


def _rate(text: str | None) -> float | None:
    """Return a stated rate, Hz; None when there is none that makes sense."""
    try:
        rate = float(text or '')
    except ValueError:
        return None
    return rate if 0.0 < rate < math.inf else None


@dataclass(frozen=True)
class TopicRecord:
    """A channel of one file: what its messages are."""

    name: str
    type: str  # noqa: A003
    schema: Any
    qos: str
    sample_rate: float | None


class McapFile:
    """
    One .mcap file: its channels, and where its messages are.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    partial : bool
        Whether a damaged file is read as far as it holds.
    codec : Codec
        Reader of the contents of records.

    Raises
    ------
    InputError
        When it is missing, empty, foreign, or damaged and not `partial`.

    """

    def __init__(self, path: Path, partial: bool, codec: Codec) -> None:
        """Index the file."""
        self.path = path
        self.topics: dict[int, TopicRecord] = {}
        self.counts: dict[int, int] = {}
        self.spans: list[Span] = []
        self.damage: str | None = None
        self.notes: list[str] = []
        self.start_ns = self.end_ns = 0
        self._codec = codec
        self._schemas: dict[int, Any] = {}
        self._skipped: set[int] = set()
        try:
            with path.open('rb') as file:
                size = file.seek(0, os.SEEK_END)
                self._check_magic(file, size)
                # The summary is trusted when whole; a partial reading trusts nothing.
                if partial or not self._use_summary(file, size):
                    self._scan(file, size)
        except OSError as error:
            raise InputError(f'cannot read {path}: {error.strerror}') from error
        if not partial:
            self._refuse_damage()

    def _refuse_damage(self) -> None:
        if self.damage is not None:
            raise InputError(f'{self.path} is damaged {self.damage}; use --partial to take what '
                             'it still holds')

    def _check_magic(self, file: BinaryIO, size: int) -> None:
        if size == 0:
            raise InputError(f'{self.path} is empty (0 bytes)')
        file.seek(0)
        head = file.read(64)
        if not head.startswith(MAGIC):
            raise InputError(f'{self.path} is not an MCAP file: {kind_of_foreign(head)}')

    def _use_summary(self, file: BinaryIO, size: int) -> bool:
        """Take channels and chunks from the summary; False when that cannot be done."""
        if size < len(MAGIC) + FOOTER_LENGTH:
            return False
        file.seek(size - FOOTER_LENGTH)
        footer = file.read(FOOTER_LENGTH)
        start = int.from_bytes(footer[9:17], 'little')
        stated = int.from_bytes(footer[25:29], 'little')
        whole = (footer.startswith(RECORD_HEAD.pack(Op.FOOTER, 20)) and footer.endswith(MAGIC)
                 and len(MAGIC) < start < size)
        if not whole:
            return False
        file.seek(start)
        if stated and zlib.crc32(file.read(size - start - len(MAGIC) - 4)) != stated:
            self.notes.append(f'The summary of {self.path.name} is damaged from byte {start}: '
                              'the whole file was scanned.')
            return False
        file.seek(0)
        try:
            summary = self._codec.summary(file)
        # The library lets every kind of error through; each means the same here.
        except Exception as error:
            self.notes.append(f'The summary of {self.path.name} cannot be read ({error}): '
                              'the whole file was scanned.')
            return False
        if summary is None or summary.statistics is None:
            return False
        if summary.statistics.message_count and not summary.chunk_indexes:
            return False
        for index in summary.chunk_indexes:
            if index.chunk_start_offset + index.chunk_length > size:
                return False
        self._schemas.update(summary.schemas)
        for channel in summary.channels.values():
            self._add_channel(channel)
        counts = summary.statistics.channel_message_counts
        self.counts = {key: counts.get(key, 0) for key in self.topics}
        # Chunks without messages have no index; files written without any index
        # do not say which chunks those are.
        indexed = any(index.message_index_offsets for index in summary.chunk_indexes)
        self.spans = [
            Span(index.message_start_time, index.message_end_time,
                 index.chunk_start_offset + RECORD_HEAD.size,
                 index.chunk_length - RECORD_HEAD.size, True,
                 frozenset(index.message_index_offsets) or None)
            for index in summary.chunk_indexes if index.message_index_offsets or not indexed]
        self.start_ns = summary.statistics.message_start_time
        self.end_ns = summary.statistics.message_end_time
        return True

    def _scan(self, file: BinaryIO, size: int) -> None:
        """Read the whole file once, noting where its messages are and where it breaks."""
        run: list[Record] = []
        in_data = True
        try:
            for record in walk(file, len(MAGIC), size):
                if record.opcode == Op.MESSAGE and (
                        not run or record.end - run[0].offset < RUN_SIZE):
                    run.append(record)
                    continue
                self._close_run(file, run)
                run = [record] if record.opcode == Op.MESSAGE else []
                if record.opcode == Op.CHUNK:
                    self._scan_span(file, record.content, record.length, True)
                elif record.opcode == Op.DATA_END:
                    # What follows repeats schemas and channels for the summary.
                    in_data = False
                elif record.opcode in (Op.SCHEMA, Op.CHANNEL) and in_data:
                    self._scan_span(file, record.offset, record.end - record.offset, False)
                elif record.opcode == Op.FOOTER:
                    file.seek(record.end)
                    if file.read(len(MAGIC)) != MAGIC:
                        raise Damage(record.end, 'the file ends without its closing mark')
        except Damage as error:
            self._close_run(file, run)
            self.damage = self.damage or str(error)
        if self.spans:
            self.start_ns = min(span.start_ns for span in self.spans)
            self.end_ns = max(span.end_ns for span in self.spans)

    def _close_run(self, file: BinaryIO, run: list[Record]) -> None:
        if run:
            self._scan_span(file, run[0].offset, run[-1].end - run[0].offset, False)

    def _scan_span(self, file: BinaryIO, offset: int, length: int, chunk: bool) -> None:
        """Count the messages of one chunk or run, and learn its channels."""
        try:
            data = self._span_data(file, Span(0, 0, offset, length, chunk))
            times: list[int] = []
            channels: set[int] = set()
            for opcode, begin, end in inner_records(data):
                if opcode == Op.MESSAGE:
                    channel, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, begin)
                    if channel in self.topics:
                        times.append(log_time)
                        channels.add(channel)
                        self.counts[channel] = self.counts.get(channel, 0) + 1
                elif opcode in (Op.SCHEMA, Op.CHANNEL):
                    self._learn(opcode, data[begin:end], offset)
            if times:
                self.spans.append(Span(
                    min(times), max(times), offset, length, chunk, frozenset(channels)))
        except Damage as error:
            # The frame around a bad chunk is whole: what comes after may be good.
            where = error if not chunk else Damage(offset, f'the chunk there is broken ({error})')
            self.damage = self.damage or str(where)

    def _learn(self, opcode: int, content: bytes, offset: int) -> None:
        try:
            if opcode == Op.SCHEMA:
                schema = self._codec.schema(content)
                self._schemas[schema.id] = schema
            else:
                self._add_channel(self._codec.channel(content))
        except Exception as error:
            raise Damage(offset, f'a schema or channel cannot be read ({error!r})') from error

    def _add_channel(self, channel: Any) -> None:
        if channel.id in self.topics or channel.id in self._skipped:
            return
        schema = self._schemas.get(channel.schema_id)
        encoding = 'none' if schema is None else schema.encoding
        if schema is None or channel.message_encoding != 'cdr' or encoding != 'ros2msg':
            self._skipped.add(channel.id)
            self.notes.append(
                f"Topic '{channel.topic}' was left out: it is not ROS 2 (messages "
                f"'{channel.message_encoding}', schema '{encoding}').")
            return
        self.topics[channel.id] = TopicRecord(
            channel.topic, schema.name, schema, channel.metadata.get('offered_qos_profiles', ''),
            _rate(channel.metadata.get(SAMPLE_RATE)))

    def read(self, span: Span, wanted: set[str]) -> list[RawMessage]:
        """Return the messages of a span in file order."""
        found: list[RawMessage] = []
        channels = {key: (topic.name, topic.type) for key, topic in self.topics.items()
                    if topic.name in wanted}
        try:
            with self.path.open('rb') as file:
                data = self._span_data(file, span)
            for opcode, begin, end in inner_records(data):
                if opcode == Op.MESSAGE:
                    channel, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, begin)
                    if channel in channels:
                        name, kind = channels[channel]
                        found.append(RawMessage(
                            name, kind, log_time, data[begin + MESSAGE_HEAD.size:end]))
        except OSError as error:
            raise InputError(f'cannot read {self.path}: {error.strerror}') from error
        except Damage as error:
            raise InputError(
                f'{self.path} is damaged at byte {span.offset}: the chunk there is broken '
                f'({error}); use --partial to take what it still holds') from error
        return found

    def _span_data(self, file: BinaryIO, span: Span) -> bytes:
        """Return the records of a span, unpacked and with its checksum verified."""
        file.seek(span.offset)
        content = file.read(span.length)
        if not span.chunk:
            return content
        try:
            return self._codec.unpack(content)
        # zstd, lz4, checksum, short data: the library lets each kind through.
        except Exception as error:
            raise Damage(span.offset, str(error) or type(error).__name__) from error


def in_time_order(files: Iterable[McapFile], wanted: set[str]) -> Iterator[RawMessage]:
    """
    Yield the messages of several files in the order of their log times.

    Holds in memory only spans that overlap in time.

    Parameters
    ----------
    files : iterable of McapFile
        Parts of one bag.
    wanted : set of str
        Topics to yield.

    Yields
    ------
    RawMessage
        Messages; those of one log time in the order of the file.

    Raises
    ------
    InputError
        At a broken chunk.

    """
    spans: list[tuple[Span, McapFile]] = []
    for file in files:
        channels = {key for key, topic in file.topics.items() if topic.name in wanted}
        spans += [(span, file) for span in file.spans
                  if span.channels is None or span.channels & channels]
    spans.sort(key=lambda pair: pair[0].start_ns)
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
