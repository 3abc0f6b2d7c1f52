"""`ou-monitor design`: which capacitance brings the brown-out risk under X at throttle Y."""

from __future__ import annotations

import argparse
from dataclasses import asdict, fields
import math
from pathlib import Path
import re
from typing import Any

from ou_monitor.bench import design
from ou_monitor.cli import output
from ou_monitor.cli.arguments import check_outputs, read_given
from ou_monitor.errors import InputError, nearest
from ou_monitor.paper.network.components import PowerNetwork, UNITS
from ou_monitor.report.terminal import table
from ou_monitor.stream.files import read_yaml

# Options that are numbers, and their units.
_OPTIONS = {'risk': '', 'throttle': '', 'horizon': 's', 'capacitance_min': 'F',
            'capacitance_max': 'F'}

# Divisors, which are exact: 10u is 1e-5 to the last digit.
_PREFIX = {'': 1.0, 'p': 1e12, 'n': 1e9, 'u': 1e6, 'µ': 1e6, 'm': 1e3, 'k': 1e-3, 'M': 1e-6}
_QUANTITY = re.compile(r'([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([pnuµmkM]?)'
                       r'(F|H|[Oo]hm|Ω|V|A|Hz|W|s|1/s)?')


def _list(target: str | None) -> None:
    """Show the components with defaults and units; as JSON where that is asked for."""
    network = PowerNetwork()
    values = asdict(network)
    if target is not None:
        output.write_json({name: {'default': network.line_feedthrough if value is None else value,
                                  'unit': UNITS.get(name, '')}
                           for name, value in values.items()}, target)
    if target != output.STDOUT:
        output.say(table(['component', 'default', 'unit'], [
            [name, _shown(value, network), UNITS.get(name, '')]
            for name, value in values.items()], left=[0, 2]))


def _shown(value: object, network: PowerNetwork) -> str:
    if value is None:
        return f'{network.line_feedthrough:.4g}'
    return str(value).lower() if isinstance(value, bool) else f'{value:g}'


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    check_outputs(args, 'report', **{'--network': args.network, '--from': args.recording})
    if args.list:
        _list(args.json)
        return 0
    if args.throttle is None and args.recording is None:
        raise InputError('--throttle is missing: ou-monitor design --throttle 0.4 asks for 40 %, '
                         'and --from RECORDING for the throttle of a flight')
    numbers = {name: quantity(f'--{name.replace("_", "-")}', getattr(args, name), unit)
               for name, unit in _OPTIONS.items() if getattr(args, name) is not None}
    if not numbers.get('throttle', 0.0) <= 1.0:
        raise InputError(f"--throttle: '{args.throttle}' is not between 0 and 1; write 40 % as "
                         '0.4')
    values = {} if args.network is None else read_network(args.network)
    for word in args.set:
        name, separator, text = word.partition('=')
        if not separator:
            raise InputError(f"--set: '{word}' is not NAME=VALUE, such as bulk_esr=20mOhm")
        name = component(name.strip(), '--set')
        values[name] = value_of(f'--set {name}', name, text)

    voltage = None if args.voltage is None else quantity('--voltage', args.voltage, 'V')
    recording = None if args.recording is None else read_given(args, None, None)
    try:
        found = design(
            numbers.get('throttle'), recording=recording, network=values, rail=args.rail,
            voltage=voltage, horizon=numbers['horizon'], risk=numbers['risk'],
            capacitances=(numbers['capacitance_min'], numbers['capacitance_max']),
            esr_fixed=args.esr_fixed)
    except ValueError as error:
        raise InputError(str(error)) from error
    output.deliver(args, found)
    return 0


def quantity(where: str, text: object, unit: str) -> float:
    """Return a number that may have an SI prefix and a unit."""
    match = _QUANTITY.fullmatch(str(text).strip())
    value = math.nan
    if match and not isinstance(text, bool):
        value = float(match[1]) / _PREFIX[match[2]]
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
    valid = [field.name for field in fields(PowerNetwork)]
    if name not in valid:
        raise InputError(f"{where}: unknown component '{name}': {nearest(name, valid)}")
    return name


def value_of(where: str, name: str, text: object) -> Any:
    """Return the value of a component."""
    if name == 'constant_power':
        word = str(text).strip().lower()
        if word not in ('true', 'false'):
            raise InputError(f"{where}: '{text}' is neither true nor false")
        return word == 'true'
    value = quantity(where, text, UNITS[name])
    return int(value) if name in ('cells', 'escs') and value == int(value) else value
