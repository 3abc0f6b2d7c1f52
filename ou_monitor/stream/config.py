"""
Read `msg_config/*.yaml`: topic, type and field of voltage, throttle, current and motor speeds.

One file describes one source (an autopilot bridge, an ADC driver); a new message type needs a new
file and no code.  An error in a file is one line with the file, the key and the nearest valid key.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, MISSING
import math
from pathlib import Path
import re
from typing import Any

import numpy as np
from ou_monitor.errors import closest, InputError, nearest
from ou_monitor.records import FloatArray
from ou_monitor.stream.files import one_line, path_words, read_yaml
from ou_monitor.text import printable

NAN_RULES = ('drop', 'unknown')
ZERO_RULES = ('value', 'unknown', 'unknown_at_first')

# Names and indices: 'channels[0].value' is ('channels', 0, 'value').
FieldPath = tuple[str | int, ...]

_TYPE = re.compile(r'[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*')
_STEP = re.compile(r'([A-Za-z_][A-Za-z0-9_]*)((?:\[\d{1,9}\])*)')
_TOPIC = re.compile(r'[~/]?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*')


@dataclass(frozen=True)
class FieldSpec:
    """Where one quantity is found: value = sign * unit_factor * raw + offset."""

    topic: str  # Topic; relative ones ('voltage') are for remapping
    # Message type, 'package/msg/Type'.
    type: str  # noqa: A003
    field: str  # Field path, 'data', 'channels[0].value'
    unit_factor: float = 1.0  # SI units per unit of the field (1e-3 for mV)
    sign: int = 1  # 1 or -1
    offset: float = 0.0  # Added after scaling, SI units
    # Meaning of NaN or infinity: a transmission error, dropped and counted ('drop'), or "not
    # measured" ('unknown').
    nan: str = 'drop'
    # Meaning of an exact 0: 'value'; "not measured" ('unknown'); or "not measured" until another
    # value has come ('unknown_at_first').
    zero: str = 'value'
    # Hz, for the voltage only; if given, the field is an array, a block of samples at this rate,
    # and the stamp belongs to the LAST sample of the block.
    sample_rate: float | None = None
    # Path of a builtin_interfaces/Time ('header.stamp') or of a number ('timestamp'); None: the
    # middleware's source timestamp.
    stamp_field: str | None = None
    stamp_factor: float = 1.0  # Seconds per unit of a numeric stamp (1e-6 for microseconds)


@dataclass(frozen=True)
class MsgConfig:
    """One source of voltage, with its throttle, current and motor speeds if it has them."""

    name: str  # Name of the file without its ending
    description: str  # Description in one sentence, with limits
    package: str  # ROS package that defines the voltage's type
    install: str  # What to install when that package is missing
    generic: bool  # Whether the topics are relative, to be remapped, rather than fixed by a driver
    voltage: FieldSpec  # Where the voltage is, V
    throttle: FieldSpec | None = None  # Where the throttle is, 0..1
    # Where the current drawn is, A, in the messages of the voltage.
    current: FieldSpec | None = None
    # Where the speeds of the motors are, 1/min of the shaft unless `notch.rpm_unit` says
    # otherwise; the field may be an array, or a field of each element, 'esc[].esc_rpm'.
    rpm: FieldSpec | None = None


# Annotation of a record's field -> accepted YAML types, and a word for them.
_KINDS: dict[str, tuple[tuple[type, ...], str]] = {
    'str': ((str,), 'text'), 'str | None': ((str, type(None)), 'text or null'),
    'float': ((int, float), 'a number'),
    'float | None': ((int, float, type(None)), 'a number or null'), 'int': ((int,), '1 or -1'),
    'bool': ((bool,), 'true or false'), 'FieldSpec': ((dict,), 'a group of keys'),
    'FieldSpec | None': ((dict, type(None)), 'a group of keys or null')}


def parse_field_path(path: str) -> FieldPath:
    """Split a field path into names and indices."""
    steps: list[str | int] = []
    for part in path.split('.'):
        match = _STEP.fullmatch(part)
        if match is None:
            raise InputError(
                f"field path '{printable(path, 80)}' is not of the form name.name[0].name "
                f"(at '{printable(part, 40)}')")
        steps.append(match[1])
        steps += [int(index) for index in re.findall(r'\d+', match[2])]
    return tuple(steps)


def parse_each_path(path: str) -> tuple[FieldPath, FieldPath | None]:
    """Split 'esc[].rpm' into the array's path and the path in an element (None without '[]')."""
    array, each, rest = path.partition('[]')
    if not each:
        return parse_field_path(path), None
    rest = rest.removeprefix('.')
    return parse_field_path(array), parse_field_path(rest) if rest else ()


def msg_config_dir() -> Path:
    """Return the folder of the shipped msg configs: beside the package, or below a prefix."""
    here = Path(__file__).resolve()
    root = here.parents[2]
    if (root / 'package.xml').is_file() and (root / 'msg_config').is_dir():
        return root / 'msg_config'
    for folder in here.parents:
        found = folder / 'share' / 'ou_monitor' / 'msg_config'
        if found.is_dir():
            return found
    raise InputError(
        f'no msg_config folder beside or above {root}: install ou_monitor again, '
        'or name a YAML file by its path')


def list_msg_configs() -> dict[str, MsgConfig]:
    """Return every shipped msg config by name."""
    return {name: _load(path) for name, path in _files().items()}


def load_msg_config(name_or_path: Path | str) -> MsgConfig:
    """Return one msg config."""
    path = Path(name_or_path)
    if path.suffix in ('.yaml', '.yml') or len(path.parts) > 1:
        return _load(path)
    known, name = _files(), str(name_or_path)
    if name not in known:
        raise InputError(f"no msg config '{name}': {nearest(name, known)}")
    return _load(known[name])


def _files() -> dict[str, Path]:
    return {path.stem: path for path in sorted(msg_config_dir().glob('*.yaml'))}


@one_line()
def _load(path: Path) -> MsgConfig:
    where = path_words(path)
    top = dict(_checked(read_yaml(path, 'msg config'), MsgConfig, where))
    if top.get('current') is not None:
        # The current comes from the messages of the voltage, with their stamps.
        shared = ('topic', 'type', 'stamp_field', 'stamp_factor')
        top['current'] = {key: top['voltage'][key] for key in shared if key in top['voltage']} | {
            'nan': 'unknown'} | top['current']
    for key in ('voltage', 'throttle', 'current', 'rpm'):
        if top.get(key) is not None:
            top[key] = _field_spec(top[key], f'{where}: {key}',
                                   parse_each_path if key == 'rpm' else parse_field_path)
            if key != 'voltage' and top[key].sample_rate is not None:
                raise InputError(f'{where}: {key}: sample_rate is for blocks of the voltage')
    for key in ('description', 'install'):
        top[key] = ' '.join(top[key].split())
    return MsgConfig(name=path.stem, **top)


def _checked(content: Any, record: type, where: str) -> dict[str, Any]:
    """Return the content if its keys and values fit a record; InputError names the first wrong."""
    # `name` is from the name of the file.
    known = {one.name: one for one in fields(record) if one.name != 'name'}
    if not isinstance(content, dict):
        raise InputError(f"{where}: expected keys ({', '.join(known)}), found none")
    for key, value in content.items():
        if key not in known:
            shown = printable(key, 60)
            # Do not quote the keys if the file is probably not a msg config.
            name = '' if closest(shown, known) is None else f" '{shown}'"
            raise InputError(f'{where}: unknown key{name}: {nearest(shown, known)}')
        accepted, word = _KINDS[str(known[key].type)]
        # In Python true is an int; in YAML it is not a number.
        wrong_bool = isinstance(value, bool) and bool not in accepted
        if wrong_bool or not isinstance(value, accepted):
            hint = ''
            if isinstance(value, str) and float in accepted:
                # YAML 1.1 reads 1e-3 as text, 1.0e-3 as a number.
                hint = ' (a number with an exponent needs a point: 1.0e-3)'
            raise InputError(f"{where}: '{key}' must be {word}, found "
                             f'{printable(repr(value), 60)}{hint}')
    for key, one in known.items():
        if one.default is MISSING and key not in content:
            raise InputError(f"{where}: key '{key}' is missing")
    return content


def _field_spec(content: Any, where: str,
                parse: Callable[[str], object] = parse_field_path) -> FieldSpec:
    group = _checked(content, FieldSpec, where)
    for key in ('unit_factor', 'offset', 'sample_rate', 'stamp_factor'):
        if group.get(key) is not None:
            group[key] = float(group[key])
            if not math.isfinite(group[key]):
                raise InputError(f"{where}: '{key}' must be finite, found {group[key]}")
    spec = FieldSpec(**group)
    if not _TYPE.fullmatch(spec.type):
        raise InputError(
            f"{where}: type '{spec.type}' is not of the form package/msg/Type")
    if not _TOPIC.fullmatch(spec.topic):
        raise InputError(f"{where}: topic '{spec.topic}' is not a valid topic name")
    if spec.sign not in (1, -1):
        raise InputError(f'{where}: sign must be 1 or -1, found {spec.sign}')
    for key, rules in (('nan', NAN_RULES), ('zero', ZERO_RULES)):
        rule = getattr(spec, key)
        if rule not in rules:
            raise InputError(f"{where}: unknown {key} rule '{rule}': {nearest(rule, rules)}")
    for key in ('unit_factor', 'stamp_factor', 'sample_rate'):
        value = getattr(spec, key)
        if value is not None and not value > 0.0:
            hint = ' (use sign: -1 to invert)' * (key == 'unit_factor')
            raise InputError(f"{where}: '{key}' must be above 0{hint}, found {value}")
    # Report a malformed path now, with the file's name, rather than at the first message.
    for key, parsed in (('field', parse), ('stamp_field', parse_field_path)):
        path = getattr(spec, key)
        if path is not None:
            try:
                parsed(path)
            except InputError as error:
                raise InputError(f'{where}: {error}') from error
    return spec


def walk(msg: object, steps: FieldPath, path: str = '', kind: str = '') -> Any:
    """Follow a field path in a message; None: an array is too short (path, kind: for errors)."""
    at: Any = msg
    for step in steps:
        if isinstance(step, str):
            if not hasattr(at, step):
                describe = getattr(at, 'get_fields_and_field_types', dict)
                raise InputError(f"field path '{path}' is not in {kind}: no '{step}' there; "
                                 + nearest(step, describe()))
            at = getattr(at, step)
        else:
            try:
                if step >= len(at):
                    return None
            except TypeError as error:
                raise InputError(f"field path '{path}' of {kind}: [{step}] asks for an element "
                                 'of something that is not an array') from error
            at = at[step]
    return at


def put(msg: object, steps: FieldPath, value: Any) -> None:
    """Write an existing element of a message."""
    holder, last = walk(msg, steps[:-1]), steps[-1]
    if isinstance(last, str):
        setattr(holder, last, value)
    else:
        holder[last] = value


class ManyExtractor:
    """Extracts numbers: one, an array, or a field of each element (such as 'esc[].esc_rpm')."""

    def __init__(self, spec: FieldSpec) -> None:
        self.spec = spec
        self._array, self._each = parse_each_path(spec.field)

    def extract(self, msg: object) -> FloatArray:
        """Return the values of one message in SI units, shape (n,); NaN: unknown."""
        path = self.spec.field
        raw = walk(msg, self._array, path, self.spec.type)
        if raw is None:
            return np.empty(0)
        try:
            if self._each is not None:
                raw = [walk(one, self._each, path, self.spec.type) for one in raw]
            if isinstance(raw, (str, bytes)):
                raise TypeError('text')
            values = np.array(raw, dtype=np.float64).ravel()
        except (TypeError, ValueError) as error:
            raise InputError(
                f"field '{self.spec.field}' of {self.spec.type} holds no numbers: name a numeric "
                "field, an array of them, or one of each element, 'name[].field'") from error
        return np.asarray(values * (self.spec.sign * self.spec.unit_factor) + self.spec.offset)
