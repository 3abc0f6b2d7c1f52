"""
The whole fit of a window whose throttle is still, from its autocovariances.

What `online.window_fit` does step by step when the mean needs regressors is
one function of scalars here: search, test for a trend, scale, noise and
information.  Like `quasi_fit` it is written in scalars and loops so that the
same text runs in plain Python and compiled.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

from ou_monitor.model.arma import (
    innovation_variance, log_covariance, noise_free_theta, noise_share)
from ou_monitor.model.quasi_fit import information, innovation, minimise, objective

# Neighbouring samples correlated by less than this many standard errors are
# not correlated.
CORRELATED = 4.0
# ln(a) settles to this when something else is fitted along with it; the error
# left in it is the square.
STEADY = 1e-3
# alpha D beyond which neighbouring samples say nothing of relaxation, and the
# range of the search in ln(alpha D).
FASTEST = 4.6
LOW = math.log(1e-9)
HIGH = math.log(2.0 * FASTEST)
# Relaxations in the window below which a minimum is not trusted before others
# have been looked for.
DOUBTFUL = 25.0
# Pull of theta towards "no measurement noise" where the data cannot tell, in
# standard errors, fading within two of them: a clamped estimate is high by 0.4
# on average when there is no noise.  A larger pull costs more at 5 mV than it
# gains when clean (doc/estimation.md).
PULL = 0.1


def guess(c0: float, c: Sequence[float]) -> tuple[float, float]:
    """Return a first ln(a) and theta: noise by extrapolating the variogram to lag zero."""
    noise = min(max(0.0, 2.0 * (c0 - c[0]) - (c0 - c[1])), 0.9 * c0)
    phi = min(max(c[0] / (c0 - noise), 0.02), 1.0 - 1e-6)
    return math.log(-math.log(phi)), 0.1 * phi


def _descend(c0: float, c: Sequence[float], free: float, log_a: float, theta: float, m: int,
             tilt_a: float, tilt_t: float) -> tuple[float, float, bool, float]:
    """Minimise from one start, the bound on theta following ln a; return the value, too."""
    floor = 0.0
    slope = 0.0
    on_bound = False
    value = math.inf
    for _ in range(4):
        if m > 1:
            a = math.exp(log_a)
            floor = noise_free_theta(a, m)
            slope = (noise_free_theta(1.001 * a, m) - floor) / math.log(1.001)
        before = log_a
        log_a, theta, value, on_bound, _ = minimise(
            c0, c, free, log_a, theta, floor, slope, LOW, HIGH, tilt_a, tilt_t)
        if m == 1 or not on_bound or abs(log_a - before) < STEADY:
            break
    return log_a, theta, on_bound, value


def search(c0: float, c: Sequence[float], free: float, log_a: float, theta: float, m: int,
           tilt_a: float, tilt_t: float) -> tuple[float, float, bool]:
    """Minimise `quasi_fit.objective` with the bound on theta, which bends with ln a."""
    theta = min(theta, 0.9 * math.exp(-math.exp(log_a)))
    log_a, theta, on_bound, value = _descend(c0, c, free, log_a, theta, m, tilt_a, tilt_t)
    if not value < math.inf:
        # Sums over a few pairs need not be a covariance: start where they are one.
        best = math.inf
        for i in range(6):
            for k in range(4):
                a = 0.01 * 4.0 ** i
                value = objective(c0, c, free, math.log(a), 0.3 * k * math.exp(-a), 0.0, 0.0)[0]
                if value < best:
                    best, log_a, theta = value, math.log(a), 0.3 * k * math.exp(-a)
        log_a, theta, on_bound, value = _descend(c0, c, free, log_a, theta, m, tilt_a, tilt_t)
    if math.exp(log_a) * free < DOUBTFUL:
        # A valley at alpha -> 0 catches searches that start badly in strong noise.
        for i in range(4):
            a = DOUBTFUL / free * (0.5 * free / DOUBTFUL) ** (0.2 + 0.2 * i)
            for k in range(2):
                other = _descend(c0, c, free, math.log(a), (0.5 + 0.4 * k) * math.exp(-a), m,
                                 tilt_a, tilt_t)
                # Sums over lags say little of the slow end: never leave for there.
                if other[3] < value and other[0] > log_a:
                    log_a, theta, on_bound, value = other
    return log_a, theta, on_bound


def finish(c0: float, c: Sequence[float], n: int, free: float, log_a: float, theta: float,
           on_bound: bool, m: int
           ) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return scale, noise and errors at the minimiser."""
    floor = noise_free_theta(math.exp(log_a), m)
    phi = math.exp(-math.exp(log_a))
    i_aa, i_at, _ = information(log_a, theta)
    # Standard error of theta, alpha being free (see `arma.log_covariance`).
    spread = (1.0 - phi * theta) / (phi - theta) * math.sqrt((1.0 - theta * theta) / n)
    score = 0.0
    if not on_bound:
        score = max(theta - floor, 0.0) / spread
    if score > 0.0 and innovation(c0, c, log_a, theta) > 0.0:
        pull = min(PULL * math.exp(-score * score / 8.0), score) * spread
        theta -= pull
        log_a += i_at / i_aa * pull
    a = math.exp(log_a)
    q = innovation(c0, c, log_a, theta) * n / free
    scale = q / innovation_variance(a, theta, m)
    share = 0.0
    if score > 0.0:
        share = max(noise_share(a, theta, m), 0.0)
    errors = log_covariance(a, theta, m, n)
    return a, theta, q, scale, share, score, errors[0], errors[1], errors[2]


def trend_score(c0: float, c: Sequence[float], n: int, place: float, change: Sequence[float],
                pairs: Sequence[float], log_a: float, theta: float) -> float:
    """Return a trend over its standard error (place in V)."""
    phi = math.exp(-math.exp(log_a))
    lead = 1.0 + phi * phi - 2.0 * phi * theta
    tail = 2.0 * (1.0 - phi * theta) * (theta - phi)
    own = (1.0 - 1.0 / (float(n) * n)) / 12.0
    xx = lead * own
    xy = lead * place
    yy = lead * c0
    power = tail
    for i in range(len(c)):
        k = (i + 1.0) / n
        xx += power * (own - 0.5 * k * k)
        xy += power * (place - change[i] * k / (2.0 * max(pairs[i], 1.0)))
        yy += power * c[i]
        power *= theta
    if xx <= 0.0:
        return 0.0
    rest = (yy - xy * xy / xx) * xx / n
    return xy / math.sqrt(rest) if rest > 0.0 else 0.0


def fit_still(c0: float, c: Sequence[float], n: int, place: float, change: Sequence[float],
              pairs: Sequence[float], log_a: float, theta: float, m: int
              ) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Fit a window whose mean is a constant."""
    if math.isnan(log_a):
        log_a, theta = guess(c0, c)
    log_a, theta, on_bound = search(c0, c, n - 1.0, log_a, theta, m, 0.0, 0.0)
    score = trend_score(c0, c, n, place, change, pairs, log_a, theta)
    end = finish(c0, c, n, n - 1.0, log_a, theta, on_bound, m)
    return (end[0], end[1], end[2], end[3], end[4], end[5], end[6], end[7], end[8], score)


def fit_sums(sums: Sequence[float], lags: int, log_a: float, theta: float, m: int
             ) -> tuple[float, float, float, float, float, float, float, float, float, float,
                        float, float]:
    """Fit a window whose mean is a constant, from its sums over lags (sums in V)."""
    n = int(sums[0])
    mean = sums[1] / n
    c0 = sums[3] / n - mean * mean
    # Lags without pairs count as uncorrelated.
    pairs = [max(sums[4 + k], 1.0) for k in range(lags)]
    change = [sums[4 + lags + k] for k in range(lags)]
    c = [c0 - 0.5 * sums[4 + 2 * lags + k] / pairs[k] for k in range(lags)]
    if not (c0 > 0.0 and c[0] > CORRELATED * c0 / math.sqrt(n)):
        none = math.nan
        return mean, c0, none, none, none, none, none, none, none, none, none, none
    place = (sums[2] - 0.5 * (n - 1) * sums[1]) / n / n
    end = fit_still(c0, c, n, place, change, pairs, log_a, theta, m)
    return (mean, c0, end[0], end[1], end[2], end[3], end[4], end[5], end[6], end[7], end[8],
            end[9])
