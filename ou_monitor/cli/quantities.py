"""Quantities with SI prefix and unit, and a power network, as users write them."""

from __future__ import annotations

from dataclasses import fields
import math
from pathlib import Path
import re
from typing import Any

from ou_monitor.errors import InputError, nearest

_PREFIX = {'': 1.0, 'p': 1e-12, 'n': 1e-9, 'u': 1e-6, 'µ': 1e-6, 'm': 1e-3, 'k': 1e3, 'M': 1e6}
_QUANTITY = re.compile(r'([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([pnuµmkM]?)'
                       r'(F|H|[Oo]hm|Ω|V|A|Hz|W|s|1/s)?')


def quantity(where: str, text: object, unit: str) -> float:
    """Return a number that may have an SI prefix and a unit."""
    match = _QUANTITY.fullmatch(str(text).strip())
    value = math.nan
    if match and not isinstance(text, bool):
        value = float(match[1]) * _PREFIX[match[2]]
    if not math.isfinite(value):
        raise InputError(f"{where}: '{text}' is not a number; write "
                         + (f'it as 0.00047, 470u or 470u{unit}' if unit else 'it as 0.4 or 1e-3'))
    assert match is not None
    given = {'ohm': 'Ohm', 'Ω': 'Ohm'}.get(match[3], match[3])
    if given is not None and given != unit:
        raise InputError(f"{where}: '{text}' must be in {unit}" if unit else
                         f"{where}: '{text}' must have no unit")
    return value


def read_network(path: str) -> dict[str, Any]:
    """Return the components that a YAML file gives (path in A)."""
    from ou_monitor.stream.files import read_yaml

    if not Path(path).is_file():
        raise InputError(f"--network: there is no file '{path}'")
    try:
        data = read_yaml(path, 'the network')
    except InputError as error:
        raise InputError(f'--network: not readable YAML: {error}') from error
    if not isinstance(data, dict):
        raise InputError(f"--network: '{path}' must be a mapping of component to value, such as "
                         'bulk_capacitance: 470uF')
    return {component(str(name), path): value_of(f'{path}: {name}', str(name), value)
            for name, value in data.items()}


def component(name: str, where: str) -> str:
    """Return the name of a component when there is such a one."""
    from ou_monitor.paper.network.components import PowerNetwork

    valid = [field.name for field in fields(PowerNetwork)]
    if name not in valid:
        raise InputError(f"{where}: unknown component '{name}': {nearest(name, valid)}")
    return name


def value_of(where: str, name: str, text: object) -> Any:
    """Return the value of a component."""
    from ou_monitor.paper.network.components import UNITS

    if name == 'constant_power':
        word = str(text).strip().lower()
        if word not in ('true', 'false'):
            raise InputError(f"{where}: '{text}' is neither true nor false")
        return word == 'true'
    value = quantity(where, text, UNITS[name])
    return int(value) if name in ('cells', 'escs') and value == int(value) else value
