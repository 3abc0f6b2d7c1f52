"""
From the sums of a window to OU parameters.

Restricted quasi-likelihood (model/quasi_fit.py) of the ARMA(1,1) that samples
or block means of an OU in white noise are (model/arma.py).  With throttle
still the whole fit is model/still_fit.py; while it moves, or when the voltage
drifts, the mean is regressed along with it (load.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model import still_fit
from ou_monitor.online.estimator.compiled import kernels
from ou_monitor.online.estimator.lagsums import Sums
from ou_monitor.online.estimator.load import Moments
from ou_monitor.records import FloatArray

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
_SUSPECT = 2.0


@dataclass(slots=True)
class WindowFit:
    """
    What the sums of a window say.

    Attributes
    ----------
    a, theta : float
        alpha times the step, and the moving-average coefficient.
    scale : float
        sigma^2 times the step, V^2.
    noise_share : float
        Noise variance of one sample in units of `scale`.
    noise_score : float
        Distance of theta from "no noise" in standard errors.
    log_var : tuple of float
        Variances of ln(alpha), ln(sigma), ln(Var_inf).
    level : ndarray, shape (c,)
        Means of voltage (less its reference) and load variables.
    beta : ndarray, shape (c,) or none
        Coefficients of the load, V per unit, and of time (0 without `trend`).
    beta_cov : ndarray
        Their covariance, V^2.
    trend : bool
        Whether a trend was needed.
    trend_score : float
        Trend over its standard error.
    correlated : bool
        Whether neighbouring samples are correlated at all; if not, a to
        log_var are NaN.
    variance : float
        Variance about the mean, V^2.

    """

    a: float
    theta: float
    scale: float
    noise_share: float
    noise_score: float
    log_var: tuple[float, float, float]
    level: FloatArray
    beta: FloatArray
    beta_cov: FloatArray
    trend: bool
    trend_score: float
    correlated: bool
    variance: float


def fit_window(sums: Sums, m: int, start: tuple[float, float] | None = None) -> WindowFit:
    """Fit the OU, the noise and the mean."""
    if sums.first.size > 1:
        fit = _fit_moving(sums, m, start, trend=False)
    else:
        fit = _fit_still(sums, m, start)
    if fit.correlated and (abs(fit.trend_score) > _SUSPECT
                           or fit.a * sums.n < still_fit.DOUBTFUL):
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
    fast = kernels()
    if fast is not None:
        end = fast.fit_sums(sums.row, sums.pairs.size, log_a, theta, m)
    else:
        end = still_fit.fit_sums(sums.row.tolist(), sums.pairs.size, log_a, theta, m)
    level, c0 = np.array(end[:1]), end[1]
    if end[2] != end[2]:
        return _uncorrelated(level, _EMPTY, False, c0)
    return WindowFit(end[2], end[3], end[5], end[6], end[7], (end[8], end[9], end[10]), level,
                     _EMPTY, _NO_COV, False, end[11], _found(end[2:]), c0)


_EMPTY = np.empty(0)
_NO_COV = np.empty((0, 0))


def _correlated(c0: float, c: FloatArray, n: int) -> bool:
    return c0 > 0.0 and float(c[0]) > still_fit.CORRELATED * c0 / math.sqrt(n)


def _found(end: tuple[float, ...]) -> bool:
    """Whether a relaxation was found: within reach of the rate, and of positive variance."""
    return end[0] < still_fit.FASTEST and end[3] > 0.0


def _uncorrelated(level: FloatArray, beta: FloatArray, trend: bool, c0: float) -> WindowFit:
    nan = math.nan
    return WindowFit(nan, nan, nan, nan, nan, (nan, nan, nan), level, beta,
                     np.full((beta.size, beta.size), nan), trend, nan, False, c0)


def _fit_moving(sums: Sums, m: int, start: tuple[float, float] | None, trend: bool
                ) -> WindowFit:
    """Fit noise and mean in turn; the mean hardly moves, so two rounds are usual."""
    search, finish = _functions()
    moments = Moments(sums, trend)
    at = start
    # Without a start: ordinary least squares, as the fastest OU is as good as white.
    mean = moments.regress(*(at or (still_fit.HIGH, 0.0)))
    on_bound = False
    for _ in range(8):
        c0, c = moments.residual(mean.beta)
        if not _correlated(c0, c, sums.n):
            return _uncorrelated(moments.mean, mean.beta, trend, c0)
        log_a, theta = at or still_fit.guess(c0, c.tolist())
        tilt = mean.tilt if at else (0.0, 0.0)
        before = log_a, theta
        log_a, theta, on_bound = search(c0, c, sums.n - 1.0 - moments.rank, log_a, theta, m,
                                        *tilt)
        settled = at is not None and max(
            abs(log_a - before[0]), abs(theta - before[1])) < still_fit.STEADY
        at = log_a, theta
        mean = moments.regress(log_a, theta)
        if settled:
            break
    c0, c = moments.residual(mean.beta)
    end = finish(c0, c, sums.n, sums.n - 1.0 - moments.rank, log_a, theta, on_bound, m)
    return WindowFit(end[0], end[1], end[3], end[4], end[5], (end[6], end[7], end[8]),
                     moments.mean, mean.beta, mean.cov * (end[2] / sums.n), trend,
                     moments.trend_score(mean), _found(end), c0)


def _functions() -> tuple[Callable[..., tuple[float, float, bool]],
                          Callable[..., tuple[float, ...]]]:
    """Return search and finish, compiled where they are ready."""
    fast = kernels()
    if fast is not None:
        return fast.search, fast.finish
    return (lambda c0, c, *rest: still_fit.search(c0, c.tolist(), *rest),
            lambda c0, c, *rest: still_fit.finish(c0, c.tolist(), *rest))
