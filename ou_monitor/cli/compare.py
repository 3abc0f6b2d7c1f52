"""`ou-monitor compare RECORDING`: a recording beside simulations of it."""

from __future__ import annotations

import argparse
import math
import shlex
from typing import TYPE_CHECKING

from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    brownout_limit, check_outputs, limit_of, part_of_recording, read_given, repeated)
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError

if TYPE_CHECKING:
    from ou_monitor.comparison.agreement import Agreement

# Simulations at least and at most, as `compare` has them.
_FEWEST, _MOST = 20, 10_000


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    start, end = part_of_recording(args.start, args.end)
    seeds, until, limit = _seeds(args.seeds), _until(args.fit_until), brownout_limit(args)
    check_outputs(args, 'report', RECORDING=args.recording,
                  **{'--msg-config': args.msg_config, '--model': args.model})

    import numpy as np
    from ou_monitor.analysis.supply import supply_facts
    from ou_monitor.comparison.compare import compare
    from ou_monitor.comparison.judgement import in_short
    from ou_monitor.recordings.model_file import read_model

    model = None if args.model is None else read_model(args.model).model
    recording = read_given(args, start, end)
    limit = limit_of(args, recording, limit)
    with Progress('comparing', args.json == output.STDOUT) as progress, \
            np.errstate(over='ignore', under='ignore'):
        found = compare(recording, model, fit_until=until, seeds=seeds, seed=args.seed,
                        levels=() if limit is None else (limit,), progress=progress)
    if args.report is not None:
        from ou_monitor.report.comparison_page import comparison_page
        output.write_text(comparison_page(found, command_line(args)), args.report)
    if args.json is not None:
        output.write_json({**found.as_data(), 'supply': supply_facts(
            recording, limit).to_dict()}, args.json)
    if args.json != output.STDOUT:
        output.say(render(found))
        output.summary(*in_short(found), report=args.report, json=args.json)
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


def render(found: Agreement) -> str:
    """Return the comparison for a terminal 100 columns wide."""
    from ou_monitor.comparison.judgement import headline, parts, path_rows, rows

    lines = [output.paragraph(headline(found)), '',
             output.paragraph(f'{found.recording}: {parts(found)}; {", ".join(found.model)}'), '',
             output.table(['', 'measured', 'simulated [95 %]', ''], rows(found), left=[0, 3]), '',
             output.facts_table(path_rows(found))]
    if found.notes:
        lines += ['', *[output.item(note) for note in found.notes]]
    return '\n'.join(lines)
