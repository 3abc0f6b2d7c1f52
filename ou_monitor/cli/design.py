"""`ou-monitor design`: which capacitance brings the brown-out risk under X at throttle Y."""

from __future__ import annotations

import argparse
from dataclasses import asdict
import math
from typing import Any, TYPE_CHECKING

from ou_monitor.cli.arguments import add_json
from ou_monitor.cli.quantities import component, quantity, read_network, value_of
from ou_monitor.errors import InputError

if TYPE_CHECKING:
    from ou_monitor.paper.network.components import PowerNetwork
    from ou_monitor.paper.network.design import Design

# One row of the printed table for this many rows of the calculation.
_EVERY = 10
# Options that are numbers, and their units.
_OPTIONS = {'risk': '', 'throttle': '', 'horizon': 's', 'capacitance_min': 'F',
            'capacitance_max': 'F'}


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'design', allow_abbrev=False,
        help='which capacitance brings the brown-out risk under X at throttle Y',
        description='Compute alpha, sigma, Var_inf and the brown-out risk of a rail from the '
                    'components of its power network, over bulk capacitances, and the least one '
                    'that meets a risk.',
        epilog='Values are in SI units, or with prefix and unit: 470uF, 40mOhm, 24kHz.')
    parser.add_argument('--risk', metavar='X',
                        help='probability of a brown-out allowed within the horizon, 0..1')
    parser.add_argument('--throttle', metavar='Y', help='throttle, 0..1')
    parser.add_argument('--rail', choices=('bus', 'regulated'), default='bus',
                        help='the battery bus at the ESCs, or the regulated rail '
                             '(default: %(default)s)')
    parser.add_argument('--voltage', metavar='V',
                        help='brown-out level, V (default: 3.3 V a cell on the bus; 4.5 V on a '
                             'regulated rail of 5 V, 2.88 V on one of 3.3 V)')
    parser.add_argument('--horizon', metavar='S', default='5', help='horizon, s (default: 5)')
    parser.add_argument('--capacitance-min', metavar='F', default='10uF',
                        help='least capacitance to look at (default: %(default)s)')
    parser.add_argument('--capacitance-max', metavar='F', default='22mF',
                        help='most capacitance to look at (default: %(default)s)')
    parser.add_argument('--esr-fixed', action='store_true',
                        help='keep the ESR (default: ESR falls as 1/C, as of more capacitors of '
                             'one series in parallel)')
    parser.add_argument('--set', metavar='NAME=VALUE', action='append', default=[],
                        help='a component, such as bulk_capacitance=1000uF; may be repeated '
                             '(see --list)')
    parser.add_argument('--network', metavar='FILE.yaml',
                        help='components as a YAML mapping of name to value; --set goes first')
    parser.add_argument('--list', action='store_true',
                        help='list the components and their defaults')
    add_json(parser)
    parser.set_defaults(run=run)


def _list(target: str | None) -> None:
    """Show the components with defaults and units; as JSON where that is asked for."""
    from ou_monitor.cli import output
    from ou_monitor.paper.network.components import PowerNetwork, UNITS

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
    from ou_monitor.cli import output

    output.check_paths({'--network': args.network}, {'--json': args.json})
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

    from ou_monitor.paper.network.components import PowerNetwork
    from ou_monitor.paper.network.design import default_voltage, design
    from ou_monitor.paper.network.design_words import as_data

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
    """Return the table and the answer for a terminal 100 columns wide."""
    from ou_monitor.cli.output import paragraph, table
    from ou_monitor.paper.network.design_words import answer, effect, probability, remarks
    from ou_monitor.text import number

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
    head = (f'{name} at throttle {result.throttle:g}: mean {present.mean:.4g} V (sag of the bus '
            f'{present.sag:.3g} V), brown-out at {result.voltage:g} V ({source}), risk allowed '
            f'{result.target:g} within {result.horizon:g} s')
    lines = [
        paragraph(head), '',
        table(['C uF', 'ESR mOhm', 'alpha 1/s', 'tau us', 'sigma V/sqrt(s)', 'Var_inf V^2',
               'mean time', 'risk OU', 'crossing', ''], cells, left=[9]), '']
    for text in (answer(result), effect(result), *remarks(result)):
        if text:
            lines.append(paragraph(text))
    return '\n'.join(lines)


def _time(value: float) -> str:
    from ou_monitor.text import number

    return 'never' if value > 1e100 else f'{number(value)} s'
