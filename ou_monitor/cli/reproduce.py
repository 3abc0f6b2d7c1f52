"""`ou-monitor reproduce`: every number of the paper, recomputed, with a verdict."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ou_monitor.cli import output
from ou_monitor.cli.arguments import check_outputs
from ou_monitor.cli.output import Progress

if TYPE_CHECKING:
    from ou_monitor.paper.reproduce.reproduce import Reproduction


def run(args: argparse.Namespace) -> int:
    """Reproduce."""
    check_outputs(args, 'report')

    from ou_monitor.paper.reproduce.reproduce import as_data, headline, reproduce

    with Progress('recomputing', args.json == output.STDOUT) as progress:
        result = reproduce(args.seed, progress)
    if args.report is not None:
        from ou_monitor.report.reproduction_page import reproduction_page
        output.write_text(
            reproduction_page(result, f'ou-monitor reproduce --seed {args.seed}'), args.report)
    if args.json is not None:
        output.write_json(as_data(result), args.json)
    if args.json != output.STDOUT:
        output.say(render(result))
        points = ', '.join(point.title for point in result.points[:2])
        output.summary(headline(result), f'{len(result.points)} points, the first: {points}.',
                       report=args.report, json=args.json)
    return 0


def render(result: Reproduction) -> str:
    """Return the rows and points for a terminal 100 columns wide."""
    from ou_monitor.paper.reproduce.reproduce import headline, recomputed, tally

    lines = [output.paragraph(headline(result))]
    rows = [[row.where if k == 0 or row.where != found[k - 1].where else '',
             row.quantity + (f', {row.unit}' if row.unit else ''), row.printed.text,
             recomputed(row), row.verdict.value]
            for _, found in result.parts() for k, row in enumerate(found)]
    lines += ['', output.table(['where', 'quantity', 'printed', 'recomputed', 'verdict'],
                               rows, left=[0, 1, 4])]
    for point in result.points:
        lines += ['', f'{point.number}. {point.title} ({tally(point.rows)})',
                  output.paragraph(point.text, '   ')]
    return '\n'.join(lines)
