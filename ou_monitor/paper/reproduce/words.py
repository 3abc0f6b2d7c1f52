"""A reproduction in words and in plain data: headline, JSON."""

from __future__ import annotations

import math
from typing import Any

from ou_monitor.paper.reproduce.points import count
from ou_monitor.paper.reproduce.reproduce import Reproduction
from ou_monitor.paper.reproduce.row import Row, Verdict
from ou_monitor.text import number


def headline(result: Reproduction) -> str:
    """Return what came out, in one sentence."""
    counts = count(result.rows)
    return (f'Of {len(result.rows)} numbers and claims of the paper, '
            f'{counts[Verdict.AGREES]} agree with their recomputation, '
            f'{counts[Verdict.ROUNDING]} differ from it by no more than rounding, and '
            f'{counts[Verdict.DOES_NOT_HOLD]} do not hold.')


def recomputed(row: Row) -> str:
    """Return the recomputed number with its standard error, to its digits."""
    digits = max(4, 1 + sum(c.isdigit() for c in row.printed.text.split('e')[0].lstrip('0.')))
    if not row.error:
        return number(row.recomputed, digits)
    # As many decimals as the error has to two digits.
    decimals = max(0, 1 - math.floor(math.log10(row.error)))
    return f'{row.recomputed:.{decimals}f} +- {row.error:.{decimals}f}'


def as_data(result: Reproduction) -> dict[str, Any]:
    """Return a reproduction as plain data."""
    return {
        'headline': headline(result),
        'seed': result.seed,
        'counts': {verdict.name: n for verdict, n in count(result.rows).items()},
        'rows': [_row(row) for row in result.rows],
        'points': [{'number': point.number, 'title': point.title, 'text': point.text,
                    'counts': {v.name: n for v, n in count(point.rows).items()}}
                   for point in result.points],
    }


def _row(row: Row) -> dict[str, Any]:
    return {
        'where': row.where, 'quantity': row.quantity, 'unit': row.unit,
        'printed': row.printed.text, 'printed_value': row.printed.value,
        'printed_half_unit': row.printed.half_unit, 'printed_inputs': row.printed_inputs,
        'recomputed': row.recomputed, 'error': row.error, 'interval': row.interval,
        'inputs': row.inputs, 'how': row.how, 'verdict': row.verdict.name,
        'sentence': row.sentence, 'point': row.point or None,
    }
