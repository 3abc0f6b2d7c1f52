"""
One .mcap file, read span by span, and the messages of several in the order of log times.

Knows the frame and what a damaged file still holds; the contents of records are left
to the MCAP library, reached through a `Codec` (`bag_reader.py` has the only one).
Memory holds only the chunks that overlap in time.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
import os
from pathlib import Path
import shlex
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.recordings.limits import chunk_limit, file_limit, MOST_METADATA, over_limit
from ou_monitor.recordings.mcap_index import Break, Codec, McapIndex, MOST_BREAKS, TopicRecord
from ou_monitor.recordings.mcap_records import (
    check_passed_over, crc_of, Damage, find_by_index, find_messages, FOOTER_LENGTH, inner_records,
    MAGIC, MESSAGE_HEAD, moment, Op, record_at, RECORD_HEAD, Span, Table)
from ou_monitor.recordings.mcap_scan import scan
from ou_monitor.stream.files import open_regular, path_words
from ou_monitor.text import printable

# First bytes of the logs that `ou-monitor convert` reads; CSV is read as it is.
_LOGS = (
    (b'ULog', 'a PX4 ULog'), (b'\xa3\x95\x80', 'an ArduPilot dataflash log'),
    (b'FMT,', 'an ArduPilot log'), (b'H Product:Blackbox', 'a blackbox log'))


# Of more channels only those in a chunk are looked for.
_FEW_CHANNELS = 8


class RawMessage(NamedTuple):
    """One message as recorded; `data` is CDR, `log_time_ns` in ns."""

    topic: str
    type: str  # noqa: A003
    log_time_ns: int
    data: bytes


class McapFile(McapIndex):
    """
    One .mcap file: its channels, and where its messages are (see `McapIndex`).

    `partial`: the whole file is walked for damage, whatever its summary says; `max_chunk`: bytes
    that a chunk may unpack to, else as of `chunk_limit`; `origin_ns`: first message of the bag.
    InputError when it is missing, empty or foreign.
    """

    def __init__(self, path: Path, partial: bool, codec: Codec,
                 max_chunk: int | None = None) -> None:
        """Index the file."""
        super().__init__(path, codec)
        try:
            with open_regular(path) as file:
                size = file.seek(0, os.SEEK_END)
                self.chunk_limit = chunk_limit(size, max_chunk)
                self.file_limit = file_limit(size, self.chunk_limit)
                self._check_magic(file, size)
                summary = self._read_summary(file, size)
                # The summary is trusted when whole; a partial reading trusts nothing.
                if partial or summary is None or not self._use_summary(summary, size):
                    scan(self, file, size, summary)
                else:
                    self._read_about(file, summary, size)
        except OSError as error:
            raise InputError(f'cannot read {path}: {error.strerror}') from error
        self.origin_ns = self.start_ns

    def where(self, found: Break) -> str:
        """Return the byte, the reason and the time of a damage in words."""
        newest = max((span.end_ns for span in self.spans if span.offset <= found.offset),
                     default=None)
        return self._when(found.why, newest)

    def _when(self, why: str, after_ns: int | None) -> str:
        if after_ns is None:
            return f'{why} (before the first message)'
        return f'{why} ({moment(after_ns, self.origin_ns)})'

    @property
    def damage(self) -> str | None:
        """Where the file is damaged, in words; None when it is not."""
        if not self.breaks:
            return None
        rest = len(self.breaks) - 1
        more = '' if not rest else (
            f'; and at {rest} more places, where the search was given up'
            if rest + 1 >= MOST_BREAKS else
            f'; and at {rest} more place{"s" * (rest > 1)}, the last at byte '
            f'{self.breaks[-1].offset}')
        return self.where(self.breaks[0]) + more

    def _check_magic(self, file: BinaryIO, size: int) -> None:
        if size == 0:
            raise InputError(f'{self.path} is empty (0 bytes)')
        file.seek(0)
        head = file.read(64)
        if not head.startswith(MAGIC):
            raise InputError(
                f'{self.path} is not an MCAP file: {kind_of_foreign(head, self.path)}')

    def _read_summary(self, file: BinaryIO, size: int) -> Any:
        """Return the summary section when it is whole, else None."""
        if size < len(MAGIC) + FOOTER_LENGTH:
            return None
        file.seek(size - FOOTER_LENGTH)
        footer = file.read(FOOTER_LENGTH)
        start = int.from_bytes(footer[9:17], 'little')
        stated = int.from_bytes(footer[25:29], 'little')
        whole = (footer.startswith(RECORD_HEAD.pack(Op.FOOTER, 20)) and footer.endswith(MAGIC)
                 and len(MAGIC) < start < size and size - start <= self.chunk_limit)
        if not whole:
            return None
        file.seek(start)
        if stated and crc_of(file, size - start - len(MAGIC) - 4) != stated:
            self.notes.append(f'The summary of {self.path.name} is damaged from byte {start}: '
                              'the whole file was scanned.')
            return None
        file.seek(0)
        try:
            return self._codec.summary(file)
        # The library lets every kind of error through; each means the same here.
        except Exception as error:
            self.notes.append(f'The summary of {self.path.name} cannot be read '
                              f'({printable(error, 200)}): the whole file was scanned.')
            return None

    def _use_summary(self, summary: Any, size: int) -> bool:
        """Take channels and chunks from the summary; False when that cannot be done."""
        if summary.statistics is None:
            return False
        if summary.statistics.message_count and not summary.chunk_indexes:
            return False
        indexes = sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
        end, unpacked = len(MAGIC), 0
        for index in indexes:
            # A chunk that is listed twice, or within another, would be read twice.
            if index.chunk_start_offset < end or index.chunk_length < RECORD_HEAD.size:
                return False
            end = index.chunk_start_offset + index.chunk_length
            unpacked += index.uncompressed_size
        if end > size:
            return False
        if unpacked > self.file_limit:
            raise InputError(f'{path_words(self.path)}: ' + over_limit(
                'its chunks hold', unpacked, self.file_limit))
        self.schemas.update(summary.schemas)
        for channel in summary.channels.values():
            self.add_channel(channel)
        counts = summary.statistics.channel_message_counts
        self.counts = {key: counts.get(key, 0) for key in self.topics}
        # Chunks without messages have no index; files written without any index
        # do not say which chunks those are.
        indexed = any(index.message_index_offsets for index in summary.chunk_indexes)
        self.spans = [
            Span(index.message_start_time, index.message_end_time,
                 index.chunk_start_offset + RECORD_HEAD.size,
                 index.chunk_length - RECORD_HEAD.size, True,
                 frozenset(index.message_index_offsets) or None,
                 # A message of 31 bytes or more has 16 in the index, beside its head.
                 min(index.message_index_length, index.uncompressed_size + 15 * 65536,
                     size - index.chunk_start_offset - index.chunk_length),
                 index.uncompressed_size)
            for index in summary.chunk_indexes if index.message_index_offsets or not indexed]
        self.start_ns = summary.statistics.message_start_time
        self.end_ns = summary.statistics.message_end_time
        return True

    def _read_about(self, file: BinaryIO, summary: Any, size: int) -> None:
        """Read the metadata records that the summary lists; a broken one is noted."""
        left = 2 * MOST_METADATA
        for index in summary.metadata_indexes:
            try:
                record = record_at(file, index.offset, size, True)
                check_passed_over(file, record)
                left -= record.end - record.offset
                if left < 0:
                    raise Damage(record.offset, 'the metadata records before it are too many')
                file.seek(record.content)
                self.learn_about(file.read(record.length), record.offset)
            except Damage as error:
                self.notes.append(f'Metadata of {printable(self.path.name)} cannot be read '
                                  f'({error}).')
                break

    def channels_of(self, wanted: set[str]) -> dict[int, TopicRecord]:
        """Return the channels of some topics."""
        return {key: topic for key, topic in self.topics.items() if topic.name in wanted}

    def read(self, span: Span, wanted: set[str]) -> list[RawMessage]:
        """Return the messages of a span in file order."""
        found: list[RawMessage] = []
        channels = {key: (topic.name, topic.type)
                    for key, topic in self.channels_of(wanted).items()}
        try:
            with open_regular(self.path) as file:
                data = self.span_data(file, span)
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
            raise self._refusal(span, error) from error
        return found

    def tables(self, span: Span, wanted: set[str]) -> dict[str, Table]:
        """Return where the messages of a span are, by topic, in file order."""
        try:
            with open_regular(self.path) as file:
                data = self.span_data(file, span)
                file.seek(span.offset + span.length)
                index = file.read(span.index_length)
            table = find_by_index(data, index) if index else None
            if table is None:
                table, _, _ = find_messages(data)
        except OSError as error:
            raise InputError(f'cannot read {self.path}: {error.strerror}') from error
        except Damage as error:
            raise self._refusal(span, error) from error
        topics: dict[str, npt.NDArray[np.bool_]] = {}
        channels = self.channels_of(wanted)
        if len(channels) > _FEW_CHANNELS:
            there = np.unique(table.channel).tolist()
            channels = {key: channels[key] for key in there if key in channels}
        for key, topic in channels.items():
            mine = table.channel == key
            # Two publishers of one topic are two channels.
            topics[topic.name] = topics.get(topic.name, False) | mine
        found = {name: table.where(mine) for name, mine in topics.items()}
        return {name: part for name, part in found.items() if part.n}

    def _refusal(self, span: Span, error: Damage) -> InputError:
        """Return the error for a chunk that turned out to be broken."""
        why = self._when(f'at byte {span.offset}: the chunk there is broken ({error.why})',
                         span.start_ns)
        return InputError(f'{self.path} is damaged {why}; use --partial to take what it still '
                          'holds')


class Part(NamedTuple):
    """
    The messages of one chunk or run.

    Attributes
    ----------
    tables : dict of str to Table
        Topic -> its messages, in the order of the file.
    later_ns : int or None
        Log time that no message of a later part is before, ns; None after the
        last part.
    done : float
        Share of the bytes to be read that are read, 0..1.

    """

    tables: dict[str, Table]
    later_ns: int | None
    done: float


def _spans(files: Iterable[McapFile], wanted: set[str]) -> list[tuple[Span, McapFile]]:
    """Return where the wanted topics are, in the order of the first log times."""
    spans: list[tuple[Span, McapFile]] = []
    for file in files:
        channels = set(file.channels_of(wanted))
        spans += [(span, file) for span in file.spans
                  if span.channels is None or span.channels & channels]
    return sorted(spans, key=lambda pair: pair[0].start_ns)


def in_parts(
    files: Iterable[McapFile], wanted: set[str], start_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[Part]:
    """Yield the messages of several files part by part."""
    spans = [(span, file) for span, file in _spans(files, wanted)
             if (start_ns is None or span.end_ns >= start_ns)
             and (end_ns is None or span.start_ns < end_ns)]
    total = sum(span.length for span, _ in spans)
    read = 0
    for place, (span, file) in enumerate(spans):
        tables = file.tables(span, wanted)
        if start_ns is not None and span.start_ns < start_ns:
            tables = _cut(tables, lambda table: table.log_time >= np.uint64(start_ns))
        if end_ns is not None and span.end_ns >= end_ns:
            tables = _cut(tables, lambda table: table.log_time < np.uint64(end_ns))
        read += span.length
        later = None if place + 1 == len(spans) else spans[place + 1][0].start_ns
        yield Part(tables, later, read / total)


def _cut(
    tables: dict[str, Table], inside: Callable[[Table], npt.NDArray[np.bool_]],
) -> dict[str, Table]:
    """Return what is inside of each table, and only tables that hold something."""
    parts = {name: table.where(inside(table)) for name, table in tables.items()}
    return {name: table for name, table in parts.items() if table.n}


def backwards(
    files: Iterable[McapFile], wanted: set[str], before_ns: int,
) -> Iterator[tuple[Table, int]]:
    """
    Yield the messages of a topic before a log time, the chunk that ends last first.

    before_ns in ns.
    """
    spans = [pair for pair in _spans(files, wanted) if pair[0].start_ns < before_ns]
    spans.sort(key=lambda pair: pair[0].end_ns, reverse=True)
    for place, (span, file) in enumerate(spans):
        older = spans[place + 1][0].end_ns if place + 1 < len(spans) else 0
        tables = _cut(file.tables(span, wanted),
                      lambda table: table.log_time < np.uint64(before_ns))
        yield from ((table, older) for table in tables.values())


def in_time_order(files: Iterable[McapFile], wanted: set[str]) -> Iterator[RawMessage]:
    """
    Yield the messages of several files in the order of their log times.

    Holds in memory only spans that overlap in time.
    """
    spans = _spans(files, wanted)
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
