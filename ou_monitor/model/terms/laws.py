"""What the laws of innovations share: climbing, normal scores, mixtures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math

import numpy as np
from ou_monitor.records import FloatArray
from scipy.optimize import minimize
from scipy.special import ndtr, ndtri

LOG_2PI = math.log(2.0 * math.pi)
# Probabilities nearer to 0 and 1 than this are cut: scores of 8 and more are one thing.
_EDGE = 1e-15


def normal_scores(cdf: FloatArray) -> FloatArray:
    """Return the normal scores of probabilities."""
    scores: FloatArray = ndtri(np.clip(cdf, _EDGE, 1.0 - 1e-16))
    return scores


def log_normal(z: FloatArray, mean: FloatArray | float = 0.0, var: FloatArray | float = 1.0
               ) -> FloatArray:
    """Return log densities of the normal law."""
    result: FloatArray = -0.5 * (LOG_2PI + np.log(var) + (z - mean) ** 2 / var)
    return result


def climb(value: Callable[[FloatArray], float], start: Sequence[float] | FloatArray,
          size: float = 0.4, most: int = 200) -> tuple[FloatArray, float]:
    """Maximise a function of a few parameters (Nelder & Mead)."""
    x0 = np.asarray(start, dtype=np.float64)
    simplex = np.vstack([x0, x0 + size * np.eye(x0.size)])
    found = minimize(lambda x: -value(x), x0, method='Nelder-Mead',
                     options={'initial_simplex': simplex, 'maxfev': most, 'xatol': 1e-3,
                              'fatol': 1e-2})
    return found.x, -float(found.fun)


def curvature_se(value: Callable[[FloatArray], float], at: FloatArray, step: float = 0.05
                 ) -> FloatArray:
    """Return standard errors from the curvature of a log-likelihood along each axis."""
    top = value(at)
    errors = np.full(at.size, math.nan)
    for k in range(at.size):
        move = np.zeros(at.size)
        move[k] = step
        bend = (value(at + move) - 2.0 * top + value(at - move)) / step**2
        if bend < 0.0:
            errors[k] = 1.0 / math.sqrt(-bend)
    return errors


def mixture_cdf(z: FloatArray, weight: FloatArray, mean: FloatArray, std: FloatArray
                ) -> FloatArray:
    """Return the cdf of normal mixtures."""
    result: FloatArray = (weight * ndtr((z[:, None] - mean) / std)).sum(axis=1)
    return result
