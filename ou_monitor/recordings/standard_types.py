"""
Message types: parsing of definitions, and the standard types that bags are written with.

A bag carries the definition (ros2msg) of every type in it, so that it can be read without ROS.
Texts and hashes are from ROS 2 Jazzy's common_interfaces, without comments; a test compares them
with an independent library.  rosbag2 writes the hash (REP-2016, RIHS01) beside the type.
Many messages are encoded at once: the library encodes one, and its layout shows where to write the
values of the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr
from functools import lru_cache
import io
import json
import math
from typing import Any

from mcap_ros2._dynamic import _for_each_msgdef, serialize_dynamic
import numpy as np
import numpy.typing as npt
from ou_monitor.recordings.cdr import DEFAULTS, Definitions, Field, Layout, short_name
from ou_monitor.stream.config import FieldPath, parse_field_path

IMU = 'sensor_msgs/msg/Imu'
JOINT_STATE = 'sensor_msgs/msg/JointState'
FLOAT32 = 'std_msgs/msg/Float32'
FLOAT64 = 'std_msgs/msg/Float64'
FLOAT32_ARRAY = 'std_msgs/msg/Float32MultiArray'
BATTERY_STATE = 'sensor_msgs/msg/BatteryState'

# rosbag2 writes this line between a definition and the definitions it uses.
_SEPARATOR = 80 * '='
_STD_HEADER = f"""\
{_SEPARATOR}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_SEPARATOR}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def _constants(kind: str, *names: str) -> str:
    """Return the constants of a BatteryState, numbered from 0."""
    return ''.join(f'uint8 POWER_SUPPLY_{kind}_{name}={k}\n' for k, name in enumerate(names))


# package/msg/Type -> its definition and the definitions it uses.
SCHEMAS: dict[str, str] = {
    FLOAT32: 'float32 data\n',
    FLOAT64: 'float64 data\n',
    FLOAT32_ARRAY: f"""\
std_msgs/MultiArrayLayout layout
float32[] data
{_SEPARATOR}
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
{_SEPARATOR}
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
""",
    BATTERY_STATE: _constants(
        'STATUS', 'UNKNOWN', 'CHARGING', 'DISCHARGING', 'NOT_CHARGING', 'FULL') + _constants(
        'HEALTH', 'UNKNOWN', 'GOOD', 'OVERHEAT', 'DEAD', 'OVERVOLTAGE', 'UNSPEC_FAILURE', 'COLD',
        'WATCHDOG_TIMER_EXPIRE', 'SAFETY_TIMER_EXPIRE') + _constants(
        'TECHNOLOGY', 'UNKNOWN', 'NIMH', 'LION', 'LIPO', 'LIFE', 'NICD', 'LIMN', 'TERNARY',
        'VRLA') + """\
std_msgs/Header header
float32 voltage
float32 temperature
float32 current
float32 charge
float32 capacity
float32 design_capacity
float32 percentage
uint8 power_supply_status
uint8 power_supply_health
uint8 power_supply_technology
bool present
float32[] cell_voltage
float32[] cell_temperature
string location
string serial_number
""" + _STD_HEADER,
    IMU: f"""\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
{_STD_HEADER}{_SEPARATOR}
MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
{_SEPARATOR}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
""",
    JOINT_STATE: """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
""" + _STD_HEADER,
}

# package/msg/Type -> its RIHS01 hash.
TYPE_HASHES: dict[str, str] = {
    FLOAT32: 'RIHS01_7170d3d8f841f7be3172ce5f4f59f3a4d7f63b0447e8b33327601ad64d83d6e2',
    FLOAT64: 'RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a',
    FLOAT32_ARRAY: 'RIHS01_0599f6f85b4bfca379873a0b4375a0aca022156bd2d7021275d116ed1fa8bfe0',
    BATTERY_STATE: 'RIHS01_4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741',
    IMU: 'RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b',
    JOINT_STATE: 'RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e',
}


def parse_definition(kind: str, text: str) -> Definitions:
    """Return the fields of a type and of its nested types, as the library parses them."""
    found = dict(DEFAULTS)

    def add(_: str, name: str, parsed: Any) -> None:
        found[name] = tuple(
            Field(field.name, field.type.type if field.type.is_primitive_type()
                  else f'{field.type.pkg_name}/{field.type.type}', bool(field.type.is_array),
                  field.type.array_size if field.type.is_fixed_size_array() else None)
            for field in parsed.fields)

    # The library also prints unreadable definitions to standard error.
    with redirect_stderr(io.StringIO()):
        _for_each_msgdef(kind, text, add)
    return found


@lru_cache(maxsize=64)
def _template(kind: str, content: str, wanted: frozenset[FieldPath]) -> tuple[bytes, Layout]:
    """Return a message of a type, given as JSON, and the places of the wanted fields."""
    data = serialize_dynamic(kind, SCHEMAS[kind])[kind](json.loads(content))
    return data, Layout(data, short_name(kind), parse_definition(kind, SCHEMAS[kind]), wanted)


def _encode(kind: str, columns: Mapping[str, npt.NDArray[Any]],
            stamps_ns: npt.NDArray[np.int64] | None = None, **content: Any) -> list[bytes]:
    """Return messages with `columns` (path -> values) and, in all of them, `content`."""
    if stamps_ns is not None:
        columns = {'header.stamp.sec': stamps_ns // 1_000_000_000,
                   'header.stamp.nanosec': stamps_ns % 1_000_000_000, **columns}
    paths = {parse_field_path(path): values for path, values in columns.items()}
    data, layout = _template(kind, json.dumps(content), frozenset(paths))
    rows = np.tile(np.frombuffer(data, np.uint8), (len(next(iter(paths.values()))), 1))
    for path, values in paths.items():
        layout.places[path].view(rows)[...] = values
    whole, size = rows.tobytes(), len(data)
    return [whole[at:at + size] for at in range(0, len(whole), size)]


def encode_scalars(kind: str, values: npt.ArrayLike) -> list[bytes]:
    """Return one std_msgs/Float32 or Float64 message for each value."""
    return _encode(kind, {'data': np.asarray(values)})


def encode_battery(stamps_ns: npt.NDArray[np.int64], voltage: npt.ArrayLike) -> list[bytes]:
    """Return one BatteryState per voltage, V, with all else "not measured" (stamps_ns in ns)."""
    return _encode(BATTERY_STATE, {'voltage': np.asarray(voltage)}, stamps_ns, present=True,
                   **dict.fromkeys(('temperature', 'current', 'charge', 'capacity',
                                    'design_capacity', 'percentage'), math.nan))


def encode_imu(stamps_ns: npt.NDArray[np.int64], values: npt.NDArray[np.float64]) -> list[bytes]:
    """Return one Imu per stamp, ns, in `base_link` (rad/s, (n, 3); with m/s^2, (n, 6))."""
    vectors = dict(zip(('angular_velocity', 'linear_acceleration'),
                       np.hsplit(values, values.shape[1] // 3)))
    # By the message definition -1 means not measured, and 0 an unknown covariance.
    unmeasured = {f'{name}_covariance': [-1.0, *[0.0] * 8] for name in (
        'orientation', 'angular_velocity', 'linear_acceleration') if name not in vectors}
    columns = {f'{name}.{axis}': values[:, k] for name, values in vectors.items()
               for k, axis in enumerate('xyz')}
    return _encode(IMU, columns, stamps_ns, header={'frame_id': 'base_link'},
                   orientation={'w': 1.0}, **unmeasured)


def encode_joints(stamps_ns: npt.NDArray[np.int64], names: Sequence[str],
                  velocity: npt.NDArray[np.float64]) -> list[bytes]:
    """Return one JointState for each stamp, ns, with velocities, rad/s, shape (n, m)."""
    return _encode(JOINT_STATE, {'velocity': velocity}, stamps_ns, name=list(names),
                   velocity=[0.0] * len(names))


def encode_blocks(samples: npt.NDArray[np.float64]) -> list[bytes]:
    """Return a std_msgs/Float32MultiArray for each row of samples, shape (m, n)."""
    n = samples.shape[1]
    return _encode(FLOAT32_ARRAY, {'data': samples}, data=[0.0] * n, layout={
        'dim': [{'label': 'samples', 'size': n, 'stride': n}]})
