"""
What is known of one .mcap file: its channels, where its messages are, and what is broken.

Filled from the summary of the file (`mcap_file.py`), or by walking it
(`mcap_scan.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from ou_monitor.recordings.framing import Damage, Op, Span
from ou_monitor.recordings.rosbag2_metadata import custom_data
import yaml


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


# Where a channel's metadata holds the rate of the samples within a block, Hz.
SAMPLE_RATE = 'sample_rate_hz'
# Names of the metadata records that say where the recording came from: that of
# `BagWriter`, and that of rosbag2, which holds the text of its metadata.yaml.
ABOUT, ROSBAG2 = 'ou_monitor', 'rosbag2'
# What the keys begin with that say where the values of a channel came from.
ORIGIN = 'origin.'


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
            self.about |= record.metadata
        elif record.name == ROSBAG2:
            try:
                table = yaml.safe_load(record.metadata.get('serialized_metadata', ''))
            except yaml.YAMLError:
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
