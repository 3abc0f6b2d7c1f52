"""Message types by name: 'sensor_msgs/msg/BatteryState' -> its class."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
import re
import sys
from typing import Any

from ou_monitor.errors import InputError, nearest

# Where the ament index of a prefix lists its packages, a file each.
_INDEX = 'share/ament_index/resource_index/packages'

# What rosidl calls the primitives in Python, and in ros2msg.
_WORDS = {'float': 'float32', 'double': 'float64', 'boolean': 'bool', 'octet': 'byte'}
_SEQUENCE = re.compile(r'sequence<(.*?)(?:, \d+)?>')
_ARRAY = re.compile(r'(.*)\[(\d+)\]')


def _is_indexed(package: str) -> bool:
    """Whether an ament index names a package: of a sourced prefix, or of this environment."""
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    return any(prefix and (Path(prefix) / _INDEX / package).is_file()
               for prefix in (*prefixes, sys.prefix))


def message_class(name: str, install: str = '') -> Any:
    """Return the class of a message type."""
    parts = name.split('/')
    if len(parts) != 3 or parts[1] != 'msg' or not all(part.isidentifier() for part in parts):
        raise InputError(f"'{name}' is not a message type: write 'package/msg/Type'")
    package, _, kind = parts
    try:
        if not _is_indexed(package):
            # A bag must not choose which Python modules are loaded.
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


def definition_of(kind: Any) -> str:
    """Return the ros2msg text of a message class, with those of the types in it."""
    texts: dict[str, str] = {}

    def add(name: str, message: Any) -> None:
        lines = []
        texts[name] = ''
        for field, of in message.get_fields_and_field_types().items():
            inside, size = of, ''
            if match := _SEQUENCE.fullmatch(of):
                inside, size = match[1], '[]'
            elif match := _ARRAY.fullmatch(of):
                inside, size = match[1], f'[{match[2]}]'
            lines.append(f'{_WORDS.get(inside, inside)}{size} {field}')
            if '/' in inside and inside not in texts:
                package, _, other = inside.partition('/')
                add(inside, getattr(importlib.import_module(package + '.msg'), other))
        texts[name] = '\n'.join(lines) + '\n'

    first = f"{kind.__module__.partition('.')[0]}/{kind.__name__}"
    add(first, kind)
    others = ''.join(f"{80 * '='}\nMSG: {name}\n{text}"
                     for name, text in texts.items() if name != first)
    return texts[first] + others
