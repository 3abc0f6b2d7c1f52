"""
Read and write `metadata.yaml`, the table of contents of a rosbag2 directory.

Written as version 9, the one of ROS 2 Jazzy; read in every version, for only
the list of files, the QoS of the topics and the custom data are used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import itertools
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from ou_monitor.errors import InputError
from ou_monitor.stream.files import one_line, parse_yaml, path_words, read_yaml
from ou_monitor.text import printable
import yaml

FILE = 'metadata.yaml'
# A bag of 2000 topics, or of 20 000 files.
MOST_BYTES, MOST_NODES = 8_000_000, 200_000
_ROOT = 'rosbag2_bagfile_information'

# rosbag2 writes "for ever" of the middleware as the greatest duration.
_FOR_EVER = {'sec': 9223372036, 'nsec': 854775807}

# Before version 9 policies were numbers (rmw/types.h).
_RELIABILITY: dict[int, str] = {1: 'reliable', 2: 'best_effort'}
_DURABILITY: dict[int, str] = {1: 'transient_local', 2: 'volatile'}


@dataclass(frozen=True)
class TopicInfo:
    """
    One topic of a bag.

    Attributes
    ----------
    name : str
        Topic name, absolute.
    type : str
        Message type, 'package/msg/Type'.
    count : int
        Number of messages.
    reliability, durability : str
        QoS that the publisher offered.
    depth : int
        Depth of the publisher's history, messages.

    """

    name: str
    type: str  # noqa: A003
    count: int
    reliability: str = 'reliable'
    durability: str = 'volatile'
    depth: int = 10


class BagFiles(NamedTuple):
    """
    What a path to a bag stands for.

    Attributes
    ----------
    paths : list of pathlib.Path
        MCAP files in recorded order.
    qos : dict of str to object
        Topic name -> offered QoS.
    about : dict of str to str
        Custom data of the recording, such as its vehicle.
    missing : str
        What is missing; '' when nothing is.

    """

    paths: list[Path]
    qos: dict[str, Any]
    about: dict[str, str]
    missing: str


def qos_profile(topic: TopicInfo) -> list[dict[str, Any]]:
    """Return the offered QoS of a topic as rosbag2 writes it."""
    return [{
        'history': 'keep_last', 'depth': topic.depth, 'reliability': topic.reliability,
        'durability': topic.durability, 'deadline': dict(_FOR_EVER),
        'lifespan': dict(_FOR_EVER), 'liveliness': 'automatic',
        'liveliness_lease_duration': dict(_FOR_EVER),
        'avoid_ros_namespace_conventions': False,
    }]


def parse_qos(text_or_list: Any) -> tuple[str, str, int]:
    """Return (reliability, durability, depth) of a recorded QoS."""
    profiles = text_or_list
    if isinstance(profiles, str):
        try:
            profiles = parse_yaml(profiles, 'QoS', most_bytes=100_000)
        except InputError:
            # A QoS nobody can read is no reason to refuse the messages.
            profiles = None
    first: dict[str, Any] = {}
    if isinstance(profiles, list) and profiles and isinstance(profiles[0], dict):
        first = profiles[0]
    depth = first.get('depth')
    return (_policy(first.get('reliability'), _RELIABILITY, 'reliable'),
            _policy(first.get('durability'), _DURABILITY, 'volatile'),
            depth if isinstance(depth, int) and 0 < depth < 2**31 else 10)


def _policy(value: Any, numbers: Mapping[int, str], default: str) -> str:
    """Return a policy by its name or number."""
    name = numbers.get(value) if isinstance(value, int) else value
    return str(name) if name in list(numbers.values()) else default


def custom_data(content: Any) -> dict[str, str]:
    """Return the custom data in the content of a metadata.yaml."""
    info = content.get(_ROOT, content) if isinstance(content, dict) else None
    custom = info.get('custom_data') if isinstance(info, dict) else None
    if not isinstance(custom, dict):
        return {}
    return plain_texts({key: value for key, value in custom.items()
                        if isinstance(value, (str, int, float))})


def plain_texts(found: Mapping[Any, Any]) -> dict[str, str]:
    """Return what a bag says of itself as names and texts of one line each."""
    return {printable(key, 100): printable(value, 1000)
            for key, value in itertools.islice(found.items(), 1000)}


def read_metadata(folder: Path) -> BagFiles:
    """Return the MCAP files of a rosbag2 directory, and what is said of them."""
    with one_line():
        return _metadata(folder)


def _metadata(folder: Path) -> BagFiles:
    path = folder / FILE
    where = path_words(path)
    content = read_yaml(path, 'the metadata', most_bytes=MOST_BYTES, most_nodes=MOST_NODES)
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
    qos: dict[str, Any] = {}
    entries = info.get('topics_with_message_count')
    for entry in entries if isinstance(entries, list) else ():
        topic = entry.get('topic_metadata') if isinstance(entry, dict) else None
        if isinstance(topic, dict):
            qos[str(topic.get('name'))] = topic.get('offered_qos_profiles')
    return BagFiles(files, qos, custom_data(info), '')


def is_part(file: Path, folder: Path) -> bool:
    """Return whether an .mcap file has the name that rosbag2 gives it in its folder."""
    begin = folder.name + '_'
    return file.stem.startswith(begin) and file.stem[len(begin):].isdigit()


def find_files(path: Path, partial: bool) -> BagFiles:
    """Return what a path to a bag stands for."""
    if path.name == FILE and path.is_file():
        path = path.parent
    if not path.exists():
        raise InputError(f'{path} is a link that leads nowhere' if path.is_symlink()
                         else f'there is no bag {path}: check the path')
    if not path.is_dir():
        return BagFiles([path], {}, {}, '')
    if (path / FILE).exists():
        return read_metadata(path)
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
        raise InputError(f'{path}: {missing}; use --partial to take what it still holds')
    return BagFiles(files, {}, {}, missing)


def write_metadata(
    folder: Path, file: str, topics: Iterable[TopicInfo], hashes: dict[str, str],
    start_ns: int, end_ns: int, custom: Mapping[str, str] | None = None,
) -> None:
    """Write metadata.yaml (version 9) of a directory with one MCAP file."""
    infos = list(topics)
    count = sum(topic.count for topic in infos)
    content = {_ROOT: {
        'version': 9,
        'storage_identifier': 'mcap',
        'duration': {'nanoseconds': end_ns - start_ns},
        'starting_time': {'nanoseconds_since_epoch': start_ns},
        'message_count': count,
        'topics_with_message_count': [{
            'topic_metadata': {
                'name': topic.name, 'type': topic.type, 'serialization_format': 'cdr',
                'offered_qos_profiles': qos_profile(topic),
                'type_description_hash': hashes.get(topic.type, ''),
            },
            'message_count': topic.count,
        } for topic in infos],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file],
        'files': [{
            'path': file,
            'starting_time': {'nanoseconds_since_epoch': start_ns},
            'duration': {'nanoseconds': end_ns - start_ns},
            'message_count': count,
        }],
        'custom_data': dict(custom) if custom else None,
        'ros_distro': 'jazzy',
    }}
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=False)
    (folder / FILE).write_text(text, encoding='utf-8')
