"""
The fit for windows whose stamps are not evenly spaced: the exact Gaussian likelihood.

Dearer than the sums over lags, so only for windows that need it: irregular sources, and windows
with many holes.  The inverse covariance of a sampled OU is tridiagonal, so the likelihood costs
O(n): K = K_ou + nu I with A = I + nu K_ou^-1 tridiagonal, K^-1 = K_ou^-1 A^-1 and log|K| =
log|K_ou| + log|A|.  It is the likelihood of the Kalman filter, restricted to the contrasts of the
regressors (REML: Harville, J. Am. Stat. Assoc. 72 (1977) 320).  Without SciPy, which would cost
the nodes 45 MB.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model import arma
from ou_monitor.online.estimator.fit import Fitted, independent, Outcome, TREND_SCORE
from ou_monitor.online.estimator.series import FAST, SLOW, T, U, Y
from ou_monitor.records import FloatArray

# Search range of the noise share nu / mean step: ten thousand times the
# diffusion of one step hides any OU.
_MOST_NOISE = 1e4


@dataclass(frozen=True)
class ExactFit:
    """
    Result of `fit_exact`.

    Attributes
    ----------
    alpha : float
        Relaxation rate, 1/s, at the maximum (no bias correction).
    sigma : float
        Noise intensity, V/sqrt(s).
    noise_var : float
        Variance of the white noise, V^2.
    beta, beta_cov : ndarray
        Coefficients of the regressors (V per unit of each) and covariance.
    log_likelihood : float
        Restricted log-likelihood at the maximum, nats.
    edge : int
        -1, 0 or 1: alpha ran into the slow end of the search (no restoring
        force visible), settled inside, or ran into the fast end (no
        correlation visible).

    """

    alpha: float
    sigma: float
    noise_var: float
    beta: FloatArray
    beta_cov: FloatArray
    log_likelihood: float
    edge: int


class _Likelihood:
    """Restricted likelihood of one data set, profiled over scale and mean."""

    def __init__(self, t: FloatArray, y: FloatArray, regressors: FloatArray) -> None:
        self.dt = np.diff(t)
        self.step = float(self.dt.mean())
        self.shift = float(y.mean())
        self.table = np.column_stack([regressors, y - self.shift])
        self.n, self.p = regressors.shape

    def solve(self, log_alpha: float, share: float
              ) -> tuple[float, float, FloatArray, FloatArray]:
        """
        Return minus the log-likelihood, sigma^2, beta and its covariance.

        `share` is the noise variance in units of sigma^2 times the mean step.
        """
        alpha, nu = math.exp(log_alpha), share * self.step
        rho = np.exp(-alpha * self.dt)
        rest = -np.expm1(-2.0 * alpha * self.dt)
        diag = np.ones(self.n)
        diag[1:] /= rest
        diag[:-1] += rho * rho / rest
        diag *= 2.0 * alpha
        off = -2.0 * alpha * rho / rest
        log_det = float(np.log(rest).sum()) - self.n * math.log(2.0 * alpha)
        w = self.table
        if nu > 0.0:
            more, w = solve_tridiagonal(1.0 + nu * diag, nu * off, self.table)
            log_det += more
        kw = diag[:, None] * w
        kw[1:] += off[:, None] * w[:-1]
        kw[:-1] += off[:, None] * w[1:]
        gram = self.table.T @ kw
        xx, xy = gram[:self.p, :self.p], gram[:self.p, self.p]
        inverse = np.linalg.pinv(xx, hermitian=True)
        beta = inverse @ xy
        free = self.n - self.p
        scale = max(float(gram[self.p, self.p] - xy @ beta) / free, np.finfo(float).tiny)
        value = 0.5 * (free * math.log(scale) + log_det + float(np.linalg.slogdet(xx)[1])
                       + free * (1.0 + math.log(2.0 * math.pi)))
        return value, scale, beta, inverse * scale


def solve_tridiagonal(diag: FloatArray, off: FloatArray, right: FloatArray
                      ) -> tuple[float, FloatArray]:
    """
    Return the log-determinant and the solutions (n, k) of a symmetric positive system.

    Cyclic reduction: every second unknown is eliminated, again and again.
    """
    log_det, halves = 0.0, []
    while diag.size > 1:
        # Each odd one has a neighbour before it and, but for the last of an even number, after it.
        pivots, before, after, w = diag[1::2], off[0::2], off[1::2], right[1::2]
        m, k = pivots.size, after.size
        halves.append((pivots, before, after, w))
        log_det += float(np.log(pivots).sum())
        back, ahead = before / pivots, after / pivots[:k]
        diag, right = diag[0::2].copy(), right[0::2].copy()
        diag[:m] -= back * before
        diag[1:k + 1] -= ahead * after
        right[:m] -= back[:, None] * w
        right[1:k + 1] -= ahead[:, None] * w[:k]
        off = -back[:k] * after
    log_det += math.log(diag.item(0))
    x = right / diag[:, None]
    for pivots, before, after, w in reversed(halves):
        odd = w - before[:, None] * x[:pivots.size]
        odd[:after.size] -= after[:, None] * x[1:after.size + 1]
        both = np.empty((pivots.size + len(x), x.shape[1]))
        both[0::2], both[1::2] = x, odd / pivots[:, None]
        x = both
    return log_det, x


# Step of the differences, in ln alpha and in the root of the noise share: truncation and rounding
# are then alike, 1e-7 of a curvature of one.
_STEP = 1e-3
# A step that gains less than this, nats, is the last: it ends a thousandth of a standard error
# from the optimum at most, and a logarithm of 4096 densities is rounded to 1e-9.
_SETTLED = 1e-6


def _least(f: Callable[[float, float], float], start: tuple[float, float],
           low: tuple[float, float], high: tuple[float, float]) -> tuple[float, float]:
    """
    Return where f is least within a box.

    Newton's method with derivatives by differences, damped (Levenberg) where f is not convex
    or a step leads up.
    """
    here, value, damping, h = np.array(start), f(*start), 0.0, _STEP
    for _ in range(60):
        a, x = here.tolist()
        up, down, right, left = f(a + h, x), f(a - h, x), f(a, x + h), f(a, x - h)
        gradient = np.array([up - down, right - left]) / (2.0 * h)
        mixed = f(a + h, x + h) + f(a - h, x - h) + 2.0 * value - up - down - right - left
        curved = np.array([[up + down - 2.0 * value, 0.5 * mixed],
                           [0.5 * mixed, right + left - 2.0 * value]]) / (h * h)
        # On an end beyond which f falls, only the other is left.
        stays = ((here <= low) & (gradient > 0.0)) | ((here >= high) & (gradient < 0.0))
        gradient[stays] = 0.0
        curved[stays] = curved[:, stays] = 0.0
        least = float(np.linalg.eigvalsh(curved)[0])
        while True:
            lift = max(damping, 1e-3 - 1.1 * least if least < 1e-3 else 0.0)
            step = np.linalg.solve(curved + lift * np.eye(2), -gradient)
            there = np.clip(here + step, low, high)
            new = f(*there.tolist())
            if new <= value or not -float(gradient @ step) >= _SETTLED:
                break
            damping = max(10.0 * damping, 1.0)
        gain = value - new
        if gain > 0.0:
            here, value, damping = there, new, 0.1 * damping if damping > 1e-2 else 0.0
        if gain < _SETTLED:
            break
    return float(here[0]), float(here[1])


def fit_exact(t: FloatArray, y: FloatArray, regressors: FloatArray) -> ExactFit:
    """Fit alpha, sigma, the white noise and the mean by restricted likelihood (t in s, y in V)."""
    likelihood = _Likelihood(t, y, regressors)
    # Slowest rate worth a name: one relaxation in ten windows; fastest: the
    # correlation of neighbours is below 1e-4.
    low = math.log(0.1 / float(t[-1] - t[0]))
    high = math.log(9.2 / likelihood.step)
    # lam = x^2 keeps the noise share positive and smooth at zero.
    starts = [(a, x) for a in np.linspace(low, high, 7)[1:-1] for x in (0.1, 1.0)]
    values = [likelihood.solve(a, x * x)[0] for a, x in starts]
    # Less noise than by the step of the differences is none, see below.
    log_alpha, root = _least(lambda a, x: likelihood.solve(a, x * x)[0],
                             starts[int(np.argmin(values))], (low, _STEP),
                             (high, math.sqrt(_MOST_NOISE)))
    share = root * root
    value, scale, beta, cov = likelihood.solve(log_alpha, share)
    clean = likelihood.solve(log_alpha, 0.0)
    if clean[0] <= value:
        share, (value, scale, beta, cov) = 0.0, clean
    beta = beta.copy()
    beta[0] += likelihood.shift
    # The likelihood is flat there: within 5 % of the end is at the end.
    edge = -1 if log_alpha < low + 0.05 else 1 if log_alpha > high - 0.05 else 0
    return ExactFit(math.exp(log_alpha), math.sqrt(scale), share * scale * likelihood.step,
                    beta, cov, -value, edge)


# Samples up to which the exact likelihood is used (some 50 ms).
MOST = 4096


def fit_irregular(columns: FloatArray, moves: bool) -> Fitted:
    """Fit the OU, the noise and the mean at the stamps as they are."""
    t, y = columns[T] - columns[T, 0], columns[Y]
    load = np.empty((0, t.size))
    if moves:
        u, fast, slow = columns[[U, FAST, SLOW]]
        load = np.stack([u, u * u, fast, slow])
    time = t / t[-1] - 0.5
    fit, basis, level = _fit(t, y, load)
    trend = False
    with_time, wide, wide_level = _fit(t, y, np.concatenate([load, [time]]))
    slope = float((wide @ with_time.beta[1:])[-1])
    spread = float((wide @ with_time.beta_cov[1:, 1:] @ wide.T)[-1, -1])
    if slope * slope > TREND_SCORE ** 2 * spread:
        fit, basis, level, trend = with_time, wide, wide_level, True
    beta = basis @ fit.beta[1:]
    cov = basis @ fit.beta_cov[1:, 1:] @ basis.T
    means = np.concatenate(([fit.beta[0]], level))
    variance = fit.sigma ** 2 / (2.0 * fit.alpha) + fit.noise_var
    outcome = {-1: Outcome.UNBOUND, 0: Outcome.FOUND, 1: Outcome.UNCORRELATED}[fit.edge]
    step = float(t[-1]) / (t.size - 1)
    a = fit.alpha * step
    share = fit.noise_var / (fit.sigma ** 2 * step) if fit.sigma > 0.0 else math.inf
    theta = arma.theta_at(a, 1, share)
    return Fitted(outcome, fit.alpha, fit.sigma, fit.noise_var, math.inf if share else 0.0,
                  arma.log_covariance(a, theta, 1, t.size), variance, means, beta, cov, trend,
                  t.size, a)


def _fit(t: FloatArray, y: FloatArray, load: FloatArray
         ) -> tuple[ExactFit, FloatArray, FloatArray]:
    """Fit with independent combinations of the load, centred."""
    mean = load.mean(axis=1)
    centred = load - mean[:, None]
    basis = independent(centred @ centred.T / t.size)
    regressors = np.column_stack([np.ones(t.size), centred.T @ basis])
    return fit_exact(t, y, regressors), basis, mean
