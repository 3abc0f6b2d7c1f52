"""
The index of one .mcap file: its channels, where its messages are, and what is broken.

`McapIndex` is filled from the summary of the file (`mcap_file.py`) or by `scan`, which
walks the whole file.  Limits of the walk: in a file without checksums a wrong byte
within a message cannot be told from a right one; a lost message is missed only where
the summary counts the messages, or where the walk stumbles.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from pathlib import Path
from typing import Any, BinaryIO, Protocol
import zlib

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.mcap_records import (
    check_passed_over, Damage, find_messages, MAGIC, Op, PRIVATE, Record, record_at, Span, Table)
from ou_monitor.recordings.rosbag2_metadata import custom_data, MOST_BYTES, MOST_NODES, plain_texts
from ou_monitor.stream.files import parse_yaml

# Where a channel's metadata holds the rate of the samples within a block, Hz.
SAMPLE_RATE = 'sample_rate_hz'
# Names of the metadata records that say where the recording came from: that of
# `BagWriter`, and that of rosbag2, which holds the text of its metadata.yaml.
ABOUT, ROSBAG2 = 'ou_monitor', 'rosbag2'
# What the keys begin with that say where the values of a channel came from.
ORIGIN = 'origin.'

# Unchunked files are read in runs of about this size.
RUN_SIZE = 1024 * 1024  # bytes


class Codec(Protocol):
    """Reads the contents of records; any exception means that they are damaged."""

    def unpack(self, chunk: bytes) -> bytes:
        """Return the records in a chunk, its checksum verified."""

    def schema(self, content: bytes) -> Any:
        """Return a schema with `id`, `name`, `encoding`, `data`."""

    def channel(self, content: bytes) -> Any:
        """Return a channel with `id`, `topic`, `schema_id`, `message_encoding`, `metadata`."""

    def metadata(self, content: bytes) -> Any:
        """Return a metadata record with `name` and `metadata`, a dict of str to str."""

    def summary(self, file: BinaryIO) -> Any:
        """Return the summary section, or None."""


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
    origin: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Break:
    """
    One place where a file is damaged.

    Attributes
    ----------
    offset : int
        Byte of the file where the damage begins.
    why : str
        ``at byte N: reason``.
    after_ns : int or None
        Log time of the newest message before it, ns; None when there is none.

    """

    offset: int
    why: str
    after_ns: int | None


class McapIndex:
    """
    What is known of one .mcap file.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    codec : Codec
        Reader of the contents of records.

    Attributes
    ----------
    topics : dict of int to TopicRecord
        Channels of ROS 2 messages.
    skipped : set of int
        Other channels.
    schemas : dict of int to schema
        Definitions by their numbers.
    counts : dict of int to int
        Messages of each channel in `topics`.
    spans : list of Span
        Where they are.
    breaks : list of Break
        Damage, in the order of the file; what is outside of it is in `spans`.
    about : dict of str to str
        What its metadata records say of the recording.
    notes : list of str
        Topics left out, and the like.
    start_ns, end_ns : int
        Log times of the first and last message, ns.

    """

    def __init__(self, path: Path, codec: Codec) -> None:
        """Start with nothing known."""
        self.path = path
        self.topics: dict[int, TopicRecord] = {}
        self.skipped: set[int] = set()
        self.schemas: dict[int, Any] = {}
        self.counts: dict[int, int] = {}
        self.spans: list[Span] = []
        self.breaks: list[Break] = []
        self.about: dict[str, str] = {}
        self.notes: list[str] = []
        self.start_ns = self.end_ns = 0
        self._codec = codec

    def note_damage(self, error: Damage) -> None:
        """Note a damage, and the newest message before it."""
        newest = max((span.end_ns for span in self.spans if span.offset <= error.offset),
                     default=None)
        self.breaks.append(Break(error.offset, str(error), newest))
        self.breaks.sort(key=lambda found: found.offset)

    def learn(self, opcode: int, content: bytes, offset: int) -> None:
        """Take a schema or channel record; Damage when it cannot be read."""
        try:
            if opcode == Op.SCHEMA:
                schema = self._codec.schema(content)
                self.schemas[schema.id] = schema
            else:
                self.add_channel(self._codec.channel(content))
        except Exception as error:
            raise Damage(offset, f'a schema or channel cannot be read ({error!r})') from error

    def learn_about(self, content: bytes, offset: int) -> None:
        """Take a metadata record; Damage when it cannot be read."""
        try:
            record = self._codec.metadata(content)
        except Exception as error:
            raise Damage(offset, f'a metadata record cannot be read ({error!r})') from error
        if record.name == ABOUT:
            self.about |= plain_texts(record.metadata)
        elif record.name == ROSBAG2:
            try:
                table = parse_yaml(record.metadata.get('serialized_metadata', ''), ROSBAG2,
                                   most_bytes=MOST_BYTES, most_nodes=MOST_NODES)
            except InputError:
                # A table nobody can read is no reason to refuse the messages.
                return
            self.about |= custom_data(table)

    def add_channel(self, channel: Any) -> None:
        """Take a channel, once."""
        if channel.id in self.topics or channel.id in self.skipped:
            return
        schema = self.schemas.get(channel.schema_id)
        encoding = 'none' if schema is None else schema.encoding
        if schema is None or channel.message_encoding != 'cdr' or encoding != 'ros2msg':
            self.skipped.add(channel.id)
            self.notes.append(
                f"Topic '{channel.topic}' was left out: it is not ROS 2 (messages "
                f"'{channel.message_encoding}', schema '{encoding}').")
            return
        self.topics[channel.id] = TopicRecord(
            channel.topic, schema.name, schema, channel.metadata.get('offered_qos_profiles', ''),
            _rate(channel.metadata.get(SAMPLE_RATE)),
            {key.removeprefix(ORIGIN): value for key, value in channel.metadata.items()
             if key.startswith(ORIGIN)})

    def span_data(self, file: BinaryIO, span: Span) -> bytes:
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


def scan(index: McapIndex, file: BinaryIO, size: int, summary: Any) -> None:
    """Fill an index by reading the whole file once (size in bytes)."""
    _Scan(index, file, size, summary).run()


class _Scan:
    """One walk."""

    def __init__(self, index: McapIndex, file: BinaryIO, size: int, summary: Any) -> None:
        self._index = index
        self._file = file
        self._size = size
        self._summary = summary
        self._private: list[Record] = []

    def run(self) -> None:
        """Read the whole file once, noting where its messages are and where it breaks."""
        summary = self._summary
        starts = [] if summary is None else sorted(
            index.chunk_start_offset for index in summary.chunk_indexes)
        starts.insert(0, len(MAGIC))
        while starts:
            at = starts[0]
            try:
                self._scan_from(at)
                break
            except Damage as error:
                self._index.note_damage(error)
                # Where the summary is whole it tells where the next chunk begins.
                starts = [start for start in starts if start > max(at, error.offset)]
        if self._index.spans:
            self._index.start_ns = min(span.start_ns for span in self._index.spans)
            self._index.end_ns = max(span.end_ns for span in self._index.spans)
        if self._index.breaks or summary is None or summary.statistics is None:
            # Nothing says that these were not messages once.
            for record in self._private:
                self._index.note_damage(Damage(
                    record.offset, f'a record of a private kind (0x{record.opcode:02x}, '
                    f'{record.length} bytes), and no count of the messages to tell that none is '
                    'missing'))
        else:
            self._compare_counts(summary)

    def _compare_counts(self, summary: Any) -> None:
        """Note when other messages were found than the summary counts."""
        for key, stated in summary.statistics.channel_message_counts.items():
            found = self._index.counts.get(key, 0)
            if key not in self._index.skipped and found != stated:
                self._index.note_damage(Damage(
                    len(MAGIC), f'somewhere before byte {self._size} messages were changed: the '
                    f'summary counts {stated} of channel {key}, {found} were found'))
                return

    def _scan_from(self, at: int) -> None:
        """Walk the records from an offset to the footer."""
        in_data = True
        while True:
            record = record_at(self._file, at, self._size, in_data)
            at = record.end
            if record.opcode == Op.MESSAGE:
                at = self._scan_run(record)
            elif record.opcode == Op.CHUNK:
                self._scan_chunk(record)
            elif record.opcode == Op.DATA_END:
                # What follows repeats schemas and channels for the summary.
                in_data = False
                self._check_data(record)
            elif record.opcode in (Op.SCHEMA, Op.CHANNEL):
                if in_data:
                    self._scan_definition(record)
            elif record.opcode == Op.FOOTER:
                self._file.seek(record.end)
                if self._file.read(len(MAGIC)) != MAGIC:
                    raise Damage(record.end, 'the file ends without its closing mark')
                end = record.end + len(MAGIC)
                if end < self._size:
                    raise Damage(end, f'{self._size - end} bytes follow the end of the recording, '
                                 'which may be another one')
                return
            elif record.opcode >= PRIVATE:
                self._private.append(record)
                self._index.notes.append(
                    f'A record of a private kind (0x{record.opcode:02x}, {record.length} bytes) '
                    f'at byte {record.offset} of {self._index.path.name} was passed over.')
            else:
                check_passed_over(self._file, record)
                if record.opcode == Op.METADATA:
                    self._file.seek(record.content)
                    self._index.learn_about(self._file.read(record.length), record.offset)
                elif (record.opcode == Op.MESSAGE_INDEX and self._index.spans
                        and self._index.spans[-1].chunk):
                    self._add_index(record)

    def _scan_definition(self, record: Record) -> None:
        """Learn a schema or channel; a broken one does not stop the walk."""
        self._file.seek(record.content)
        try:
            self._index.learn(record.opcode, self._file.read(record.length), record.offset)
        except Damage as error:
            self._index.note_damage(error)
            self._fill_schemas()

    def _fill_schemas(self) -> None:
        """Take schemas that may have been in a broken record from the summary."""
        if self._summary is not None:
            for key, schema in self._summary.schemas.items():
                self._index.schemas.setdefault(key, schema)

    def _add_index(self, record: Record) -> None:
        """Count a message index to the chunk right before it."""
        last = self._index.spans[-1]
        if last.offset + last.length + last.index_length == record.offset:
            self._index.spans[-1] = Span(
                last.start_ns, last.end_ns, last.offset, last.length, True, last.channels,
                last.index_length + record.end - record.offset)

    def _check_data(self, record: Record) -> None:
        """Check the checksum of all that is before the end of the data, if it has one."""
        self._file.seek(record.content)
        stated = int.from_bytes(self._file.read(4), 'little')
        if not stated or self._index.breaks:
            return
        self._file.seek(0)
        left, found = record.offset, 0
        while left:
            block = self._file.read(min(RUN_SIZE, left))
            found = zlib.crc32(block, found)
            left -= len(block)
        if found != stated:
            self._index.note_damage(Damage(
                len(MAGIC), f'the checksum of the data up to byte {record.offset} is not that '
                'of the file: something in it was changed'))

    def _scan_run(self, first: Record) -> int:
        """Count plain messages from a record on; return the offset behind them."""
        self._file.seek(first.offset)
        data = self._file.read(max(first.end - first.offset, RUN_SIZE))
        table, _, length = find_messages(data, messages_only=True)
        if not table.n:
            raise Damage(first.offset, 'a message is shorter than its own head')
        k = self._first_strange(table)
        if k is not None:
            # What comes before it is taken, and what comes after it, as another run.
            length = int(table.end[k - 1]) if k else 0
            self._add_span(table.first(k), Span(0, 0, first.offset, length, False))
            self._index.note_damage(self._undefined(first.offset + length, int(table.channel[k])))
            return first.offset + int(table.end[k])
        self._add_span(table, Span(0, 0, first.offset, length, False))
        return first.offset + length

    def _first_strange(self, table: Table) -> int | None:
        """Return the first message of a channel that the file does not define."""
        strange = [key for key in _count(table) if not self._known(key)]
        return int(np.argmax(np.isin(table.channel, strange))) if strange else None

    def _known(self, key: int) -> bool:
        """Whether a channel is defined: before, or, if that was in a broken chunk, after."""
        index, summary = self._index, self._summary
        if key not in index.topics and summary is not None and key in summary.channels:
            self._fill_schemas()
            index.add_channel(summary.channels[key])
        return key in index.topics or key in index.skipped

    def _undefined(self, offset: int, channel: int) -> Damage:
        return Damage(offset, f'a message of channel {channel}, which is not defined')

    def _scan_chunk(self, record: Record) -> None:
        """Count the messages of one chunk, and learn its channels."""
        span = Span(0, 0, record.content, record.length, True)
        try:
            data = self._index.span_data(self._file, span)
            table, others, _ = find_messages(data)
            for opcode, begin, end in others:
                if opcode in (Op.SCHEMA, Op.CHANNEL):
                    self._index.learn(opcode, data[begin:end], record.content)
            k = self._first_strange(table)
            if k is not None:
                raise self._undefined(record.content, int(table.channel[k]))
            self._add_span(table, span)
        except Damage as error:
            # The frame around a bad chunk is whole: what comes after may be good.
            self._index.note_damage(Damage(
                record.content, f'the chunk there is broken ({error.why})'))

    def _add_span(self, table: Table, span: Span) -> None:
        """Add the messages of a span to what is known."""
        found = {key: n for key, n in _count(table).items() if key in self._index.topics}
        if not found:
            return
        for key, n in found.items():
            self._index.counts[key] = self._index.counts.get(key, 0) + n
        read = frozenset(found)
        times = table.log_time
        if self._index.skipped:
            times = times[np.isin(table.channel, list(read))]
        self._index.spans.append(Span(
            int(times.min()), int(times.max()), span.offset, span.length, span.chunk, read))


def _count(table: Table) -> dict[int, int]:
    """Return the number of messages of each channel that has any."""
    counts = np.bincount(table.channel)
    return {key: int(counts[key]) for key in np.nonzero(counts)[0].tolist()}
