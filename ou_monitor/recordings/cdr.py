"""
Bulk CDR (little endian) of the four standard types that carry a voltage.

Any other type, and any message whose shape is not the expected one, goes
through the general decoder of the MCAP library; this is the shortcut that
makes a million messages a matter of seconds.  Layouts: OMG DDS-XTypes 7.4.3,
plain CDR version 1, alignment counted from after the 4-byte header.
"""

from __future__ import annotations

from collections.abc import Sequence
import struct

import numpy as np
import numpy.typing as npt

from ou_monitor.records import FloatArray

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

Bytes = bytes | memoryview


def encode_scalars(kind: str, values: npt.ArrayLike) -> list[bytes]:
    """
    Return one std_msgs/Float32 or Float64 message for each value.

    Parameters
    ----------
    kind : str
        `FLOAT32` or `FLOAT64`.
    values : array_like, shape (n,)
        Content of `data`.

    Returns
    -------
    list of bytes, length n
        Serialized messages.

    """
    layout = {FLOAT32: _FLOAT32, FLOAT64: _FLOAT64}[kind]
    rows = np.zeros(np.size(values), layout)
    rows['head'] = np.void(HEADER)
    rows['data'] = values
    return _split(rows)


def encode_battery(stamps_ns: npt.NDArray[np.int64], voltage: npt.ArrayLike) -> list[bytes]:
    """
    Return one sensor_msgs/BatteryState for each voltage; the rest is "not measured".

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Header stamps, ns, 0 <= stamp < 2^31 s.
    voltage : array_like, shape (n,)
        Voltage, V.

    Returns
    -------
    list of bytes, length n
        Serialized messages.

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
    """
    Return one std_msgs/Float32MultiArray with one dimension named 'samples'.

    Parameters
    ----------
    samples : array_like, shape (n,)
        Content of `data`.

    Returns
    -------
    bytes
        Serialized message.

    """
    data = np.asarray(samples, dtype='<f4')
    layout = struct.pack('<II8sIII', 1, 8, b'samples', data.size, data.size, 0)
    return HEADER + layout + struct.pack('<I', data.size) + data.tobytes()


def decode_scalars(
    kind: str, field: str, messages: Sequence[Bytes],
) -> tuple[npt.NDArray[np.int64] | None, FloatArray] | None:
    """
    Return stamps and values of many messages of one standard type at once.

    Parameters
    ----------
    kind : str
        Message type.
    field : str
        Field path asked for.
    messages : sequence of bytes, length n
        Serialized messages.

    Returns
    -------
    tuple or None
        ``(stamps, values)``: header stamps, ns, shape (n,), or None when the
        type has none, and raw values, shape (n,).  None as a whole when this
        shortcut does not apply.

    """
    wanted = {FLOAT32: 'data', FLOAT64: 'data', BATTERY_STATE: 'voltage'}.get(kind)
    if wanted is None or wanted != field or not messages:
        return None
    length = len(messages[0])
    if any(len(message) != length for message in messages):
        return None
    whole = np.frombuffer(b''.join(messages), np.uint8).reshape(len(messages), length)
    if length < 8 or not (whole[:, :2] == (0, 1)).all():
        return None
    if kind != BATTERY_STATE:
        layout = {FLOAT32: '<f4', FLOAT64: '<f8'}[kind]
        size = np.dtype(layout).itemsize
        return None if length < 4 + size else (None, _column(whole, 4, layout))
    if length < 20:
        return None
    frame = _column(whole, 12, '<u4')
    # The voltage comes after the frame_id, on the next multiple of 4.
    at = 4 + (12 + int(frame[0]) + 3) // 4 * 4
    if not (frame == frame[0]).all() or at + 4 > length:
        return None
    stamps = (_column(whole, 4, '<i4').astype(np.int64) * 1_000_000_000
              + _column(whole, 8, '<u4').astype(np.int64))
    return stamps, _column(whole, at, '<f4')


def decode_block(message: Bytes) -> FloatArray | None:
    """
    Return `data` of a std_msgs/Float32MultiArray.

    Parameters
    ----------
    message : bytes
        Serialized message.

    Returns
    -------
    ndarray, shape (n,), or None
        Samples; None when the message is not little endian or is cut off.

    """
    if bytes(message[:2]) != HEADER[:2]:
        return None
    try:
        (dimensions,) = struct.unpack_from('<I', message, 4)
        at = 8
        for _ in range(min(dimensions, len(message))):
            (text,) = struct.unpack_from('<I', message, at)
            at += 4 + (text + 3) // 4 * 4 + 8
        (count,) = struct.unpack_from('<I', message, at + 4)
        data = np.frombuffer(message, '<f4', count, at + 8)
    except (struct.error, ValueError):
        return None
    return data.astype(np.float64)


def _column(whole: npt.NDArray[np.uint8], at: int, kind: str) -> FloatArray:
    width = np.dtype(kind).itemsize
    column = np.ascontiguousarray(whole[:, at:at + width]).view(kind)[:, 0]
    return column.astype(np.float64) if kind.startswith('<f') else column


def _split(rows: npt.NDArray[np.void]) -> list[bytes]:
    """Return the bytes of each row."""
    size = rows.dtype.itemsize
    whole = rows.tobytes()
    return [whole[at:at + size] for at in range(0, len(whole), size)]
