"""The same bag to arrays, by this package and by the two libraries that users would take."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
from ou_monitor.recordings.bag import BagReader
from ou_monitor.recordings.columns import batches, join
from ou_monitor.recordings.read import read_recording
from ou_monitor.recordings.topic_choice import choose
from ou_monitor.records import Recording
from reading_bags import Case, THROTTLE
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

# Topic -> log times or stamps (s), values.
Columns = dict[str, tuple[np.ndarray, np.ndarray]]


def collect(case: Case, messages: Any) -> Columns:
    """Return columns from (topic, log time in ns, message) one by one."""
    voltage: tuple[list[float], list[Any]] = ([], [])
    throttle: tuple[list[float], list[Any]] = ([], [])
    value = case.value
    for topic, time, message in messages:
        if topic == THROTTLE:
            throttle[0].append(time * 1e-9)
            throttle[1].append(message.data)
        elif case.stamped:
            stamp = message.header.stamp
            voltage[0].append(stamp.sec + 1e-9 * stamp.nanosec)
            voltage[1].append(value(message))
        else:
            voltage[0].append(time * 1e-9)
            voltage[1].append(value(message))
    join: Callable[[list[Any]], np.ndarray] = np.concatenate if case.block else np.array
    return {case.topic: (np.array(voltage[0]), join(voltage[1]).astype(float)),
            THROTTLE: (np.array(throttle[0]), np.array(throttle[1], dtype=float))}


def rosbags(path: Path, case: Case) -> Columns:
    """Read with rosbags: `AnyReader`, a message an object."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        wanted = [c for c in reader.connections if c.topic in (case.topic, THROTTLE)]
        return collect(case, ((c.topic, t, reader.deserialize(data, c.msgtype))
                              for c, t, data in reader.messages(connections=wanted)))


def mcap_ros2(path: Path, case: Case) -> Columns:
    """Read with mcap and mcap-ros2-support, a message an object."""
    with path.open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = reader.iter_decoded_messages(topics=[case.topic, THROTTLE])
        return collect(case, ((channel.topic, message.log_time, decoded)
                              for _, channel, message, decoded in found))


def unpacked(path: Path) -> int:
    """Read and unpack the chunks, their checksums verified: what every reader has to do."""
    file = BagReader(path)._files[0]
    with path.open('rb') as stream:
        return sum(len(file.span_data(stream, span)) for span in file.spans)


def ours(path: Path, case: Case) -> Columns:
    """Read with this package, to the same arrays as the others."""
    bag = BagReader(path)
    choice = choose(path, bag.topics, msg_config=case.config)
    assert choice.throttle is not None
    found = list(batches(bag, {case.topic: choice.voltage, THROTTLE: choice.throttle}))
    columns = {topic: join([batch[topic] for batch in found if topic in batch])
               for topic in (case.topic, THROTTLE)}
    return {topic: (column.stamp, column.values) for topic, column in columns.items()}


def recording(path: Path, case: Case) -> Recording:
    """Read with `read_recording`: in order, each stamp once, the throttle held at each sample."""
    return read_recording(path, msg_config=case.config)


def check(case: Case, mine: Columns, other: Columns) -> None:
    """Refuse to compare the time of ways that do not agree on what is in the bag."""
    for topic in (case.topic, THROTTLE):
        np.testing.assert_array_equal(mine[topic][1], other[topic][1])
        # Float64 seconds since 1970 resolve 0.24 us.
        np.testing.assert_allclose(mine[topic][0], other[topic][0], rtol=0, atol=1e-6)
