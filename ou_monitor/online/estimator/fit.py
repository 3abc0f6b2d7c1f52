"""
From the sums of a window to OU parameters.

Samples, or block means, of an OU in white noise are an ARMA(1,1), which is fitted by restricted
quasi-likelihood (model/arma.py). While throttle moves, or when the voltage drifts, sag, its
curvature and its lag are regressed out of the mean. Generalised least squares needs the lag sums
only: with the inverse autocovariances of the noise every product x' K^-1 z is a weighted sum of
the sums over lags, so no sample is read again.

Windows whose stamps are not evenly spaced: the exact Gaussian likelihood.  It costs more than the
sums over lags and serves only irregular sources and windows with many holes.  The inverse
covariance Q of a sampled OU is tridiagonal, so the likelihood costs O(n): K = Q^-1 + nu I with A =
I + nu Q tridiagonal, K^-1 = Q A^-1 and log|K| = log|A| - log|Q|. It is the likelihood of the
Kalman filter, restricted to the contrasts of the regressors (REML: Harville, J. Am. Stat. Assoc.
72 (1977) 320).  Its gradient needs no more than the elimination and the three diagonals of A^-1,
so a search that starts from the fit of evenly spaced samples takes a handful of evaluations. It
avoids SciPy, which would cost the nodes 45 MB.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import enum
import math

import numpy as np
from ou_monitor.model import arma
from ou_monitor.online.estimator.window import (
    FACTOR, FAST, FEWEST, LAGS, LOST, SLOW, Sums, T, U, Y)
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
class MeanFit:
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

    def regress(self, log_a: float, theta: float) -> MeanFit:
        """Fit the mean by generalised least squares with the noise of (ln a, theta)."""
        gram, by_log_a, by_theta = (self._weights(log_a, theta) @ self._flat).reshape(
            3, *self._raw.shape[1:])
        basis = self.basis
        inner = gram[1:, 1:]
        cov = basis @ np.linalg.inv(basis.T @ inner @ basis) @ basis.T
        # The gradient of half a log-determinant is half the trace of inverse times change.
        return MeanFit(cov @ gram[1:, 0], cov,
                       (0.5 * float(np.vdot(cov, by_log_a[1:, 1:])),
                        0.5 * float(np.vdot(cov, by_theta[1:, 1:]))), gram)

    def trend_score(self, mean: MeanFit) -> float:
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
# A few relaxations look like a trend more often, so the score asked for grows by 1 + 6/x, x =
# alpha T. A false trend then remains in 1 % of windows of 4 to 13 relaxations, and in 5 % of
# random walks (16 apparent relaxations). A drift of 8 standard deviations over 25 relaxations is
# missed in one window of 12; twice the constant would miss it in one of 5.
_FEW = 6.0
# From this score on a trend is looked into (by chance once in 22 windows).
SUSPECT = 2.0


@dataclass(slots=True)
class WindowFit:
    """Fit of the sums of a window."""

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
        # Without restoring force any drift may be chance, so the fit that includes the drift
        # decides.
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


class FitEnd(enum.Enum):
    """How a fit ended."""

    FOUND = 'alpha found'
    UNCORRELATED = 'neighbouring samples are uncorrelated'
    UNBOUND = 'no restoring force visible'


@dataclass(slots=True)
class Fitted:
    """Parameters before correction for the length of the window."""

    outcome: FitEnd  # How it ended; other than FOUND the numbers may be NaN
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
        return Fitted(FitEnd.UNCORRELATED, math.nan, math.nan, fit.variance * m, math.nan,
                      (math.nan,) * 3, fit.variance, level, fit.beta, fit.beta_cov, fit.trend, n,
                      math.nan)
    return Fitted(
        FitEnd.FOUND, fit.a / step, math.sqrt(fit.scale / step),
        fit.noise_share * fit.scale * m, fit.noise_score, fit.log_var, fit.variance, level,
        fit.beta, fit.beta_cov, fit.trend, n, fit.a)


# Relaxations between two samples beyond which they are independent: exp(2 * 300) is a double.
_FAR = 300.0
# Unknowns of a tridiagonal system that are eliminated at once: fewer steps of NumPy calls.
_DENSE = 24
# A step that gains less than this, nats, is not taken: the optimum is then within a hundredth of
# a standard error.
_SETTLED = 1e-5
# Evaluations that a fit may take after the first; 4 to 8 are usual, more where nothing tells
# alpha from noise.
_MOST_POINTS = 24
# Step of the finite differences of slopes, in ln a and z: for unit curvature the error is 1e-4,
# the rounding 1e-7.
_STEP = 1e-4
# Lower limit of the curvature of a direction, nats; longest step.
_FLAT, _LONGEST = 1e-3, 1.5
# Share of noise up to which the search is linear in it; noise of more than ten thousand times the
# diffusion of one step hides any OU.
_SMALL = 0.05
_LOUDEST = math.log1p(1e4 / _SMALL)


@dataclass(frozen=True, slots=True)
class _Point:
    """The likelihood at one choice of ln a and z, see `Likelihood.at`."""

    # Minus the restricted log-likelihood, nats, and its slopes by the two.
    value: float
    slopes: FloatArray
    # Scale sigma^2, V^2/s; coefficients, V per unit of each regressor, and their covariance, V^2.
    scale: float
    beta: FloatArray
    cov: FloatArray
    # Products x' K^-1 z of all columns at scale 1: regressors, then the voltage.
    gram: FloatArray


class Likelihood:
    """Restricted likelihood of one data set, profiled over scale and mean (t in s, y in V)."""

    def __init__(self, t: FloatArray, y: FloatArray, regressors: FloatArray) -> None:
        self.steps = np.diff(t)
        self.n = t.size
        self.step = float(t[-1] - t[0]) / (self.n - 1)
        self.shift = float(y.mean())
        self._table = np.concatenate([regressors.T, [y - self.shift]])
        # Slowest rate worth a name: one relaxation in ten windows; fastest: the correlation of
        # neighbours is below 1e-4.
        self.low, self.high = math.log(0.1 / (self.n - 1)), arma.HIGH

    def at(self, log_a: float, z: float, used: int) -> _Point:
        """
        Return the likelihood with the first `used` regressors.

        a is alpha times the mean step; z, 0 or more, is `noise_scale` of the white noise.
        """
        a, share = math.exp(log_a), _SMALL * math.expm1(z)
        # Q over 2 alpha: its diagonal and the one beside it.
        x = np.minimum(a / self.step * self.steps, _FAR)
        h = 1.0 / np.expm1(2.0 * x)
        off = -np.sqrt(h * (1.0 + h))
        diag = np.ones(self.n)
        diag[1:] += h
        diag[:-1] += h
        double = 2.0 * a / self.step
        nu = 2.0 * a * share
        log_det, w, inner, beside = solve_tridiagonal(1.0 + nu * diag, nu * off, self._table)
        log_det -= self.n * math.log(double) + float(np.log1p(h).sum())
        q = diag * w
        q[:, 1:] += off * w[:, :-1]
        q[:, :-1] += off * w[:, 1:]
        gram = double * (self._table @ q.T)
        # The same by ln alpha at constant noise, and by the noise: of the products and of log|K|.
        d_h = -2.0 * x * off * off
        d_diag = diag.copy()
        d_diag[1:] += d_h
        d_diag[:-1] += d_h
        d_off = off * (1.0 - x * (1.0 + 2.0 * h))
        side = (w[:, :-1] * d_off) @ w[:, 1:].T
        slow = double * ((w * d_diag) @ w.T + side + side.T)
        white = -(double * double) * (q @ q.T)
        log_slow = nu * float(inner @ d_diag + 2.0 * (beside @ d_off)) - self.n - float(
            np.sum(d_h / (1.0 + h)))
        log_white = double * float(inner @ diag + 2.0 * (beside @ off))
        # Profiled over mean and scale.
        free = self.n - used
        own = gram[:used, :used]
        inverse = np.linalg.pinv(own, hermitian=True)
        beta = inverse @ gram[:used, -1]
        c = np.zeros(len(gram))
        c[:used], c[-1] = -beta, 1.0
        rest = max(float(c @ gram @ c), np.finfo(float).tiny)
        by_rate, by_noise = (0.5 * (
            free * float(c @ change @ c) / rest + log_change
            + float(np.vdot(inverse, change[:used, :used])))
            for change, log_change in ((slow, log_slow), (white, log_white)))
        value = 0.5 * (free * math.log(rest / free) + log_det + float(np.linalg.slogdet(own)[1])
                       + free * (1.0 + math.log(2.0 * math.pi)))
        slopes = np.array([by_rate, (_SMALL + share) * self.step * by_noise])
        return _Point(value, slopes, rest / free, beta, inverse * (rest / free), gram)

    def start(self, used: int) -> FloatArray:
        """Return ln a and z by the quasi-likelihood of the samples taken as even."""
        x, y = self._table[:used], self._table[-1]
        r, m = y - np.linalg.lstsq(x.T, y, rcond=None)[0] @ x, 1
        log_a, z = self.high, 0.0
        while True:
            c0, c = _variogram(r)
            if not c0 > 0.0:
                break
            log_a, theta, _ = arma.search(c0, c, r.size - used, *arma.guess(c0, c), m, 0.0, 0.0)
            a = math.exp(log_a)
            z = noise_scale(max(arma.noise_share(a, theta, m), 0.0) * m * m)
            log_a -= math.log(m)
            # Coarser where noise hides what the lags can hold, as in even windows.
            if theta ** LAGS <= LOST or r.size < FACTOR * FEWEST:
                break
            r = r[:r.size // FACTOR * FACTOR].reshape(-1, FACTOR).mean(axis=1)
            m *= FACTOR
        return np.clip([log_a, z], [self.low, 0.0], [self.high, _LOUDEST])


def noise_scale(share: float) -> float:
    """Return z of the white noise over sigma^2 times the mean step: linear, then logarithmic."""
    return math.log1p(share / _SMALL)


def _variogram(r: FloatArray) -> tuple[float, list[float]]:
    """Return the variance of residuals, and their autocovariances by the variogram, V^2."""
    c0, c = float(r @ r) / r.size, []
    for k in range(1, min(LAGS, r.size - 1) + 1):
        d = r[k:] - r[:-k]
        c.append(c0 - 0.5 * float(d @ d) / d.size)
    return c0, c


def solve_tridiagonal(diag: FloatArray, off: FloatArray, right: FloatArray
                      ) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """
    Solve a symmetric positive system for rows of right sides, shape (k, n).

    Cyclic reduction: every second unknown is eliminated, again and again.  Returns the
    log-determinant, the solutions, and of the inverse the diagonal and the one beside it.
    """
    halves, pivots = [], []
    while diag.size > _DENSE:
        # Each odd one has a neighbour before it and, but for the last of an even number, after it.
        pivot, before, after, w = diag[1::2], off[0::2], off[1::2], right[:, 1::2]
        m, k = pivot.size, after.size
        inverse = 1.0 / pivot
        back, ahead = before * inverse, after * inverse[:k]
        pivots.append(pivot)
        halves.append((inverse, back, ahead, w))
        diag, right = diag[0::2].copy(), right[:, 0::2].copy()
        diag[:m] -= back * before
        diag[1:k + 1] -= ahead * after
        right[:, :m] -= back * w
        right[:, 1:k + 1] -= ahead * w[:, :k]
        off = -back[:k] * after
    dense = np.diag(diag) + np.diag(off, 1) + np.diag(off, -1)
    log_det = float(np.linalg.slogdet(dense)[1]) + sum(float(np.log(p).sum()) for p in pivots)
    dense = np.linalg.inv(dense)
    x, own, beside = right @ dense, dense.diagonal(), dense.diagonal(1)
    for inverse, back, ahead, w in reversed(halves):
        m, k = inverse.size, ahead.size
        odd = inverse * w - back * x[:, :m]
        odd[:, :k] -= ahead * x[:, 1:k + 1]
        left, right_of = -back * own[:m], -ahead * own[1:k + 1] - back[:k] * beside[:k]
        left[:k] -= ahead * beside[:k]
        inner = inverse - back * left
        inner[:k] -= ahead * right_of
        x, own, beside = _woven(x, odd), _woven(own, inner), _woven(left, right_of)
    return log_det, x, own, beside


def _woven(even: FloatArray, odd: FloatArray) -> FloatArray:
    """Return an array whose last axis takes turns from two."""
    both = np.empty((*even.shape[:-1], even.shape[-1] + odd.shape[-1]))
    both[..., 0::2], both[..., 1::2] = even, odd
    return both


@dataclass(frozen=True)
class ExactFit:
    """Result of `fit_exact`; no bias correction."""

    # Relaxation rate, 1/s; noise intensity, V/sqrt(s); variance of the white noise, V^2.
    alpha: float
    sigma: float
    noise_var: float
    # Coefficients of the regressors (V per unit of each) and covariance.
    beta: FloatArray
    beta_cov: FloatArray
    # Restricted log-likelihood at the maximum, nats.
    log_likelihood: float
    # -1, 0 or 1: alpha ran into the slow end of the search (no restoring force visible), settled
    # inside, or ran into the fast end (no correlation visible).
    edge: int
    # alpha times the mean step, and noise_var over sigma^2 times the mean step.
    a: float
    share: float
    # Products of all columns at the maximum, see `_Point`.
    gram: FloatArray
    # ln a and z at the maximum, and the curvature there, nats: where the next window begins.
    place: FloatArray
    curved: FloatArray | None


def fit_exact(likelihood: Likelihood, used: int, before: ExactFit | None = None) -> ExactFit:
    """
    Fit alpha, sigma, the white noise and the mean, of the first `used` regressors.

    before: the fit of a nearly identical window.
    """
    low, high = np.array([likelihood.low, 0.0]), np.array([likelihood.high, _LOUDEST])
    place, at, curved = _least(
        lambda p: likelihood.at(p.item(0), p.item(1), used),
        likelihood.start(used) if before is None else np.clip(before.place, low, high),
        None if before is None else before.curved, low, high)
    log_a, z = place.tolist()
    beta = at.beta.copy()
    beta[0] += likelihood.shift
    a, share = math.exp(log_a), _SMALL * math.expm1(z)
    # The likelihood is flat at the slow end: within 5 % of the end is at the end.
    edge = -1 if log_a < low[0] + 0.05 else 1 if a > arma.FASTEST else 0
    return ExactFit(a / likelihood.step, math.sqrt(at.scale),
                    share * at.scale * likelihood.step, beta, at.cov, -at.value, edge, a, share,
                    at.gram, place, curved)


def _least(f: Callable[[FloatArray], _Point], here: FloatArray, curved: FloatArray | None,
           low: FloatArray, high: FloatArray) -> tuple[FloatArray, _Point, FloatArray | None]:
    """
    Return where f is least within a box, its point, and the curvature.

    Newton's method: where the curvature is not given, and after a step that had to be shortened,
    it is by differences of the slopes, else by their change over the last step (BFGS).
    """
    at = f(here)
    left = _MOST_POINTS
    while left > 0:
        if curved is None:
            left -= 2
            curved = np.stack([(f(here + step).slopes - at.slopes) / _STEP
                               for step in _STEP * np.eye(2)])
            curved = 0.5 * (curved + curved.T)
        # At a bound beyond which f falls, only the other coordinate moves.
        free = ~(((here <= low) & (at.slopes > 0.0)) | ((here >= high) & (at.slopes < 0.0)))
        slopes = np.where(free, at.slopes, 0.0)
        values, vectors = np.linalg.eigh(np.where(np.outer(free, free), curved, np.eye(2)))
        step = -vectors @ ((slopes @ vectors) / np.maximum(np.abs(values), _FLAT))
        step *= min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-300))
        gain = -float(slopes @ step)
        if gain < 2.0 * _SETTLED:
            break
        whole = True
        while left > 0:
            left -= 1
            there = np.clip(here + step, low, high)
            new = f(there)
            if new.value <= at.value:
                break
            # To the minimum of the parabola through both values and the slope here.
            whole = False
            step *= min(max(0.5 * gain / (new.value - at.value + gain), 0.1), 0.5)
            gain = -float(slopes @ step)
        else:
            break
        moved, turned = there - here, new.slopes - at.slopes
        here, at = there, new
        along, pushed = float(moved @ turned), curved @ moved
        if whole and along > 0.0 and float(moved @ pushed) > 0.0:
            curved = curved + np.outer(turned, turned) / along - np.outer(
                pushed, pushed) / float(moved @ pushed)
        else:
            curved = None
    return here, at, curved


# Samples up to which the exact likelihood is used.
MOST = 4096
# Share of its variance that time must keep, given the load, to be separable from it.
_APART = 1e-5


def fit_irregular(columns: FloatArray, moves: bool, before: ExactFit | None = None
                  ) -> tuple[Fitted, ExactFit | None]:
    """
    Fit the OU, the noise and the mean at the stamps as they are.

    before: the second value returned for a nearly identical window.
    """
    t, y = columns[T] - columns[T, 0], columns[Y]
    load = np.empty((0, t.size))
    if moves:
        u, fast, slow = columns[[U, FAST, SLOW]]
        load = np.stack([u, u * u, fast, slow])
    level = load.mean(axis=1)
    centred = load - level[:, None]
    basis = independent(centred @ centred.T / t.size)
    known = basis.T @ centred
    time = t / t[-1] - 0.5
    # Time beside the load: what of it the load does not explain.
    within = known @ time / t.size
    time -= time.mean() + within @ known
    likelihood = Likelihood(t, y, np.column_stack([np.ones(t.size), known.T, time]))
    used = 1 + len(known)
    fit, trend = fit_exact(likelihood, used, before), False
    doubtful = fit.a * t.size < arma.DOUBTFUL
    # Where there may be another optimum the next search begins anew.
    again = None if doubtful or fit.edge else fit
    if float(time @ time) > _APART * t.size / 12.0 and (
            doubtful or abs(_score(fit.gram, used, t.size)) > SUSPECT):
        drifting = fit_exact(likelihood, used + 1, again)
        if drifting.beta[-1] ** 2 > TREND_SCORE ** 2 * drifting.beta_cov[-1, -1]:
            fit, trend = drifting, True
            basis = np.block([[basis, -(basis @ within)[:, None]],
                              [np.zeros((1, len(known))), np.ones((1, 1))]])
            level = np.append(level, 0.0)
    beta = basis @ fit.beta[1:]
    cov = basis @ fit.beta_cov[1:, 1:] @ basis.T
    variance = fit.sigma ** 2 / (2.0 * fit.alpha) + fit.noise_var
    outcome = {-1: FitEnd.UNBOUND, 0: FitEnd.FOUND, 1: FitEnd.UNCORRELATED}[fit.edge]
    return Fitted(
        outcome, fit.alpha, fit.sigma, fit.noise_var, math.inf if fit.share else 0.0,
        arma.log_covariance(fit.a, arma.theta_at(fit.a, 1, fit.share), 1, t.size), variance,
        np.concatenate(([fit.beta[0]], level)), beta, cov, trend, t.size, fit.a), again


def _score(gram: FloatArray, used: int, n: int) -> float:
    """Return the coefficient of the regressor after the first `used`, in standard errors."""
    others = np.linalg.pinv(gram[:used, :used], hermitian=True) @ gram[:used, used:]
    rest = gram[used:, used:] - gram[used:, :used] @ others
    xx, xy, yy = rest.item(0, 0), rest.item(0, -1), rest.item(-1, -1)
    left = (xx * yy - xy * xy) / (n - used - 1)
    return xy / math.sqrt(left) if left > 0.0 else 0.0
