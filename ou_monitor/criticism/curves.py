"""Histograms and spectra for pages, and the range allowed for simulations."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray


def outline(edges: FloatArray, heights: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the corners of a histogram, from the first edge to the last."""
    return np.repeat(edges, 2)[1:-1], np.repeat(np.asarray(heights, dtype=np.float64), 2)


# Margin on either side of the recorded range, as a share of the range.  The extremes of two halves
# of a stationary flight differ by less; a wrong sag or a growing drift moves them by more.
MARGIN = 0.5


def stray(simulated: FloatArray, voltage: FloatArray) -> float:
    """Return how far simulations leave a recorded range and its margin, V; inf if not finite."""
    low, high = float(np.min(voltage)), float(np.max(voltage))
    room = MARGIN * (high - low)
    if not np.isfinite(simulated).all():
        return float('inf')
    return max(0.0, low - room - float(np.min(simulated)), float(np.max(simulated)) - high - room)


def even_on_log(x: FloatArray, y: FloatArray, per_decade: int) -> tuple[FloatArray, FloatArray]:
    """Average a curve over increasing x > 0 in even bins of log x."""
    if x.size < 3:
        return x, y
    bins = np.floor(per_decade * np.log10(x / x[0])).astype(np.intp)
    count = np.bincount(bins)
    some = count > 0
    return np.bincount(bins, x)[some] / count[some], np.bincount(bins, y)[some] / count[some]
