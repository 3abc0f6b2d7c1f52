"""
MCAP bags: written here by `BagWriter`, read by `BagReader`.

This module and `bag_reader.py` are the only ones that import mcap; all others
take both classes from here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
import shutil
from types import TracebackType
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag_reader import BagReader, DecodedMessage
from ou_monitor.recordings.mcap_file import RawMessage
from ou_monitor.recordings.mcap_index import ABOUT, ORIGIN, SAMPLE_RATE
from ou_monitor.recordings.rosbag2_metadata import qos_profile, TopicInfo, write_metadata
from ou_monitor.recordings.standard_types import SCHEMAS, TYPE_HASHES
import yaml

__all__ = ['BagReader', 'BagWriter', 'DecodedMessage', 'RawMessage', 'TopicInfo']

# Small chunks: a recording cut off by the brown-out it was made for loses what
# is in the last one, here about a second at 1 kHz.
CHUNK_SIZE = 128 * 1024  # bytes


class BagTarget:
    """
    A new .mcap file, or a new rosbag2 directory with one in it: `file`, open for writing.

    InputError when the target exists, its folder does not, or it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        """Open the target; nothing that exists is touched."""
        self.path = path
        self._folder = None if path.suffix == '.mcap' else path
        if path.exists() or path.is_symlink():
            raise InputError(f'{path} exists already: remove it or choose another name')
        if not path.parent.is_dir():
            raise InputError(f'cannot write {path}: there is no folder {path.parent}')
        self._mcap = path
        try:
            if self._folder is not None:
                self._folder.mkdir()
                self._mcap = self._folder / f'{path.name}_0.mcap'
            self.file: BinaryIO = self._mcap.open('xb')
        except OSError as error:
            raise InputError(f'cannot write {path}: {error.strerror}') from error

    def finish(
        self, topics: Iterable[TopicInfo], hashes: dict[str, str], start_ns: int, end_ns: int,
        custom: Mapping[str, str] | None = None,
    ) -> None:
        """Close the file and, in a directory, write its metadata.yaml."""
        self.file.close()
        if self._folder is not None:
            write_metadata(self._folder, self._mcap.name, topics, hashes, start_ns, end_ns,
                           custom)

    def remove(self) -> None:
        """Take away what was written; it was made by this object and by no other."""
        # On a full disk closing fails as well: what is still in the buffer has no place.
        with suppress(OSError):
            self.file.close()
        if self._folder is not None:
            shutil.rmtree(self._folder)
        else:
            self._mcap.unlink()


class BagWriter:
    """
    Writes a bag: an .mcap file when the path ends in .mcap, else a rosbag2 directory.

    A context manager; when its block is left by an exception, what was written is removed.
    `about`, where the data came from, is kept in a metadata record of the file, and in the custom
    data of metadata.yaml.  InputError: the target exists or cannot be written.
    """

    def __init__(self, path: Path | str, *, about: Mapping[str, str] | None = None) -> None:
        """Open the target."""
        # A file name may hold bytes that are no text, which neither MCAP nor YAML can hold.
        self._about = {key: _as_text(value) for key, value in (about or {}).items()}
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
        if self._about:
            self._writer.add_metadata(ABOUT, self._about)

    def add_topic(
        self, name: str, type: str, *,  # noqa: A002
        schema: str | None = None, reliability: str = 'reliable',
        sample_rate: float | None = None, origin: Mapping[str, str] | None = None,
    ) -> str:
        """Announce a topic (sample_rate in Hz)."""
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
        metadata |= {ORIGIN + key: _as_text(value) for key, value in (origin or {}).items()}
        self._channels[topic] = self._writer.register_channel(
            topic, 'cdr', self._schemas[type], metadata)
        self._counts[topic] = 0
        return topic

    def write(self, topic: str, t_ns: int, message: Any) -> None:
        """Write one message (topic in A, t_ns in ns)."""
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
        """Finish the bag."""
        if self._target.file.closed:
            return
        finish: Callable[[], None] = self._writer.finish
        try:
            finish()
            self._target.finish(
                [replace(info, count=self._counts[name]) for name, info in self._topics.items()],
                TYPE_HASHES, self._start_ns or 0, self._end_ns, self._about)
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


def _as_text(value: str) -> str:
    return value.encode('utf-8', 'backslashreplace').decode()
