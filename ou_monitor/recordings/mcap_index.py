"""
The index of one .mcap file: its channels, where its messages are, and what is broken.

Filled from the summary of the file (`mcap_file.py`), or by walking it (`mcap_scan.py`).
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass, field
import math
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from ou_monitor.errors import InputError
from ou_monitor.recordings.limits import MOST_DEFINITION, MOST_METADATA, over_limit
from ou_monitor.recordings.mcap_records import Damage, Op, Span
from ou_monitor.recordings.rosbag2_metadata import custom_data, MOST_BYTES, MOST_NODES, plain_texts
from ou_monitor.stream.files import parse_yaml
from ou_monitor.text import printable

# Where a channel's metadata holds the rate of the samples within a block, Hz.
SAMPLE_RATE = 'sample_rate_hz'
# Names of the metadata records that say where the recording came from: that of
# `BagWriter`, and that of rosbag2, which holds the text of its metadata.yaml.
ABOUT, ROSBAG2 = 'ou_monitor', 'rosbag2'
# What the keys begin with that say where the values of a channel came from.
ORIGIN = 'origin.'

# Places of damage after which a walk is given up, and topics left out that are named.
MOST_BREAKS = 10_000
MOST_NOTES = 20
# rosbag2 writes one table of contents, and another at the end.
_MOST_TABLES = 3
# DDS has no longer names.
_MOST_OF_NAME = 256


class Codec(Protocol):
    """Reads the contents of records; any exception means that they are damaged."""

    def unpack(self, chunk: bytes, limit: int) -> bytes:
        """Return the records in a chunk, its checksum verified; at most `limit` bytes."""

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

    """

    offset: int
    why: str


class McapIndex:
    """
    What is known of one .mcap file.

    `topics`: channels of ROS 2 messages, `skipped` the others, `schemas` definitions by number,
    `counts` messages of each channel, `spans` where they are, `breaks` damage in the order of the
    file, `about` its metadata, `notes` topics left out; `start_ns`, `end_ns` log times of first
    and last message; `chunk_limit`, `file_limit` bytes that one chunk, or all, may unpack to.
    """

    def __init__(self, path: Path, codec: Codec) -> None:
        """Start with nothing known."""
        self.path = path
        self.chunk_limit = self.file_limit = 0
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
        self._tables = 0

    def note_damage(self, error: Damage) -> None:
        """Note a damage."""
        bisect.insort(self.breaks, Break(error.offset, str(error)), key=lambda b: b.offset)

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
        if len(content) > MOST_METADATA:
            raise Damage(offset, f'a metadata record has more than {MOST_METADATA / 1e6:g} MB')
        try:
            record = self._codec.metadata(content)
        except Exception as error:
            raise Damage(offset, f'a metadata record cannot be read ({error!r})') from error
        if record.name == ABOUT:
            self.about |= plain_texts(record.metadata)
        elif record.name == ROSBAG2 and self._tables < _MOST_TABLES:
            self._tables += 1
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
        # Names reach messages, tables and pages: here they become plain text.
        name = printable(channel.topic, _MOST_OF_NAME)
        if schema is None or channel.message_encoding != 'cdr' or encoding != 'ros2msg':
            self._leave_out(channel.id, f"Topic '{name}' was left out: it is not ROS 2 (messages "
                            f"'{printable(channel.message_encoding, 40)}', schema "
                            f"'{printable(encoding, 40)}').")
        elif len(channel.topic) > _MOST_OF_NAME or len(schema.name) > _MOST_OF_NAME:
            self._leave_out(channel.id, f"Topic '{name}' was left out: ROS 2 has no names of more "
                            f'than {_MOST_OF_NAME} characters.')
        elif len(schema.data) > MOST_DEFINITION:
            self._leave_out(channel.id, f"Topic '{name}' was left out: its definition has more "
                            f'than {MOST_DEFINITION // 1024} kB.')
        else:
            self.topics[channel.id] = TopicRecord(
                name, printable(schema.name), schema,
                channel.metadata.get('offered_qos_profiles', ''),
                _rate(channel.metadata.get(SAMPLE_RATE)),
                plain_texts({key.removeprefix(ORIGIN): value for key, value
                             in channel.metadata.items() if key.startswith(ORIGIN)}))

    def _leave_out(self, channel: int, why: str) -> None:
        self.skipped.add(channel)
        if len(self.skipped) < MOST_NOTES:
            self.notes.append(why)
        elif len(self.skipped) == MOST_NOTES:
            self.notes.append('More topics were left out.')

    def span_data(self, file: BinaryIO, span: Span) -> bytes:
        """Return the records of a span, unpacked and with its checksum verified."""
        if not 0 <= span.length <= self.chunk_limit:
            raise Damage(span.offset, over_limit('it has', span.length, self.chunk_limit))
        file.seek(span.offset)
        content = file.read(span.length)
        if not span.chunk:
            return content
        try:
            data = self._codec.unpack(content, self.chunk_limit)
            if span.unpacked not in (0, len(data)):
                raise ValueError(f'{len(data)} bytes in place of the {span.unpacked} of the index')
            return data
        # zstd, lz4, checksum, short data: the library lets each kind through.
        except Exception as error:
            raise Damage(span.offset, printable(error, 200) or type(error).__name__) from error
