"""
The signals that `adaptive_filter` takes from a message and writes back.

The unit of a derivative differs from its signal's (per second), so a derivative is not written
into the field of the signal, but published in a message of another type (except a bare number).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from ou_monitor.errors import InputError, nearest
from ou_monitor.nodes.sources import definition_of, message_class
from ou_monitor.recordings.cdr import value_path
from ou_monitor.stream.config import FieldPath, FieldSpec, put, walk

# Output types of derivatives: of an angular velocity; of another signal with a stamp (its
# derivative is the vector's x); of a signal without a stamp.
ACCEL, VECTOR, PLAIN = ('geometry_msgs/msg/AccelStamped', 'geometry_msgs/msg/Vector3Stamped',
                        'std_msgs/msg/Float64')
_NONE = (math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Channels:
    """The signals of one message type."""

    names: tuple[str, ...]  # Signals, one low-pass each
    fields: tuple[FieldPath, ...]  # Where each is in the message
    # Covariance of the signals, which stays unchanged; its first element is -1 if the message
    # lacks the signals.
    covariance: FieldPath | None = None
    output: str = ''  # Type of the output; empty: the type of the input
    # Makes the output from a message and filtered values; None: the values replace the signals.
    make: Callable[[Any, Sequence[float]], Any] | None = None

    def take(self, message: Any) -> Sequence[float]:
        """Return the values in a message; empty if it lacks them."""
        if self.covariance is not None and walk(message, self.covariance)[0] == -1.0:
            return ()
        values = [walk(message, path) for path in self.fields]
        return () if None in values else tuple(map(float, values))

    def put(self, message: Any, values: Sequence[float]) -> Any:
        """Return the output message."""
        if self.make is not None:
            return self.make(message, values)
        for path, value in zip(self.fields, values, strict=True):
            put(message, path, value)
        return message


def _fill(vector: Any, values: Sequence[float]) -> None:
    vector.x, vector.y, vector.z = values


_DATA = Channels(('data',), (('data',),))
_GYRO = Channels(tuple('xyz'), tuple(('angular_velocity', axis) for axis in 'xyz'),
                 ('angular_velocity_covariance',))

# Types whose signals need not be named.
CHANNELS: dict[str, Channels] = {
    'std_msgs/msg/Float32': _DATA,
    'std_msgs/msg/Float64': _DATA,
    'sensor_msgs/msg/BatteryState': Channels(('voltage',), (('voltage',),)),
    'sensor_msgs/msg/Imu': _GYRO,
}


def channels_of(kind: str, field: str, *, mode: str = 'lowpass') -> Channels:
    """Return the signals of a message type; InputError if `field` is missing or unusable."""
    if field:
        found = _field_channel(kind, field)
    elif kind in CHANNELS:
        found = CHANNELS[kind]
    else:
        raise InputError(
            f"input.type: cannot filter '{kind}' without input.field (the path of its signal); "
            f'{nearest(kind, CHANNELS)}')
    # A bare number has no unit: without `input.field`, its derivative keeps its type.
    return found if mode != 'derivative' or found is _DATA else _derivative(kind, found)


def _derivative(kind: str, channels: Channels) -> Channels:
    """Return channels whose output is a derivative, with the header of the input."""
    stamped = hasattr(message_class(kind)(), 'header')
    output = ACCEL if channels is _GYRO else VECTOR if stamped else PLAIN
    made_of = message_class(output)

    def derive(message: Any, values: Sequence[float]) -> Any:
        out = made_of()
        if output == PLAIN:
            out.data = values[0]
            return out
        out.header = message.header
        if output == ACCEL:
            _fill(out.accel.angular, values)
            _fill(out.accel.linear, _NONE)
        else:
            _fill(out.vector, (values[0], math.nan, math.nan))
        return out

    return replace(channels, output=output, make=derive)


def _field_channel(kind: str, field: str) -> Channels:
    """Return one field of any installed type, tried on an empty message."""
    message = message_class(kind)()
    steps = value_path(FieldSpec('input', kind, field), definition_of(message_class(kind)))
    # None: an array element that an empty message lacks.
    value = walk(message, steps)
    if value is not None and not isinstance(value, float):
        raise InputError(
            f"input.field: '{field}' of {kind} holds a {type(value).__name__}, which cannot take "
            'a filtered value: name a float field')
    return Channels((field,), (steps,))
