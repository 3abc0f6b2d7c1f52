"""
What the rail did while the ADC clipped, drawn anew.

Leaving clipped samples out would leave a law that is cut where they were, and
every statistic of what remains would see the cut.  So they are drawn from the
law of an AR(1), given their neighbours and that they lie beyond the limit
(Gibbs sampling; Tanner & Wong, J. Am. Stat. Assoc. 82 (1987) 528).
"""

from __future__ import annotations

import numpy as np
from ou_monitor.records import FloatArray
from scipy.special import ndtr, ndtri

# Sweeps over all samples drawn: excursions last some relaxation times at most.
_SWEEPS = 60


def redraw(voltage: FloatArray, low: float, high: float, step: float,
           rng: np.random.Generator) -> FloatArray:
    """
    Return the voltage with clipped samples drawn beyond their limit.

    voltage in V, low, high in V, step in V.
    """
    v = voltage.astype(np.float64)
    top, bottom = voltage >= high, voltage <= low
    sites = np.flatnonzero(top | bottom)
    sites = sites[(sites > 0) & (sites < v.size - 1)]
    halves = [sites[sites % 2 == parity] for parity in (0, 1)]
    for _ in range(_SWEEPS):
        mean = float(v.mean())
        c = v - mean
        phi = min(float(c[1:] @ c[:-1]) / float(c @ c), 0.9999)
        spread = float(np.sqrt(np.mean((c[1:] - phi * c[:-1]) ** 2) / (1.0 + phi * phi)))
        for k in halves:
            centre = mean + phi / (1.0 + phi * phi) * (c[k - 1] + c[k + 1])
            side = np.where(top[k], 1.0, -1.0)
            limit = np.where(top[k], high, low)
            # On the side of the limit: -z is below where the limit lies.
            room = ndtr(side * (centre - limit) / spread)
            draw = -ndtri(np.maximum(room * (1.0 - rng.random(k.size)), 1e-300))
            c[k] = np.where(room > 1e-12, centre + side * spread * draw, limit) - mean
        v = c + mean
    if step > 0.0:
        for at, end in ((top, high), (bottom, low)):
            v[at] = end + step * np.rint((v[at] - end) / step)
    return v
