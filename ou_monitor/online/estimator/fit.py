"""
From the sums of a window to OU parameters.

Restricted quasi-likelihood (model/arma.py) of the ARMA(1,1) that samples or block
means of an OU in white noise are.  While throttle moves, or when the voltage
drifts, the mean is regressed along with it: sag, its curvature, its lag.
Generalised least squares from the lag sums alone: with the inverse
autocovariances of the noise every product x' K^-1 z is a weighted sum of the
sums over lags, so no sample is read again.
"""

from __future__ import annotations

from dataclasses import dataclass
import enum
import math

import numpy as np
from ou_monitor.model import arma
from ou_monitor.online.estimator.window import Sums
from ou_monitor.records import FloatArray

# Directions of the load that vary less than this share of the largest are
# left out: the window does not show them.
_UNSEEN = 1e-5
# A load variable of less variance than this (full scale squared) is constant.
_STILL = 1e-12
# Exponents of theta, as many as lags could be; parts of vectors.
_COUNT = np.arange(256.0)
_ONE, _NO_TIME = np.ones(1), np.zeros(1)


@dataclass(slots=True)
class Regression:
    """The mean, fitted at one choice of noise."""

    beta: FloatArray  # Coefficients of load and time, V per unit; shape (c,)
    cov: FloatArray  # Their covariance per unit innovation variance, times n; shape (c, c)
    # Gradient of half the log-determinant of their information in ln a and theta (see
    # `arma.objective`).
    tilt: tuple[float, float]
    gram: FloatArray  # Products x' K^-1 z over n of voltage, load and time; shape (c + 1, c + 1)


class Moments:
    """
    Sample autocovariances of the voltage and of what may explain its mean.

    Lags without pairs count as uncorrelated.  `mean`, shape (c,): of voltage (less its reference),
    load, and time (0); `basis`, shape (c, r): coefficients of load and, last, time in each of r
    independent regressors.
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
        cov = basis @ np.linalg.inv(basis.T @ inner @ basis) @ basis.T
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
            cov = load @ np.linalg.inv(load.T @ gram[1:, 1:] @ load) @ load.T
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
    values, vectors = np.linalg.eigh(cov / (scale[:, None] * scale))
    found: FloatArray = vectors[:, values > _UNSEEN * values[-1]] / scale[:, None]
    return found


# A trend is taken into the model from this many standard errors on: by chance
# once in 16 000 long windows.
TREND_SCORE = 4.0
# A few relaxations look like a trend more often: the score asked for grows by
# 1 + 6/x, x = alpha T.  That leaves 1 % of windows of 4 to 13 relaxations, and
# 5 % of random walks, in which 16 relaxations about a trend are seen; with twice
# as much a drift of 8 standard deviations over 25 relaxations would be missed
# in every fifth window rather than in every twelfth.
_FEW = 6.0
# From this score on a trend is looked into (by chance once in 22 windows).
SUSPECT = 2.0


@dataclass(slots=True)
class WindowFit:
    """What the sums of a window say."""

    # alpha times the step, and the moving-average coefficient.
    a: float
    theta: float
    scale: float  # sigma^2 times the step, V^2
    noise_share: float  # Noise variance of one sample in units of `scale`
    noise_score: float  # Distance of theta from "no noise" in standard errors
    log_var: tuple[float, float, float]  # Variances of ln(alpha), ln(sigma), ln(Var_inf)
    level: FloatArray  # Means of voltage (less its reference) and load variables; shape (c,)
    # Coefficients of the load, V per unit, and of time (0 without `trend`); shape (c,).
    beta: FloatArray
    beta_cov: FloatArray  # Their covariance, V^2
    trend: bool  # Whether a trend was needed
    trend_score: float  # Trend over its standard error
    # Whether neighbouring samples are correlated at all; if not, a to log_var are NaN.
    correlated: bool
    variance: float  # Variance about the mean, V^2


def fit_window(sums: Sums, m: int, start: tuple[float, float] | None = None) -> WindowFit:
    """Fit the OU, the noise and the mean."""
    if sums.first.size > 1:
        fit = _fit_moving(sums, m, start, trend=False)
    else:
        fit = _fit_still(sums, m, start)
    if fit.correlated and (abs(fit.trend_score) > SUSPECT
                           or fit.a * sums.n < arma.DOUBTFUL):
        # To a rail without restoring force any drift is chance: so the drift is
        # judged by the fit that knows it.
        drifting = _fit_moving(sums, m, None, trend=True)
        if drifting.correlated and abs(drifting.trend_score) > TREND_SCORE * (
                1.0 + _FEW / (drifting.a * sums.n)):
            return drifting
    return fit


def _fit_still(sums: Sums, m: int, start: tuple[float, float] | None) -> WindowFit:
    """Fit a window whose mean is a constant."""
    log_a, theta = start or (math.nan, math.nan)
    end = arma.fit_sums(sums.row.tolist(), sums.pairs.size, log_a, theta, m)
    level, c0 = np.array(end[:1]), end[1]
    if end[2] != end[2]:
        return _uncorrelated(level, _EMPTY, False, c0)
    return WindowFit(end[2], end[3], end[5], end[6], end[7], (end[8], end[9], end[10]), level,
                     _EMPTY, _NO_COV, False, end[11], _found(end[2:]), c0)


_EMPTY = np.empty(0)
_NO_COV = np.empty((0, 0))


def _correlated(c0: float, c: FloatArray, n: int) -> bool:
    return c0 > 0.0 and float(c[0]) > arma.CORRELATED * c0 / math.sqrt(n)


def _found(end: tuple[float, ...]) -> bool:
    """Whether a relaxation was found: within reach of the rate, and of positive variance."""
    return end[0] < arma.FASTEST and end[3] > 0.0


def _uncorrelated(level: FloatArray, beta: FloatArray, trend: bool, c0: float) -> WindowFit:
    nan = math.nan
    return WindowFit(nan, nan, nan, nan, nan, (nan, nan, nan), level, beta,
                     np.full((beta.size, beta.size), nan), trend, nan, False, c0)


def _fit_moving(sums: Sums, m: int, start: tuple[float, float] | None, trend: bool
                ) -> WindowFit:
    """Fit noise and mean in turn; the mean hardly moves, so two rounds are usual."""
    moments = Moments(sums, trend)
    at = start
    # Without a start: ordinary least squares, as the fastest OU is as good as white.
    mean = moments.regress(*(at or (arma.HIGH, 0.0)))
    on_bound = False
    for _ in range(8):
        c0, c = moments.residual(mean.beta)
        if not _correlated(c0, c, sums.n):
            return _uncorrelated(moments.mean, mean.beta, trend, c0)
        log_a, theta = at or arma.guess(c0, c.tolist())
        tilt = mean.tilt if at else (0.0, 0.0)
        before = log_a, theta
        log_a, theta, on_bound = arma.search(
            c0, c.tolist(), sums.n - 1.0 - moments.rank, log_a, theta, m, *tilt)
        settled = at is not None and max(
            abs(log_a - before[0]), abs(theta - before[1])) < arma.STEADY
        at = log_a, theta
        mean = moments.regress(log_a, theta)
        if settled:
            break
    c0, c = moments.residual(mean.beta)
    end = arma.finish(c0, c.tolist(), sums.n, sums.n - 1.0 - moments.rank, log_a, theta, on_bound,
                      m)
    return WindowFit(end[0], end[1], end[3], end[4], end[5], (end[6], end[7], end[8]),
                     moments.mean, mean.beta, mean.cov * (end[2] / sums.n), trend,
                     moments.trend_score(mean), _found(end), c0)


class Outcome(enum.Enum):
    """How a fit ended."""

    FOUND = 'alpha found'
    UNCORRELATED = 'neighbouring samples are uncorrelated'
    UNBOUND = 'no restoring force visible'


@dataclass(slots=True)
class Fitted:
    """Parameters before correction for the length of the window."""

    outcome: Outcome  # How it ended; other than FOUND the numbers may be NaN
    # 1/s and V/sqrt(s), as maximised.
    alpha: float
    sigma: float
    noise_var: float  # Variance of the white noise of one raw sample, V^2
    noise_score: float  # How many standard errors the noise is from none
    log_var: tuple[float, float, float]  # Variances of ln(alpha), ln(sigma), ln(Var_inf)
    variance: float  # Variance about the mean, V^2
    level: FloatArray  # Means of voltage and load variables; shape (c,)
    # Load coefficients, V per unit, and covariance, V^2.
    beta: FloatArray
    beta_cov: FloatArray
    trend: bool  # Whether the mean drifts
    n: int  # Samples, or block means, fitted
    alpha_step: float  # alpha times the step between them


def from_window(fit: WindowFit, step: float, m: int, n: int, reference: float) -> Fitted:
    """Return a window's fit in physical units (step in s, reference in V)."""
    level = fit.level.copy()
    level[0] += reference
    if not fit.correlated:
        return Fitted(Outcome.UNCORRELATED, math.nan, math.nan, fit.variance * m, math.nan,
                      (math.nan,) * 3, fit.variance, level, fit.beta, fit.beta_cov, fit.trend, n,
                      math.nan)
    return Fitted(
        Outcome.FOUND, fit.a / step, math.sqrt(fit.scale / step),
        fit.noise_share * fit.scale * m, fit.noise_score, fit.log_var, fit.variance, level,
        fit.beta, fit.beta_cov, fit.trend, n, fit.a)
