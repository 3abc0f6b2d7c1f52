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


@dataclass(frozen=True)
class Moments:
    """
    Sample autocovariances of the voltage and of what may explain its mean.

    The regressors are independent combinations of the load and, if wanted,
    time; `basis` leads back.

    Attributes
    ----------
    n : int
        Samples.
    mean : ndarray, shape (c,)
        Means of voltage (less its reference), load, and time.
    at_zero : ndarray, shape (1 + r, 1 + r)
        Covariance at lag 0 of voltage and regressors.
    at_lag : ndarray, shape (K, 1 + r, 1 + r)
        Covariance at lags 1..K, symmetrised.
    basis : ndarray, shape (c - 1, r)
        Load (and time) coefficients of each regressor.

    """

    n: int
    mean: FloatArray
    at_zero: FloatArray
    at_lag: FloatArray
    basis: FloatArray

    @property
    def rank(self) -> int:
        """Return the number of regressors."""
        return int(self.basis.shape[1])

    @staticmethod
    def of(sums: Sums, trend: bool) -> Moments:
        """Return the moments of a window; lags without pairs count as uncorrelated."""
        n, c = sums.n, sums.first.size
        mean = sums.first / n
        zero = sums.second / n - mean[:, None] * mean
        pairs = np.maximum(sums.pairs, 1.0)
        lag = zero - sums.spread / (2.0 * pairs)[:, None, None]
        if trend:
            mean, zero, lag = _with_time(sums, mean, zero, lag)
            c += 1
        basis = _independent(zero[1:, 1:])
        turn = np.zeros((c, 1 + basis.shape[1]))
        turn[0, 0] = 1.0
        turn[1:, 1:] = basis
        return Moments(n, mean, turn.T @ zero @ turn, turn.T @ lag @ turn, basis)

    def residual(self, b: FloatArray) -> tuple[float, FloatArray]:
        """Return autocovariances, V^2, of the voltage less b times regressors: lag 0, 1..K."""
        w = np.concatenate(([1.0], -b))
        return float(w @ self.at_zero @ w), (self.at_lag @ w) @ w

    def information(self, log_a: float, theta: float) -> FloatArray:
        """Return x' K^-1 z over all columns, per sample, for unit innovation variance."""
        phi = math.exp(-math.exp(log_a))
        lead = 1.0 + phi * phi - 2.0 * phi * theta
        tail = (1.0 - phi * theta) * (theta - phi)
        powers = theta ** np.arange(self.at_lag.shape[0])
        lagged = (powers @ self.at_lag.reshape(powers.size, -1)).reshape(self.at_zero.shape)
        return (lead * self.at_zero + 2.0 * tail * lagged) / (1.0 - theta * theta)

    def regress(self, log_a: float, theta: float) -> tuple[FloatArray, FloatArray]:
        """Return coefficients and covariance per unit innovation variance over n."""
        gram = self.information(log_a, theta)
        inverse = np.linalg.inv(gram[1:, 1:])
        return inverse @ gram[1:, 0], inverse

    def tilt(self, log_a: float, theta: float) -> tuple[float, float]:
        """Return the gradient of half the log-determinant of the regressors' information."""
        step_a, step_t = 1e-3, 1e-3 * (1.0 - theta)

        def half_log_det(x: float, y: float) -> float:
            return 0.5 * float(np.linalg.slogdet(self.information(x, y)[1:, 1:])[1])

        here = half_log_det(log_a, theta)
        return ((half_log_det(log_a - step_a, theta) - here) / -step_a,
                (half_log_det(log_a, theta - step_t) - here) / -step_t)


def _independent(cov: FloatArray) -> FloatArray:
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


def _with_time(sums: Sums, mean: FloatArray, zero: FloatArray, lag: FloatArray
               ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Join time, counted from the middle in windows, as the last variable."""
    n, c, lags = sums.n, mean.size, sums.pairs.size
    wide = np.zeros((c + 1, c + 1))
    wide[:c, :c] = zero
    wide[:c, c] = wide[c, :c] = (sums.place / n - 0.5 * (n - 1) * mean) / n
    wide[c, c] = (1.0 - 1.0 / (n * n)) / 12.0
    k = np.arange(1.0, lags + 1.0) / n
    wide_lag = np.empty((lags, c + 1, c + 1))
    wide_lag[:, :c, :c] = lag
    cross = sums.change * (k / (2.0 * np.maximum(sums.pairs, 1.0)))[:, None]
    wide_lag[:, :c, c] = wide_lag[:, c, :c] = wide[:c, c] - cross
    wide_lag[:, c, c] = wide[c, c] - 0.5 * k * k
    return np.concatenate([mean, [0.0]]), wide, wide_lag


def load_at(throttle: float) -> FloatArray:
    """Return the load variables of a throttle that has long been steady."""
    return np.array([throttle, throttle * throttle, throttle, throttle])


def slope_at(throttle: float, beta: FloatArray) -> float:
    """Return d(mean)/d(throttle), V per unit throttle, at a steady throttle."""
    return float(beta[0] + 2.0 * throttle * beta[1] + beta[2] + beta[3])
