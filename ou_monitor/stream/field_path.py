"""Field paths: 'channels[0].value' -> its steps."""

from __future__ import annotations

import re

from ou_monitor.errors import InputError

FieldPath = tuple[str | int, ...]

_STEP = re.compile(r'([A-Za-z_][A-Za-z0-9_]*)((?:\[\d+\])*)')


def parse_field_path(path: str) -> FieldPath:
    """Split a field path into names and indices."""
    steps: list[str | int] = []
    for part in path.split('.'):
        match = _STEP.fullmatch(part)
        if match is None:
            raise InputError(
                f"field path '{path}' is not of the form name.name[0].name (at '{part}')")
        steps.append(match[1])
        steps += [int(index) for index in re.findall(r'\d+', match[2])]
    return tuple(steps)
