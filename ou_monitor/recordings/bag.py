"""
MCAP bags: the only module that imports mcap.

`BagReader` reads an .mcap file or a rosbag2 directory without loading it into
memory; `BagWriter` writes either.  A bag that is cut off or damaged is refused
with the byte where the trouble begins, or, when asked, read as far as it holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
import io
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.bag_target import BagTarget
from ou_monitor.recordings.mcap_file import (
    in_time_order, McapFile, RawMessage, SAMPLE_RATE)
from ou_monitor.recordings.rosbag2_metadata import (
    find_files, parse_qos, qos_profile, TopicInfo)
from ou_monitor.recordings.schemas import SCHEMAS, TYPE_HASHES
import yaml

__all__ = ['BagReader', 'BagWriter', 'DecodedMessage', 'RawMessage', 'TopicInfo']

# Small chunks: a recording cut off by the brown-out it was made for loses what
# is in the last one, here about a second at 1 kHz.
CHUNK_SIZE = 128 * 1024  # bytes


class DecodedMessage(NamedTuple):
    """One message with its fields as attributes."""

    topic: str
    type: str  # noqa: A003
    log_time_ns: int
    message: Any


class _LibraryCodec:
    """Contents of records as the MCAP library reads them."""

    def unpack(self, chunk: bytes) -> bytes:
        """Return the records in a chunk, its checksum verified."""
        record = Chunk.read(ReadDataStream(io.BytesIO(chunk)))
        stream, length = get_chunk_data_stream(record, validate_crc=True)
        return bytes(stream.read(length))

    def schema(self, content: bytes) -> Schema:
        """Return a schema."""
        record: Schema = Schema.read(ReadDataStream(io.BytesIO(content)))
        return record

    def channel(self, content: bytes) -> Channel:
        """Return a channel."""
        record: Channel = Channel.read(ReadDataStream(io.BytesIO(content)))
        return record

    def summary(self, file: BinaryIO) -> Summary | None:
        """Return the summary section."""
        return make_reader(file).get_summary()


class BagReader:
    """
    Reads a bag: an .mcap file or a rosbag2 directory.

    Parameters
    ----------
    path : str or path
        File or directory.
    partial : bool
        Whether a damaged bag is read as far as it holds (`damage` then says
        what is wrong).

    Attributes
    ----------
    topics : dict of str to str
        Topic -> message type.
    info : dict of str to TopicInfo
        Topic -> type, number of messages, QoS.
    sample_rates : dict of str to float
        Topic -> rate of the samples within its blocks, Hz, where the bag
        states it (those written here do).
    start_ns, end_ns : int
        Log times of the first and last message, ns.
    message_count : int
        Messages of all topics.
    damage : str or None
        Where and how the bag is damaged.
    notes : tuple of str
        Topics left out, and the like.

    Raises
    ------
    InputError
        When the bag is missing, empty, foreign, holds no messages, or is
        damaged and not `partial`.

    """

    def __init__(self, path: Path | str, *, partial: bool = False) -> None:
        """Index the bag; messages are read later."""
        self.path = Path(path)
        paths, qos, missing = find_files(self.path, partial)
        self._files = [McapFile(file, partial, _LibraryCodec()) for file in paths]
        damages = [f'{file.path.name} is damaged {file.damage}'
                   for file in self._files if file.damage is not None]
        self.damage = '; '.join(([missing] if missing else []) + damages) or None
        self.info: dict[str, TopicInfo] = {}
        self.sample_rates: dict[str, float] = {}
        self._schemas: dict[str, Schema] = {}
        for file in self._files:
            for key, topic in file.topics.items():
                if topic.sample_rate is not None:
                    self.sample_rates[topic.name] = topic.sample_rate
                known = self.info.get(topic.name)
                if known is None:
                    reliability, durability, depth = parse_qos(qos.get(topic.name) or topic.qos)
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
                'topics: ' + (', '.join(self.topics) or 'none'))
            raise InputError(f'{self.path} holds no messages ({why})')
        held = [file for file in self._files if file.spans]
        self.start_ns = min(file.start_ns for file in held)
        self.end_ns = max(file.end_ns for file in held)

    def __enter__(self) -> BagReader:
        """Return itself; no file stays open between reads."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: no file stays open between reads."""

    def raw_messages(self, topics: Iterable[str] | None = None) -> Iterator[RawMessage]:
        """
        Yield the messages in the order of their log times.

        Parameters
        ----------
        topics : iterable of str, optional
            Topics wanted; all when left out.

        Yields
        ------
        RawMessage
            Topic, type, log time (ns) and CDR bytes.

        Raises
        ------
        InputError
            For a topic that is not in the bag, or at a broken chunk.

        """
        yield from in_time_order(self._files, self._wanted(topics))

    def decoded(self, topics: Iterable[str] | None = None) -> Iterator[DecodedMessage]:
        """
        Yield the messages with their fields as attributes, in log-time order.

        Parameters
        ----------
        topics : iterable of str, optional
            Topics wanted; all when left out.

        Yields
        ------
        DecodedMessage
            Topic, type, log time (ns) and message object.

        Raises
        ------
        InputError
            As `raw_messages`, and for a message that does not fit its type.

        """
        decoders: dict[str, Callable[[bytes], Any]] = {}
        for topic, kind, log_time, data in self.raw_messages(topics):
            if kind not in decoders:
                decoders[kind] = self.decoder(kind)
            yield DecodedMessage(topic, kind, log_time, decoders[kind](data))

    def decoder(self, kind: str) -> Callable[[bytes], Any]:
        """
        Return the function from CDR bytes to a message of one type in the bag.

        Parameters
        ----------
        kind : str
            Message type.

        Returns
        -------
        callable
            Raises InputError for bytes that do not fit the type.

        """
        def complain(error: Exception) -> InputError:
            return InputError(f'{self.path}: a message of type {kind} cannot be decoded '
                              f'({type(error).__name__}: {error})')
        try:
            decode = DecoderFactory().decoder_for('cdr', self._schemas[kind])
        except Exception as error:
            raise complain(error) from error
        if decode is None:
            raise InputError(f'{self.path}: type {kind} has no ros2msg definition')

        def checked(data: bytes) -> Any:
            try:
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


class BagWriter:
    """
    Writes a bag: an .mcap file when the path ends in .mcap, else a rosbag2 directory.

    A context manager; when its block is left by an exception, what was written
    is removed.

    Parameters
    ----------
    path : str or path
        Target; must not exist, its folder must.

    Raises
    ------
    InputError
        When the target exists or cannot be written.

    """

    def __init__(self, path: Path | str) -> None:
        """Open the target."""
        self.path = Path(path)
        self._target = BagTarget(self.path)
        self._topics: dict[str, TopicInfo] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._definitions: dict[str, str] = {}
        self._encoders: dict[str, Callable[[Any], bytes]] = {}
        self._start_ns: int | None = None
        self._end_ns = 0
        self._writer = Writer(self._target.file, CHUNK_SIZE, CompressionType.ZSTD)
        self._writer.start(profile='ros2', library='ou_monitor')

    def add_topic(
        self, name: str, type: str, *,  # noqa: A002
        schema: str | None = None, reliability: str = 'reliable',
        sample_rate: float | None = None,
    ) -> str:
        """
        Announce a topic.

        Parameters
        ----------
        name : str
            Topic; made absolute, as rosbag2 has it.
        type : str
            Message type, 'package/msg/Type'.
        schema : str, optional
            Its ros2msg definition; needed for types not in `schemas.SCHEMAS`.
        reliability : {'reliable', 'best_effort'}
            QoS to be offered at playback.
        sample_rate : float, optional
            Rate of the samples within a block, Hz; kept in the channel's
            metadata, where `BagReader` finds it.

        Returns
        -------
        str
            The absolute name, for `write`.

        Raises
        ------
        ValueError
            When the topic is there already, or the definition is not known.

        """
        topic = '/' + name.lstrip('/')
        if topic in self._topics:
            raise ValueError(f"topic '{topic}' was added before")
        text = SCHEMAS.get(type) if schema is None else schema
        if text is None:
            raise ValueError(f'no definition of type {type}: give its ros2msg text as schema')
        if type not in self._schemas:
            self._schemas[type] = self._writer.register_schema(type, 'ros2msg', text.encode())
            self._definitions[type] = text
        info = TopicInfo(topic, type, 0, reliability)
        self._topics[topic] = info
        metadata = {'offered_qos_profiles': yaml.safe_dump(qos_profile(info), sort_keys=False),
                    'topic_type_hash': TYPE_HASHES.get(type, '')}
        if sample_rate is not None:
            metadata[SAMPLE_RATE] = repr(float(sample_rate))
        self._channels[topic] = self._writer.register_channel(
            topic, 'cdr', self._schemas[type], metadata)
        self._counts[topic] = 0
        return topic

    def write(self, topic: str, t_ns: int, message: Any) -> None:
        """
        Write one message.

        Parameters
        ----------
        topic : str
            A topic added before.
        t_ns : int
            Log time, ns, not negative.
        message : bytes, dict or object
            CDR bytes as they are, or a message (dict of fields, or an object
            with attributes) to be serialized.

        Raises
        ------
        ValueError
            When the topic was not added or the time is negative.
        InputError
            When the disk refuses.

        """
        name = topic if topic in self._counts else '/' + topic
        if name not in self._counts:
            raise ValueError(f"topic '{topic}' was not added")
        if t_ns < 0:
            raise ValueError(f'a bag cannot hold a negative log time, got {t_ns} ns')
        data = message if isinstance(message, bytes) else self._encode(
            self._topics[name].type, message)
        try:
            self._writer.add_message(
                self._channels[name], t_ns, data, t_ns, self._counts[name])
        except OSError as error:
            raise InputError(f'cannot write {self.path}: {error.strerror}') from error
        self._counts[name] += 1
        self._start_ns = t_ns if self._start_ns is None else min(t_ns, self._start_ns)
        self._end_ns = max(t_ns, self._end_ns)

    def _encode(self, kind: str, message: Any) -> bytes:
        """Serialize a message that was not given as bytes."""
        if kind not in self._encoders:
            # The library's public writer cannot set the QoS of a channel, so its
            # encoder is taken alone.
            from mcap_ros2._dynamic import serialize_dynamic
            self._encoders[kind] = serialize_dynamic(kind, self._definitions[kind])[kind]
        return self._encoders[kind](message)

    def close(self) -> None:
        """
        Finish the bag.

        Raises
        ------
        InputError
            When the disk refuses.

        """
        if self._target.file.closed:
            return
        finish: Callable[[], None] = self._writer.finish
        try:
            finish()
            self._target.finish(
                [replace(info, count=self._counts[name]) for name, info in self._topics.items()],
                TYPE_HASHES, self._start_ns or 0, self._end_ns)
        except OSError as error:
            self._target.remove()
            raise InputError(f'cannot write {self.path}: {error.strerror}') from error

    def __enter__(self) -> BagWriter:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish the bag, or remove it when the block failed."""
        if kind is None:
            self.close()
        else:
            self._target.remove()
