"""
Many messages at once -> CDR (little endian), for the four standard types of a voltage.

Layouts: OMG DDS-XTypes 7.4.3, plain CDR version 1, alignment counted from after
the 4-byte header.  `layout.py` is the way back, for any type.
"""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt

# Representation identifier CDR_LE, no options.
HEADER = b'\x00\x01\x00\x00'

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
