"""
The fit for windows whose stamps are not evenly spaced: the exact Gaussian likelihood.

Dearer than the sums over lags, so only for windows that need it: irregular sources, and windows
with many holes.  The inverse covariance Q of a sampled OU is tridiagonal, so the likelihood costs
O(n): K = Q^-1 + nu I with A = I + nu Q tridiagonal, K^-1 = Q A^-1 and log|K| = log|A| - log|Q|.
It is the likelihood of the Kalman filter, restricted to the contrasts of the regressors (REML:
Harville, J. Am. Stat. Assoc. 72 (1977) 320).  Its gradient needs no more than the elimination
and the three diagonals of A^-1, so a search that begins where the samples would be if they were
even takes a handful of evaluations.  Without SciPy, which would cost the nodes 45 MB.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model import arma
from ou_monitor.online.estimator.fit import Fitted, independent, Outcome, SUSPECT, TREND_SCORE
from ou_monitor.online.estimator.window import FACTOR, FAST, FEWEST, LAGS, LOST, SLOW, T, U, Y
from ou_monitor.records import FloatArray

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
# Step of the differences of slopes, in ln a and z: of a curvature of one they are then
# right to 1e-4 and rounded to 1e-7.
_STEP = 1e-4
# Curvature below which a direction counts as this much curved, nats; longest step.
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

    before: the fit of a window that is nearly this one.
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
        # On an end beyond which f falls, only the other is left.
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
            # To the least point of the parabola through both values and the slope here.
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
# Share of its variance that time must keep beside the load to be told from it.
_APART = 1e-5


def fit_irregular(columns: FloatArray, moves: bool, before: ExactFit | None = None
                  ) -> tuple[Fitted, ExactFit | None]:
    """
    Fit the OU, the noise and the mean at the stamps as they are.

    before: the second thing returned for a window that is nearly this one.
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
    outcome = {-1: Outcome.UNBOUND, 0: Outcome.FOUND, 1: Outcome.UNCORRELATED}[fit.edge]
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
