"""
Where an adaptive D term begins to hunt: coupling against how the cutoff is held.

Run by `filter.py loop`.
"""

from __future__ import annotations

from collections.abc import Callable
import math

from control_loop import critical_gain, judge, Loop, SWING, Verdict
import numpy as np
from ou_monitor.report.svg import Plot
from tables import number, table

COUPLINGS = (0.1, 0.3, 1.0, 1.5, 2.0, 3.0, 4.0)
# The threshold just above what a quiet hover has: where a law is most tempted.
_ABOVE = 0.72
_BARE = {'smoothing': 0.0, 'slew': 0.0, 'dead_band': 0.0}
# A body rate as quick as the loop makes it; its coupling is that of the loop.
_KALMAN = {'law': 'kalman', 'signal_bandwidth': 5.0, 'signal_rms': 0.3, 'signal_poles': 2,
           'n0': 1e-7}
CASES: dict[str, dict[str, object]] = {
    'constant_noise, defaults': {},
    'constant_noise, defaults, sigma ~ load^3': {'steepness': 3.0},
    'constant_noise, nothing held': {'filter': {**_BARE}},
    'constant_noise, nothing held, sigma ~ load^3': {
        'filter': {**_BARE, 'fmin': 5.0}, 'steepness': 3.0},
    'threshold, defaults': {'filter': {'law': 'threshold', 'sigma_ref': _ABOVE}},
    'threshold, nothing held': {'filter': {'law': 'threshold', 'sigma_ref': _ABOVE, **_BARE}},
    'kalman, lag <= 20 degrees at 10 Hz': {'filter': {**_KALMAN, 'max_lag': 20.0}},
    'kalman, fmin 5 Hz, sigma ~ load^3': {
        'filter': {**_KALMAN, 'fmin': 5.0}, 'steepness': 3.0},
    'threshold, slew 0.2 octaves/s': {
        'filter': {'law': 'threshold', 'sigma_ref': _ABOVE, 'slew': 0.2}},
}


def scan(seconds: float, seed: int, tell: Callable[[str], None]) -> dict[str, list[Verdict]]:
    """Return verdicts of each case at each coupling."""
    found: dict[str, list[Verdict]] = {}
    for name, options in CASES.items():
        found[name] = []
        for coupling in COUPLINGS:
            given = dict(options)
            of_filter = given.get('filter', {})
            if 'kalman' in name:
                given['filter'] = {**of_filter, 'coupling': coupling}  # type: ignore[dict-item]
            found[name].append(judge(Loop(coupling=coupling, **given),  # type: ignore[arg-type]
                                     seconds, seed))
        tell(name)
    return found


def render(found: dict[str, list[Verdict]]) -> tuple[str, Plot]:
    """Return a table and a figure."""
    rows = []
    plot = Plot('Swing of the cutoff against coupling of the supply into the gyro',
                'coupling, rad/s per V', 'swing, octaves', width=760, height=380, log_x=True)
    # Room for the legend above the curves.
    plot.limits((COUPLINGS[0], COUPLINGS[-1]), (-0.1, 5.0))
    for colour, (name, verdicts) in enumerate(found.items()):
        swings = [v.swing for v in verdicts]
        first = next((k for k, v in enumerate(verdicts) if v.cycle), None)
        rows.append([
            name, *(f'{v.swing:.2f}{" *" if v.cycle else ""}' for v in verdicts),
            'none' if first is None else f'{COUPLINGS[first]:g}',
            '-' if first is None else number(verdicts[first].period, '.1f')])
        plot.line(np.array(COUPLINGS), np.array(swings), name, colour, 'thick')
    plot.line(np.array([COUPLINGS[0], COUPLINGS[-1]]), np.array([SWING] * 2), '', 7, 'dash')
    share = found['constant_noise, defaults']
    text = ('**Swing of the cutoff, octaves (95 % less 5 % quantile; * it hunts), by coupling, '
            'rad/s per V**\n\n'
            + table(['law', *(f'{c:g}' for c in COUPLINGS), 'hunts from', 'period, s'], rows)
            + '\nRms of the differential command in the first row: '
            + ', '.join(f'{v.command:.2f}' for v in share) + '.\n\n'
            '**Loop gain from which the linear theory hunts, window 2 s**\n\n' + table(
                ['smoothing, s', *(f'{s:g}' for s in _SMOOTHINGS)],
                [['gain', *(_gain(s) for s in _SMOOTHINGS)]]))
    return text, plot


_SMOOTHINGS = (0.0, 0.05, 0.2, 0.5, 1.0, 4.0)


def _gain(smoothing: float) -> str:
    value = critical_gain(2.0, smoothing)
    return 'never' if math.isinf(value) else f'{value:.1f}'
