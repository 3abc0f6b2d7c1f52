"""The data (`View`) to which laws of the innovations are fitted, and functions for laws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np
from ou_monitor.records import FloatArray
from scipy.optimize import minimize
from scipy.special import ndtr, ndtri

LOG_2PI = math.log(2.0 * math.pi)
# Minimum probability, which limits normal scores to about 8.
_EDGE = 1e-15


@dataclass(frozen=True, eq=False)
class View:
    """The residual of the model so far, to which a candidate is fitted."""

    z: FloatArray  # Normal scores of the one-step innovations under the model so far; shape (n,)
    variance: FloatArray  # Predictive variance of each sample, V^2; shape (n,)
    phi: FloatArray  # exp(-alpha step) of the OU in the step before each sample; shape (n,)
    # Deviation of the previous sample from its mean, V; 0 at the first; shape (n,).
    state: FloatArray
    residual: FloatArray  # Voltage less its mean, V; shape (n,)
    at: FloatArray  # Time since the first sample, s; shape (n,)
    step: FloatArray  # Time since the previous sample, s; shape (n,)
    throttle: FloatArray | None  # 0..1; shape (n,)
    train: slice  # Samples to which parameters are fitted
    # Gain of the filter, 0..1: 1 without white noise; shape (n,).
    trust: FloatArray | float = 1.0
    # Share of each variance that is due to the noise of the `ou` in the step before: 1 without
    # white noise and other states; shape (n,).
    driven: FloatArray | float = 1.0
    slope: FloatArray | float = 0.0  # Slope of the tones of the model, V/s; shape (n,)
    by_current: bool = False  # Whether `throttle` is a current as a share of the largest

    @cached_property
    def rate(self) -> float:
        """Return the median sampling rate, Hz."""
        return 1.0 / float(np.median(self.step[1:]))


def normal_scores(cdf: FloatArray) -> FloatArray:
    """Return the normal scores of probabilities."""
    scores: FloatArray = ndtri(np.clip(cdf, _EDGE, 1.0 - 1e-16))
    return scores


def log_normal(z: FloatArray, mean: FloatArray | float = 0.0, var: FloatArray | float = 1.0
               ) -> FloatArray:
    """Return log densities of a normal distribution."""
    result: FloatArray = -0.5 * (LOG_2PI + np.log(var) + (z - mean) ** 2 / var)
    return result


def climb(value: Callable[[FloatArray], float], start: Sequence[float] | FloatArray,
          size: float = 0.4, most: int = 200) -> tuple[FloatArray, float]:
    """Maximise a function of a few parameters (Nelder & Mead); return position and value."""
    x0 = np.asarray(start, dtype=np.float64)
    simplex = np.vstack([x0, x0 + size * np.eye(x0.size)])
    found = minimize(lambda x: -value(x), x0, method='Nelder-Mead',
                     options={'initial_simplex': simplex, 'maxfev': most, 'xatol': 1e-3,
                              'fatol': 1e-2})
    return found.x, -float(found.fun)


def curvature_se(value: Callable[[FloatArray], float], at: FloatArray, step: float = 0.05
                 ) -> FloatArray:
    """Return the joint standard errors at a maximum of a log-likelihood; NaN if undetermined."""
    found = np.array([value(x) for x in at + _around(at.size, step)])
    return _errors(_parabola(found, at.size, step)[1])


def _around(size: int, step: float) -> FloatArray:
    """Return moves that determine a parabola: none, along each axis, and along pairs of axes."""
    moves, pairs = step * np.eye(size), np.triu_indices(size, 1)
    both = moves[pairs[0]] + moves[pairs[1]]
    # Central differences, because one-sided ones are biased by the third derivative.
    return np.concatenate((np.zeros((1, size)), moves, -moves, both, -both))


def _parabola(found: FloatArray, size: int, step: float) -> tuple[FloatArray, FloatArray]:
    """Return gradient and second derivatives from the values at the points of `_around`."""
    with np.errstate(invalid='ignore'):
        top, up, down = found[0], found[1:size + 1], found[size + 1:2 * size + 1]
        bend, pairs = np.diag((up - 2.0 * top + down) / step**2), np.triu_indices(size, 1)
        sides = found[2 * size + 1:].reshape(2, -1).sum(axis=0)
        alone = up + down - top
        bend[pairs] = (sides - alone[pairs[0]] - alone[pairs[1]]) / (2.0 * step**2)
        return (up - down) / (2.0 * step), bend + np.triu(bend, 1).T


def _errors(bend: FloatArray) -> FloatArray:
    """Return joint standard errors from second derivatives of a log-likelihood."""
    errors, slope = np.full(bend.shape[0], math.nan), bend.diagonal()
    # Leave out parameters without effect or at a limit, which must not affect the other errors.
    kept = np.flatnonzero(np.isfinite(slope) & (slope < 0.0))
    scale = np.sqrt(-slope[kept])
    curve, axes = np.linalg.eigh(-bend[np.ix_(kept, kept)] / np.outer(scale, scale))
    if (curve > 0.0).all():
        errors[kept] = np.sqrt((axes**2 / curve).sum(axis=1)) / scale
    return errors


def refine(values: Callable[[FloatArray], FloatArray], start: Sequence[float] | FloatArray,
           step: float = 0.1) -> tuple[FloatArray, float, FloatArray] | None:
    """Return position, value and errors of a maximum near `start` by Newton steps, or None."""
    x = np.asarray(start, dtype=np.float64)
    turn = 0
    while True:
        found = values(x + _around(x.size, step))
        if not np.isfinite(found).all():
            return None
        top, (gradient, bend) = found[0], _parabola(found, x.size, step)
        curve, axes = np.linalg.eigh(bend)
        if curve[0] >= 0.0:
            return None
        # Step uphill along each principal axis, even where the curvature is positive.
        by = axes @ (axes.T @ gradient / np.maximum(np.abs(curve), _STRAIGHT * -curve[0]))
        gain = 0.5 * float(by @ gradient)
        ends = x + np.clip(by, -0.5, 0.5) * _SHARES[:, None]
        further = values(ends) if gain >= _FLAT and turn < _NEWTON else found[:1]
        if not further.max() > top:
            return x, float(top), _errors(bend)
        x, turn = ends[int(np.argmax(further))], turn + 1


_NEWTON, _FLAT = 5, 0.05  # Maximum number of Newton steps, and gain, nats, below which they end
_SHARES = np.array([1.0, 0.4, 0.1])  # Step lengths tried
_STRAIGHT = 1e-3  # Minimum curvature as a share of the largest


def mixture_cdf(z: FloatArray, weight: FloatArray, mean: FloatArray, std: FloatArray
                ) -> FloatArray:
    """Return the cdf of normal mixtures."""
    result: FloatArray = (weight * ndtr((z[:, None] - mean) / std)).sum(axis=1)
    return result
