"""
What a load model leaves over: white noise that follows throttle, and an OU.

The intensity of the noise follows throttle and its changes: variance = exp(b0 + b1 ripple(u))
+ exp(b2) du^2, with du the change of throttle in 20 ms, or from the sample before where that is
older: the two are not read at one moment, so that a change leaves an error as large as itself.
Beyond the throttles and changes of the fit it stays at their edge.

The Ornstein-Uhlenbeck process, beside white noise, is found by Whittle's likelihood of the
periodogram, in bins of frequency; what has another law than the normal, or an intensity that
changes, keeps the spectrum and so the estimate, not its error.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model.load import ripple
from ou_monitor.records import FloatArray
from scipy.optimize import minimize
from scipy.signal import lfilter, periodogram, ss2tf

# Centre and deviation of b1 before any data, what recordings usually show; and of b2, about ln of
# the mean square of the errors: a wide choice.
USUAL = ((2.0, 2.0), (0.0, 4.0))
# Shares of the samples at each end of throttle, and at the top of its changes, that the law does
# not go beyond.
_EDGE, _TOP = 0.01, 0.001
# Errors are drawn from those whose intensity is alike: this share of all to either side, and at
# least so many.  How far ln variance is drawn from its estimate, and what of it is rounding.
_ALIKE, _FEWEST, _FARTHEST, _ROUNDING = 0.02, 50, 1.0, 1e-9
# Scores count up to this in the correlation of neighbours; it counts from so many standard errors.
_CLIP, _CLEAR = 3.0, 3.0
# Time within which a change of throttle counts, s: what the filter onboard takes as one step; and
# a hair, for the rounding of stamps.
_SPAN, _HAIR = 0.02, 1e-6


def changes(t: FloatArray, throttle: FloatArray) -> FloatArray:
    """Return how much throttle changed within `_SPAN` before each stamp, s; 0 at the first."""
    then = np.searchsorted(t, t - _SPAN + _HAIR, side='right') - 1
    before = np.minimum(np.maximum(then, 0), np.maximum(np.arange(t.size) - 1, 0))
    return np.asarray(np.abs(throttle - throttle[before]), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class NoiseLaw:
    """White noise that follows throttle."""

    b: FloatArray  # Coefficients of the variance, V^2; shape (3,)
    covariance: FloatArray  # Their covariance; shape (3, 3)
    # Least and most throttle, and most change of it, in the fit.
    limits: tuple[float, float, float]
    intensities: FloatArray  # ln variance at the samples of the fit, rising; shape (n,)
    # Errors there, V, less what is not the noise's: the shape of the law, tails included; shape
    # (n,).
    errors: FloatArray
    memory: float = 0.0  # Correlation of neighbouring samples, as of a filter before the ADC

    def variance(self, t: FloatArray, throttle: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the variance, V^2, and how ln of it changes with the coefficients, (n, 3)."""
        return _variance(self.b, *_features(throttle, changes(t, throttle), self.limits))

    def draw(self, t: FloatArray, throttle: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return noise, V, of samples with that throttle; the coefficients' errors are drawn."""
        variance, slopes = self.variance(t, throttle)
        wanted = np.log(variance)
        # Any of those that are as intense, and its neighbours: as many at the ends as between.
        # By rounding the same intensity comes out in two ways.
        first = np.searchsorted(self.intensities, wanted - _ROUNDING, side='left')
        last = np.searchsorted(self.intensities, wanted + _ROUNDING, side='right')
        at = first + (rng.random(wanted.size) * (last - first)).astype(np.int64)
        most = self.errors.size - 1
        reach = min(max(_FEWEST, int(_ALIKE * self.errors.size)), most // 2)
        near = np.clip(at, reach, most - reach) + rng.integers(-reach, reach + 1, at.size)
        off = slopes @ rng.multivariate_normal(np.zeros(3), self.covariance)
        # As they were, not scaled: an outlier in a calm does not become a larger one in a storm.
        fresh = self.errors[near] * np.exp(0.5 * np.clip(off, -_FARTHEST, _FARTHEST))
        if self.memory == 0.0:
            return np.asarray(fresh)
        fresh[1:] *= math.sqrt(1.0 - self.memory ** 2)
        return np.asarray(lfilter([1.0], [1.0, -self.memory], fresh), dtype=np.float64)


def _features(u: FloatArray, du: FloatArray, limits: tuple[float, float, float]
              ) -> tuple[FloatArray, FloatArray]:
    """Return ripple and squared change, within the limits."""
    low, high, most = limits
    return ripple(np.clip(u, low, high)), np.square(np.minimum(du, most))


def _variance(b: FloatArray, rippled: FloatArray, square: FloatArray
              ) -> tuple[FloatArray, FloatArray]:
    """Return the variance, V^2, and the slopes of its logarithm over the coefficients."""
    still, moved = np.exp(np.clip([b[0] + b[1] * rippled, np.full(rippled.size, b[2])],
                                  -200.0, 200.0))
    moved = moved * square
    whole = still + moved
    slopes = np.stack([still, still * rippled, moved], axis=1) / whole[:, None]
    return np.asarray(whole, dtype=np.float64), np.asarray(slopes, dtype=np.float64)


def fit_noise_law(t: FloatArray, errors: FloatArray, throttle: FloatArray,
                  other: float) -> NoiseLaw:
    """
    Fit the law to errors of a prediction, V.

    Normal quasi-likelihood, so that the second moments are met whatever the tails; other is the
    variance, V^2, that the errors have beside the noise, as of a state or of rounding.
    """
    moved = changes(t, throttle)
    limits = (float(np.quantile(throttle, _EDGE)), float(np.quantile(throttle, 1.0 - _EDGE)),
              float(np.quantile(moved, 1.0 - _TOP)))
    features = _features(throttle, moved, limits)
    square = errors * errors
    total = float(square.mean())
    centre, deviation = np.array(USUAL).T
    centre = centre + [0.0, math.log(max(total, 1e-300))]

    def cost(b: FloatArray) -> tuple[float, FloatArray]:
        own, slopes = _variance(b, *features)
        whole = own + other
        away = (b[1:] - centre) / deviation
        slope = 0.5 * slopes.T @ (own * (1.0 / whole - square / whole ** 2))
        slope[1:] += away / deviation
        return (0.5 * float(np.sum(np.log(whole) + square / whole)) + 0.5 * float(away @ away),
                slope)

    # A floor, so that noise below the rounding does not run away to nothing.
    least = math.log(1e-6 * total)
    start = np.array([max(math.log(max(total - other, 0.1 * total)), least + 1.0), 0.0, centre[1]])
    found = minimize(cost, start, jac=True, method='L-BFGS-B',
                     bounds=[(least, None), (None, None), (None, None)])
    own, slopes = _variance(found.x, *features)
    share = own / (own + other)
    # Fisher information of ln variance: half a square of the share that is the noise's own.
    information = 0.5 * (slopes * (share ** 2)[:, None]).T @ slopes
    # A factor of e where there is none, as of noise far below the rounding.
    information += np.diag([1.0, *(deviation ** -2)])
    order = np.argsort(own, kind='stable')
    scores = np.clip(errors / np.sqrt(own + other), -_CLIP, _CLIP)
    memory = float(scores[1:] @ scores[:-1]) / float(scores @ scores)
    if abs(memory) < _CLEAR / math.sqrt(scores.size):
        memory = 0.0
    return NoiseLaw(np.asarray(found.x), np.asarray(np.linalg.inv(information)), limits,
                    np.log(own[order]), (errors * np.sqrt(share))[order], memory)


# Time constant of what a load model takes for its own slow error, s.
SLOW_TIME = 20.0
# Relaxation below so many steps is white, and above this share of the part is drift.
_FASTEST, _LONGEST = 2.0, 0.1
# Relaxation times tried, bins of frequency, and parts for cross-validation.
_TRIED, _BINS, _PARTS = 12, 120, 4
_TINY = 1e-12
# A Hann window makes neighbouring ordinates alike: so many count as one (Percival & Walden 1993).
_BINS_ALIKE = 35.0 / 18.0
# Logarithms are not drawn farther than this from their estimates.
_DRAWN = 2.0


@dataclass(frozen=True, eq=False)
class ResidualOU:
    """What is in a series beside a slow process that is given."""

    white: float  # Variance of white noise, V^2
    variance: float  # Stationary variance of the OU, V^2; 0 where none is visible
    tau: float  # Its relaxation time, s
    gain: float  # What it adds to the log-likelihood of parts left out, nats a sample
    covariance: FloatArray  # Covariance of the logarithms of white, variance and tau; shape (3, 3)

    def draw(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """Return white, variance and tau within their errors."""
        off = np.clip(rng.multivariate_normal(np.zeros(3), self.covariance), -_DRAWN, _DRAWN)
        white, variance, tau = (x * math.exp(d) for x, d in zip(
            (self.white, self.variance, self.tau), off))
        return white, variance, tau


def _spectrum(f: FloatArray, dt: float, tau: float) -> FloatArray:
    """Return the one-sided density of a sampled OU of variance 1, 1/Hz."""
    keep = math.exp(-dt / tau)
    density = 2.0 * dt * (1.0 - keep * keep) / np.abs(
        1.0 - keep * np.exp(-2j * math.pi * f * dt)) ** 2
    return np.asarray(density, dtype=np.float64)


def _binned(x: FloatArray, dt: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return frequencies, mean density and number of ordinates of bins."""
    f, power = periodogram(x - x.mean(), 1.0 / dt, window='hann', detrend=False)
    # The lowest two share the mean that was taken out, by way of the window.
    f, power = f[2:], power[2:]
    edge = np.unique(np.rint(np.geomspace(1.0, f.size + 1, _BINS)).astype(int)) - 1
    count = np.diff(edge)
    starts = edge[:-1]
    return (np.add.reduceat(f, starts) / count, np.add.reduceat(power, starts) / count,
            count.astype(np.float64))


def _cost(density: FloatArray, power: FloatArray, count: FloatArray) -> float:
    return float(np.sum(count * (np.log(density) + power / density)))


def _fit(f: FloatArray, power: FloatArray, count: FloatArray, dt: float, slow: float,
         taus: FloatArray) -> tuple[float, float, float, float]:
    """Return white variance, OU variance, tau and that of white noise alone."""
    base = slow * _spectrum(f, dt, SLOW_TIME) + _TINY * float(power.max())
    total = max(float(np.sum(count * power) / np.sum(count)) / (2.0 * dt), 1e-300)

    def least(shape: FloatArray | None) -> tuple[float, FloatArray]:
        def cost(q: FloatArray) -> tuple[float, FloatArray]:
            parts = [np.full(f.size, 2.0 * dt * math.exp(q[0]))]
            if shape is not None:
                parts.append(math.exp(q[1]) * shape)
            density = np.sum(parts, axis=0) + base
            slope = count * (1.0 / density - power / density ** 2)
            return _cost(density, power, count), np.array([part @ slope for part in parts])

        start = [math.log(0.7 * total)] + ([] if shape is None else [math.log(0.5 * total)])
        low = math.log(1e-9 * total)
        found = minimize(cost, start, jac=True, method='L-BFGS-B',
                         bounds=[(low, low + 30.0)] * len(start))
        return float(found.fun), np.exp(found.x)

    alone = float(least(None)[1][0])
    fits = [least(_spectrum(f, dt, tau)) for tau in taus]
    best = int(np.argmin([value for value, _ in fits]))
    white, variance = fits[best][1]
    return float(white), float(variance), float(taus[best]), alone


def fit_residual_ou(x: FloatArray, dt: float, slow: float) -> ResidualOU:
    """
    Fit white noise and an OU to even samples, V, of spacing dt, s.

    slow is the variance of the slow process of `SLOW_TIME` that is in x as well, V^2.  The OU
    counts where it raises the likelihood of parts of the series that were left out.
    """
    longest = _LONGEST * x.size * dt
    taus = np.geomspace(_FASTEST * dt, max(longest, 4.0 * dt), _TRIED)
    size = x.size // _PARTS
    parts = [_binned(x[k * size:(k + 1) * size], dt) for k in range(_PARTS)]
    f, _, count = parts[0]
    gain = 0.0
    for k, (_, power, _) in enumerate(parts):
        others = np.mean([p for j, (_, p, _) in enumerate(parts) if j != k], axis=0)
        white, variance, tau, alone = _fit(
            f, others, (_PARTS - 1) * count, dt, slow, taus)
        base = slow * _spectrum(f, dt, SLOW_TIME)
        with_ou = 2.0 * dt * white + variance * _spectrum(f, dt, tau) + base
        gain += _cost(2.0 * dt * alone + base, power, count) - _cost(with_ou, power, count)
    gain /= 2.0 * x.size
    f, power, count = _binned(x, dt)
    white, variance, tau, alone = _fit(f, power, count, dt, slow, taus)
    if not gain > 0.0:
        white, variance, tau = alone, 0.0, longest
    return ResidualOU(white, variance, tau, gain,
                      _covariance(f, count, dt, slow, (white, variance, tau)))


def _covariance(f: FloatArray, count: FloatArray, dt: float, slow: float,
                at: tuple[float, float, float]) -> FloatArray:
    """Return the inverse of the Fisher information of the logarithms; 0 for an OU not there."""
    white, variance, tau = at
    shape = _spectrum(f, dt, tau)
    flat = np.full(f.size, 2.0 * dt * white)
    density = flat + variance * shape + slow * _spectrum(f, dt, SLOW_TIME) + 1e-300
    hair = 1e-3
    moved = (_spectrum(f, dt, tau * math.exp(hair)) - shape) / hair
    slopes = np.stack([flat, variance * shape, variance * moved]) / density
    # A factor of e where the series does not decide.
    information = (slopes * count) @ slopes.T / _BINS_ALIKE + np.eye(3)
    covariance = np.linalg.inv(information)
    if not variance > 0.0:
        covariance[1:] = covariance[:, 1:] = 0.0
    return np.asarray(covariance)


def innovations(x: FloatArray, dt: float, ou: ResidualOU, slow: float
                ) -> tuple[FloatArray, float]:
    """
    Return the errors of predicting each sample from those before, and what the states add.

    x in V, dt in s, slow in V^2; the second is a variance, V^2, beside that of white noise.
    """
    keep = np.exp(-dt / np.array([ou.tau, SLOW_TIME]))
    variance = np.array([ou.variance, slow])
    added = variance * (1.0 - keep ** 2)
    if not (variance > 0.0).any():
        return x - x.mean(), 0.0
    state = np.diag(variance)
    ones = np.ones(2)
    white = max(ou.white, 1e-6 * float(variance.sum()))
    # Riccati's recursion, until it stands still.
    for _ in range(100_000):
        gain = state @ ones / (ones @ state @ ones + white)
        new = np.outer(keep, keep) * (state - np.outer(gain, ones @ state)) + np.diag(added)
        still = np.abs(new - state).max() <= 1e-10 * float(variance.max())
        state = new
        if still:
            break
    gain = state @ ones / (ones @ state @ ones + white)
    step = np.diag(keep) @ (np.eye(2) - np.outer(gain, ones))
    numerator, denominator = ss2tf(step, (keep * gain)[:, None], -ones[None, :], [[1.0]])
    errors = lfilter(numerator[0], denominator, x)
    return np.asarray(errors, dtype=np.float64), float(ones @ state @ ones)
