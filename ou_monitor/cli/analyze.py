"""`ou-monitor analyze RECORDING`: the paper's Tables 1 and 2 for a recording."""

from __future__ import annotations

import argparse
import shlex
from typing import Any

from ou_monitor.cli.arguments import (
    add_estimate, add_json, add_part, add_recording, add_topics, part_of_recording,
    positive_number, read_given, said_again, throttle_levels)
from ou_monitor.errors import InputError


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'analyze', allow_abbrev=False,
        help='Vpp, Vrms, alpha, tau, sigma, Var_inf with 95 %% intervals per load level',
        description='Analyze the noise of a supply: per load level Vpp, Vrms, alpha, tau, '
                    'sigma and Var_inf with 95 % intervals, and the type of process.')
    add_recording(parser)
    parser.add_argument('--levels', metavar='0,0.05,...',
                        help='throttles 0..1 of the load levels (default: found)')
    add_part(parser)
    add_estimate(parser, 'voltage that must not be undershot, V (default: as the node, 4.5)')
    add_topics(parser)
    add_json(parser)
    parser.add_argument('--report', metavar='FILE.html',
                        help='write a self-contained HTML page')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from ou_monitor.cli import output
    from ou_monitor.cli.analysis_text import render

    output.check_paths(
        {'RECORDING': args.recording, '--msg-config': args.msg_config},
        {'--json': args.json, '--report': args.report})
    levels = throttle_levels(args.levels)
    window = positive_number('--window', args.window)
    horizon = positive_number('--brownout-horizon', args.brownout_horizon)
    voltage = None if args.brownout_voltage is None else positive_number(
        '--brownout-voltage', args.brownout_voltage)
    _in_range(voltage, horizon)
    start, end = part_of_recording(args.start, args.end)
    if args.report == output.STDOUT:
        raise InputError("--report needs a file: '-' is not supported")
    output.check_writable(args.json)
    output.check_writable(args.report)

    from ou_monitor.analyze.analyze import analyze
    from ou_monitor.analyze.data import as_data

    recording = read_given(args, start, end)
    if recording.n < 2:
        raise InputError(f"'{args.recording}' holds {recording.n} usable sample"
                         f"{'' if recording.n == 1 else 's'}: nothing can be estimated from it")
    if levels is not None and not recording.has_throttle:
        raise InputError(f"--levels: '{args.recording}' has no throttle; leave --levels out, or "
                         'name the topic with --throttle-topic')
    with output.Progress('analyzing') as progress:
        analysis = analyze(recording, levels=levels, window=window, brownout_voltage=voltage,
                           brownout_horizon=horizon, progress=progress)
    if args.report is not None:
        from ou_monitor.report.analysis_page import analysis_page
        output.write_text(analysis_page(analysis, command_line(args)), args.report)
    if args.json is not None:
        output.write_json(as_data(analysis), args.json)
    if args.json != output.STDOUT:
        output.say(render(analysis))
        if args.report is not None:
            output.say(f'\nReport: {args.report}')
    return 0


def command_line(args: argparse.Namespace) -> str:
    """Return the command that repeats this analysis."""
    return shlex.join(['ou-monitor', 'analyze', args.recording, *said_again(
        args, 'levels', 'window', 'brownout_voltage', 'brownout_horizon')])


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
