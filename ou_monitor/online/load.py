"""
The mean of the supply as throttle explains it: sag, its curvature, its lag.

Generalised least squares from the lag sums alone: with the inverse
autocovariances of the noise (model/quasi_fit.py) every product x' K^-1 z is a
weighted sum of the sums over lags, so no sample is read again.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from ou_monitor.online.lagsums import Sums
from ou_monitor.records import FloatArray

# Directions of the load that vary less than this share of the largest are
# left out: the window does not show them.
_UNSEEN = 1e-5
# A load variable of less variance than this (full scale squared) is constant.
_STILL = 1e-12
# Steps of the differences that give the gradient of a log-determinant.
_STEP = 1e-3


@dataclass(frozen=True)
class Regression:
    """
    The mean, fitted at one choice of noise.

    Attributes
    ----------
    b : ndarray, shape (r,)
        Coefficients of the regressors, V.
    inverse : ndarray, shape (r, r)
        Their covariance per unit innovation variance, times n.
    tilt : tuple of float
        Gradient of half the log-determinant of their information in ln a and
        theta (see `quasi_fit.objective`).

    """

    b: FloatArray
    inverse: FloatArray
    tilt: tuple[float, float]


class Moments:
    """
    Sample autocovariances of the voltage and of what may explain its mean.

    Parameters
    ----------
    sums : Sums
        Of the window; lags without pairs count as uncorrelated.
    trend : bool
        Whether time is a regressor.

    Attributes
    ----------
    n : int
        Samples.
    mean : ndarray, shape (c,)
        Means of voltage (less its reference), load, and time (0).
    basis : ndarray, shape (c - 1, r)
        Load and time coefficients of each of the r regressors, which are
        independent combinations of them; the last row is time.

    """

    def __init__(self, sums: Sums, trend: bool) -> None:
        n, c, lags = sums.n, sums.first.size, sums.pairs.size
        self.n = n
        mean = sums.first / n
        self.mean = np.append(mean, 0.0)
        pairs = np.maximum(sums.pairs, 1.0)
        # Lag 0, then lags 1..K; time, counted from the middle in windows, comes last.
        raw = np.empty((lags + 1, c + 1, c + 1))
        zero = sums.second / n - mean[:, None] * mean
        raw[0, :c, :c] = zero
        raw[1:, :c, :c] = zero - sums.spread / (2.0 * pairs)[:, None, None]
        with_time = (sums.place / n - 0.5 * (n - 1) * mean) / n
        k = np.arange(lags + 1.0) / n
        raw[:, :c, c] = with_time
        raw[1:, :c, c] -= sums.change * (k[1:] / (2.0 * pairs))[:, None]
        raw[:, c, :c] = raw[:, :c, c]
        raw[:, c, c] = (1.0 - 1.0 / (n * n)) / 12.0 - 0.5 * k * k
        self._raw = raw
        self.use_time(trend)

    def use_time(self, trend: bool) -> None:
        """Choose the regressors: the load, and time if wanted."""
        size = self.mean.size
        used = slice(1, size if trend else size - 1)
        found = independent(self._raw[0, used, used])
        self.basis = np.zeros((size - 1, found.shape[1]))
        self.basis[:found.shape[0]] = found
        turn = np.zeros((size, 1 + self.rank))
        turn[0, 0] = 1.0
        turn[1:, 1:] = self.basis
        self._at = turn.T @ self._raw @ turn
        self._flat = self._at.reshape(self._at.shape[0], -1)

    @property
    def rank(self) -> int:
        """Return the number of regressors."""
        return int(self.basis.shape[1])

    def residual(self, b: FloatArray) -> tuple[float, FloatArray]:
        """Return autocovariances, V^2, of the voltage less b times regressors: lag 0, 1..K."""
        w = np.concatenate(([1.0], -b))
        c = (self._at @ w) @ w
        return float(c[0]), c[1:]

    def regress(self, log_a: float, theta: float) -> Regression:
        """Fit the mean by generalised least squares with the noise of (ln a, theta)."""
        step = _STEP * (1.0 - theta)
        gram = (_weights(np.array([log_a, log_a - _STEP, log_a]),
                         np.array([theta, theta, theta - step]), self._at.shape[0])
                @ self._flat).reshape(3, *self._at.shape[1:])
        inner = gram[:, 1:, 1:]
        inverse = np.linalg.inv(inner[0])
        half = 0.5 * np.linalg.slogdet(inner)[1]
        return Regression(inverse @ gram[0, 1:, 0], inverse,
                          (float(half[0] - half[1]) / _STEP, float(half[0] - half[2]) / step))

    def trend_score(self, log_a: float, theta: float) -> float:
        """Return a trend beyond the load, over its standard error; theta as in `regress`."""
        weights = _weights(np.array([log_a]), np.array([theta]), self._raw.shape[0])
        gram = (weights @ self._raw.reshape(self._raw.shape[0], -1)).reshape(
            self._raw.shape[1:])
        load = independent(self._raw[0, 1:-1, 1:-1])
        turn = np.zeros((self.mean.size, 2 + load.shape[1]))
        turn[0, 0] = turn[-1, 1] = 1.0
        turn[1:-1, 2:] = load
        gram = turn.T @ gram @ turn
        inverse = np.linalg.inv(gram[1:, 1:])
        b = inverse @ gram[1:, 0]
        rest = float(gram[0, 0] - gram[0, 1:] @ b)
        spread = float(inverse[0, 0]) * max(rest, 0.0) / self.n
        return float(b[0]) / math.sqrt(spread) if spread > 0.0 else 0.0


def _weights(log_a: FloatArray, theta: FloatArray, count: int) -> FloatArray:
    """Return what each lag counts in x' K^-1 z, shape (points, count), lag 0 first."""
    phi = np.exp(-np.exp(log_a))
    weights = np.empty((theta.size, count))
    weights[:, 0] = 1.0 + phi * phi - 2.0 * phi * theta
    tail = 2.0 * (1.0 - phi * theta) * (theta - phi)
    weights[:, 1:] = tail[:, None] * theta[:, None] ** np.arange(count - 1)
    return weights / (1.0 - theta * theta)[:, None]


def independent(cov: FloatArray) -> FloatArray:
    """Return the independent, unit-variance combinations (columns) of variables that vary."""
    used = np.flatnonzero(cov.diagonal() > _STILL)
    if not used.size:
        return np.empty((cov.shape[0], 0))
    scale = np.sqrt(cov.diagonal()[used])
    values, vectors = np.linalg.eigh(cov[np.ix_(used, used)] / (scale[:, None] * scale))
    seen = values > _UNSEEN * values[-1]
    basis = np.zeros((cov.shape[0], int(seen.sum())))
    basis[used] = vectors[:, seen] / scale[:, None]
    return basis


def load_at(throttle: float) -> FloatArray:
    """Return the load variables of a throttle that has long been steady."""
    return np.array([throttle, throttle * throttle, throttle, throttle])


def slope_at(throttle: float, beta: FloatArray) -> float:
    """Return d(mean)/d(throttle), V per unit throttle, at a steady throttle."""
    return float(beta[0] + 2.0 * throttle * beta[1] + beta[2] + beta[3])
