"""Message types by name: 'sensor_msgs/msg/BatteryState' -> its class."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
import sys
from typing import Any

from ou_monitor.errors import InputError, nearest

# Where the ament index of a prefix lists its packages, a file each.
_INDEX = 'share/ament_index/resource_index/packages'


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
