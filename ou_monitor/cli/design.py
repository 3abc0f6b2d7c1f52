"""`ou-monitor design`: which capacitance brings the brown-out risk under X at throttle Y."""

from __future__ import annotations

import argparse
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from ou_monitor.bench import design
from ou_monitor.cli import output
from ou_monitor.cli.arguments import check_outputs, read_given
from ou_monitor.cli.commands import quantity
from ou_monitor.errors import InputError, nearest
from ou_monitor.paper.network import PowerNetwork, UNITS
from ou_monitor.report.document import Document, Table
from ou_monitor.stream.files import read_yaml


def _list(args: argparse.Namespace) -> None:
    network = PowerNetwork()
    values = {**asdict(network), 'line_gain': network.line_feedthrough}
    output.tell(args, Document('Components', '', (), [Table(['component', 'default', 'unit'], [
        [name, f'{value:g}', UNITS[name]] for name, value in values.items()], left=[0, 2])]),
                lambda: {name: {'default': value, 'unit': UNITS[name]}
                         for name, value in values.items()})


def run(args: argparse.Namespace) -> int:
    check_outputs(args, **{'--network': args.network, '--from': args.recording})
    if args.list:
        _list(args)
        return 0
    if args.throttle is None and args.recording is None:
        raise InputError('--throttle is missing: ou-monitor design --throttle 0.4 means 40 %, '
                         "and --from RECORDING takes a flight's throttle")
    values = {} if args.network is None else read_network(args.network)
    for word in args.set:
        name, separator, text = word.partition('=')
        if not separator:
            raise InputError(f"--set: '{word}' is not NAME=VALUE, such as bulk_esr=20mOhm")
        name = component(name.strip(), '--set')
        values[name] = value_of(f'--set {name}', name, text)

    recording = None if args.recording is None else read_given(args)[0]
    try:
        found = design(
            args.throttle, recording=recording, network=values, rail=args.rail,
            voltage=args.brownout_voltage, cells=args.cells or 0, horizon=args.brownout_horizon,
            risk=args.risk, capacitances=(args.capacitance_min, args.capacitance_max),
            esr_fixed=args.esr_fixed)
    except ValueError as error:
        raise InputError(str(error)) from error
    output.deliver(args, found)
    return 0


def read_network(path: str) -> dict[str, Any]:
    """Return the components that a YAML file gives."""
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
    """Return the name of a component; raise InputError if there is no such component."""
    valid = [field.name for field in fields(PowerNetwork)]
    if name not in valid:
        raise InputError(f"{where}: unknown component '{name}': {nearest(name, valid)}")
    return name


def value_of(where: str, name: str, text: object) -> Any:
    try:
        value = quantity(UNITS[name])(text)
    except argparse.ArgumentTypeError as error:
        raise InputError(f'{where}: {error}') from None
    return int(value) if name in ('cells', 'escs') and value == int(value) else value
