"""
Fit OU parameters, noise and mean to the samples of a window.

The restricted likelihood (REML: Harville, J. Am. Stat. Assoc. 72 (1977) 320) removes the sag with
its curvature and lag (if throttle moves), and a drift (if it is significant).

Samples, or block means, whose steps differ little beside the relaxation time:
`SpectralLikelihood`, the Whittle likelihood (model/whittle.py), which `window: auto` and
`supply_facts` use too.

Other samples: `StampLikelihood`, the exact Gaussian likelihood, equal to the Kalman filter's.
The inverse covariance Q of a sampled OU is tridiagonal, so the cost is O(n): the covariance is K =
Q^-1 + nu I; with the tridiagonal A = I + nu Q, K^-1 = Q A^-1 and log|K| = log|A| - log|Q|.  The
gradient needs only the elimination and the three diagonals of A^-1.  The search starts from a fit
that treats the samples as evenly spaced, and takes a few evaluations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import enum
import functools
import math

import numpy as np
from ou_monitor.model import arma
from ou_monitor.model.ou_fit import stretches
from ou_monitor.model.whittle import CrossSpectrum, SpectrumBins
from ou_monitor.records import FloatArray

# Minimum variance of a combination of load variables, relative to the largest; with less, the
# window does not determine its coefficient.
_UNSEEN = 1e-5
# Minimum variance of a load variable, relative to full scale squared; below it, the variable
# counts as constant.
_STILL = 1e-12
# Minimum correlation of adjacent samples for a fit, in standard errors.
_CORRELATED = 4.0
# Maximum of alpha times the step, above which adjacent samples have no information on the
# relaxation; minimum number of relaxation times in the window, below which a drift may be chance.
_FASTEST, _DOUBTFUL = 4.6, 25.0


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
    seen = values > _UNSEEN * values[-1]
    found: FloatArray = vectors[:, seen] / np.sqrt(values[seen]) / scale[:, None]
    return found


# Score (standard errors) above which a trend is included; chance exceeds it once in 16 000 long
# windows.
TREND_SCORE = 4.0
# A window of few relaxation times looks like a trend more often, so the required score is
# multiplied by 1 + 6/x, x = alpha T.  False trends remain in 1 % of windows with x of 4 to 13, and
# in 5 % of random walks (apparent x of 16).  A drift of 8 standard deviations at x = 25 is missed
# in one window of 12; with twice the constant, in one of 5.
_FEW = 6.0
# Score above which a fit with a trend is tried; chance exceeds it once in 22 windows.
SUSPECT = 2.0


class FitEnd(enum.Enum):
    """Outcome of a fit."""

    FOUND = 'alpha found'
    UNCORRELATED = 'neighbouring samples are uncorrelated'
    UNBOUND = 'no restoring force visible'


@dataclass(slots=True)
class WindowFit:
    """Fitted parameters, before the correction for short windows."""

    outcome: FitEnd  # Outcome; unless it is FOUND, the numbers may be NaN
    # Maximum-likelihood values, 1/s and V/sqrt(s).
    alpha: float
    sigma: float
    noise_var: float  # Variance of the white noise of one raw sample, V^2
    noise_score: float  # Distance of the noise from zero, in standard errors
    log_var: tuple[float, float, float]  # Variances of ln(alpha), ln(sigma), ln(Var_inf)
    level: FloatArray  # Means of voltage and load variables; shape (c,)
    # Coefficients of load and trend, V per unit, and their covariance, V^2.
    beta: FloatArray
    beta_cov: FloatArray
    trend: bool  # Whether the mean drifts
    n: int  # Number of samples, or block means, fitted
    alpha_step: float  # alpha times the step between samples
    high: float  # Bias of alpha, times the length of the window


# Relaxation times after which two samples are independent; exp(2 * 300) does not overflow.
_FAR = 300.0
# Size up to which a tridiagonal system is solved as a dense one, which needs fewer NumPy calls.
_DENSE = 24
# Gain of a step, nats, below which a search ends: the result is then within 1e-4 standard errors
# of the optimum, from any start.
_SETTLED = 1e-9
# Maximum number of evaluations of a fit after the first; 4 to 8 are usual, and more are needed if
# alpha and noise cannot be distinguished.
_MOST_POINTS = 24
# Steps, in ln a and z, for finite differences of slopes (error 1e-4 for unit curvature, rounding
# 1e-7) and of values (error 1e-6, rounding 1e-5 in second derivatives); places of these values.
_STEP, _HAIR = 1e-4, 1e-3
_AROUND = np.array([[0.0, 1.0, -1.0, 0.0, 0.0, 1.0, -1.0], [0.0, 0.0, 0.0, 1.0, -1.0, 1.0, -1.0]])
# Number of points of the initial grid of a search, in ln a and z.
_GRID = (16, 8)
# Minimum curvature in any direction, nats; maximum step.
_FLAT, _LONGEST = 1e-3, 1.5
# Ratio of white noise to the diffusion of one step, up to which z is linear in the noise (above
# it, z is logarithmic); upper limit of z (for a ratio of 1e4, which hides any OU).
_SMALL = 0.05
_LOUDEST = math.log1p(1e4 / _SMALL)


@dataclass(frozen=True, slots=True)
class _Point:
    """The likelihood at one choice of ln a (a = alpha step) and z (see `noise_scale`)."""

    # Minus the restricted log-likelihood, nats, and its first and second derivatives by ln a and
    # z (None: the second ones are unknown).
    value: float
    slopes: FloatArray
    curved: FloatArray | None
    scale: float  # sigma^2, V^2/s
    # Products x' K^-1 z of all columns at scale 1: regressors, then the voltage.
    gram: FloatArray


def _ends(n: int) -> tuple[FloatArray, FloatArray]:
    """Return limits of ln a and z: from a relaxation time of ten windows to no correlation."""
    return np.array([math.log(0.1 / (n - 1)), 0.0]), np.array([math.log(2.0 * _FASTEST), _LOUDEST])


class SpectralLikelihood:
    """
    Whittle likelihood of evenly spaced samples, or means of m; last row: the voltage, V.

    It is restricted, and profiled over scale and mean; low, high: limits of ln a and z.
    """

    def __init__(self, rows: FloatArray, lengths: list[int], step: float, m: int = 1) -> None:
        self.n, self.m, self.step = rows.shape[1], m, step
        self._cross = CrossSpectrum(rows, lengths)
        self.low, self.high = _ends(self.n)

    def at(self, log_a: float, z: float, used: int) -> _Point:
        """Return the likelihood with the first `used` regressors; see `StampLikelihood.at`."""
        value, scale, gram = self._cross.cost(self.step * _spectra(
            self._cross.bins, self.m, log_a + _HAIR * _AROUND[0], z + _HAIR * _AROUND[1]), used)
        both = value[1::2] + value[2::2] - 2.0 * value[0]
        mixed = 0.5 * (both[2] - both[0] - both[1])
        return _Point(float(value[0]), (value[1:5:2] - value[2:5:2]) / (2.0 * _HAIR),
                      np.array([[both[0], mixed], [mixed, both[1]]]) / _HAIR ** 2,
                      float(scale[0]), gram[0])

    def start(self, used: int) -> FloatArray:
        """Return the best ln a and z of a grid."""
        places, spectra = _grid(self._cross.bins, self.m, self.n)
        # The cost does not depend on the scale of a spectrum.
        found: FloatArray = places[int(np.argmin(self._cross.cost(spectra, used)[0]))]
        return found


def _spectra(bins: SpectrumBins, m: int, log_a: FloatArray, z: FloatArray) -> FloatArray:
    """Return the spectra of OU and noise in units of sigma^2 times the step, shape (k, bins)."""
    gamma = np.array([arma.block_autocovariance(math.exp(x), m) for x in log_a.tolist()])
    a = np.exp(log_a)
    # The covariance of two block means is that of an OU of variance `size`; the variance of one
    # block mean is less.
    size = gamma[:, 1] * np.exp(a)
    white = gamma[:, 0] - size + _SMALL * np.expm1(z)
    return np.asarray(size[:, None] * bins.ou(a[:, None]) + white[:, None])


@functools.lru_cache(maxsize=4)
def _grid(bins: SpectrumBins, m: int, n: int) -> tuple[FloatArray, FloatArray]:
    """Return ln a and z at the points of the initial grid, shape (k, 2), and their spectra."""
    log_a, z = (x.ravel() for x in np.meshgrid(*(
        np.linspace(*ends) for ends in zip(*_ends(n), _GRID)), indexing='ij'))
    return np.stack([log_a, z], axis=1), _spectra(bins, m, log_a, z)


class StampLikelihood:
    """Exact likelihood of samples at stamps, s; rows: regressors, then the voltage, V."""

    def __init__(self, t: FloatArray, rows: FloatArray) -> None:
        self.steps = np.diff(t)
        self.n, self.m = t.size, 1
        self.step = float(t[-1] - t[0]) / (self.n - 1)
        self._table = rows
        self.low, self.high = _ends(self.n)

    def at(self, log_a: float, z: float, used: int) -> _Point:
        """Return the likelihood with the first `used` regressors; z is `noise_scale`."""
        a, share = math.exp(log_a), _SMALL * math.expm1(z)
        # Q / (2 alpha): its diagonal and first off-diagonal.
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
        # Derivatives of the products and of log|K| by ln alpha (at constant noise) and by the
        # noise.
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
        # Maximise over mean and scale.
        free = self.n - used
        own = gram[:used, :used]
        inverse = np.linalg.pinv(own, hermitian=True)
        c = np.zeros(len(gram))
        c[:used], c[-1] = -(inverse @ gram[:used, -1]), 1.0
        rest = max(float(c @ gram @ c), np.finfo(float).tiny)
        by_rate, by_noise = (0.5 * (
            free * float(c @ change @ c) / rest + log_change
            + float(np.vdot(inverse, change[:used, :used])))
            for change, log_change in ((slow, log_slow), (white, log_white)))
        value = 0.5 * (free * math.log(rest / free) + log_det + float(np.linalg.slogdet(own)[1])
                       + free * (1.0 + math.log(2.0 * math.pi)))
        slopes = np.array([by_rate, (_SMALL + share) * self.step * by_noise])
        return _Point(value, slopes, None, rest / free, gram)

    def start(self, used: int) -> FloatArray:
        """Return ln a and z of a fit that treats the samples as evenly spaced."""
        even = SpectralLikelihood(self._table, [self.n], self.step)
        return maximise(even, used).place


Likelihood = SpectralLikelihood | StampLikelihood


def noise_scale(share: float) -> float:
    """Return z of white noise / (sigma^2 mean step): linear for small values, then logarithmic."""
    return math.log1p(share / _SMALL)


def solve_tridiagonal(diag: FloatArray, off: FloatArray, right: FloatArray
                      ) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Return log-determinant, solutions, and two diagonals of the inverse (cyclic reduction)."""
    halves, pivots = [], []
    while diag.size > _DENSE:
        # Each odd row has a row before it and, unless it is the last row, a row after it.
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
        x, own, beside = _interleave(x, odd), _interleave(own, inner), _interleave(left, right_of)
    return log_det, x, own, beside


def _interleave(even: FloatArray, odd: FloatArray) -> FloatArray:
    """Return an array whose last axis alternates between two arrays."""
    both = np.empty((*even.shape[:-1], even.shape[-1] + odd.shape[-1]))
    both[..., 0::2], both[..., 1::2] = even, odd
    return both


@dataclass(frozen=True)
class Maximum:
    """Result of `maximise`, without bias correction."""

    # Relaxation rate, 1/s; noise intensity, V/sqrt(s); variance of the white noise, V^2, of a
    # sample or block mean.
    alpha: float
    sigma: float
    noise_var: float
    # Coefficients of the regressors (V per unit of each) and covariance.
    beta: FloatArray
    beta_cov: FloatArray
    # Restricted log-likelihood at the maximum, nats.
    log_likelihood: float
    # -1, 0 or 1: alpha at the slow end of the search (no restoring force visible), inside, or at
    # the fast end (no correlation visible).
    edge: int
    # alpha times the mean step, and noise_var over sigma^2 times the mean step.
    a: float
    share: float
    # Products of all rows at the maximum, see `_Point`.
    gram: FloatArray
    # ln a and z at the maximum, and the curvature there, nats, for starting the next search.
    place: FloatArray
    curved: FloatArray | None


def maximise(likelihood: Likelihood, used: int, before: Maximum | None = None) -> Maximum:
    """Fit rate, noise and a mean of `used` regressors (before: fit of a nearly equal window)."""
    low, high = likelihood.low, likelihood.high
    place, at, curved = _minimised(
        lambda p: likelihood.at(p.item(0), p.item(1), used),
        likelihood.start(used) if before is None else np.clip(before.place, low, high),
        None if before is None else before.curved, low, high)
    log_a, z = place.tolist()
    a, share = math.exp(log_a), _SMALL * math.expm1(z)
    # The likelihood is flat at the slow end, so values within 5 % of this end count as the end.
    edge = -1 if log_a < low[0] + 0.05 else 1 if a > _FASTEST else 0
    inverse = np.linalg.pinv(at.gram[:used, :used], hermitian=True)
    return Maximum(a / likelihood.step, math.sqrt(at.scale), share * at.scale * likelihood.step,
                   inverse @ at.gram[:used, -1], inverse * at.scale, -at.value, edge, a, share,
                   at.gram, place, curved)


def _minimised(f: Callable[[FloatArray], _Point], here: FloatArray, curved: FloatArray | None,
               low: FloatArray, high: FloatArray) -> tuple[FloatArray, _Point, FloatArray | None]:
    """Minimise f within a box (Newton, or BFGS); return place, point, and curvature."""
    at = f(here)
    left = _MOST_POINTS
    while left > 0:
        if at.curved is not None:
            curved = at.curved
        elif curved is None:
            left -= 2
            curved = np.stack([(f(here + step).slopes - at.slopes) / _STEP
                               for step in _STEP * np.eye(2)])
            curved = 0.5 * (curved + curved.T)
        # If f decreases beyond a bound, only the other coordinate moves.
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
            # Step to the minimum of the parabola through both values with the slope here.
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


# Jitter of the stamps, in relaxation times, above which the exact likelihood is used: at 0.06,
# sigma was 1 to 2 % too low, and its 95 % intervals held 90 % (80 Poisson windows); the error
# grows with the square of the jitter.
JITTER = 0.05
# Maximum number of samples for which the exact likelihood is used.
MOST = 4096
# A trend is fitted if the load leaves at least this share of the variance of time unexplained.
_APART = 1e-5
# Number of samples averaged into one sample of a coarser grid; minimum number of samples on that
# grid.
_FACTOR, _FEWEST = 4, 100
# Minimum rms movement of the OU between two samples, in ADC steps, with which the ADC's rounding
# acts as white noise; with less, a coarser grid is used.
_DITHER = 0.7
# Correction of the bias of alpha, in 1/T, for the spectral likelihood and for the exact one.  The
# exact restricted likelihood makes alpha too high by 2/T (Tang & Chen, J. Econometrics 149 (2009)
# 65: 4/T with unknown mean, half of it from the mean), the spectral one by 0.1/T to 1.2/T, or by
# 1.6/T to 2.5/T with 5 mV of noise (600 simulated windows each of 12 to 126 relaxation times).
# Var_inf = sigma^2 / (2 alpha) is convex in alpha, so one correction for both parameters is a
# compromise: Var_inf remains too high, by 0.5/(alpha T) (spectral) and 1.3/(alpha T) (exact).
_HIGH_BY = (0.5, 1.5)
# Share of the mean square below which a residual, or the diffusion of a step, is rounding error.
_EXACT = 1e-14


def fit_window(t: FloatArray, y: FloatArray, load: FloatArray, m: int, adc: float,
               jitter: float, before: Maximum | None,
               ) -> tuple[WindowFit, Maximum | None]:
    """Fit the OU, the noise and the mean (t in s, y in V, load of shape (c, n), adc step in V)."""
    # load: empty while throttle is constant.  m: number of raw samples averaged in each sample.
    # jitter: standard deviation of the steps between gaps, s.  before: the second value returned
    # for a nearly identical window.
    level = np.append(y.mean(), load.mean(axis=1))
    centred = load - level[1:, None]
    basis = independent(centred @ centred.T / t.size)
    known = basis.T @ centred
    time = (t - t[0]) / (t[-1] - t[0]) - 0.5
    # Remove the part of time that the load explains.
    within = known @ time / t.size
    time = time - time.mean() - within @ known
    used, apart = 1 + len(known), float(time @ time) > _APART * t.size / 12.0
    rows = np.stack([np.ones(t.size), *known, *([time] if apart else []), y - level[0]])
    # To avoid rounding errors, fit the residuals of a least-squares fit, which is added later.
    # The regressors other than time are orthogonal, with unit mean squares.
    plain = rows[:used] @ rows[-1] / t.size
    rows[-1] -= plain @ rows[:used]
    left = rows[-1]
    variance = float(left @ left) / t.size
    rounding = _EXACT * float(np.mean((y - y[0]) ** 2))
    exact, held, trend = False, m, False
    likelihood: Likelihood = _spectral(t, rows, m)
    found: Maximum | None = None
    again: Maximum | None = None
    if variance > rounding and _correlated(left):
        found = maximise(likelihood, used, before)
        exact = jitter * found.alpha > JITTER
        if exact:
            likelihood = StampLikelihood(t, rows)
            found = maximise(likelihood, used, found)
        while not exact and found.edge == 0 and likelihood.n >= _FACTOR * _FEWEST and (
                likelihood.step < (_DITHER * adc / found.sigma) ** 2):
            # Use a coarser grid if an ADC step hides the differences of adjacent samples.
            held *= _FACTOR
            likelihood = _spectral(t, rows, m, held // m)
            found = maximise(likelihood, used)
        doubtful = found.a * likelihood.n < _DOUBTFUL
        # If there may be another optimum, the next search starts from the grid.
        again = None if doubtful or found.edge or held > m else found
        if apart and found.edge <= 0 and (
                doubtful or abs(_score(found.gram, used, likelihood.n)) > SUSPECT):
            # Without a restoring force, any drift may be chance; so require a restoring force in
            # the fit with the drift.
            drifting = maximise(likelihood, used + 1, again)
            if drifting.edge <= 0 and drifting.beta[-1] ** 2 > drifting.beta_cov[-1, -1] * (
                    TREND_SCORE * (1.0 + _FEW / (drifting.a * likelihood.n))) ** 2:
                found, trend = drifting, True
    if found is None or found.edge > 0 or found.sigma ** 2 * likelihood.step < rounding:
        level[0] += plain[0]
        return WindowFit(FitEnd.UNCORRELATED, math.nan, math.nan, variance * m, math.nan,
                         (math.nan,) * 3, level, np.append(basis @ plain[1:], 0.0),
                         np.full((len(load) + 1,) * 2, math.nan), trend, t.size, math.nan,
                         math.nan), None
    whole = np.zeros((len(load) + 1, used - 1 + trend))
    whole[:-1, :used - 1] = basis
    beta = found.beta.copy()
    beta[:used] += plain
    level[0] += beta[0]
    if trend:
        whole[:-1, -1], whole[-1, -1] = -(basis @ within), 1.0
    theta, bare = (arma.theta_at(found.a, likelihood.m, share) for share in (found.share, 0.0))
    spread = (1.0 - math.exp(-found.a) * theta) / (math.exp(-found.a) - theta) * math.sqrt(
        (1.0 - theta * theta) / likelihood.n)
    return WindowFit(
        FitEnd.UNBOUND if found.edge else FitEnd.FOUND, found.alpha, found.sigma,
        found.noise_var * likelihood.m, max(theta - bare, 0.0) / spread,
        arma.log_covariance(found.a, theta, likelihood.m, likelihood.n), level,
        whole @ beta[1:], whole @ found.beta_cov[1:, 1:] @ whole.T, trend, likelihood.n,
        found.a, _HIGH_BY[int(exact)]), again


def _spectral(t: FloatArray, rows: FloatArray, m: int, factor: int = 1) -> SpectralLikelihood:
    """Return the likelihood of stretches without gaps, from means of `factor` samples."""
    parts = stretches(t) or [slice(0, t.size)]
    sizes = [(part.stop - part.start) // factor for part in parts]
    step = sum(t[part.stop - 1] - t[part.start] for part in parts) / sum(
        part.stop - part.start - 1 for part in parts)
    kept = [rows[:, part.start:part.start + size * factor] for part, size in zip(parts, sizes)]
    means = np.concatenate(kept, axis=1)
    if factor > 1:
        means = means.reshape(len(rows), -1, factor).mean(axis=2)
    return SpectralLikelihood(means, sizes, factor * step, factor * m)


def _correlated(left: FloatArray) -> bool:
    """Whether adjacent samples are correlated."""
    square = float(left @ left)
    return square > 0.0 and float(left[1:] @ left[:-1]) > (
        _CORRELATED * square / math.sqrt(left.size))


def _score(gram: FloatArray, used: int, n: int) -> float:
    """Return the coefficient of the regressor after the first `used`, in standard errors."""
    others = np.linalg.solve(gram[:used, :used], gram[:used, used:])
    rest = gram[used:, used:] - gram[used:, :used] @ others
    xx, xy, yy = rest.item(0, 0), rest.item(0, -1), rest.item(-1, -1)
    left = (xx * yy - xy * xy) / (n - used - 1)
    return xy / math.sqrt(left) if left > 0.0 else 0.0
