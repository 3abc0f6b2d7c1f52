"""
Topics, types and fields of voltage, throttle and motor speeds.

A msg_config gives them; with `auto`, the message type of the topic's publisher selects a generic
msg_config.  Parameters override single entries.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import importlib
import os
from pathlib import Path
import re
import sys
from typing import Any

from ou_monitor.errors import InputError, nearest
from ou_monitor.online.settings import Parameter
from ou_monitor.recordings.cdr import Definitions, Field, stamp_paths, value_path
from ou_monitor.stream.config import (
    FieldSpec, list_msg_configs, load_msg_config, ManyExtractor, MsgConfig)

AUTO = 'auto'

_CONFIG = Parameter('msg_config', AUTO,
                    'Name or path of a msg_config; auto: chosen by the type of the publisher.')


def _where(quantity: str, words: str) -> tuple[Parameter, ...]:
    return (
        Parameter(f'{quantity}.topic', '',
                  f'Topic of the {words}; empty: as the msg_config says.'),
        Parameter(f'{quantity}.type', '',
                  f'Message type of the {words}; empty: as the msg_config says.'),
        Parameter(f'{quantity}.field', '',
                  f'Field path of the {words}; empty: as the msg_config says.'))


SOURCE_PARAMETERS: tuple[Parameter, ...] = (
    _CONFIG, *_where('voltage', 'voltage'), *_where('throttle', 'throttle'),
    Parameter('adc.sample_rate', 0.0,
              'True rate of the samples in a block, Hz; 0: as the msg_config says.', 0.0, 1.0e9),
)
# For `adaptive_filter`, whose notches follow the motors.
MOTOR_PARAMETERS: tuple[Parameter, ...] = (
    _CONFIG, *_where('throttle', 'throttle'), *_where('rpm', 'motor speeds'))

# In auto mode, throttle and motor speeds may be bare numbers, which need no msg_config.
_SCALARS = ('std_msgs/msg/Float32', 'std_msgs/msg/Float64')
_ARRAYS = ('std_msgs/msg/Float32MultiArray', 'std_msgs/msg/Float64MultiArray')


@dataclass(frozen=True)
class Source:
    """Where one quantity comes from: specified, or to be determined from its publisher."""

    quantity: str  # 'voltage', 'throttle' or 'rpm'
    topic: str  # Topic, relative or absolute
    spec: FieldSpec | None  # Field of the quantity; None until the publisher's type is known
    config: str  # Name of its msg_config
    install: str = ''  # What to install when the package of the type is missing
    candidates: tuple[Source, ...] = ()  # Choices in auto mode
    current: FieldSpec | None = None  # For a voltage: the field of the current

    def choose(self, types: Sequence[str]) -> Source | None:
        """Return the first candidate whose message type is in `types`, or None."""
        for candidate in self.candidates:
            if candidate.spec is not None and candidate.spec.type in types:
                return candidate
        return None

    def open_many(self) -> tuple[Any, ManyExtractor]:
        """Return the message class and an extractor that reads several numbers of a message."""
        message, spec = self._class()
        extractor = ManyExtractor(spec)
        extractor.extract(message())
        return message, extractor

    def open(self) -> tuple[Any, FieldSpec]:  # noqa: A003
        """Return the message class and the field of the quantity; InputError if unusable."""
        message, spec = self._class()
        definitions = definition_of(message)
        value_path(spec, definitions)
        stamp_paths(spec, definitions)
        return message, spec

    def _class(self) -> tuple[Any, FieldSpec]:
        assert self.spec is not None, 'choose a candidate first'
        return message_class(self.spec.type, self.install), self.spec


def find_source(quantity: str, values: Mapping[str, Any]) -> Source | None:
    """Return the source of a quantity by the parameters; None if the msg_config lacks it."""
    topic, kind, field = (str(values[f'{quantity}.{key}']) for key in ('topic', 'type', 'field'))
    rate = float(values.get('adc.sample_rate', 0.0)) if quantity == 'voltage' else 0.0
    if values['msg_config'] == AUTO:
        offered = _generic(quantity)
    else:
        offered = _config_source(load_msg_config(values['msg_config']), quantity)
    if kind:
        usual = offered[0].topic if len(offered) == 1 else quantity
        offered = [s for s in offered if s.spec is not None and s.spec.type == kind] or [
            _user_source(quantity, topic or usual, kind, field)]
    elif topic and not offered:
        raise InputError(
            f"msg_config '{values['msg_config']}' has no {quantity}: give {quantity}.type and "
            f'{quantity}.field with {quantity}.topic')
    offered = [_overridden(source, topic, field, rate) for source in offered]
    if values['msg_config'] == AUTO and not kind:
        return Source(quantity, topic or quantity, None, AUTO, candidates=tuple(offered))
    return offered[0] if offered else None


def _generic(quantity: str) -> list[Source]:
    """Return the generic msg_configs' entries for a quantity, one per type."""
    found: dict[str, Source] = {}
    if quantity != 'voltage':
        for kind in (*_SCALARS, *(_ARRAYS if quantity == 'rpm' else ())):
            found[kind] = Source(quantity, quantity, FieldSpec(quantity, kind, 'data'), AUTO)
    for config in list_msg_configs().values():
        for source in _config_source(config, quantity) if config.generic else ():
            if source.spec is not None:
                found.setdefault(source.spec.type, source)
    return list(found.values())


def _config_source(config: MsgConfig, quantity: str) -> list[Source]:
    """Return the source that a msg_config describes; empty if it lacks the quantity."""
    spec: FieldSpec | None = getattr(config, quantity)
    if spec is None:
        return []
    own = spec.type.partition('/')[0] == config.package
    return [Source(quantity, spec.topic, spec, config.name, config.install if own else '',
                   current=config.current if quantity == 'voltage' else None)]


def _user_source(quantity: str, topic: str, kind: str, field: str) -> Source:
    """Return a source of any installed type; if the type has a header, its stamp is used."""
    if not field:
        raise InputError(
            f"{quantity}.type is '{kind}', which no generic msg_config describes: give "
            f'{quantity}.field too')
    fields = message_class(kind).get_fields_and_field_types()
    stamp = 'header.stamp' if fields.get('header') == 'std_msgs/Header' else None
    return Source(quantity, topic, FieldSpec(topic, kind, field, stamp_field=stamp),
                  'parameters')


def _overridden(source: Source, topic: str, field: str, rate: float) -> Source:
    spec = source.spec
    if spec is None:
        return source
    # A rate applies only to a field that the msg_config declares as a block, or that the user
    # named.
    block = rate > 0.0 and (spec.sample_rate is not None or source.config == 'parameters')
    spec = replace(spec, topic=topic or spec.topic, field=field or spec.field,
                   sample_rate=rate if block else spec.sample_rate)
    return replace(source, topic=spec.topic, spec=spec)


# Folder of the ament index below a prefix, with a file for each package.
_INDEX = 'share/ament_index/resource_index/packages'

# Names of primitive types in rosidl's Python, and in message definitions if they differ.
_WORDS = {'float': 'float32', 'double': 'float64', 'boolean': 'bool', 'octet': 'byte'}
_SEQUENCE = re.compile(r'sequence<(.*?)(?:, \d+)?>')
_ARRAY = re.compile(r'(.*)\[(\d+)\]')


def _is_indexed(package: str) -> bool:
    """Whether the ament index of a sourced prefix or of this environment lists a package."""
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    return any(prefix and (Path(prefix) / _INDEX / package).is_file()
               for prefix in (*prefixes, sys.prefix))


def message_class(name: str, install: str = '') -> Any:
    """Return the class of a message type; InputError if it is not installed."""
    parts = name.split('/')
    if len(parts) != 3 or parts[1] != 'msg' or not all(part.isidentifier() for part in parts):
        raise InputError(f"'{name}' is not a message type: write 'package/msg/Type'")
    package, _, kind = parts
    try:
        if not _is_indexed(package):
            # Load only packages of the index, because a bag must not choose which Python modules
            # are loaded.
            raise ModuleNotFoundError(package)
        module = importlib.import_module(package + '.msg')
    except ModuleNotFoundError as error:
        advice = install or f"ros-jazzy-{package.replace('_', '-')}"
        raise InputError(
            f"message type '{name}' needs the ROS package '{package}', which is not installed: "
            f'install {advice}, or source the workspace that has it') from error
    if not hasattr(getattr(module, kind, None), 'get_fields_and_field_types'):
        words = [word for word in vars(module) if word[0].isupper()]
        raise InputError(f"package '{package}' has no message '{kind}': {nearest(kind, words)}")
    return getattr(module, kind)


def definition_of(kind: Any) -> Definitions:
    """Return the fields of a message class and of its nested messages."""
    found: Definitions = {}

    def add(name: str, message: Any) -> None:
        fields = []
        for field, of in message.get_fields_and_field_types().items():
            inside, array, size = of, False, None
            if match := _SEQUENCE.fullmatch(of):
                inside, array = match[1], True
            elif match := _ARRAY.fullmatch(of):
                inside, array, size = match[1], True, int(match[2])
            fields.append(Field(field, _WORDS.get(inside, inside), array, size))
            if '/' in inside and inside not in found:
                package, _, other = inside.partition('/')
                add(inside, getattr(importlib.import_module(package + '.msg'), other))
        found[name] = tuple(fields)

    add(f"{kind.__module__.partition('.')[0]}/{kind.__name__}", kind)
    return found
