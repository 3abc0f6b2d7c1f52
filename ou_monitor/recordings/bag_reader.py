"""
Read MCAP bags: messages one by one, or where they are for reading in bulk.

A bag that is cut off or damaged is refused with the byte and the recording time
where the trouble begins, or, when asked, read as far as it holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import redirect_stderr
from dataclasses import replace
import io
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
import zlib

import lz4.frame
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.summary import Summary
from mcap_ros2._dynamic import _for_each_msgdef
from mcap_ros2.decoder import DecoderFactory
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.layout import (
    check_extent, DEFAULTS, Definitions, endless, Field, short_name)
from ou_monitor.recordings.limits import over_limit
from ou_monitor.recordings.mcap_file import (
    backwards, in_parts, in_time_order, McapFile, Part, RawMessage)
from ou_monitor.recordings.mcap_records import Table
from ou_monitor.recordings.rosbag2_metadata import find_files, MOST_BYTES, parse_qos, TopicInfo
from ou_monitor.text import printable, some
import zstandard


class DecodedMessage(NamedTuple):
    """One message with its fields as attributes."""

    topic: str
    type: str  # noqa: A003
    log_time_ns: int
    message: Any


class _LibraryCodec:
    """Contents of records as the MCAP library reads them."""

    def unpack(self, chunk: bytes, limit: int) -> bytes:
        """Return the records in a chunk, its checksum verified; at most `limit` bytes."""
        record = Chunk.read(ReadDataStream(io.BytesIO(chunk)))
        stated = record.uncompressed_size
        if stated > limit:
            raise ValueError(over_limit('it unpacks to', stated, limit))
        data = _decompressed(record.compression, record.data, stated)
        if len(data) != stated:
            raise ValueError(f'{len(data)} bytes in place of {stated}')
        if record.uncompressed_crc not in (0, zlib.crc32(data)):
            raise ValueError('its checksum is wrong')
        return data

    def schema(self, content: bytes) -> Schema:
        """Return a schema."""
        record: Schema = Schema.read(ReadDataStream(io.BytesIO(content)))
        return record

    def channel(self, content: bytes) -> Channel:
        """Return a channel."""
        record: Channel = Channel.read(ReadDataStream(io.BytesIO(content)))
        return record

    def metadata(self, content: bytes) -> Metadata:
        """Return a metadata record."""
        record: Metadata = Metadata.read(ReadDataStream(io.BytesIO(content)))
        return record

    def summary(self, file: BinaryIO) -> Summary | None:
        """Return the summary section."""
        return make_reader(file).get_summary()


def _decompressed(compression: str, data: bytes, stated: int) -> bytes:
    """Return the content of a chunk; never more memory than it states, whatever it holds."""
    if compression == 'zstd':
        size = zstandard.frame_content_size(data)
        if size not in (-1, stated):
            raise ValueError(f'{size} bytes in place of {stated}')
        plain: bytes = zstandard.decompress(data, stated)
    elif compression == 'lz4':
        frame = lz4.frame.LZ4FrameDecompressor()
        plain = frame.decompress(data, stated)
        if not frame.eof:
            raise ValueError(f'more than {stated} bytes, or not all of them')
    elif compression == '':
        plain = data
    else:
        # The library takes what it does not know for plain bytes.
        raise ValueError(f"unknown compression '{compression}'")
    return plain


def _definitions(kind: str, text: str) -> Definitions:
    """Return the fields of a type and of those in it, as the library understands them."""
    found = dict(DEFAULTS)

    def add(_: str, name: str, parsed: Any) -> None:
        found[name] = tuple(
            Field(field.name, field.type.type if field.type.is_primitive_type()
                  else f'{field.type.pkg_name}/{field.type.type}', bool(field.type.is_array),
                  field.type.array_size if field.type.is_fixed_size_array() else None)
            for field in parsed.fields)

    _for_each_msgdef(kind, text, add)
    return found


class BagReader:
    """
    Reads a bag, .mcap file or rosbag2 directory; with `partial` as far as a damaged one holds.

    max_chunk: bytes that a chunk may unpack to; else OU_MONITOR_MAX_CHUNK_MB, or 256 times the
    file, at least 64 MiB and at most an eighth of the memory.  By topic: message types in
    `topics`, number and QoS in `info`, rate of the samples within blocks, Hz, in `sample_rates`,
    and where values came from in `origins`, as far as the bag states it.  `about` is the custom
    data of metadata.yaml or of the files; `start_ns`, `end_ns` the log times of the first and last
    message; `damage` where and how the bag is damaged, else None; `notes` topics left out, and the
    like.  InputError: missing, empty, foreign, without messages, or damaged and not `partial`.
    """

    def __init__(self, path: Path | str, *, partial: bool = False,
                 max_chunk: int | None = None) -> None:
        """Index the bag; messages are read later."""
        self.path = Path(path)
        self.partial = partial
        paths, qos, about, missing = find_files(self.path, partial)
        self._files = [McapFile(file, partial, _LibraryCodec(), max_chunk) for file in paths]
        # The table of the directory is what a person edits: it holds.
        self.about = {key: value for known in (*(file.about for file in self._files), about)
                      for key, value in known.items()}
        held = [file for file in self._files if file.spans]
        self.start_ns = min((file.start_ns for file in held), default=0)
        self.end_ns = max((file.end_ns for file in held), default=0)
        for file in self._files:
            file.origin_ns = self.start_ns
        broken = [file for file in self._files if file.breaks]
        if broken and not partial:
            raise InputError(f'{broken[0].path} is damaged {broken[0].damage}; use --partial to '
                             'take what it still holds')
        damages = [f'{file.path.name} is damaged {file.damage}' for file in broken]
        self.damage = '; '.join(([missing] if missing else []) + damages) or None
        self.info: dict[str, TopicInfo] = {}
        self.sample_rates: dict[str, float] = {}
        self.origins: dict[str, dict[str, str]] = {}
        self._schemas: dict[str, Schema] = {}
        spent = 0
        for file in self._files:
            for key, topic in file.topics.items():
                if topic.sample_rate is not None:
                    self.sample_rates[topic.name] = topic.sample_rate
                if topic.origin:
                    self.origins[topic.name] = topic.origin
                known = self.info.get(topic.name)
                if known is None:
                    profiles = qos.get(topic.name) or topic.qos
                    spent += len(profiles) if isinstance(profiles, str) else 0
                    reliability, durability, depth = parse_qos(
                        profiles if spent < MOST_BYTES else None)
                    known = TopicInfo(topic.name, topic.type, 0, reliability, durability, depth)
                    self._schemas[topic.type] = topic.schema
                if known.type != topic.type:
                    raise InputError(f"{self.path}: topic '{topic.name}' has two types, "
                                     f'{known.type} and {topic.type}')
                self.info[topic.name] = replace(
                    known, count=known.count + file.counts.get(key, 0))
        self.notes = tuple(dict.fromkeys(note for file in self._files for note in file.notes))
        self.topics = {name: info.type for name, info in self.info.items()}
        self.message_count = sum(info.count for info in self.info.values())
        if self.message_count == 0:
            why = self.damage or ' '.join(self.notes) or (
                'topics: ' + (some(self.topics) or 'none'))
            raise InputError(f'{self.path} holds no messages ({why})')

    def __enter__(self) -> BagReader:
        """Return itself; no file stays open between reads."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: no file stays open between reads."""

    def raw_messages(self, topics: Iterable[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages in the order of their log times."""
        yield from in_time_order(self._files, self._wanted(topics))

    def tables(
        self, topics: Iterable[str], *, start_ns: int | None = None, end_ns: int | None = None,
    ) -> Iterator[Part]:
        """
        Yield where the messages are, chunk by chunk, for reading them in bulk.

        start_ns, end_ns in ns.
        """
        yield from in_parts(self._files, self._wanted(topics), start_ns, end_ns)

    def tables_before(self, topic: str, before_ns: int) -> Iterator[tuple[Table, int]]:
        """
        Yield the messages of a topic before a log time, newest chunk first.

        before_ns in ns.
        """
        yield from backwards(self._files, self._wanted([topic]), before_ns)

    def definition(self, kind: str) -> str:
        """Return the ros2msg text of a type in the bag."""
        return str(self._schemas[kind].data.decode('utf-8', 'replace'))

    def decoded(self, topics: Iterable[str] | None = None) -> Iterator[DecodedMessage]:
        """Yield the messages with their fields as attributes, in log-time order."""
        decoders: dict[str, Callable[[bytes], Any]] = {}
        for topic, kind, log_time, data in self.raw_messages(topics):
            if kind not in decoders:
                decoders[kind] = self.decoder(kind)
            yield DecodedMessage(topic, kind, log_time, decoders[kind](data))

    def decoder(self, kind: str) -> Callable[[bytes], Any]:
        """Return the function from CDR bytes to a message of one type in the bag."""
        def complain(error: Exception) -> InputError:
            return InputError(f'{self.path}: a message of type {kind} cannot be decoded '
                              f'({type(error).__name__}: {printable(error, 200)})')
        try:
            # The library tells a definition that it cannot read on standard error as well.
            with redirect_stderr(io.StringIO()):
                decode = DecoderFactory().decoder_for('cdr', self._schemas[kind])
                definitions = _definitions(kind, self.definition(kind))
        except Exception as error:
            raise complain(error) from error
        if decode is None:
            raise InputError(f'{self.path}: type {kind} has no ros2msg definition')

        name = short_name(kind)
        unsafe = endless(name, definitions)

        def checked(data: bytes) -> Any:
            try:
                if unsafe:
                    check_extent(data, name, definitions)
                return decode(data)
            except Exception as error:
                raise complain(error) from error
        return checked

    def _wanted(self, topics: Iterable[str] | None) -> set[str]:
        wanted = set(self.topics if topics is None else topics)
        for topic in sorted(wanted):
            if topic not in self.topics:
                raise InputError(f"{self.path}: no topic '{topic}': "
                                 f'{nearest(topic, self.topics)}')
        return wanted
