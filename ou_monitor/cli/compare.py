"""`ou-monitor compare RECORDING`: a recording beside simulations of it."""

from __future__ import annotations

import argparse
import math
import shlex

from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    brownout_limit, check_outputs, limit_of, part_of_recording, read_given, repeated)
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError

# Simulations at least and at most, as `compare` has them.
_FEWEST, _MOST = 20, 10_000


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    start, end = part_of_recording(args.start, args.end)
    seeds, until, limit = _seeds(args.seeds), _until(args.fit_until), brownout_limit(args)
    check_outputs(args, 'report', RECORDING=args.recording,
                  **{'--msg-config': args.msg_config, '--model': args.model})

    import numpy as np
    from ou_monitor.analysis.overview import overview
    from ou_monitor.comparison.compare import compare
    from ou_monitor.recordings.model_file import read_model
    from ou_monitor.report.comparison_document import comparison_document

    model = None if args.model is None else read_model(args.model).model
    recording = read_given(args, start, end)
    limit = limit_of(args, recording, limit)
    with Progress('comparing', args.json == output.STDOUT) as progress, \
            np.errstate(over='ignore', under='ignore'):
        found = compare(recording, model, fit_until=until, seeds=seeds, seed=args.seed,
                        levels=() if limit is None else (limit,), progress=progress)
    seen = overview(recording, limit, cells=args.cells or 0)
    output.deliver(args, comparison_document(found, seen, command_line(args)),
                   {**found.as_data(), 'supply': seen.facts.to_dict()})
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
