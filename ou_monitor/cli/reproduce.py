"""`ou-monitor reproduce`: every number of the paper, recomputed, with a verdict."""

from __future__ import annotations

import argparse

from ou_monitor.cli import output
from ou_monitor.cli.arguments import check_outputs
from ou_monitor.cli.output import Progress


def run(args: argparse.Namespace) -> int:
    """Reproduce."""
    check_outputs(args, 'report')

    from ou_monitor.paper.reproduce.reproduce import as_data, reproduce
    from ou_monitor.report.reproduction_document import reproduction_document

    with Progress('recomputing', args.json == output.STDOUT) as progress:
        result = reproduce(args.seed, progress)
    command = f'ou-monitor reproduce --seed {args.seed}'
    output.deliver(args, reproduction_document(result, command), as_data(result))
    return 0
