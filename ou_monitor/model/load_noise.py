"""
White noise of a supply whose intensity follows throttle and its changes.

ln variance = b0 + b1 ripple(u) + b2 sqrt(|du|), with du the change of throttle in 20 ms, or from
the sample before where that is older.  Beyond the throttles and changes of the fit it stays at
their edge.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model.load import ripple
from ou_monitor.records import FloatArray
from scipy.optimize import minimize
from scipy.signal import lfilter

# Centre and deviation of b1 and b2 before any data: what recordings usually show.
USUAL = ((2.0, 2.0), (4.0, 3.0))
# Shares of the samples at each end of throttle, and at the top of its changes, that the law does
# not go beyond.
_EDGE, _TOP = 0.01, 0.001
# Errors are drawn from those whose intensity is alike: this share of all to either side, and at
# least so many.  And how far ln variance is drawn from its estimate.
_ALIKE, _FEWEST, _FARTHEST = 0.02, 50, 1.0
# Scores count up to this in the correlation of neighbours; it counts from so many standard errors.
_CLIP, _CLEAR = 3.0, 3.0
# Time within which a change of throttle counts, s: what the filter onboard takes as one step; and
# a hair, for the rounding of stamps.
_SPAN, _HAIR = 0.02, 1e-6


def changes(t: FloatArray, throttle: FloatArray) -> FloatArray:
    """Return how much throttle changed within `_SPAN` before each stamp, s; 0 at the first."""
    then = np.searchsorted(t, t - _SPAN + _HAIR, side='right') - 1
    before = np.minimum(np.maximum(then, 0), np.maximum(np.arange(t.size) - 1, 0))
    return np.asarray(np.abs(throttle - throttle[before]), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class NoiseLaw:
    """
    White noise that follows throttle.

    Attributes
    ----------
    b : ndarray, shape (3,)
        Coefficients of ln variance, V^2.
    covariance : ndarray, shape (3, 3)
        Their covariance.
    limits : tuple of float
        Least and most throttle, and most change of it, in the fit.
    intensities : ndarray, shape (n,)
        ln variance at the samples of the fit, rising.
    errors : ndarray, shape (n,)
        Errors there, V, less what is not the noise's: the shape of the law, tails included.
    memory : float
        Correlation of neighbouring samples, as of a filter before the ADC.

    """

    b: FloatArray
    covariance: FloatArray
    limits: tuple[float, float, float]
    intensities: FloatArray
    errors: FloatArray
    memory: float = 0.0

    def features(self, t: FloatArray, throttle: FloatArray) -> FloatArray:
        """Return what the coefficients multiply, shape (n, 3)."""
        return _features(throttle, changes(t, throttle), self.limits)

    def draw(self, t: FloatArray, throttle: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return noise, V, of samples with that throttle; the coefficients' errors are drawn."""
        features = self.features(t, throttle)
        wanted = features @ self.b
        # Any of those that are as intense, and its neighbours: as many at the ends as between.
        first = np.searchsorted(self.intensities, wanted, side='left')
        last = np.searchsorted(self.intensities, wanted, side='right')
        at = first + (rng.random(wanted.size) * (last - first)).astype(np.int64)
        most = self.errors.size - 1
        reach = min(max(_FEWEST, int(_ALIKE * self.errors.size)), most // 2)
        near = np.clip(at, reach, most - reach) + rng.integers(-reach, reach + 1, at.size)
        off = features @ rng.multivariate_normal(np.zeros(3), self.covariance)
        # As they were, not scaled: an outlier in a calm does not become a larger one in a storm.
        fresh = self.errors[near] * np.exp(0.5 * np.clip(off, -_FARTHEST, _FARTHEST))
        if self.memory == 0.0:
            return np.asarray(fresh)
        fresh[1:] *= math.sqrt(1.0 - self.memory ** 2)
        return np.asarray(lfilter([1.0], [1.0, -self.memory], fresh), dtype=np.float64)


def _features(u: FloatArray, du: FloatArray, limits: tuple[float, float, float]) -> FloatArray:
    low, high, most = limits
    inside = np.clip(u, low, high)
    return np.stack([np.ones(u.size), ripple(inside), np.sqrt(np.minimum(du, most))], axis=1)


def fit_noise_law(t: FloatArray, errors: FloatArray, throttle: FloatArray,
                  other: float) -> NoiseLaw:
    """
    Fit the law to errors of a prediction, V.

    Normal quasi-likelihood, so that the second moments are met whatever the tails; other is the
    variance, V^2, that the errors have beside the noise, as of a state or of rounding.
    """
    moved = changes(t, throttle)
    limits = (float(np.quantile(throttle, _EDGE)), float(np.quantile(throttle, 1.0 - _EDGE)),
              float(np.quantile(moved, 1.0 - _TOP)))
    features = _features(throttle, moved, limits)
    square = errors * errors
    total = float(square.mean())
    centre, deviation = np.array(USUAL).T

    def cost(b: FloatArray) -> tuple[float, FloatArray]:
        own = np.exp(np.clip(features @ b, -200.0, 200.0))
        whole = own + other
        away = (b[1:] - centre) / deviation
        slope = 0.5 * features.T @ (own * (1.0 / whole - square / whole ** 2))
        slope[1:] += away / deviation
        return (0.5 * float(np.sum(np.log(whole) + square / whole)) + 0.5 * float(away @ away),
                slope)

    # A floor, so that noise below the rounding does not run away to nothing.
    least = math.log(1e-6 * total)
    start = np.array([max(math.log(max(total - other, 0.1 * total)), least + 1.0), 0.0, 0.0])
    found = minimize(cost, start, jac=True, method='L-BFGS-B',
                     bounds=[(least, None), (None, None), (None, None)])
    own = np.exp(features @ found.x)
    share = own / (own + other)
    # Fisher information of ln variance: half a square of the share that is the noise's own.
    information = 0.5 * (features * (share ** 2)[:, None]).T @ features
    # A factor of e where there is none, as of noise far below the rounding.
    information += np.diag([1.0, *(deviation ** -2)])
    order = np.argsort(own, kind='stable')
    scores = np.clip(errors / np.sqrt(own + other), -_CLIP, _CLIP)
    memory = float(scores[1:] @ scores[:-1]) / float(scores @ scores)
    if abs(memory) < _CLEAR / math.sqrt(scores.size):
        memory = 0.0
    return NoiseLaw(np.asarray(found.x), np.linalg.inv(information), limits,
                    np.log(own[order]), (errors * np.sqrt(share))[order], memory)
