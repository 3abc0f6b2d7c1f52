"""
From the sums of a window to OU parameters.

Restricted quasi-likelihood (model/quasi_fit.py) of the ARMA(1,1) that samples
or block means of an OU in white noise are (model/arma.py), with the mean
regressed on throttle (load.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np

from ou_monitor.model import arma, quasi_fit
from ou_monitor.online.lagsums import Sums
from ou_monitor.online.load import Moments, trend_score
from ou_monitor.records import FloatArray

# A trend is taken into the model from this many standard errors on: by chance
# once in 16 000 windows.
TREND_SCORE = 4.0
# alpha D beyond which neighbouring samples say nothing of relaxation.
FASTEST = 4.6
# ln(a) and theta settle to this when the mean is fitted along with them; the
# error left in them is its square.
_STEADY = 1e-3
_LOW = math.log(1e-9)
_HIGH = math.log(2.0 * FASTEST)
# Pull of theta towards "no measurement noise" where the data cannot tell: a
# clamped estimate is high by 0.4 standard errors on average when there is no
# noise; this takes a third of it away and fades within two standard errors.
_PULL = 0.4

Minimise = Callable[..., tuple[float, float, float, bool, int]]


@dataclass(frozen=True)
class WindowFit:
    """
    What the sums of a window say.

    Attributes
    ----------
    a, theta : float
        alpha times the step, and the moving-average coefficient.
    sigma2_step : float
        sigma^2 times the step, V^2.
    noise_share : float
        Noise variance of one sample in units of sigma2_step.
    noise_score : float
        Distance of theta from "no noise" in standard errors.
    level : ndarray, shape (c,)
        Means of voltage (less its reference) and load variables.
    beta : ndarray, shape (c - 1,)
        Coefficients of the load, V per unit; of time last when `trend`.
    beta_cov : ndarray
        Their covariance, V^2.
    trend : bool
        Whether a trend was needed.
    correlated : bool
        Whether neighbouring samples are correlated at all.
    variance : float
        Variance about the mean, V^2.
    first_lag : float
        Correlation of neighbours.

    """

    a: float
    theta: float
    sigma2_step: float
    noise_share: float
    noise_score: float
    level: FloatArray
    beta: FloatArray
    beta_cov: FloatArray
    trend: bool
    correlated: bool
    variance: float
    first_lag: float


def fit_window(sums: Sums, m: int, start: tuple[float, float] | None = None,
               minimise: Minimise | None = None) -> WindowFit:
    """
    Fit the OU, the noise and the mean.

    Parameters
    ----------
    sums : Sums
        Of the window, at one resolution.
    m : int
        Raw samples in each of its samples.
    start : tuple of float, optional
        ln(a) and theta of an earlier fit.
    minimise : callable, optional
        `plain_minimise`, the default, or its compiled twin.

    Returns
    -------
    WindowFit
        The fit.

    """
    trend = False
    moments = Moments.of(sums, trend)
    b = np.empty(0)
    c0, c = moments.residual(b)
    log_a, theta = start or _start(c0, c)
    if moments.rank:
        b = moments.regress(-20.0, 0.0)[0] if start is None else moments.regress(log_a, theta)[0]
    on_bound = False
    for _ in range(8):
        tilt = (0.0, 0.0)
        if moments.rank:
            c0, c = moments.residual(b)
            tilt = moments.tilt(log_a, theta)
        if not c0 > 0.0 or c[0] <= 2.0 * c0 / math.sqrt(sums.n):
            return _uncorrelated(moments, b, trend, c0, c)
        before = log_a, theta
        log_a, theta, on_bound = _search(
            minimise or plain_minimise, c0, c, sums.n - 1.0 - moments.rank, log_a, theta, m, tilt)
        if not trend:
            trend = _drifts(sums, moments, c0, c, log_a, theta)
            if trend:
                moments = Moments.of(sums, True)
                b = moments.regress(log_a, theta)[0]
                continue
        if not moments.rank:
            break
        b = moments.regress(log_a, theta)[0]
        if abs(log_a - before[0]) < _STEADY and abs(theta - before[1]) < _STEADY:
            break
    return _finish(moments, b, trend, log_a, theta, on_bound, m)


def _drifts(sums: Sums, moments: Moments, c0: float, c: FloatArray, log_a: float,
            theta: float) -> bool:
    """Whether time explains the voltage by itself, beyond what the load does."""
    if not moments.rank:
        return abs(trend_score(sums, c0, c, log_a, theta)) > TREND_SCORE
    full = Moments.of(sums, True)
    b, cov = full.regress(log_a, theta)
    q = _innovation(*full.residual(b), log_a, theta)
    time = full.basis[-1]
    return float(time @ b) ** 2 > TREND_SCORE ** 2 * float(time @ cov @ time) * q / sums.n


def _innovation(c0: float, c: FloatArray, log_a: float, theta: float) -> float:
    return quasi_fit.innovation(c0, c.tolist(), log_a, theta)


def _uncorrelated(moments: Moments, b: FloatArray, trend: bool, c0: float, c: FloatArray
                  ) -> WindowFit:
    beta = moments.basis @ b
    return WindowFit(math.nan, math.nan, math.nan, math.nan, math.nan, moments.mean, beta,
                     np.full((beta.size, beta.size), math.nan), trend, False, c0,
                     c[0] / c0 if c0 > 0.0 else math.nan)


def plain_minimise(c0: float, c: FloatArray, *rest: float
                   ) -> tuple[float, float, float, bool, int]:
    """Return `quasi_fit.minimise`, whose loops are quicker over a list."""
    return quasi_fit.minimise(c0, c.tolist(), *rest)


def _start(c0: float, c: FloatArray) -> tuple[float, float]:
    """Return a first guess: noise by extrapolating the variogram to lag zero."""
    first, second = float(c[0]), float(c[1])
    noise = min(max(0.0, 2.0 * (c0 - first) - (c0 - second)), 0.9 * c0)
    phi = min(max(first / (c0 - noise), 0.02), 1.0 - 1e-6)
    return math.log(-math.log(phi)), 0.1 * phi


def _search(minimise: Minimise, c0: float, c: FloatArray, free: float, log_a: float,
            theta: float, m: int, tilt: tuple[float, float]) -> tuple[float, float, bool]:
    """Minimise with the bound on theta, which bends with ln a for block means."""
    theta = min(theta, 0.9 * math.exp(-math.exp(log_a)))
    floor = slope = 0.0
    on_bound = False
    for _ in range(4):
        if m > 1:
            a = math.exp(log_a)
            floor = arma.noise_free_theta(a, m)
            slope = (arma.noise_free_theta(1.001 * a, m) - floor) / math.log(1.001)
        before = log_a
        log_a, theta, _, on_bound, _ = minimise(
            c0, c, free, log_a, theta, floor, slope, _LOW, _HIGH, *tilt)
        if m == 1 or not on_bound or abs(log_a - before) < _STEADY:
            break
    return log_a, theta, on_bound


def _finish(moments: Moments, b: FloatArray, trend: bool, log_a: float, theta: float,
            on_bound: bool, m: int) -> WindowFit:
    n, free = moments.n, moments.n - 1.0 - moments.rank
    floor = arma.noise_free_theta(math.exp(log_a), m)
    i_aa, i_at, i_tt = quasi_fit.information(log_a, theta)
    spread = math.sqrt(i_aa / (i_aa * i_tt - i_at * i_at) / n)
    score = 0.0 if on_bound else max(theta - floor, 0.0) / spread
    if score > 0.0:
        pull = min(_PULL * math.exp(-score * score / 8.0), score) * spread
        theta -= pull
        log_a += i_at / i_aa * pull
    a = math.exp(log_a)
    c0, c = moments.residual(b)
    q = _innovation(c0, c, log_a, theta) * n / free
    beta_cov = np.empty((0, 0))
    if moments.rank:
        beta_cov = moments.basis @ moments.regress(log_a, theta)[1] @ moments.basis.T * q / n
    scale = q / arma.innovation_variance(a, theta, m)
    share = max(arma.noise_share(a, theta, m), 0.0) if score > 0.0 else 0.0
    return WindowFit(a, theta, scale, share, score, moments.mean, moments.basis @ b, beta_cov,
                     trend, a < FASTEST, c0, c[0] / c0)
