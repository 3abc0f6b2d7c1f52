"""
From a message to numbers: the field that a msg_config names, in SI units.

Works on any object with attributes: rclpy messages and decoded MCAP messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
import math
import operator
from typing import Any

import numpy as np
from ou_monitor.errors import InputError, nearest
from ou_monitor.records import FloatArray
from ou_monitor.stream.config import FieldPath, FieldSpec, parse_each_path, parse_field_path


class ZeroRule:
    """Makes NaN of zeros that are none, as a msg_config's `zero` says."""

    def __init__(self, rule: str) -> None:
        self._rule = rule

    def apply(self, values: FloatArray) -> FloatArray:
        """Return values in order of arrival, zeros that are none as NaN."""
        if self._rule == 'value':
            return values
        nothing = values == 0.0
        if self._rule == 'unknown_at_first':
            something = np.flatnonzero(np.isfinite(values) & ~nothing)
            if something.size:
                self._rule = 'value'
                nothing[int(something[0]):] = False
        return np.where(nothing, np.nan, values) if nothing.any() else values


@dataclass(frozen=True, eq=False)
class Extracted:
    """What one message said."""

    # Stamp, s (of the LAST sample of a block); None when the message has none, or a zero one: take
    # the source timestamp of the middleware.
    stamp: float | None
    # Values in SI units, in order.  With the rule ``drop`` a number that is not finite is left out
    # (n may be 0); with ``unknown``, and in blocks (where every sample holds its place on the time
    # line), it is NaN; shape (n,).
    values: FloatArray
    # Numbers that were not finite, or not there.
    missing: int


class Extractor:
    """Takes one field and its stamp out of messages of one type; InputError: malformed path."""

    def __init__(self, spec: FieldSpec) -> None:
        """Prepare the paths once; messages arrive at kHz."""
        self.spec = spec
        self._zero = ZeroRule(spec.zero)
        self._scale = spec.sign * spec.unit_factor
        self._value = self._getter(spec.field)
        self._stamp = None if spec.stamp_field is None else self._getter(spec.stamp_field)

    def extract(self, msg: object) -> Extracted:
        """Return the stamp and the values of one message."""
        stamp = None if self._stamp is None else self._read_stamp(self._stamp(msg))
        raw = self._value(msg)
        if raw is None:
            return Extracted(stamp, np.empty(0), 1)
        # A damaged message may hold a signalling NaN, of which NumPy would warn.
        with np.errstate(invalid='ignore'):
            values = self._zero.apply(self._numbers(raw) * self._scale + self.spec.offset)
        finite = np.isfinite(values)
        missing = values.size - int(np.count_nonzero(finite))
        if missing:
            if self.spec.nan == 'drop' and self.spec.sample_rate is None:
                values = values[finite]
            else:
                values[~finite] = np.nan
        return Extracted(stamp, values, missing)

    def _numbers(self, raw: Any) -> FloatArray:
        """Return the raw content of the field as a new array of shape (n,)."""
        is_text = isinstance(raw, (str, bytes))
        try:
            if is_text:
                raise TypeError('text')
            values = np.array(raw, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"field '{self.spec.field}' of {self.spec.type} holds a {type(raw).__name__}, "
                'not a number: name a numeric field in the msg config') from error
        if values.ndim > 1 or (values.ndim == 1 and self.spec.sample_rate is None):
            raise InputError(
                f"field '{self.spec.field}' of {self.spec.type} is an array: name one element, "
                f"'{self.spec.field}[0]', or give sample_rate if it is a block of samples")
        if values.ndim == 0:
            values = values.reshape(1)
        return values

    def _read_stamp(self, raw: Any) -> float | None:
        """Return a stamp in seconds, or None for "no stamp" (zero)."""
        if raw is None:
            return None
        if hasattr(raw, 'sec') and hasattr(raw, 'nanosec'):
            seconds = float(raw.sec) + 1e-9 * float(raw.nanosec)
        elif isinstance(raw, (int, float)):
            seconds = float(raw) * self.spec.stamp_factor
        else:
            raise InputError(
                f"stamp_field '{self.spec.stamp_field}' of {self.spec.type} is a "
                f'{type(raw).__name__}: neither a builtin_interfaces/Time nor a number')
        return seconds if math.isfinite(seconds) and seconds != 0.0 else None

    def _getter(self, path: str) -> Callable[[object], Any]:
        """Return a function from message to the content at `path`."""
        steps = parse_field_path(path)
        names = [step for step in steps if isinstance(step, str)]
        if len(names) == len(steps):
            get = operator.attrgetter('.'.join(names))

            def plain(msg: object) -> Any:
                try:
                    return get(msg)
                except AttributeError:
                    return self.walk(msg, steps, path)
            return plain
        return lambda msg: self.walk(msg, steps, path)

    def walk(self, msg: object, steps: FieldPath, path: str) -> Any:
        """Follow a path step by step; None where an array is too short."""
        at: Any = msg
        for step in steps:
            if isinstance(step, str):
                if not hasattr(at, step):
                    raise InputError(
                        f"field path '{path}' is not in {self.spec.type}: no '{step}' there; "
                        + nearest(step, _fields_of(at)))
                at = getattr(at, step)
            else:
                try:
                    if step >= len(at):
                        return None
                except TypeError as error:
                    raise InputError(
                        f"field path '{path}' of {self.spec.type}: [{step}] asks for an element "
                        'of something that is not an array') from error
                at = at[step]
        return at


class ManyExtractor:
    """
    Takes several numbers out of messages of one type: a number, an array, or a field of each.

    'esc[].esc_rpm' is that field of each element of `esc`.  InputError when a path is malformed.
    """

    def __init__(self, spec: FieldSpec) -> None:
        self.spec = spec
        self._array, self._each = parse_each_path(spec.field)
        self._walker = Extractor(replace(spec, field=spec.field.partition('[]')[0]))

    def extract(self, msg: object) -> FloatArray:
        """Return the values of one message in SI units, shape (n,); NaN: not known."""
        path = self.spec.field
        raw = self._walker.walk(msg, self._array, path)
        if raw is None:
            return np.empty(0)
        try:
            if self._each is not None:
                raw = [self._walker.walk(one, self._each, path) for one in raw]
            if isinstance(raw, (str, bytes)):
                raise TypeError('text')
            values = np.array(raw, dtype=np.float64).ravel()
        except (TypeError, ValueError) as error:
            raise InputError(
                f"field '{self.spec.field}' of {self.spec.type} holds no numbers: name a numeric "
                "field, an array of them, or one of each element, 'name[].field'") from error
        return np.asarray(values * (self.spec.sign * self.spec.unit_factor) + self.spec.offset)


def _fields_of(msg: object) -> Iterable[str]:
    """Return the names of the fields of a message, for hints."""
    describe = getattr(msg, 'get_fields_and_field_types', None)
    if callable(describe):
        return list(describe())
    slots = [name for name in getattr(msg, '__slots__', ()) if not name.startswith('_')]
    return slots or [name for name in getattr(msg, '__dict__', {}) if not name.startswith('_')]
