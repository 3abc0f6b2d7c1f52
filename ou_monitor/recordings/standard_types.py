"""
The standard message types that bags are written with: definitions, and encoding in bulk.

A bag carries the definition (ros2msg) of every type in it, so that it can be read
where ROS is not installed.  Texts and hashes are those of ROS 2 Jazzy's
common_interfaces, comments left out; a test compares them with an independent
library.  The hash (REP-2016, RIHS01) is what rosbag2 writes beside the type.
Encoding is plain CDR version 1, little endian (OMG DDS-XTypes 7.4.3), alignment counted
from after the 4-byte header.  `cdr.py` is the way back, for any type.
"""

from __future__ import annotations

from collections.abc import Sequence
import struct

import numpy as np
import numpy.typing as npt

_SEPARATOR = 80 * '='

# rosbag2 prints this line between a definition and those that it uses.
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

# package/msg/Type -> its definition and the definitions it uses.
SCHEMAS: dict[str, str] = {
    'std_msgs/msg/Float32': 'float32 data\n',
    'std_msgs/msg/Float64': 'float64 data\n',
    'std_msgs/msg/Float32MultiArray': f"""\
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
    'sensor_msgs/msg/BatteryState': """\
uint8 POWER_SUPPLY_STATUS_UNKNOWN=0
uint8 POWER_SUPPLY_STATUS_CHARGING=1
uint8 POWER_SUPPLY_STATUS_DISCHARGING=2
uint8 POWER_SUPPLY_STATUS_NOT_CHARGING=3
uint8 POWER_SUPPLY_STATUS_FULL=4
uint8 POWER_SUPPLY_HEALTH_UNKNOWN=0
uint8 POWER_SUPPLY_HEALTH_GOOD=1
uint8 POWER_SUPPLY_HEALTH_OVERHEAT=2
uint8 POWER_SUPPLY_HEALTH_DEAD=3
uint8 POWER_SUPPLY_HEALTH_OVERVOLTAGE=4
uint8 POWER_SUPPLY_HEALTH_UNSPEC_FAILURE=5
uint8 POWER_SUPPLY_HEALTH_COLD=6
uint8 POWER_SUPPLY_HEALTH_WATCHDOG_TIMER_EXPIRE=7
uint8 POWER_SUPPLY_HEALTH_SAFETY_TIMER_EXPIRE=8
uint8 POWER_SUPPLY_TECHNOLOGY_UNKNOWN=0
uint8 POWER_SUPPLY_TECHNOLOGY_NIMH=1
uint8 POWER_SUPPLY_TECHNOLOGY_LION=2
uint8 POWER_SUPPLY_TECHNOLOGY_LIPO=3
uint8 POWER_SUPPLY_TECHNOLOGY_LIFE=4
uint8 POWER_SUPPLY_TECHNOLOGY_NICD=5
uint8 POWER_SUPPLY_TECHNOLOGY_LIMN=6
uint8 POWER_SUPPLY_TECHNOLOGY_TERNARY=7
uint8 POWER_SUPPLY_TECHNOLOGY_VRLA=8
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
    'sensor_msgs/msg/Imu': f"""\
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
    'sensor_msgs/msg/JointState': """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
""" + _STD_HEADER,
}

# package/msg/Type -> its RIHS01 hash.
TYPE_HASHES: dict[str, str] = {
    'std_msgs/msg/Float32':
        'RIHS01_7170d3d8f841f7be3172ce5f4f59f3a4d7f63b0447e8b33327601ad64d83d6e2',
    'std_msgs/msg/Float64':
        'RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a',
    'std_msgs/msg/Float32MultiArray':
        'RIHS01_0599f6f85b4bfca379873a0b4375a0aca022156bd2d7021275d116ed1fa8bfe0',
    'sensor_msgs/msg/BatteryState':
        'RIHS01_4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741',
    'sensor_msgs/msg/Imu':
        'RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b',
    'sensor_msgs/msg/JointState':
        'RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e',
}


# Representation identifier CDR_LE, no options.
HEADER = b'\x00\x01\x00\x00'

IMU = 'sensor_msgs/msg/Imu'
JOINT_STATE = 'sensor_msgs/msg/JointState'
FLOAT32 = 'std_msgs/msg/Float32'
FLOAT64 = 'std_msgs/msg/Float64'
FLOAT32_ARRAY = 'std_msgs/msg/Float32MultiArray'
BATTERY_STATE = 'sensor_msgs/msg/BatteryState'

_FLOAT32 = np.dtype([('head', 'V4'), ('data', '<f4')])
_FLOAT64 = np.dtype([('head', 'V4'), ('data', '<f8')])
# With an empty frame_id ("\0" and three bytes of padding), no cells, an empty
# location and an empty serial number.
_BATTERY = np.dtype([
    ('head', 'V4'), ('sec', '<i4'), ('nanosec', '<u4'), ('frame_length', '<u4'),
    ('frame', 'V4'), ('voltage', '<f4'), ('unmeasured', '<f4', (6,)), ('status', 'u1', (3,)),
    ('present', 'u1'), ('cells', '<u4', (2,)), ('location_length', '<u4'), ('location', 'V4'),
    ('serial_length', '<u4'), ('serial', 'V1')])

_IMU = np.dtype([
    ('head', 'V4'), ('sec', '<i4'), ('nanosec', '<u4'), ('frame_length', '<u4'), ('frame', 'V12'),
    *((name, '<f8', (size,)) for name, size in (
        ('orientation', 4), ('orientation_covariance', 9), ('angular_velocity', 3),
        ('angular_velocity_covariance', 9), ('linear_acceleration', 3),
        ('linear_acceleration_covariance', 9)))])


def encode_scalars(kind: str, values: npt.ArrayLike) -> list[bytes]:
    """Return one std_msgs/Float32 or Float64 message for each value."""
    layout = {FLOAT32: _FLOAT32, FLOAT64: _FLOAT64}[kind]
    rows = np.zeros(np.size(values), layout)
    rows['head'] = np.void(HEADER)
    rows['data'] = values
    return _split(rows)


def encode_battery(stamps_ns: npt.NDArray[np.int64], voltage: npt.ArrayLike) -> list[bytes]:
    """
    Return one sensor_msgs/BatteryState for each voltage; the rest is "not measured".

    stamps_ns in ns, voltage in V.
    """
    rows = np.zeros(stamps_ns.size, _BATTERY)
    rows['head'] = np.void(HEADER)
    rows['sec'] = stamps_ns // 1_000_000_000
    rows['nanosec'] = stamps_ns % 1_000_000_000
    # Strings count their terminating zero.
    for name in ('frame_length', 'location_length', 'serial_length'):
        rows[name] = 1
    rows['voltage'] = voltage
    rows['unmeasured'] = np.nan
    rows['present'] = 1
    return _split(rows)


def encode_imu(stamps_ns: npt.NDArray[np.int64], angular_velocity: npt.NDArray[np.float64] | None,
               acceleration: npt.NDArray[np.float64] | None) -> list[bytes]:
    """
    Return one sensor_msgs/Imu in `base_link` for each stamp; None: not measured.

    stamps_ns in ns, angular_velocity of shape (n, 3) in rad/s, acceleration in m/s^2.
    """
    rows = np.zeros(stamps_ns.size, _IMU)
    rows['head'] = np.void(HEADER)
    rows['sec'], rows['nanosec'] = stamps_ns // 1_000_000_000, stamps_ns % 1_000_000_000
    rows['frame_length'], rows['frame'] = 10, np.void(b'base_link\0\0\0')
    rows['orientation'][:, 3] = 1.0
    # By the message definition -1 means not measured, and 0 an unknown covariance.
    rows['orientation_covariance'][:, 0] = -1.0
    for name, values in (('angular_velocity', angular_velocity),
                         ('linear_acceleration', acceleration)):
        if values is None:
            rows[f'{name}_covariance'][:, 0] = -1.0
        else:
            rows[name] = values
    return _split(rows)


def encode_joints(stamps_ns: npt.NDArray[np.int64], names: Sequence[str],
                  velocity: npt.NDArray[np.float64]) -> list[bytes]:
    """
    Return one sensor_msgs/JointState for each stamp, velocities only.

    stamps_ns in ns, velocity of shape (n, m) in rad/s.
    """
    # From the frame, which is empty, to the number of velocities: the same in all.
    texts = struct.pack('<I4sI', 1, b'', len(names))
    for name in names:
        data = name.encode() + b'\0'
        texts += b'\0' * (-len(texts) % 4) + struct.pack('<I', len(data)) + data
    texts += b'\0' * (-len(texts) % 4) + struct.pack('<II', 0, len(names))
    # Counted from the stamp, of 8 bytes.
    texts += b'\0' * (-len(texts) % 8)
    layout = np.dtype([('head', 'V4'), ('sec', '<i4'), ('nanosec', '<u4'),
                       ('texts', f'V{len(texts)}'), ('velocity', '<f8', (len(names),)),
                       ('effort', '<u4')])
    rows = np.zeros(stamps_ns.size, layout)
    rows['head'] = np.void(HEADER)
    rows['sec'], rows['nanosec'] = stamps_ns // 1_000_000_000, stamps_ns % 1_000_000_000
    rows['texts'], rows['velocity'] = np.void(texts), velocity
    return _split(rows)


def encode_block(samples: npt.ArrayLike) -> bytes:
    """Return one std_msgs/Float32MultiArray with one dimension named 'samples'."""
    data = np.asarray(samples, dtype='<f4')
    layout = struct.pack('<II8sIII', 1, 8, b'samples', data.size, data.size, 0)
    return HEADER + layout + struct.pack('<I', data.size) + data.tobytes()


def _split(rows: npt.NDArray[np.void]) -> list[bytes]:
    """Return the bytes of each row."""
    size = rows.dtype.itemsize
    whole = rows.tobytes()
    return [whole[at:at + size] for at in range(0, len(whole), size)]
