"""`ou-monitor design`: which capacitance brings the brown-out risk under X at throttle Y."""

from __future__ import annotations

import argparse
from dataclasses import asdict, fields
import math
from pathlib import Path
import re
from typing import Any

import numpy as np
from ou_monitor.analysis.crafts import check_cells
from ou_monitor.cli import output
from ou_monitor.cli.arguments import check_outputs, read_given
from ou_monitor.errors import InputError, nearest
from ou_monitor.paper.network.components import (
    completed, PowerNetwork, UNITS)
from ou_monitor.paper.network.design import (
    answer, as_data, default_voltage, Design, design, effect, Flight, network_of, probability,
    remarks)
from ou_monitor.report.document import Document, Table, Text
from ou_monitor.report.terminal import table
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
    flight = None if args.recording is None else _flight(args)
    if args.throttle is None and flight is not None:
        args.throttle = flight.highest
    numbers = {name: quantity(f'--{name.replace("_", "-")}', getattr(args, name), unit)
               for name, unit in _OPTIONS.items()}
    if not numbers['throttle'] <= 1.0:
        raise InputError(f"--throttle: '{args.throttle}' is not between 0 and 1; write 40 % as "
                         '0.4')
    values = {} if args.network is None else read_network(args.network)
    for word in args.set:
        name, separator, text = word.partition('=')
        if not separator:
            raise InputError(f"--set: '{word}' is not NAME=VALUE, such as bulk_esr=20mOhm")
        name = component(name.strip(), '--set')
        values[name] = value_of(f'--set {name}', name, text)

    try:
        if flight is not None:
            cells = values.setdefault('cells', flight.cells)
            if not cells:
                raise InputError(f'{flight.full:.4g} V is no pack of cells: --set cells=N')
            check_cells(flight.full, cells)
            network = network_of(flight, numbers['throttle'], values)
        else:
            network = PowerNetwork(**completed(values))
        voltage, source = (
            default_voltage(network, args.rail) if args.voltage is None
            else (quantity('--voltage', args.voltage, 'V'), 'given'))
        result = design(
            network, numbers['throttle'], voltage=voltage, horizon=numbers['horizon'],
            risk=numbers['risk'], rail=args.rail, esr_follows=not args.esr_fixed,
            capacitances=(numbers['capacitance_min'], numbers['capacitance_max']))
    except ValueError as error:
        raise InputError(str(error)) from error
    taken = '' if flight is None else _taken(flight, network, numbers['throttle'], values)
    output.deliver(args, design_document(result, source, taken),
                   {**as_data(result, source), 'measured': taken or None})
    return 0


def _flight(args: argparse.Namespace) -> Flight:
    """Return what the recording says of its supply."""
    from ou_monitor.analysis.crafts import cells_of, full_voltage
    from ou_monitor.analysis.supply import facts_and_end

    recording = read_given(args, None, None)
    facts, load, _ = facts_and_end(recording)
    if not recording.has_throttle:
        raise InputError(f'--from {args.recording}: the recording has no throttle')
    full = full_voltage(recording)
    return Flight(load.level, full, cells_of(recording)[0],
                  facts.sag.throttle, facts.sag.sag_v, facts.noise.rms_v,
                  facts.noise.steady_rms_v, facts.noise.flown,
                  min(1.0, float(np.nanmax(recording.throttle))), facts.resistance.ohm,
                  facts.ou.alpha, facts.ou.var_inf)


def _taken(flight: Flight, network: PowerNetwork, throttle: float, values: dict[str, Any]) -> str:
    """Return what was taken from a flight, and what was not."""
    known = flight.resistance > 0.0 and values.get('battery_resistance') is None
    return (f'From the flight: {flight.level:.4g} V open at its end, {network.cells} cells '
            f'({flight.full:.4g} V at most; --set cells=N), sag '
            f'{float(np.interp(throttle, flight.throttle, flight.sag)):.3g} V and noise '
            f'{1e3 * float(np.interp(throttle, flight.throttle, flight.noise)):.3g} mV rms at '
            f'{throttle:.0%} throttle, resistance '
            + (f'{1e3 * flight.resistance:.3g} mOhm.' if known else
               f'{1e3 * network.battery_resistance:.3g} mOhm as given or assumed: the current is '
               'scaled to the sag.')
            + ' The bulk capacitor and its ESR cannot be seen: --set bulk_capacitance=470uF.')


def design_document(result: Design, source: str, taken: str) -> Document:
    """Return what is said of a design; taken: what came from a flight, if anything did."""
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
    subject = (f'{name} at throttle {result.throttle:g}: mean {present.mean:.4g} V (sag of the '
               f'bus {present.sag:.3g} V), brown-out at {result.voltage:g} V ({source}), risk '
               f'allowed {result.target:g} within {result.horizon:g} s')
    return Document('Which capacitance', subject, [answer(result)], [
        Table(['C, uF', 'ESR, mOhm', 'alpha, 1/s', 'tau, us', 'sigma, V/sqrt(s)', 'Var_inf, V^2',
               'mean time', 'risk OU', 'crossing', ''], cells, left=[9]),
        Table(['what', 'unit', 'present', 'tried', 'risk then', f'for {result.target:g}'],
              [[lever.name, lever.unit, number(lever.present), number(lever.tried),
                probability(lever.risk), number(lever.least)
                if math.isfinite(lever.least) else 'out of reach'] for lever in result.levers],
              left=[0, 1]),
        *(Text(text) for text in (effect(result), *remarks(result), taken) if text)])


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
