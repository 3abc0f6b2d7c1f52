"""
Risk from the margin in units of the flight's own excursions, where not even the load is known.

P = expit(b0 + b1 z1 + b2 z2), z1 = (now - L - m)/S within -4..8, z2 = (now - L)/S within 0..8,
with m and S mean and deviation of the drops of completed horizons, and one more of twice the
deviation of the last 5 s.  The coefficients were fitted on eight quadcopters.

Limits: it knows nothing of throttle; between 1, 2 and 5 s the coefficients are interpolated in
ln h, and beyond those of the end are taken, with the drops of the horizon itself.  Beyond 8 S
the risk falls with the fifth power of the margin, as the tail of Student's t that the other
laws have; it was not fitted there.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.online.risk.past import BLOCK, Past
from ou_monitor.records import FloatArray, NAN
from scipy.special import expit

_LN_HORIZON = np.log([1.0, 2.0, 5.0])
_COEFFICIENTS = np.array([(-0.90, -0.62, -0.34), (-0.52, -0.12, -0.68), (-1.08, 0.23, -0.52)])
# Margin, S, up to which they were fitted, and the power with which the risk falls beyond.
_FARTHEST, _POWER = 8.0, 5.0
_RECENT = 5.0
# Least deviation, as a share of the voltage: that of a source that does not move.
_LEAST = 1e-3
# And of a voltage of nothing, V.
_SMALLEST = 1e-6
# Blocks from which on something is known: a second.
_FEWEST = round(1.0 / BLOCK)


def excursions(past: Past, horizon: float) -> tuple[float, float]:
    """Return mean and deviation, V, of the drops within a horizon, s; NaN in the first second."""
    if past.table.shape[1] < _FEWEST:
        return NAN, NAN
    last = past.table[1]
    recent = last[-round(_RECENT / BLOCK):]
    recent = recent[np.isfinite(recent)]
    drops = past.drops(horizon)
    # Blocks that overlap count as n dt / h.
    n = drops.size * BLOCK / max(horizon, BLOCK)
    first = 2.0 * float(recent.std())
    least = max(_LEAST * abs(float(last[-1])), _SMALLEST)
    if not drops.size:
        return first, max(first, least)
    mean = (n * float(drops.mean()) + first) / (n + 1.0)
    square = (n * float(((drops - mean) ** 2).mean()) + (first - mean) ** 2) / (n + 1.0)
    return mean, max(math.sqrt(square), least)


def excursion_risk(now: float, levels: FloatArray, horizon: float, mean: float, deviation: float
                   ) -> FloatArray:
    """Return the risk at levels, V, shape (k,); it falls as the margin grows."""
    b = [float(np.interp(math.log(horizon), _LN_HORIZON, column)) for column in _COEFFICIENTS.T]
    margin = np.maximum(now - levels, 0.0) / deviation
    far = np.minimum(margin, _FARTHEST)
    score = b[0] + b[1] * np.clip(far - mean / deviation, -4.0, _FARTHEST) + b[2] * far
    return np.asarray(expit(score) * np.minimum(1.0, _FARTHEST / np.maximum(
        margin, _FARTHEST)) ** _POWER)
