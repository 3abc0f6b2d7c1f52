"""
Messages of `adaptive_filter` as the middleware has them.

Signals are read and replaced where the layout of a message has them (`recordings.cdr`): of an
Imu that costs a sixth of what decoding and encoding do.  A message without a layout, and one
that becomes another in a derivative, is decoded.
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct
from typing import Any

from ou_monitor.nodes.filter_channels import Channels, Group
from ou_monitor.nodes.inputs import decode
from ou_monitor.nodes.sources import definition_of, message_class
from ou_monitor.recordings.cdr import (
    Layout, layout_of, MOST_LAYOUTS, parse_definition, Place, short_name)
from ou_monitor.stream.config import FieldPath

_STAMP: tuple[FieldPath, ...] = (('header', 'stamp', 'sec'), ('header', 'stamp', 'nanosec'))
_CODES = {'<f4': 'f', '<f8': 'd'}


class Frames:
    """
    The messages of one type on a topic.

    `decoded` counts those that have no layout.
    """

    def __init__(self, kind: str, channels: Channels, topic: str) -> None:
        self._topic = topic
        self._channels = channels
        self._class = message_class(kind)
        self._kind = short_name(kind)
        self._stamped = (
            self._class.get_fields_and_field_types().get('header') == 'std_msgs/Header')
        self._definitions = (None if channels.make is not None else
                             parse_definition(kind, definition_of(self._class)))
        self._cuts: dict[int, list[_Cut]] = {}
        self._learned = 0
        self.decoded = 0

    def open(self, data: bytes) -> Frame:  # noqa: A003
        """Return a message with its signals; InputError: it cannot be read."""
        known = (cut for cut in self._cuts.get(len(data), ()) if cut.holds_for(data))
        cut = next(known, None) or self._learn(data)
        if cut is not None:
            return Frame(cut, data, cut.stamp(data), cut.values(data))
        self.decoded += 1
        message = decode(data, self._class, self._topic)
        stamp = message.header.stamp if self._stamped else None
        return Frame(self._channels, message,
                     stamp.sec + stamp.nanosec * 1e-9 if stamp else 0.0,
                     self._channels.take(message))

    def _learn(self, data: bytes) -> _Cut | None:
        """Return where the signals are in such messages; None: that is not to be had."""
        if self._definitions is None or self._learned >= MOST_LAYOUTS:
            return None
        wanted = [path for group in self._channels.groups
                  for path in (*group.fields, *([group.covariance] if group.covariance else []))]
        stamp = _STAMP if self._stamped else ()
        layout = layout_of(data, self._kind, self._definitions, (*wanted, *stamp))
        if layout is None or not {*wanted, *stamp} <= layout.places.keys():
            return None
        parts = [_part(group, layout) for group in self._channels.groups]
        if None in parts:
            return None
        self._learned += 1
        cut = _Cut(layout, [part for part in parts if part is not None], self._stamped)
        self._cuts.setdefault(len(data), []).append(cut)
        return cut


class Frame:
    """
    A message.

    `stamp` is the header's, s, and 0 where it has none; `values` are empty where the message does
    not hold them.
    """

    __slots__ = ('_of', '_content', 'stamp', 'values')

    def __init__(self, of: Channels | _Cut, content: Any, stamp: float,
                 values: Sequence[float]) -> None:
        self._of, self._content, self.stamp, self.values = of, content, stamp, values

    def put(self, values: Sequence[float], left: float) -> Any:
        """Return what goes out, serialised or not; as `Channels.put`."""
        return self._of.put(self._content, values, left)


class _Part:
    """A group of signals in a serialised message."""

    def __init__(self, numbers: Struct, at: int, covariance: tuple[Struct, int] | None,
                 group: Group) -> None:
        self.size, self.needed = len(group.fields), group.needed
        self._numbers, self._at = numbers, at
        self._covariance = covariance

    def values(self, data: bytes) -> tuple[float, ...] | None:
        """Return its values; None where the message does not hold them."""
        if self._covariance is not None:
            matrix, at = self._covariance
            if matrix.unpack_from(data, at)[0] == -1.0:
                return None
        return self._numbers.unpack_from(data, self._at)

    def put(self, out: bytearray, values: Sequence[float], left: float) -> None:
        """Write filtered values, where the message holds any."""
        if self._covariance is not None:
            matrix, at = self._covariance
            found = matrix.unpack_from(out, at)
            if found[0] == -1.0:
                return
            if any(found):
                matrix.pack_into(out, at, *(one * left for one in found))
        self._numbers.pack_into(out, self._at, *values)


class _Cut:
    """A layout, made ready for one message at a time."""

    def __init__(self, layout: Layout, parts: Sequence[_Part], stamped: bool) -> None:
        self._parts = parts
        # The two bytes that say little endian, and every length.
        form, at = '<2B', 2
        for offset, _ in layout.words:
            form += f'{offset - at}xI'
            at = offset + 4
        self._words = Struct(form)
        self._expected = (0, 1, *(value for _, value in layout.words))
        self._stamp = layout.places[_STAMP[0]].offset if stamped else 0

    def holds_for(self, data: bytes) -> bool:
        """Return whether a message of the same length has this layout."""
        return self._words.unpack_from(data) == self._expected

    def stamp(self, data: bytes) -> float:
        """Return the header's stamp, s; 0: none."""
        if not self._stamp:
            return 0.0
        sec, nanosec = _TIME.unpack_from(data, self._stamp)
        return float(sec + nanosec * 1e-9)

    def values(self, data: bytes) -> Sequence[float]:
        """Return the signals; empty where the message does not hold them."""
        values: tuple[float, ...] = ()
        for part in self._parts:
            found = part.values(data)
            if found is None:
                if part.needed:
                    return ()
                found = (0.0,) * part.size
            values += found
        return values

    def put(self, data: bytes, values: Sequence[float], left: float) -> bytes:
        """Return the message with filtered values, and so much of the white noise's variance."""
        out = bytearray(data)
        at = 0
        for part in self._parts:
            part.put(out, values[at:at + part.size], left)
            at += part.size
        return bytes(out)


_TIME = Struct('<iI')


def _part(group: Group, layout: Layout) -> _Part | None:
    """Return where a group is; None where its numbers are no floats one behind the other."""
    places = [layout.places[path] for path in group.fields]
    numbers = _struct(places)
    if numbers is None:
        return None
    covariance = None
    if group.covariance is not None:
        place = layout.places[group.covariance]
        covariance = Struct(f'<{place.size or 1}{_CODES[place.kind]}'), place.offset
    return _Part(numbers, places[0].offset, covariance, group)


def _struct(places: Sequence[Place]) -> Struct | None:
    kinds = {place.kind for place in places}
    if len(kinds) > 1 or not kinds <= _CODES.keys():
        return None
    found = Struct(f'<{len(places)}{_CODES[kinds.pop()]}')
    width = found.size // len(places)
    first = places[0].offset
    if [place.offset for place in places] != [first + k * width for k in range(len(places))]:
        return None
    return found if all(place.size is None for place in places) else None
