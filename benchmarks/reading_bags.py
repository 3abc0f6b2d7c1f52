"""Bags to be read: types, compressions, layouts of the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.writer import Writer
import numpy as np
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_block, encode_scalars, FLOAT32, FLOAT32_ARRAY, SCHEMAS)
from rosbags.typesys import get_typestore, Stores

THROTTLE = '/throttle'
IMU = 'sensor_msgs/msg/Imu'
START = 1_704_067_200_000_000_000
BLOCK = 100
# Size of a chunk that rosbag2 writes.
CHUNK = 786_432

_IMU_CONFIG = f"""description: A body rate read as if it were the voltage.
package: sensor_msgs
install: ros-jazzy-sensor-msgs
generic: false
voltage:
  topic: /imu
  type: {IMU}
  field: angular_velocity.x
  stamp_field: header.stamp
throttle:
  topic: /throttle
  type: std_msgs/msg/Float32
  field: data
"""


@dataclass(frozen=True)
class Case:
    """One type of message."""

    name: str
    type: str  # noqa: A003
    topic: str
    config: str
    value: Callable[[Any], Any]
    stamped: bool = False
    block: bool = False


def cases(folder: Path) -> list[Case]:
    """Return the types; the msg config of one of them is written to a folder."""
    config = folder / 'imu.yaml'
    config.write_text(_IMU_CONFIG, encoding='utf-8')
    return [
        Case('Float32', FLOAT32, '/voltage', 'std_float32', lambda m: m.data),
        Case('BatteryState', BATTERY_STATE, '/voltage', 'battery_state', lambda m: m.voltage,
             stamped=True),
        Case('Imu', IMU, '/imu', str(config), lambda m: m.angular_velocity.x, stamped=True),
        Case(f'Float32MultiArray, {BLOCK} samples', FLOAT32_ARRAY, '/voltage', 'adc_block',
             lambda m: m.data, block=True)]


def _imu(stamps: np.ndarray, values: np.ndarray) -> Iterator[bytes]:
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    vector, quaternion = types['geometry_msgs/msg/Vector3'], types['geometry_msgs/msg/Quaternion']
    header, time = types['std_msgs/msg/Header'], types['builtin_interfaces/msg/Time']
    for stamp, value in zip(stamps.tolist(), values.tolist()):
        message = types[IMU](
            header(time(stamp // 10**9, stamp % 10**9), 'imu_link'),
            quaternion(0.0, 0.0, 0.0, 1.0), np.zeros(9), vector(value, 0.1, -0.2), np.zeros(9),
            vector(0.0, 0.0, 9.81), np.zeros(9))
        yield bytes(store.serialize_cdr(message, IMU))


def messages(case: Case, count: int) -> list[tuple[str, int, bytes]]:
    """
    Return (topic, log time in ns, message), a throttle with every twentieth.

    Messages come at 1 kHz, blocks so that their samples are at 10 kHz.
    """
    rng = np.random.default_rng(7)
    times = START + np.arange(1, count + 1) * (10_000_000 if case.block else 1_000_000)
    values = rng.normal(5.0, 0.1, count)
    if case.block:
        voltage = [encode_block(row) for row in rng.normal(5.0, 0.1, (count, BLOCK))]
    elif case.type == IMU:
        voltage = list(_imu(times, values))
    elif case.type == BATTERY_STATE:
        voltage = encode_battery(times, values)
    else:
        voltage = encode_scalars(case.type, values)
    throttle = encode_scalars(FLOAT32, rng.random(count // 20 + 1))
    rows: list[tuple[str, int, bytes]] = []
    for k, (time, data) in enumerate(zip(times.tolist(), voltage)):
        if k % 20 == 0:
            rows.append((THROTTLE, time, throttle[k // 20]))
        rows.append((case.topic, time, data))
    return rows


def write(path: Path, case: Case, rows: list[tuple[str, int, bytes]], **options: Any) -> Path:
    """Write a bag with the Python library of MCAP."""
    schemas = dict(SCHEMAS)
    if case.type not in schemas:
        store = get_typestore(Stores.ROS2_JAZZY)
        schemas[case.type], _ = store.generate_msgdef(case.type, ros_version=2)
    with path.open('wb') as file:
        writer = Writer(file, **{'chunk_size': CHUNK, **options})
        writer.start(profile='ros2', library='benchmark')
        channels = {}
        for topic, kind in ((case.topic, case.type), (THROTTLE, FLOAT32)):
            schema = writer.register_schema(kind, 'ros2msg', schemas[kind].encode())
            channels[topic] = writer.register_channel(topic, 'cdr', schema)
        for topic, time, data in rows:
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path
