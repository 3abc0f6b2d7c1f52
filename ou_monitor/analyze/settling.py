"""
Whether what follows a change of throttle has settled where a level begins.

A level begins `SETTLE` after throttle arrived.  Where the measured relaxation is slower, its rest
is taken for noise: alpha comes out too low, as that of the settling, and sigma with it.

Limits: only relaxations that are seen after changes between levels; the share of the variance
rests on one exponential, and is that of the fit, which holds the settling itself.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

from ou_monitor.analyze.levels import SETTLE
from ou_monitor.analyze.relaxation import Relaxation
from ou_monitor.criticism.quality_item import QualityItem, Severity
from ou_monitor.records import Estimate

# Share of a level's variance that may be left of the settling: alpha is then off by about as much.
SHARE = 0.02


def unsettled(relaxations: Sequence[Relaxation], throttles: Sequence[float],
              estimates: Sequence[Estimate], times: Sequence[float]) -> list[QualityItem]:
    """
    Return a warning for each kind of change after which levels hold the settling too.

    throttles 0..1, times in s.
    """
    items = []
    for fit in relaxations:
        shares = {x: _share(fit, x, e, time)
                  for x, e, time in zip(throttles, estimates, times) if e.usable and time > 0.0}
        where = tuple(x for x, share in shares.items() if share > SHARE)
        if not where:
            continue
        what = {'release': 'falls', 'load': 'rises'}[fit.kind]
        start = f'After throttle {what} the voltage '
        end = (f'only {1e3 * SETTLE:.3g} ms are left out: alpha and sigma here hold the settling '
               'too')
        if fit.seen:
            most = 100.0 * min(1.0, max(shares[x] for x in where))
            text = (f'{start}settles in tau = {1e3 * fit.tau:.3g} ms, and {end} (up to '
                    f'{most:.0f} % of the variance).')
        else:
            text = f'{start}moves on for as long as it is watched, and {end}.'
        items.append(QualityItem('NOT_SETTLED', Severity.WARNING, text, where))
    return items


def _share(fit: Relaxation, throttle: float, estimate: Estimate, time: float) -> float:
    """Return the mean square of what is left of the settling, over Var_inf."""
    changes = [change for change in fit.releases if change.throttle_after == throttle]
    if not changes:
        return 0.0
    if not fit.seen:
        return math.inf if fit.moves_on else 0.0
    # Of A exp(-t / tau), squared, from the end of what is left out to the end of what is watched.
    left = sum(change.amplitude ** 2 * max(0.0, math.exp(-2.0 * SETTLE / fit.tau)
                                           - math.exp(-2.0 * change.duration / fit.tau))
               for change in changes if math.isfinite(change.amplitude))
    return 0.5 * fit.tau * left / (time * estimate.var_inf)
