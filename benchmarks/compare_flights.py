"""
Recorded flights and their simulations: first half fitted, second half simulated (1 min).

All flights use the same settings.
"""

from __future__ import annotations

import sys
import time

from common import arguments, deliver, flights, say, table
from ou_monitor.comparison.compare import Agreement, compare, ComparedNumber

HEAD = ['flight', 's', 'explained', 'bias mV', 'lowest V', 'simulated', 'dips 1 %', 'simulated',
        'dips 5 %', 'simulated', 'verdict', 'CPU s']


def beside(of: ComparedNumber, digits: int) -> str:
    """Return the median of the simulations and their 95 % band."""
    return f'{of.median:.{digits}f} [{of.low:.{digits}f}, {of.high:.{digits}f}]'


def within(of: ComparedNumber, factor: float = 2.0) -> bool:
    """Return whether the median is within a factor of the measured number."""
    return of.measured / factor <= of.median <= of.measured * factor


def row(name: str, found: Agreement, spent: float) -> list[str]:
    """Return the row of a flight."""
    first, second = found.of('dips')
    return [name, f'{found.simulated[1] - found.simulated[0]:.0f}', f'{found.explained:.2f}',
            f'{1e3 * found.bias:.0f}', f'{found.lowest.measured:.2f}', beside(found.lowest, 2),
            f'{first.measured:.1f}', beside(first, 1), f'{second.measured:.1f}',
            beside(second, 1),
            'looks like it' if found.verdict.name == 'LOOKS_LIKE_IT' else 'differs',
            f'{spent:.1f}']


def main() -> int:
    """Compare the flights and print the table, or put it into the page."""
    parser = arguments(__doc__, names=True)
    parser.add_argument('--seeds', type=int, default=200, help='simulations of each')
    options = parser.parse_args()
    rows: list[list[str]] = []
    lowest = rates = one = 0
    for name, recording in flights(options.names):
        started = time.process_time()
        found = compare(recording, seeds=options.seeds)
        rows.append(row(name, found, time.process_time() - started))
        say(rows[-1], found.worst)
        lowest += found.lowest.inside
        rates += all(within(dips) for dips in found.of('dips'))
        one += any(within(dips) for dips in found.of('dips'))
    text = table(HEAD, rows) + (
        f'\nLowest voltage within its band: {lowest} of {len(rows)}. Falls within a factor of 2 '
        f'of the measured: through both levels {rates} of {len(rows)}, through one at least '
        f'{one} of {len(rows)}.\n')
    deliver(text, options.page, 'beside')
    return 0


if __name__ == '__main__':
    sys.exit(main())
