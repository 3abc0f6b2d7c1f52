"""`ou-monitor reproduce`: every number of the paper, recomputed, with a verdict."""

from __future__ import annotations

import argparse

from ou_monitor.bench import reproduce
from ou_monitor.cli import output
from ou_monitor.cli.arguments import check_outputs
from ou_monitor.cli.output import Progress


def run(args: argparse.Namespace) -> int:
    """Reproduce."""
    check_outputs(args, 'report')

    with Progress('recomputing', args.json == output.STDOUT) as progress:
        found = reproduce(seed=args.seed, progress=progress)
    output.deliver(args, found, f'ou-monitor reproduce --seed {args.seed}')
    return 0
