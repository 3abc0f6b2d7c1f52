"""
What `adaptive_filter` takes out of a message, and puts back.

A derivative is in the unit of its signal per second, which the field of the signal
is not: it goes out in a message that says what it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from ou_monitor.errors import InputError, nearest
from ou_monitor.nodes.sources import message_class
from ou_monitor.stream.config import FieldPath, FieldSpec, parse_field_path
from ou_monitor.stream.extract import Extractor

IMU = 'sensor_msgs/msg/Imu'
# Of a derivative: angular acceleration (rad/s^2); any other of a message with a stamp, as x,
# and without one.
ACCEL, VECTOR, PLAIN = ('geometry_msgs/msg/AccelStamped', 'geometry_msgs/msg/Vector3Stamped',
                        'std_msgs/msg/Float64')
_NONE = (math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Channels:
    """
    The signals of one message type.

    Attributes
    ----------
    names : tuple of str
        Signals, one low-pass each.
    take : callable
        Message to its values; empty where the message does not hold them.
    put : callable
        Message, filtered values, and the share that is left of the variance of white
        noise, to the message that goes out.
    output : str
        Its type; empty: that of the input.

    """

    names: tuple[str, ...]
    take: Callable[[Any], Sequence[float]]
    put: Callable[[Any, Sequence[float], float], Any]
    output: str = ''


def _put_data(message: Any, values: Sequence[float], _: float) -> Any:
    message.data = values[0]
    return message


def _put_voltage(message: Any, values: Sequence[float], _: float) -> Any:
    message.voltage = values[0]
    return message


def _take_gyro(message: Any) -> Sequence[float]:
    if message.angular_velocity_covariance[0] == -1.0:
        # The message says that it holds none.
        return ()
    return _vector(message.angular_velocity)


def _put_gyro(message: Any, values: Sequence[float], left: float) -> Any:
    _set(message.angular_velocity, values)
    _scale(message.angular_velocity_covariance, left)
    return message


def _take_both(message: Any) -> Sequence[float]:
    rates = _take_gyro(message)
    if not rates:
        return ()
    absent = message.linear_acceleration_covariance[0] == -1.0
    return (*rates, *((0.0, 0.0, 0.0) if absent else _vector(message.linear_acceleration)))


def _put_both(message: Any, values: Sequence[float], left: float) -> Any:
    _put_gyro(message, values[:3], left)
    # Where the message says that it holds none, it goes on saying so.
    if message.linear_acceleration_covariance[0] != -1.0:
        _set(message.linear_acceleration, values[3:])
        _scale(message.linear_acceleration_covariance, left)
    return message


def _vector(vector: Any) -> Sequence[float]:
    return vector.x, vector.y, vector.z


def _set(vector: Any, values: Sequence[float]) -> None:
    vector.x, vector.y, vector.z = values


def _scale(covariance: Any, left: float) -> None:
    """Scale a matrix in place; all 0 says that it is not known, and stays."""
    for place, value in enumerate(covariance):
        covariance[place] = value * left


_DATA = Channels(('data',), lambda message: (message.data,), _put_data)
_GYRO = Channels(('x', 'y', 'z'), _take_gyro, _put_gyro)

# The types that are filtered without a field being named.
CHANNELS: dict[str, Channels] = {
    'std_msgs/msg/Float32': _DATA,
    'std_msgs/msg/Float64': _DATA,
    'sensor_msgs/msg/BatteryState': Channels(
        ('voltage',), lambda message: (message.voltage,), _put_voltage),
    IMU: _GYRO,
}
_BOTH = Channels(('x', 'y', 'z', 'acceleration x', 'acceleration y', 'acceleration z'),
                 _take_both, _put_both)


def channels_of(kind: str, field: str, *, mode: str = 'lowpass',
                acceleration: bool = False) -> Channels:
    """Return the signals of a type."""
    if acceleration and (kind != IMU or field or mode == 'derivative'):
        raise InputError(
            f'input.acceleration is for {IMU}, without input.field and in mode lowpass: got '
            f"{kind}, input.field '{field}', mode {mode}")
    if field:
        found = _field_channel(kind, field)
    elif kind in CHANNELS:
        found = _BOTH if acceleration else CHANNELS[kind]
    else:
        raise InputError(
            f"input.type: cannot filter '{kind}' without input.field (the path of its signal); "
            f'{nearest(kind, CHANNELS)}')
    # A number without a unit stays one.
    return found if mode != 'derivative' or found is _DATA else _derivative(kind, found)


def _derivative(kind: str, channels: Channels) -> Channels:
    """Return channels whose output is a derivative, with the header of the input."""
    stamped = hasattr(message_class(kind)(), 'header')
    output = ACCEL if channels is _GYRO else VECTOR if stamped else PLAIN
    make = message_class(output)

    def put(message: Any, values: Sequence[float], _: float) -> Any:
        out = make()
        if output == PLAIN:
            out.data = values[0]
            return out
        out.header = message.header
        if output == ACCEL:
            _set(out.accel.angular, values)
            _set(out.accel.linear, _NONE)
        else:
            _set(out.vector, (values[0], math.nan, math.nan))
        return out

    return replace(channels, put=put, output=output)


def _field_channel(kind: str, field: str) -> Channels:
    """Return one field of any installed type, tried on an empty message."""
    steps = parse_field_path(field)
    message = message_class(kind)()
    # It says what is wrong with a path in words; None stands for an element not there yet.
    Extractor(FieldSpec('input', kind, field)).extract(message)
    value = _walk(message, steps)
    if value is not None and not isinstance(value, float):
        raise InputError(
            f"input.field: '{field}' of {kind} holds a {type(value).__name__}, which cannot take "
            'a filtered value: name a float field')
    holder, last = steps[:-1], steps[-1]

    def take(message: Any) -> Sequence[float]:
        value = _walk(message, steps)
        return () if value is None else (float(value),)

    def put(message: Any, values: Sequence[float], _: float) -> Any:
        at = _walk(message, holder)
        if isinstance(last, str):
            setattr(at, last, values[0])
        else:
            at[last] = values[0]
        return message

    return Channels((field,), take, put)


def _walk(message: Any, steps: FieldPath) -> Any:
    """Return what is at a path; None where an array is too short."""
    at = message
    for step in steps:
        if isinstance(step, str):
            at = getattr(at, step)
        elif step < len(at):
            at = at[step]
        else:
            return None
    return at
