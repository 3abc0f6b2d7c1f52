"""
One .mcap file: indexed by its summary or by a walk, and read span by span.

Knows the frame and what a damaged one still holds; the contents of records are
left to the MCAP library, reached through a `Codec` (`bag_reader.py` has the only
one).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
import zlib

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.recordings.framing import (
    check_passed_over, Damage, FOOTER_LENGTH, inner_records, kind_of_foreign, MAGIC, MESSAGE_HEAD,
    moment, Op, record_at, RECORD_HEAD, Span)
from ou_monitor.recordings.mcap_index import Break, Codec, McapIndex, TopicRecord
from ou_monitor.recordings.mcap_scan import scan
from ou_monitor.recordings.record_table import find_by_index, find_messages, Table


class RawMessage(NamedTuple):
    """One message as recorded; `data` is CDR, `log_time_ns` in ns."""

    topic: str
    type: str  # noqa: A003
    log_time_ns: int
    data: bytes


class McapFile(McapIndex):
    """
    One .mcap file: its channels, and where its messages are (see `McapIndex`).

    Parameters
    ----------
    path : pathlib.Path
        The file.
    partial : bool
        Whether the whole file is walked for damage, whatever its summary says.
    codec : Codec
        Reader of the contents of records.

    Attributes
    ----------
    origin_ns : int
        Where the time of the recording counts from, ns: the first message of
        the bag that the file belongs to.

    Raises
    ------
    InputError
        When it is missing, empty or foreign.

    """

    def __init__(self, path: Path, partial: bool, codec: Codec) -> None:
        """Index the file."""
        super().__init__(path, codec)
        try:
            with path.open('rb') as file:
                size = file.seek(0, os.SEEK_END)
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
        if found.after_ns is None:
            return f'{found.why} (before the first message)'
        return f'{found.why} ({moment(found.after_ns, self.origin_ns)})'

    @property
    def damage(self) -> str | None:
        """Where the file is damaged, in words; None when it is not."""
        if not self.breaks:
            return None
        rest = len(self.breaks) - 1
        more = '' if not rest else (
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
                 and len(MAGIC) < start < size)
        if not whole:
            return None
        file.seek(start)
        if stated and zlib.crc32(file.read(size - start - len(MAGIC) - 4)) != stated:
            self.notes.append(f'The summary of {self.path.name} is damaged from byte {start}: '
                              'the whole file was scanned.')
            return None
        file.seek(0)
        try:
            return self._codec.summary(file)
        # The library lets every kind of error through; each means the same here.
        except Exception as error:
            self.notes.append(f'The summary of {self.path.name} cannot be read ({error}): '
                              'the whole file was scanned.')
            return None

    def _use_summary(self, summary: Any, size: int) -> bool:
        """Take channels and chunks from the summary; False when that cannot be done."""
        if summary.statistics is None:
            return False
        if summary.statistics.message_count and not summary.chunk_indexes:
            return False
        for index in summary.chunk_indexes:
            if index.chunk_start_offset + index.chunk_length > size:
                return False
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
                 min(index.message_index_length,
                     size - index.chunk_start_offset - index.chunk_length))
            for index in summary.chunk_indexes if index.message_index_offsets or not indexed]
        self.start_ns = summary.statistics.message_start_time
        self.end_ns = summary.statistics.message_end_time
        return True

    def _read_about(self, file: BinaryIO, summary: Any, size: int) -> None:
        """Read the metadata records that the summary lists; a broken one is noted."""
        for index in summary.metadata_indexes:
            try:
                record = record_at(file, index.offset, size, True)
                check_passed_over(file, record)
                file.seek(record.content)
                self.learn_about(file.read(record.length), record.offset)
            except Damage as error:
                self.notes.append(f'Metadata of {self.path.name} cannot be read ({error}).')

    def channels_of(self, wanted: set[str]) -> dict[int, TopicRecord]:
        """Return the channels of some topics."""
        return {key: topic for key, topic in self.topics.items() if topic.name in wanted}

    def read(self, span: Span, wanted: set[str]) -> list[RawMessage]:
        """Return the messages of a span in file order."""
        found: list[RawMessage] = []
        channels = {key: (topic.name, topic.type)
                    for key, topic in self.channels_of(wanted).items()}
        try:
            with self.path.open('rb') as file:
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
            with self.path.open('rb') as file:
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
        for key, topic in self.channels_of(wanted).items():
            mine = table.channel == key
            # Two publishers of one topic are two channels.
            topics[topic.name] = topics.get(topic.name, False) | mine
        found = {name: table.where(mine) for name, mine in topics.items()}
        return {name: part for name, part in found.items() if part.n}

    def _refusal(self, span: Span, error: Damage) -> InputError:
        """Return the error for a chunk that turned out to be broken."""
        found = Break(span.offset, f'at byte {span.offset}: the chunk there is broken '
                      f'({error.why})', span.start_ns)
        return InputError(f'{self.path} is damaged {self.where(found)}; use --partial to take '
                          'what it still holds')
