"""`ou-monitor design`: which capacitance brings the brown-out risk under X at throttle Y."""

from __future__ import annotations

import argparse
from dataclasses import asdict, fields
import math
from pathlib import Path
import re
from typing import Any

from ou_monitor.cli import output
from ou_monitor.cli.output import paragraph, table
from ou_monitor.errors import InputError, nearest
from ou_monitor.paper.network.components import PowerNetwork, UNITS
from ou_monitor.paper.network.design import (
    answer, as_data, default_voltage, Design, design, effect, probability, remarks)
from ou_monitor.stream.files import read_yaml
from ou_monitor.text import number

# One row of the printed table for this many rows of the calculation.
_EVERY = 10
# Options that are numbers, and their units.
_OPTIONS = {'risk': '', 'throttle': '', 'horizon': 's', 'capacitance_min': 'F',
            'capacitance_max': 'F'}

_PREFIX = {'': 1.0, 'p': 1e-12, 'n': 1e-9, 'u': 1e-6, 'µ': 1e-6, 'm': 1e-3, 'k': 1e3, 'M': 1e6}
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
        output.say(output.table(['component', 'default', 'unit'], [
            [name, _shown(value, network), UNITS.get(name, '')]
            for name, value in values.items()], left=[0, 2]))


def _shown(value: object, network: PowerNetwork) -> str:
    if value is None:
        return f'{network.line_feedthrough:.4g}'
    return str(value).lower() if isinstance(value, bool) else f'{value:g}'


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    output.check_paths({'--network': args.network}, {'--json': args.json}, args.force)
    if args.list:
        _list(args.json)
        return 0
    for option, value in (('--risk', args.risk), ('--throttle', args.throttle)):
        if value is None:
            raise InputError(f'{option} is missing: ou-monitor design --risk 1e-3 --throttle 0.4 '
                             'asks for a risk of 1e-3 at 40 %')
    numbers = {name: quantity(f'--{name.replace("_", "-")}', getattr(args, name), unit)
               for name, unit in _OPTIONS.items()}
    if numbers['throttle'] > 1.0:
        raise InputError(f"--throttle: '{args.throttle}' is not between 0 and 1; write 40 % as "
                         '0.4')
    values = {} if args.network is None else read_network(args.network)
    for word in args.set:
        name, separator, text = word.partition('=')
        if not separator:
            raise InputError(f"--set: '{word}' is not NAME=VALUE, such as bulk_esr=20mOhm")
        name = component(name.strip(), '--set')
        values[name] = value_of(f'--set {name}', name, text)
    output.check_writable(args.json)

    try:
        network = PowerNetwork(**values)
        voltage, source = (
            default_voltage(network, args.rail) if args.voltage is None
            else (quantity('--voltage', args.voltage, 'V'), 'given'))
        result = design(
            network, numbers['throttle'], voltage=voltage, horizon=numbers['horizon'],
            risk=numbers['risk'], rail=args.rail, esr_follows=not args.esr_fixed,
            capacitances=(numbers['capacitance_min'], numbers['capacitance_max']))
    except ValueError as error:
        raise InputError(str(error)) from error
    if args.json is not None:
        output.write_json(as_data(result, source), args.json)
    if args.json != output.STDOUT:
        output.say(render(result, source))
    return 0


def render(result: Design, source: str) -> str:
    """Return the answer and its table for a terminal 100 columns wide."""
    present = result.present
    chosen = [(present, 'present')]
    if result.least is not None:
        chosen.append((result.least, 'least that meets it'))
    for row in result.rows[::_EVERY]:
        if not any(math.isclose(row.capacitance, r.capacitance, rel_tol=0.01) for r, _ in chosen):
            chosen.append((row, '' if row.stable else 'unstable'))
    cells = [[number(1e6 * r.capacitance), number(1e3 * r.esr), number(r.alpha),
              number(1e6 * r.tau), number(r.sigma), number(r.var_inf), _time(r.mean_time),
              probability(r.risk_ou), probability(r.risk_crossing), mark]
             for r, mark in sorted(chosen, key=lambda item: item[0].capacitance)]
    name = 'battery bus' if result.rail == 'bus' else 'regulated rail'
    given = (f'{name} at throttle {result.throttle:g}: mean {present.mean:.4g} V (sag of the bus '
             f'{present.sag:.3g} V), brown-out at {result.voltage:g} V ({source}), risk allowed '
             f'{result.target:g} within {result.horizon:g} s')
    lines = [
        paragraph(answer(result)), '', paragraph(given), '',
        table(['C uF', 'ESR mOhm', 'alpha 1/s', 'tau us', 'sigma V/sqrt(s)', 'Var_inf V^2',
               'mean time', 'risk OU', 'crossing', ''], cells, left=[9]), '']
    lines += [paragraph(text) for text in (effect(result), *remarks(result)) if text]
    return '\n'.join(lines)


def _time(value: float) -> str:
    return 'never' if value > 1e100 else f'{number(value)} s'


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
