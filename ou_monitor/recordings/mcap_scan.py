"""
Walk a whole .mcap file: where its messages are, and where it breaks.

Limits: in a file without checksums a wrong byte within a message cannot be told from a
right one; a lost message is missed only where the summary counts the messages, or where
the walk stumbles.
"""

from __future__ import annotations

import bisect
from dataclasses import replace
from typing import Any, BinaryIO

import numpy as np
from ou_monitor.recordings.limits import MOST_METADATA, over_limit
from ou_monitor.recordings.mcap_index import McapIndex, MOST_BREAKS, MOST_NOTES
from ou_monitor.recordings.mcap_records import (
    check_passed_over, crc_of, Damage, find_messages, MAGIC, Op, PRIVATE, Record, record_at, Span,
    Table)
from ou_monitor.text import printable

# Unchunked files are read in runs that grow to about this size.
RUN_SIZE = 1024 * 1024  # bytes
_FIRST_RUN = 16 * 1024


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
        self._run_size = _FIRST_RUN
        self._unpacked = 0

    def run(self) -> None:
        """Read the whole file once, noting where its messages are and where it breaks."""
        summary = self._summary
        starts = [] if summary is None else sorted(
            index.chunk_start_offset for index in summary.chunk_indexes)
        at: int | None = len(MAGIC)
        while at is not None and len(self._index.breaks) < MOST_BREAKS:
            try:
                self._scan_from(at)
                break
            except Damage as error:
                self._index.note_damage(error)
                # Where the summary is whole it tells where the next chunk begins.
                place = bisect.bisect_right(starts, max(at, error.offset))
                at = starts[place] if place < len(starts) else None
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
        while len(self._index.breaks) < MOST_BREAKS:
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
                self._pass_over(record)
            else:
                check_passed_over(self._file, record)
                if record.opcode == Op.METADATA:
                    self._index.learn_about(self._content(record, MOST_METADATA), record.offset)
                elif (record.opcode == Op.MESSAGE_INDEX and self._index.spans
                        and self._index.spans[-1].chunk):
                    self._add_index(record)

    def _pass_over(self, record: Record) -> None:
        """Note a record of a private kind, those after the first some no more."""
        if len(self._private) < MOST_NOTES:
            self._private.append(record)
            self._index.notes.append(
                f'A record of a private kind (0x{record.opcode:02x}, {record.length} bytes) '
                f'at byte {record.offset} of {printable(self._index.path.name)} was passed over.')

    def _scan_definition(self, record: Record) -> None:
        """Learn a schema or channel; a broken one does not stop the walk."""
        try:
            content = self._content(record, self._index.chunk_limit)
            self._index.learn(record.opcode, content, record.offset)
        except Damage as error:
            self._index.note_damage(error)
            self._fill_schemas()

    def _content(self, record: Record, limit: int) -> bytes:
        """Return the content of a record that is not longer than it may be."""
        if record.length > limit:
            raise Damage(record.offset, f'a record 0x{record.opcode:02x} of {record.length} bytes '
                         f'is longer than the {limit} that such a one may have')
        self._file.seek(record.content)
        return self._file.read(record.length)

    def _fill_schemas(self) -> None:
        """Take schemas that may have been in a broken record from the summary."""
        if self._summary is not None:
            for key, schema in self._summary.schemas.items():
                self._index.schemas.setdefault(key, schema)

    def _add_index(self, record: Record) -> None:
        """Count a message index to the chunk right before it."""
        last = self._index.spans[-1]
        if last.offset + last.length + last.index_length == record.offset:
            self._index.spans[-1] = replace(
                last, index_length=last.index_length + record.end - record.offset)

    def _check_data(self, record: Record) -> None:
        """Check the checksum of all that is before the end of the data, if it has one."""
        self._file.seek(record.content)
        stated = int.from_bytes(self._file.read(4), 'little')
        if not stated or self._index.breaks:
            return
        self._file.seek(0)
        if crc_of(self._file, record.offset) != stated:
            self._index.note_damage(Damage(
                len(MAGIC), f'the checksum of the data up to byte {record.offset} is not that '
                'of the file: something in it was changed'))

    def _scan_run(self, first: Record) -> int:
        """Count plain messages from a record on; return the offset behind them."""
        limit = self._index.chunk_limit
        if first.length > limit:
            raise Damage(first.offset, over_limit('a message has', first.length, limit))
        self._file.seek(first.offset)
        data = self._file.read(max(first.end - first.offset, self._run_size))
        table, _, length = find_messages(data, messages_only=True)
        # Short runs, such as of a file that was made so, must not cost a large read each.
        self._run_size = (min(2 * self._run_size, RUN_SIZE)
                          if 2 * length > len(data) else _FIRST_RUN)
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
            self._unpacked += len(data)
            if self._unpacked > self._index.file_limit:
                raise Damage(record.content, over_limit(
                    'it and those before it hold', self._unpacked, self._index.file_limit))
            table, others, _ = find_messages(data)
            for opcode, begin, end in others:
                if opcode in (Op.SCHEMA, Op.CHANNEL):
                    self._index.learn(opcode, data[begin:end], record.content)
            k = self._first_strange(table)
            if k is not None:
                raise self._undefined(record.content, int(table.channel[k]))
            self._add_span(table, replace(span, unpacked=len(data)))
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
        self._index.spans.append(replace(
            span, start_ns=int(times.min()), end_ns=int(times.max()), channels=read))


def _count(table: Table) -> dict[int, int]:
    """Return the number of messages of each channel that has any."""
    if table.n < 1000:
        return dict(zip(*(part.tolist() for part in np.unique(table.channel, return_counts=True)),
                        strict=True))
    counts = np.bincount(table.channel)
    return {key: int(counts[key]) for key in np.nonzero(counts)[0].tolist()}
