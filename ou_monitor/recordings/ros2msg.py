"""
Message definitions (ros2msg text) -> the fields of each type, in order.

Limits first: this reads what `rosidl` writes into bags.  A definition with
anything else in it gives None, and the general decoder has the word.
https://docs.ros.org/en/jazzy/Concepts/Basic/About-Interfaces.html
"""

from __future__ import annotations

from dataclasses import dataclass
import re

# ROS name -> NumPy type, little endian, as the general decoder reads it.
PRIMITIVES = {
    'bool': '?', 'byte': 'u1', 'char': 'i1', 'int8': 'i1', 'uint8': 'u1', 'int16': '<i2',
    'uint16': '<u2', 'int32': '<i4', 'uint32': '<u4', 'int64': '<i8', 'uint64': '<u8',
    'float32': '<f4', 'float64': '<f8',
}
TEXT = 'string'

_SEPARATOR = re.compile(r'^={3,}$', re.MULTILINE)
_NAME = re.compile(r'MSG:\s+([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)')
_CONSTANT = re.compile(r'\w+(?:<=\d+)?\s+[A-Z]\w*\s*=')
_FIELD = re.compile(
    r'(?:([A-Za-z]\w*)/)?([A-Za-z]\w*)(?:<=\d+)?(\[(?:<=\d+|\d*)\])?\s+([a-z]\w*)'
    r'(?:\s+[^=\s][^=]*)?')


@dataclass(frozen=True)
class Field:
    """
    One field of a message.

    Attributes
    ----------
    name : str
        Its name.
    type : str
        A key of `PRIMITIVES`, `TEXT`, or 'package/Type'.
    array : bool
        Whether it is an array.
    size : int or None
        Elements of an array of fixed size; None when a message states them.

    """

    name: str
    type: str  # noqa: A003
    array: bool = False
    size: int | None = None


# package/Type -> its fields.
Definitions = dict[str, tuple[Field, ...]]

# What the general decoder takes where a bag does not carry these.
_TIME = (Field('sec', 'uint32'), Field('nanosec', 'uint32'))


def short_name(kind: str) -> str:
    """Return 'package/Type' for 'package/msg/Type'."""
    words = kind.split('/')
    return f'{words[0]}/{words[-1]}'


def parse_definition(kind: str, text: str) -> Definitions | None:
    """Return the fields of a type and of those that it uses."""
    found: Definitions = {'builtin_interfaces/Time': _TIME, 'builtin_interfaces/Duration': _TIME}
    name = short_name(kind)
    for part in _SEPARATOR.split(text.replace('\r', '')):
        lines = [line.strip() for line in part.splitlines()]
        lines = [line for line in lines if line]
        if lines and (match := _NAME.fullmatch(lines[0])):
            name = f'{match[1]}/{match[2]}'
            lines = lines[1:]
        fields = []
        for line in lines:
            if '#' in line and ('"' in line or "'" in line.partition('#')[0]):
                return None
            line = line.partition('#')[0].strip()
            if not line or _CONSTANT.match(line):
                continue
            field = _field(line, name.partition('/')[0])
            if field is None:
                return None
            fields.append(field)
        found[name] = tuple(fields)
    return found if short_name(kind) in found else None


def _field(line: str, package: str) -> Field | None:
    match = _FIELD.fullmatch(line)
    if match is None:
        return None
    other, kind, array, name = match.groups()
    if other is not None:
        kind = f'{other}/{kind}'
    elif kind[0].isupper():
        kind = f'{package}/{kind}'
    elif kind not in PRIMITIVES and kind != TEXT:
        return None
    if array is None:
        return Field(name, kind)
    inside = array[1:-1]
    return Field(name, kind, True, int(inside) if inside.isdigit() else None)
