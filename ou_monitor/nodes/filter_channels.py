"""What `adaptive_filter` takes out of a message, and puts back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Channels:
    """
    The signals of one message type.

    Attributes
    ----------
    names : tuple of str
        Signals, one low-pass each.
    take : callable
        Message to its values.
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

# The one place that knows which types can be filtered.
CHANNELS: dict[str, Channels] = {
    'std_msgs/msg/Float32': _DATA,
    'std_msgs/msg/Float64': _DATA,
    'sensor_msgs/msg/BatteryState': Channels(
        ('voltage',), lambda message: (message.voltage,), _put_voltage),
    'sensor_msgs/msg/Imu': Channels(('x', 'y', 'z'), _take_gyro, _put_gyro),
}
