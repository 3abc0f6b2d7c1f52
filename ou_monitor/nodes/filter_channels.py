"""What `adaptive_filter` takes out of a message, and puts back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ou_monitor.errors import InputError, nearest
from ou_monitor.nodes.message_types import message_class
from ou_monitor.stream.config import FieldPath, FieldSpec, parse_field_path
from ou_monitor.stream.extract import Extractor


@dataclass(frozen=True)
class Channels:
    """
    The signals of one message type.

    Attributes
    ----------
    names : tuple of str
        Signals, one low-pass each.
    take : callable
        Message to its values; empty where an array is too short for them.
    put : callable
        Message and filtered values; changes the message in place.

    """

    names: tuple[str, ...]
    take: Callable[[Any], Sequence[float]]
    put: Callable[[Any, Sequence[float]], None]


def _put_data(message: Any, values: Sequence[float]) -> None:
    message.data = values[0]


def _put_voltage(message: Any, values: Sequence[float]) -> None:
    message.voltage = values[0]


def _take_gyro(message: Any) -> Sequence[float]:
    rate = message.angular_velocity
    return rate.x, rate.y, rate.z


def _put_gyro(message: Any, values: Sequence[float]) -> None:
    rate = message.angular_velocity
    rate.x, rate.y, rate.z = values


_DATA = Channels(('data',), lambda message: (message.data,), _put_data)

# The types that are filtered without a field being named.
CHANNELS: dict[str, Channels] = {
    'std_msgs/msg/Float32': _DATA,
    'std_msgs/msg/Float64': _DATA,
    'sensor_msgs/msg/BatteryState': Channels(
        ('voltage',), lambda message: (message.voltage,), _put_voltage),
    'sensor_msgs/msg/Imu': Channels(('x', 'y', 'z'), _take_gyro, _put_gyro),
}


def channels_of(kind: str, field: str) -> Channels:
    """Return the signals of a type."""
    if field:
        return _field_channel(kind, field)
    if kind not in CHANNELS:
        raise InputError(
            f"input.type: cannot filter '{kind}' without input.field (the path of its signal); "
            f'{nearest(kind, CHANNELS)}')
    return CHANNELS[kind]


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

    def put(message: Any, values: Sequence[float]) -> None:
        at = _walk(message, holder)
        if isinstance(last, str):
            setattr(at, last, values[0])
        else:
            at[last] = values[0]

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
