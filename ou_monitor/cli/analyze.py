"""`ou-monitor analyze RECORDING`: the paper's Tables 1 and 2 for a recording."""

from __future__ import annotations

import argparse
from dataclasses import replace
import shlex

from ou_monitor.analysis.analyze import analyze, as_data
from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    brownout_limit, check_outputs, limit_of, part_of_recording, positive_number, read_given,
    repeated, throttle_levels)
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError
from ou_monitor.report.analysis_document import analysis_document
from ou_monitor.text import counted

# Fewest samples that have a scatter beside their mean and their trend.
_FEWEST = 3


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    check_outputs(args, 'report', RECORDING=args.recording, **{'--msg-config': args.msg_config})
    levels = throttle_levels(args.levels)
    window = positive_number('--window', args.window)
    horizon = positive_number('--brownout-horizon', args.brownout_horizon)
    voltage = brownout_limit(args)
    _in_range(voltage, horizon)
    start, end = part_of_recording(args.start, args.end)
    recording = read_given(args, start, end)
    voltage = limit_of(args, recording, voltage)
    if recording.n < _FEWEST:
        raise InputError(f"'{args.recording}' holds {counted(recording.n, 'usable sample')}: "
                         f'nothing can be estimated from fewer than {_FEWEST}')
    if levels is not None and not recording.has_throttle:
        raise InputError(f"--levels: '{args.recording}' has no throttle; leave --levels out, or "
                         'name the topic with --throttle-topic')
    with Progress('analyzing', args.json == output.STDOUT) as progress:
        analysis = analyze(recording, levels=levels, window=window, brownout_voltage=voltage,
                           brownout_horizon=horizon, cells=args.cells or 0, progress=progress)
    said = analysis_document(analysis, command_line(args))
    found = analysis.overview.facts
    if analysis.brownout_default:
        # As other commands without a limit.
        found = replace(found, dips=None, budget=None)
    output.deliver(args, said, {**as_data(analysis), 'headline': said.headline,
                                'supply': found.to_dict()})
    return 0


def command_line(args: argparse.Namespace) -> str:
    """Return the command that repeats this analysis."""
    return shlex.join(['ou-monitor', 'analyze', args.recording, *repeated(
        args, 'levels', 'window', 'brownout_voltage', 'cells', 'brownout_horizon')])


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
