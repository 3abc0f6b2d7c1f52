"""
An Ornstein-Uhlenbeck process and white noise in what a model leaves over.

Whittle's likelihood of the periodogram, in bins of frequency; what has another law than the
normal, or an intensity that changes, keeps the spectrum and so the estimate, not its error.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.records import FloatArray
from scipy.optimize import minimize
from scipy.signal import lfilter, periodogram, ss2tf

# Time constant of what a load model takes for its own slow error, s.
SLOW_TIME = 20.0
# Relaxation below so many steps is white, and above this share of the part is drift.
_FASTEST, _LONGEST = 2.0, 0.1
# Relaxation times tried, bins of frequency, and parts for cross-validation.
_TRIED, _BINS, _PARTS = 12, 120, 4
_TINY = 1e-12
# A Hann window makes neighbouring ordinates alike: so many count as one (Percival & Walden 1993).
_ALIKE = 35.0 / 18.0
# Logarithms are not drawn farther than this from their estimates.
_FARTHEST = 2.0


@dataclass(frozen=True, eq=False)
class ResidualOU:
    """
    What is in a series beside a slow process that is given.

    Attributes
    ----------
    white : float
        Variance of white noise, V^2.
    variance : float
        Stationary variance of the OU, V^2; 0 where none is visible.
    tau : float
        Its relaxation time, s.
    gain : float
        What it adds to the log-likelihood of parts left out, nats a sample.
    covariance : ndarray, shape (3, 3)
        Covariance of the logarithms of white, variance and tau.

    """

    white: float
    variance: float
    tau: float
    gain: float
    covariance: FloatArray

    def draw(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """Return white, variance and tau within their errors."""
        off = np.clip(rng.multivariate_normal(np.zeros(3), self.covariance), -_FARTHEST, _FARTHEST)
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
    information = (slopes * count) @ slopes.T / _ALIKE + np.eye(3)
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
