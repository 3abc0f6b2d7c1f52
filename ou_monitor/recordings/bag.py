"""
Read and write bags: an .mcap file, or a rosbag2 directory of .mcap files and `metadata.yaml`.

`BagReader` reads single messages in the order of log times, with only those chunks in memory that
overlap in time; `read_fields` reads fields of topics as arrays.  A truncated or damaged bag is
refused with the byte and the recording time of the damage or, on request, read as far as it is
intact.  `BagWriter` writes bags with metadata.yaml version 9 (ROS 2 Jazzy); every version is read,
because only the list of files and the custom data are used.

This module, `mcap_file.py` and `standard_types.py` are the only ones that import mcap.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Any, NamedTuple

from mcap.writer import CompressionType, Writer
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.cdr import (
    ColumnBuffer, Definitions, FieldColumn, FieldReader, MessageTable)
from ou_monitor.recordings.mcap_file import (
    ABOUT, McapFile, moment, SAMPLE_RATE, Span)
from ou_monitor.recordings.standard_types import parse_definition, SCHEMAS, TYPE_HASHES
from ou_monitor.stream.config import FieldSpec
from ou_monitor.stream.files import one_line, path_words, plain_texts, read_yaml
from ou_monitor.text import printable, some
import yaml

FILE = 'metadata.yaml'
_ROOT = 'rosbag2_bagfile_information'
# Maximum bytes and values of the metadata (2000 topics).
_MOST_BYTES, _MOST_NODES = 8_000_000, 200_000

# rosbag2 writes the middleware's "for ever" as the largest duration.
_FOR_EVER = {'sec': 9223372036, 'nsec': 854775807}


def _qos() -> list[dict[str, Any]]:
    """Return the QoS that rosbag2 writes; its dicts are copies, or YAML would write aliases."""
    return [{
        'history': 'keep_last', 'depth': 10, 'reliability': 'reliable', 'durability': 'volatile',
        'deadline': dict(_FOR_EVER), 'lifespan': dict(_FOR_EVER), 'liveliness': 'automatic',
        'liveliness_lease_duration': dict(_FOR_EVER), 'avoid_ros_namespace_conventions': False}]


@one_line()
def read_metadata(folder: Path) -> tuple[list[Path], dict[str, str]]:
    """Return the MCAP files of a rosbag2 directory, in recorded order, and its custom data."""
    path = folder / FILE
    where = path_words(path)
    content = read_yaml(path, 'the metadata', most_bytes=_MOST_BYTES, most_nodes=_MOST_NODES)
    info = content.get(_ROOT) if isinstance(content, dict) else None
    if not isinstance(info, dict):
        raise InputError(f"{where} has no '{_ROOT}': it is not the metadata of a rosbag2")
    storage = info.get('storage_identifier')
    if storage != 'mcap':
        raise InputError(
            f"{path_words(folder)}: the storage is '{printable(storage, 40)}', only mcap is read: "
            "convert it with 'ros2 bag convert' to the storage mcap")
    names = info.get('relative_file_paths')
    if not isinstance(names, list) or not names:
        raise InputError(f"{where} names no file in 'relative_file_paths'")
    # Old versions wrote the folder before the name.
    files = [folder / name for name in dict.fromkeys(
        PurePosixPath(str(name)).name for name in names)]
    for file in files:
        if not file.is_file():
            raise InputError(f"{where} names '{printable(file.name, 60)}', which is not in its "
                             'folder')
    custom = info.get('custom_data')
    return files, plain_texts({
        key: value for key, value in (custom if isinstance(custom, dict) else {}).items()
        if isinstance(value, (str, int, float))})


def is_part(file: Path, folder: Path) -> bool:
    """Return whether an .mcap file has the name that rosbag2 gives it in its folder."""
    begin = folder.name + '_'
    return file.stem.startswith(begin) and file.stem[len(begin):].isdigit()


def find_files(path: Path, partial: bool) -> tuple[list[Path], dict[str, str], str]:
    """Return the files of a bag in recorded order, its custom data, and what is missing or ''."""
    if path.name == FILE and path.is_file():
        path = path.parent
    if not path.exists():
        raise InputError(f'{path} is a broken link' if path.is_symlink()
                         else f'there is no recording {path}: check the path')
    if not path.is_dir():
        return [path], {}, ''
    if (path / FILE).exists():
        return *read_metadata(path), ''
    # NAME_0.mcap .. NAME_10.mcap: the shorter name is the earlier one.
    files = sorted(path.glob('*.mcap'), key=lambda file: (len(file.name), file.name))
    if not files:
        raise InputError(f'{path} is not a bag: it holds neither {FILE} nor an .mcap file'
                         + ("; name one of the bags in it, or give all to 'ou-monitor fleet'"
                            if any(path.glob(f'*/{FILE}')) else
                            "; 'ou-monitor fleet' takes folders of recordings"))
    missing = f'{FILE} is missing: the recording was cut off'
    if not partial:
        if not all(is_part(file, path) for file in files):
            raise InputError(
                f'{path}: {FILE} is missing: name one of the .mcap files in it; if they are one '
                'recording that was cut off, use --partial')
        raise InputError(f'{path}: {missing}; use --partial to read the intact part')
    return files, {}, missing


def remove_bag(files: Iterable[Path], folder: Path | None) -> None:
    """Remove files and metadata of a bag, and its folder if it is then empty."""
    for file in (*files, *(() if folder is None else [folder / FILE])):
        file.unlink(missing_ok=True)
    if folder is not None:
        with suppress(OSError):
            folder.rmdir()


class RawMessage(NamedTuple):
    """One message as recorded; `data` is CDR, `log_time_ns` in ns."""

    topic: str
    type: str  # noqa: A003
    log_time_ns: int
    data: bytes


class Part(NamedTuple):
    """The messages of some chunks that are read together."""

    tables: dict[str, MessageTable]  #: Topic -> its messages, in the order of the file
    #: No later part has a message before this log time, ns; None after the last part.
    later_ns: int | None
    done: float  #: Share of the bytes that has been read, 0..1


class BagReader:
    """
    Reads a bag (.mcap file or rosbag2 directory); with `partial` also a damaged one.

    By topic: `topics` has the message type, `counts` the number of messages, `sample_rates` the
    rate of samples within blocks, Hz, if stated. `about` is the custom data of metadata.yaml or of
    the files; `start_ns`, `end_ns` are the log times of the first and last message; `damage` is
    the place and kind of damage, or None; `notes` list what was left out. Raises InputError if the
    bag is missing, empty, of another format, without messages, or damaged and not `partial`.
    """

    def __init__(self, path: Path | str, *, partial: bool = False) -> None:
        """Index the bag; messages are read later, and files are closed between reads."""
        self.path = Path(path)
        paths, about, missing = find_files(self.path, partial)
        self._files = [McapFile(file, partial) for file in paths]
        # The metadata of the directory take precedence, because users edit them.
        self.about = {key: value for known in (*(file.about for file in self._files), about)
                      for key, value in known.items()}
        held = [file for file in self._files if file.spans]
        self.start_ns = min((file.start_ns for file in held), default=0)
        self.end_ns = max((file.end_ns for file in held), default=0)
        for file in self._files:
            file.origin_ns = self.start_ns
        broken = [file for file in self._files if file.damage]
        if broken and not partial:
            raise InputError(f'{broken[0].path} is damaged {broken[0].damage}; use --partial to '
                             'read the intact part')
        self.damage = '; '.join([*([missing] if missing else []), *(
            f'{file.path.name} is damaged {file.damage}' for file in broken)]) or None
        self.topics: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        self.sample_rates: dict[str, float] = {}
        self._schemas: dict[str, Any] = {}
        self._collect()
        self.notes = tuple(dict.fromkeys(note for file in self._files for note in file.notes))
        self.message_count = sum(self.counts.values())
        if self.message_count == 0:
            why = self.damage or ' '.join(self.notes) or (
                'topics: ' + (some(self.topics) or 'none'))
            raise InputError(f'{self.path} holds no messages ({why})')

    def _collect(self) -> None:
        for file in self._files:
            for key, topic in file.topics.items():
                if topic.sample_rate is not None:
                    self.sample_rates[topic.name] = topic.sample_rate
                known = self.topics.setdefault(topic.name, topic.type)
                if known != topic.type:
                    raise InputError(f"{self.path}: topic '{topic.name}' has two types, "
                                     f'{known} and {topic.type}')
                schema = self._schemas.setdefault(topic.type, topic.schema)
                if schema.data != topic.schema.data and not _same_fields(schema, topic.schema):
                    raise InputError(f'{self.path}: type {topic.type} has two definitions, which '
                                     'differ: read the files of the bag one by one')
                self.counts[topic.name] = (
                    self.counts.get(topic.name, 0) + file.counts.get(key, 0))

    def tables(self, topics: Iterable[str], end_ns: int | None = None, *, as_written: bool = False,
               ) -> Iterator[Part]:
        """Yield the messages as tables up to `end_ns`, ns; chunks in time or written order."""
        wanted = set(topics)
        for topic in sorted(wanted):
            if topic not in self.topics:
                raise InputError(f"{self.path}: no topic '{topic}': "
                                 f'{nearest(topic, self.topics)}')
        spans: list[tuple[Span, McapFile]] = []
        for file in self._files:
            channels = file.channels_of(wanted).keys()
            spans += [(span, file) for span in file.spans
                      if (span.channels is None or span.channels & channels)
                      and (end_ns is None or span.start_ns < end_ns)]
        if not as_written:
            spans.sort(key=lambda pair: pair[0].start_ns)
        total = sum(span.length for span, _ in spans)
        read = place = 0
        while place < len(spans):
            file, first, size = spans[place][1], place, 0
            while place < len(spans) and spans[place][1] is file and (
                    place == first or size + spans[place][0].unpacked <= _TOGETHER):
                size += spans[place][0].unpacked
                read += spans[place][0].length
                place += 1
            tables = file.tables([span for span, _ in spans[first:place]], wanted)
            later = None if place == len(spans) else spans[place][0].start_ns
            yield Part(tables, later, read / total)

    def raw_messages(self, topics: Iterable[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages in the order of their log times."""
        pending: list[RawMessage] = []
        for part in self.tables(self.topics if topics is None else topics):
            # Messages of equal time stay in file order.
            rows = sorted((begin, end, log_time, name) for name, table in part.tables.items()
                          for begin, end, log_time in zip(
                              table.begin.tolist(), table.end.tolist(), table.log_time.tolist()))
            pending += [RawMessage(name, self.topics[name], log_time,
                                   part.tables[name].data[begin:end])
                        for begin, end, log_time, name in rows]
            pending.sort(key=lambda message: message.log_time_ns)
            # Yield messages older than everything still to be read.
            ready = len(pending) if part.later_ns is None else bisect.bisect_left(
                pending, part.later_ns, key=lambda message: message.log_time_ns)
            yield from pending[:ready]
            del pending[:ready]

    def definitions(self, kind: str) -> Definitions:
        """Return the fields of a type in the bag, and of its nested types."""
        try:
            return parse_definition(kind, self._schemas[kind].data.decode('utf-8', 'replace'))
        # The library raises errors of many kinds.
        except Exception as error:
            raise InputError(f'{self.path}: a message of type {kind} cannot be decoded: its '
                             f'definition cannot be read ({type(error).__name__}: '
                             f'{printable(error, 200)})') from error


def _same_fields(schema: Any, other: Any) -> bool:
    with suppress(Exception):
        one, two = (parse_definition(each.name, each.data.decode('utf-8', 'replace'))
                    for each in (schema, other))
        return one == two
    return False


def read_fields(
    bag: BagReader, specs: Mapping[str, FieldSpec], *, end_ns: int | None = None,
    progress: Callable[[float], None] | None = None,
    broken: list[str] | None = None, beside: Mapping[str, FieldSpec] | None = None,
) -> dict[str, FieldColumn]:
    """
    Return fields of a bag in the order of the file, at least to `end_ns`, ns.

    `beside` names a second field to read from the same messages. `broken` gets one item for
    each message that cannot be decoded, the first with the reason; if `broken` is None, such a
    message raises InputError.
    """
    def reader_of(spec: FieldSpec, second: FieldSpec | None) -> FieldReader:
        def refuse(log_time: int, why: str) -> None:
            words = (f'{bag.path}: a message of type {spec.type} cannot be decoded ({why}) '
                     f'({moment(log_time, bag.start_ns)})')
            if broken is None:
                raise InputError(f'{words}; use --partial to leave it out')
            broken.append('' if broken else words)
        return FieldReader(spec, bag.definitions(spec.type), refuse, second)

    readers = {name: reader_of(spec, (beside or {}).get(name)) for name, spec in specs.items()}
    found = {name: ColumnBuffer() for name in specs}
    counts = dict.fromkeys(specs, 0)
    for part in bag.tables([spec.topic for spec in specs.values()], end_ns, as_written=True):
        for name, reader in readers.items():
            table = part.tables.get(reader.spec.topic)
            if table is not None:
                counts[name] += table.n
                found[name].add(reader.read(table))
        if progress is not None:
            progress(part.done)
    for name, spec in specs.items() if end_ns is None else ():
        stated = bag.counts[spec.topic]
        if counts[name] < stated:
            raise InputError(
                f"{bag.path} is damaged: it states {stated} messages of topic '{spec.topic}', "
                f'{counts[name]} were found; use --partial to read the intact part')
    return {name: buffer.whole() for name, buffer in found.items()}


# Chunks are read together up to this size, bytes unpacked.
_TOGETHER = 1024 * 1024

# Small, because a brown-out costs a recording its last chunk, about a second at 1 kHz.
CHUNK_SIZE = 128 * 1024  # bytes


class BagWriter(AbstractContextManager['BagWriter']):
    """
    Writes a bag: an .mcap file when the path ends in .mcap, else a rosbag2 directory.

    A context manager; after an exception in its block the files are removed. `about`, where the
    data came from, is kept in a metadata record of the file, and in the custom data of
    metadata.yaml. Raises InputError if the target exists, its folder does not, or it cannot be
    written.
    """

    def __init__(self, path: Path | str, *, about: Mapping[str, str] | None = None) -> None:
        """Open the target; never overwrite anything."""
        # A file name may contain bytes that are not text, which MCAP and YAML cannot store.
        self._about = {key: value.encode('utf-8', 'backslashreplace').decode()
                       for key, value in (about or {}).items()}
        self.path = Path(path)
        self._folder = None if self.path.suffix == '.mcap' else self.path
        self._mcap = self.path if self._folder is None else (
            self._folder / f'{self.path.name}_0.mcap')
        if self.path.exists() or self.path.is_symlink():
            raise InputError(f'{path} exists already: remove it or choose another name')
        if not self.path.parent.is_dir():
            raise InputError(f'cannot write {path}: there is no folder {self.path.parent}')
        try:
            if self._folder is not None:
                self._folder.mkdir()
            self._file = self._mcap.open('xb')
        except OSError as error:
            raise self._write_error(error) from error
        self.topics: dict[str, str] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._start_ns: int | None = None
        self._end_ns = 0
        self._writer = Writer(self._file, CHUNK_SIZE, CompressionType.ZSTD)
        self._writer.start(profile='ros2', library='ou_monitor')
        if self._about:
            self._writer.add_metadata(ABOUT, self._about)

    def _write_error(self, error: OSError) -> InputError:
        return InputError(f'cannot write {self.path}: {error.strerror}')

    def add_topic(
        self, name: str, type: str, *,  # noqa: A002
        schema: str | None = None, sample_rate: float | None = None,
    ) -> str:
        """Add a topic (sample_rate in Hz)."""
        topic = '/' + name.lstrip('/')
        if topic in self.topics:
            raise ValueError(f"topic '{topic}' was added before")
        text = SCHEMAS.get(type) if schema is None else schema
        if text is None:
            raise ValueError(f'no definition of type {type}: give its ros2msg text as schema')
        if type not in self._schemas:
            self._schemas[type] = self._writer.register_schema(type, 'ros2msg', text.encode())
        self.topics[topic] = type
        metadata = {'offered_qos_profiles': yaml.safe_dump(_qos(), sort_keys=False),
                    'topic_type_hash': TYPE_HASHES.get(type, '')}
        if sample_rate is not None:
            metadata[SAMPLE_RATE] = repr(float(sample_rate))
        self._channels[topic] = self._writer.register_channel(
            topic, 'cdr', self._schemas[type], metadata)
        self._counts[topic] = 0
        return topic

    def write(self, topic: str, t_ns: int, data: bytes) -> None:
        """Write one message, in CDR (t_ns in ns)."""
        name = topic if topic in self._counts else '/' + topic
        if name not in self._counts:
            raise ValueError(f"topic '{topic}' was not added")
        if t_ns < 0:
            raise ValueError(f'a bag cannot hold a negative log time, got {t_ns} ns')
        try:
            self._writer.add_message(
                self._channels[name], t_ns, data, t_ns, self._counts[name])
        except OSError as error:
            raise self._write_error(error) from error
        self._counts[name] += 1
        self._start_ns = t_ns if self._start_ns is None else min(t_ns, self._start_ns)
        self._end_ns = max(t_ns, self._end_ns)

    def close(self) -> None:
        """Finish the bag."""
        if self._file.closed:
            return
        finish: Callable[[], None] = self._writer.finish
        try:
            finish()
            self._file.close()
            if self._folder is not None:
                text = yaml.safe_dump(self._metadata(), sort_keys=False, default_flow_style=False)
                (self._folder / FILE).write_text(text, encoding='utf-8')
        except OSError as error:
            self._remove()
            raise self._write_error(error) from error

    def _metadata(self) -> dict[str, Any]:
        start_ns = self._start_ns or 0
        duration = {'nanoseconds': self._end_ns - start_ns}
        start = {'nanoseconds_since_epoch': start_ns}
        count = sum(self._counts.values())
        return {_ROOT: {
            'version': 9,
            'storage_identifier': 'mcap',
            'duration': dict(duration),
            'starting_time': dict(start),
            'message_count': count,
            'topics_with_message_count': [{
                'topic_metadata': {
                    'name': name, 'type': kind, 'serialization_format': 'cdr',
                    'offered_qos_profiles': _qos(),
                    'type_description_hash': TYPE_HASHES.get(kind, ''),
                },
                'message_count': self._counts[name],
            } for name, kind in self.topics.items()],
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [self._mcap.name],
            'files': [{'path': self._mcap.name, 'starting_time': start, 'duration': duration,
                       'message_count': count}],
            'custom_data': self._about or None,
            'ros_distro': 'jazzy',
        }}

    def _remove(self) -> None:
        # On a full disk closing fails too, because the buffer cannot be flushed.
        with suppress(OSError):
            self._file.close()
        remove_bag([self._mcap], self._folder)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._remove()
