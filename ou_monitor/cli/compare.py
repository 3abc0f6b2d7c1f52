"""`ou-monitor compare RECORDING`: a recording beside simulations of it."""

from __future__ import annotations

import argparse

from ou_monitor.bench import compare
from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    check_outputs, command_line, given, limit_given, part_of_recording, read_given)
from ou_monitor.cli.options import TIME, whole
from ou_monitor.cli.output import Progress
from ou_monitor.recordings.model_file import read_model

# Simulations at least and at most, as `compare` has them.
_SEEDS = whole('a whole number, 20 to 10000', 20, 10_000)


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    start, end = part_of_recording(args.start, args.end)
    seeds = given('--seeds', args.seeds, _SEEDS)
    until = None if args.fit_until is None else given('--fit-until', args.fit_until, TIME)
    limit = limit_given(args)
    check_outputs(args, 'report', RECORDING=args.recording,
                  **{'--msg-config': args.msg_config, '--model': args.model})
    model = None if args.model is None else read_model(args.model).model
    recording = read_given(args, start, end)
    with Progress('comparing', args.json == output.STDOUT) as progress:
        found = compare(recording, model, fit_until=until, seeds=seeds, seed=args.seed,
                        progress=progress, **limit)
    output.deliver(args, found, command_line(
        args, 'compare', 'fit_until', 'seeds', 'seed', 'brownout_voltage', 'cells', 'model'))
    return 0
