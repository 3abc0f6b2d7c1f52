"""How fast a rail relaxes under levels that come and go: what their likelihood starts from."""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.records import FloatArray

# Median of the size of a normal score.
_MEDIAN = 0.6745


def moving(view: View, size: int) -> slice:
    """Return the segment of a size in which the voltage moves most beside its noise."""
    moves = (view.residual / np.sqrt(view.variance))[view.train]
    starts = range(0, moves.size - size + 1, max(size // 2, 1))
    begin = max(starts, key=lambda k: float(moves[k:k + size].var()))
    return slice(begin, begin + size)


def relaxing(view: View, faster: float) -> View:
    """
    Return what a rail that relaxes faster leaves over.

    The relaxation that was fitted without levels is that of both together.
    """
    if faster == 1.0:
        return view
    phi = view.phi**faster
    e = view.z * np.sqrt(view.variance) + (view.phi - phi) * view.state
    inside = e[view.train]
    # Most of what it leaves is noise, however large the levels are.
    middle = float(np.median(inside))
    std = float(np.median(np.abs(inside - middle))) / _MEDIAN
    if not std > 0.0:
        return view
    spread = 1.0 - phi * phi
    variance = std * std * spread / float(np.median(spread))
    return replace(view, z=(e - middle) / np.sqrt(variance), phi=phi, variance=variance)


def faster_by(view: View, levels: FloatArray) -> float:
    """Return how much faster the rail relaxes than it seems to with these levels on it, V."""
    r = (view.residual - levels)[view.train]
    r = r - r.mean()
    keep = min(max(float(r[1:] @ r[:-1]) / float(r @ r), 1e-3), 1.0 - 1e-9)
    return max(math.log(keep) / math.log(float(np.median(view.phi[view.train]))), 1.0)


def units_of(view: View) -> FloatArray:
    """Return how much of a score the median standard deviation is, sample by sample."""
    units: FloatArray = np.sqrt(float(np.median(view.variance)) / view.variance)
    return units
