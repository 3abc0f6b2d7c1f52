"""Message types by name: 'sensor_msgs/msg/BatteryState' -> its class."""

from __future__ import annotations

import importlib
from typing import Any

from ou_monitor.errors import InputError, nearest


def message_class(name: str, install: str = '') -> Any:
    """Return the class of a message type."""
    parts = name.split('/')
    if len(parts) != 3 or parts[1] != 'msg' or not all(part.isidentifier() for part in parts):
        raise InputError(f"'{name}' is not a message type: write 'package/msg/Type'")
    package, _, kind = parts
    try:
        module = importlib.import_module(package + '.msg')
    except ModuleNotFoundError as error:
        advice = install or f"ros-jazzy-{package.replace('_', '-')}"
        raise InputError(
            f"message type '{name}' needs the ROS package '{package}', which is not installed: "
            f'install {advice}, or source the workspace that has it') from error
    if not hasattr(module, kind):
        words = [word for word in vars(module) if word[0].isupper()]
        raise InputError(f"package '{package}' has no message '{kind}': {nearest(kind, words)}")
    return getattr(module, kind)
