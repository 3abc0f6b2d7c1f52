"""
What the pilot may do next, drawn from what he did in this flight.

Each completed horizon of the last minutes is one future: its highest throttle, the time spent
there, and the mean of the rest.  It weighs the more the nearer its first throttle is to the
present one and the more recent it is.  One horizon's worth of futures is never flown: a rise
into each fifth of the throttle that is left (rule of succession).

Limits: what a pilot has never done has the weight of one horizon; the order within a horizon
is peak first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from ou_monitor.online.risk.load_law import Futures
from ou_monitor.online.risk.past import AT_PEAK, BLOCK, Past, sliding
from ou_monitor.records import FloatArray

# Throttle that makes a past instant like the present, and s in which it is forgotten.
_LIKE, _MEMORY = 0.25, 100.0
# Share of the throttle that is left to which futures never flown rise, and their dwell.
_RISES, _RISE_DWELL = (0.1, 0.3, 0.5, 0.7, 0.9), 0.2
# Starts are so far apart, s and in horizons, and no more than so many.
_APART, _SHARE, _MOST = 0.2, 0.1, 320


@dataclass(frozen=True, eq=False)
class Flown:
    """Completed horizons: throttle at first, peak, dwell (s), rest, age (s); shapes (k,)."""

    first: FloatArray
    peak: FloatArray
    dwell: FloatArray
    rest: FloatArray
    age: FloatArray


def flown(past: Past, horizon: float) -> Flown:
    """Return what throttle did in completed horizons, s."""
    width = max(1, round(horizon / BLOCK))
    mean, high = past.table[2], past.table[3]
    n = mean.size - width
    if n <= 0:
        none = np.empty(0)
        return Flown(none, none, none, none, none)
    step = max(1, round(_APART / BLOCK), round(_SHARE * width), -(-n // _MOST))
    at = np.arange((n - 1) % step, n, step)
    peak = sliding(np.maximum, high[1:], width)[at]
    within = sliding_window_view(mean[1:], width)[at]
    near = within >= peak[:, None] - AT_PEAK
    count = near.sum(axis=1)
    rest = np.where(count < width, (within.sum(axis=1) - (within * near).sum(axis=1))
                    / np.maximum(width - count, 1), peak)
    good = np.isfinite(within.sum(axis=1) + mean[at])
    # A block that holds the peak may have a mean below it.
    dwell = np.maximum(count, 1) * BLOCK
    return Flown(*(x[good] for x in (mean[at], peak, dwell, rest, (n - 1 - at) * BLOCK)))


def pilot(past: Flown, throttle: float, horizon: float) -> tuple[Futures, FloatArray]:
    """Return futures from a throttle on, and their weights, which add up to 1."""
    weight = np.exp(-0.5 * ((past.first - throttle) / _LIKE) ** 2 - past.age / _MEMORY)
    if past.age.size > 1:
        weight *= min((past.age[0] - past.age[1]) / horizon, 1.0)
    n = len(_RISES)
    ahead = throttle + (1.0 - throttle) * np.array(_RISES)
    weight = np.concatenate((weight, np.full(n, 1.0 / n)))
    futures = Futures(
        np.concatenate((np.maximum(past.peak, throttle), ahead)),
        np.concatenate((past.dwell, np.full(n, _RISE_DWELL * horizon))),
        np.concatenate((past.rest, np.full(n, throttle))))
    return futures, weight / weight.sum()
