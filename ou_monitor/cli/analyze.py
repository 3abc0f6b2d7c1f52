"""`ou-monitor analyze RECORDING`: the paper's Tables 1 and 2 for a recording."""

from __future__ import annotations

import argparse

from ou_monitor.bench import analyze
from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    check_outputs, command_line, given, limit_given, part_of_recording, read_given,
    throttle_levels)
from ou_monitor.cli.options import POSITIVE
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    check_outputs(args, 'report', RECORDING=args.recording, **{'--msg-config': args.msg_config})
    levels = throttle_levels(args.levels)
    window = given('--window', args.window, POSITIVE)
    horizon = given('--brownout-horizon', args.brownout_horizon, POSITIVE)
    limit = limit_given(args)
    _in_range(limit['brownout_voltage'], horizon)
    start, end = part_of_recording(args.start, args.end)
    recording = read_given(args, start, end)
    with Progress('analyzing', args.json == output.STDOUT) as progress:
        found = analyze(recording, levels=levels, window=window, brownout_horizon=horizon,
                        progress=progress, **limit)
    output.deliver(args, found, command_line(
        args, 'analyze', 'levels', 'window', 'brownout_voltage', 'cells', 'brownout_horizon'))
    return 0


def _in_range(voltage: float | None, horizon: float) -> None:
    """Refuse what the node would refuse."""
    from ou_monitor.online.settings import ESTIMATOR_PARAMETERS

    for parameter in ESTIMATOR_PARAMETERS:
        name = parameter.name.removeprefix('brownout.')
        value = {'voltage': voltage, 'horizon': horizon}.get(name)
        if value is None or parameter.low is None or parameter.high is None:
            continue
        if not parameter.low <= value <= parameter.high:
            raise InputError(f'--brownout-{name}: {value:g} is not within {parameter.low:g} to '
                             f'{parameter.high:g}')
