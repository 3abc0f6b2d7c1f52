"""
Whether a simulation can be mistaken for the recording in level.

Limits first: it says nothing of the times between; a simulation that stays in range may still dip
at the wrong moments.
"""

from __future__ import annotations

import numpy as np
from ou_monitor.records import FloatArray

# Room on either side of what was seen, as a share of its range.  The extremes of two halves of a
# stationary flight differ by less, and a wrong sag or a drift that runs on by more; a choice.
MARGIN = 0.5


def seen_range(voltage: FloatArray) -> tuple[float, float]:
    """Return the range that a simulation may have: that of the recording, V, and a margin."""
    low, high = float(np.min(voltage)), float(np.max(voltage))
    room = MARGIN * (high - low)
    return low - room, high + room


def stray(simulated: FloatArray, voltage: FloatArray) -> float:
    """Return how far simulations, V, shape (..., n), leave `seen_range`, V; inf: not finite."""
    low, high = seen_range(voltage)
    if not np.isfinite(simulated).all():
        return float('inf')
    return max(0.0, low - float(np.min(simulated)), float(np.max(simulated)) - high)
