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
from ou_monitor.online.estimator.lagsums import Sums
from ou_monitor.records import FloatArray
from scipy.linalg.lapack import dposv, dsyev

# Directions of the load that vary less than this share of the largest are
# left out: the window does not show them.
_UNSEEN = 1e-5
# A load variable of less variance than this (full scale squared) is constant.
_STILL = 1e-12
# Exponents of theta, as many as lags could be; parts of vectors.
_COUNT = np.arange(256.0)
_ONE, _NO_TIME = np.ones(1), np.zeros(1)
_IDENTITIES = [np.eye(size) for size in range(8)]


@dataclass(slots=True)
class Regression:
    """
    The mean, fitted at one choice of noise.

    Attributes
    ----------
    beta : ndarray, shape (c,)
        Coefficients of load and time, V per unit.
    cov : ndarray, shape (c, c)
        Their covariance per unit innovation variance, times n.
    tilt : tuple of float
        Gradient of half the log-determinant of their information in ln a and
        theta (see `quasi_fit.objective`).
    gram : ndarray, shape (c + 1, c + 1)
        Products x' K^-1 z over n of voltage, load and time.

    """

    beta: FloatArray
    cov: FloatArray
    tilt: tuple[float, float]
    gram: FloatArray


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
    basis : ndarray, shape (c, r)
        Load and time coefficients of each of the r regressors, which are
        independent combinations of them; the last row is time.

    """

    def __init__(self, sums: Sums, trend: bool) -> None:
        n, c, lags = sums.n, sums.first.size, sums.pairs.size
        self.n = n
        mean = sums.first / n
        self.mean = np.concatenate([mean, _NO_TIME])
        halves = 0.5 / np.maximum(sums.pairs, 1.0)
        # Lag 0, then lags 1..K; time, counted from the middle in windows, comes last.
        raw = np.empty((lags + 1, c + 1, c + 1))
        zero = sums.second / n
        zero -= mean[:, None] * mean
        raw[0, :c, :c] = zero
        np.multiply(sums.spread, -halves[:, None, None], out=raw[1:, :c, :c])
        raw[1:, :c, :c] += zero
        k = np.arange(lags + 1.0) / n
        raw[:, :c, c] = (sums.place - 0.5 * (n - 1) * sums.first) / n / n
        raw[1:, :c, c] -= sums.change * (k[1:] * halves)[:, None]
        raw[:, c, :c] = raw[:, :c, c]
        raw[:, c, c] = (1.0 - 1.0 / (n * n)) / 12.0 - 0.5 * k * k
        self._raw = raw
        self._flat = raw.reshape(lags + 1, -1)
        # Powers of theta, their derivatives, and lag 0 apart.
        self._powers = np.zeros((3, lags + 1))
        self._powers[0, 0] = 1.0
        load = independent(zero[1:, 1:])
        self._load = np.zeros((c, load.shape[1]))
        self._load[:-1] = load
        self.basis = independent(raw[0, 1:, 1:]) if trend else self._load

    @property
    def rank(self) -> int:
        """Return the number of regressors."""
        return int(self.basis.shape[1])

    def residual(self, beta: FloatArray) -> tuple[float, FloatArray]:
        """Return autocovariances, V^2, of the voltage less its mean: lag 0, lags 1..K."""
        w = np.concatenate([_ONE, -beta])
        c = (self._raw @ w) @ w
        return float(c[0]), c[1:]

    def regress(self, log_a: float, theta: float) -> Regression:
        """Fit the mean by generalised least squares with the noise of (ln a, theta)."""
        gram, by_log_a, by_theta = (self._weights(log_a, theta) @ self._flat).reshape(
            3, *self._raw.shape[1:])
        basis = self.basis
        inner = gram[1:, 1:]
        cov = basis @ _inverse(basis.T @ inner @ basis) @ basis.T
        # The gradient of half a log-determinant is half the trace of inverse times change.
        return Regression(cov @ gram[1:, 0], cov,
                          (0.5 * float(np.vdot(cov, by_log_a[1:, 1:])),
                           0.5 * float(np.vdot(cov, by_theta[1:, 1:]))), gram)

    def trend_score(self, mean: Regression) -> float:
        """Return a trend beyond the load, over its standard error, with the noise of `mean`."""
        gram = mean.gram
        cov = mean.cov
        if self.basis is not self._load:
            load = self._load
            cov = load @ _inverse(load.T @ gram[1:, 1:] @ load) @ load.T
        # What the load does not explain of the trend and of the voltage.
        x, y = gram[1:, -1], gram[1:, 0]
        explained = cov @ x
        xx = float(gram[-1, -1] - explained @ x)
        xy = float(gram[-1, 0] - explained @ y)
        yy = float(gram[0, 0] - y @ cov @ y)
        if not xx > 0.0:
            return 0.0
        spread = max(yy - xy * xy / xx, 0.0) * xx / self.n
        return xy / math.sqrt(spread) if spread > 0.0 else 0.0

    def _weights(self, log_a: float, theta: float) -> FloatArray:
        """Return what each lag counts in x' K^-1 z, and the derivatives by ln a and theta."""
        phi = math.exp(-math.exp(log_a))
        by = -math.exp(log_a) * phi
        one, cross, apart = 1.0 - theta * theta, 1.0 - phi * theta, theta - phi
        lead, tail = 1.0 + phi * phi - 2.0 * phi * theta, 2.0 * cross * apart
        more = 2.0 * theta / one
        powers = self._powers
        k = _COUNT[:powers.shape[1] - 1]
        powers[1, 1:] = theta ** k
        np.multiply(k[1:], powers[1, 1:-1], out=powers[2, 2:])
        turn = np.array([
            [lead, tail, 0.0],
            [-2.0 * by * apart, -2.0 * by * (theta * apart + cross), 0.0],
            [more * lead - 2.0 * phi, more * tail + 2.0 * (cross - phi * apart), tail]])
        turn /= one
        weights: FloatArray = turn @ powers
        return weights


def _inverse(inner: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric matrix; LAPACK's own call, as these are small."""
    if not inner.size:
        return inner
    _, inverse, bad = dposv(inner, _IDENTITIES[len(inner)])
    # Sums over few pairs need not be positive.
    return np.asarray(np.linalg.inv(inner) if bad else inverse, dtype=np.float64)


def independent(cov: FloatArray) -> FloatArray:
    """Return the independent, unit-variance combinations (columns) of variables that vary."""
    variances = cov.diagonal()
    varies = variances > _STILL
    if not varies.all():
        used = varies.nonzero()[0]
        basis = np.zeros((cov.shape[0], used.size))
        if used.size:
            own = independent(cov[used[:, None], used])
            basis = basis[:, :own.shape[1]]
            basis[used] = own
        return basis
    if not variances.size:
        return np.empty((0, 0))
    scale = np.sqrt(variances)
    values, vectors, _ = dsyev(cov / (scale[:, None] * scale))
    found: FloatArray = vectors[:, values > _UNSEEN * values[-1]] / scale[:, None]
    return found


def load_at(throttle: float) -> FloatArray:
    """Return the load variables of a throttle that has long been steady."""
    return np.array([throttle, throttle * throttle, throttle, throttle])


def slope_at(throttle: float, beta: FloatArray) -> float:
    """Return d(mean)/d(throttle), V per unit throttle, at a steady throttle."""
    return float(beta[0] + 2.0 * throttle * beta[1] + beta[2] + beta[3])
