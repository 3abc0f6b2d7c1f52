"""`ou-monitor compare RECORDING`: a recording beside simulations of it."""

from __future__ import annotations

import argparse
import math
import shlex

from ou_monitor.bench import compare
from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    check_outputs, limit_given, part_of_recording, read_given, repeated)
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError
from ou_monitor.recordings.model_file import read_model

# Simulations at least and at most, as `compare` has them.
_FEWEST, _MOST = 20, 10_000


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    start, end = part_of_recording(args.start, args.end)
    seeds, until, limit = _seeds(args.seeds), _until(args.fit_until), limit_given(args)
    check_outputs(args, 'report', RECORDING=args.recording,
                  **{'--msg-config': args.msg_config, '--model': args.model})
    model = None if args.model is None else read_model(args.model).model
    recording = read_given(args, start, end)
    with Progress('comparing', args.json == output.STDOUT) as progress:
        found = compare(recording, model, fit_until=until, seeds=seeds, seed=args.seed,
                        progress=progress, **limit)
    output.deliver(args, found, command_line(args))
    return 0


def command_line(args: argparse.Namespace) -> str:
    """Return the command that repeats this comparison."""
    more = repeated(args, 'fit_until', 'seeds', 'seed', 'brownout_voltage', 'cells')
    if args.model is not None:
        more += ['--model', str(args.model)]
    return shlex.join(['ou-monitor', 'compare', args.recording, *more])


def _seeds(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not _FEWEST <= int(text) <= _MOST:
        raise InputError(f"--seeds: '{text}' is not a whole number, {_FEWEST} to {_MOST}")
    return int(text)


def _until(text: str | None) -> float | None:
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0.0):
        raise InputError(f"--fit-until: '{text}' is not a time in seconds, 0 or more")
    return value
