"""
The codes of an ADC: the step between them, and the rails at which it clips.

Ties have no chance in a diffusion, so both are findings without a model.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.records import FloatArray

# Values looked at for the step: more tell no more.
_MOST = 200_000
# Rounding of float32, as a share of the value, with room for two of them.
_FLOAT32 = 2.5e-7
# Share of the samples that must lie on the lattice, and how near, in steps.
_SHARE, _NEAR = 0.99, 0.1
# Samples at a rail, visits to it, and standard errors above its neighbours, at least.
_LEAST, _VISITS, _CLEAR = 8, 3, 5.0
# With steps above this many standard deviations of the noise the codes next to
# each other say nothing of a density.
_COARSE = 2.0


def find_step(voltage: FloatArray) -> float:
    """Return the step of the lattice on which the values lie (voltage in V)."""
    v = voltage[:_MOST]
    if v.size > 16:
        # A rail need not be a code.
        inner = v[(v > v.min()) & (v < v.max())]
        v = inner if np.unique(inner).size > 2 else v
    values, counts = np.unique(v, return_counts=True)
    rounding = _FLOAT32 * float(np.abs(values).max(initial=0.0))
    begins = np.concatenate(([0], np.flatnonzero(np.diff(values) > rounding) + 1))
    if begins.size < 2 or begins.size > 0.5 * v.size:
        return 0.0
    weight = np.add.reduceat(counts, begins).astype(np.float64)
    codes = np.add.reduceat(values * counts, begins) / weight
    gaps = np.diff(codes)
    for first in (float(gaps.min()), float(np.median(gaps))):
        step = _fitted(codes, gaps, weight, first)
        if step > 8.0 * rounding:
            return step
    return 0.0


def _fitted(codes: FloatArray, gaps: FloatArray, weight: FloatArray, first: float) -> float:
    """Return the step near `first` that the codes fit; 0 when they do not."""
    step = float(gaps[gaps < 1.5 * first].mean())
    number = np.concatenate(([0.0], np.cumsum(np.rint(gaps / step))))
    middle = float(weight @ number) / float(weight.sum())
    spread = float(weight @ (number - middle) ** 2)
    if not spread > 0.0:
        return 0.0
    step = float(weight @ ((number - middle) * codes)) / spread
    level = float(weight @ codes) / float(weight.sum())
    off = np.abs(codes - level - step * (number - middle))
    return step if weight[off < _NEAR * step].sum() >= _SHARE * weight.sum() else 0.0


def find_rails(voltage: FloatArray, step: float, noise: float) -> tuple[float, float]:
    """Return the readings at which the ADC clips (voltage in V, step in V, noise in V)."""
    if step > _COARSE * noise:
        return -math.inf, math.inf
    high = float(voltage.max()) if _clipped(voltage, step, 1.0) else math.inf
    low = float(voltage.min()) if _clipped(voltage, step, -1.0) else -math.inf
    return low, high


def _clipped(voltage: FloatArray, step: float, side: float) -> bool:
    """Return whether the top (or with side -1 the bottom) holds more than its neighbours say."""
    top = float(voltage.max()) if side > 0.0 else -float(voltage.min())
    tie = _FLOAT32 * abs(top)
    width = step if step > 0.0 else tie
    below = top - side * voltage
    at = below < 0.5 * width + tie
    count = int(at.sum())
    # The extremes of a bell need not be tested where nothing is heaped.
    if count < _LEAST or int((at[1:] & ~at[:-1]).sum()) < _VISITS:
        return False
    others = below[~at]
    if not others.size or float(others.min()) > max(3.5 * step, 0.2 * float(others.std())):
        # Far from all others: a code of its own, no end of a range.
        return False
    if step > 0.0:
        expected = max(float((np.abs(below - k * step) < 0.5 * step).sum()) for k in (1, 2, 3))
    else:
        # As dense as the nearest stretch that holds some samples.
        reach = float(np.partition(others, min(_LEAST, others.size - 1))[:_LEAST].max())
        expected = _LEAST * 2.0 * tie / max(reach, tie)
    return count - expected > _CLEAR * math.sqrt(count + expected)
