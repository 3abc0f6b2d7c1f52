"""
Blocks of samples at one throttle: their means, and the squares of their innovations.

Limits: throttle is taken as constant within what is pooled; the innovations are those of an OU
with white noise, with alpha and noise from the estimate.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.records import Estimate, FloatArray

# Throttles closer than this are one.
STEADY = 0.03
# Relative variance of sigma^2 at which its logarithm is taken, and up to which it may be.
_SHARP = 0.1
_BLUNT = 0.35
# Fewest squares of one block.
_SQUARES = 8


def noise_variance(e: Estimate) -> float:
    """Return the variance of the white noise of a sample, V^2; 0 when unknown."""
    return e.noise_std ** 2 if e.noise_std > 0.0 else 0.0


class Pool:
    """Means of blocks at one throttle."""

    def __init__(self) -> None:
        self.n = 0
        self.begin = self.end = self.time = 0.0
        self.voltage = self.throttle = self.apart = 0.0

    def add(self, n: int, begin: float, end: float, dt: float, voltage: float, throttle: float,
            apart: float) -> None:
        """Add a block of n samples."""
        if not self.n:
            self.begin = begin
        self.n += n
        self.end = end
        self.time += n * dt
        share = n / self.n
        self.voltage += share * (voltage - self.voltage)
        self.throttle += share * (throttle - self.throttle)
        self.apart += share * (apart - self.apart)


class Squares:
    """Squares of innovations, until there are enough for a logarithm."""

    def __init__(self) -> None:
        self._sum = self._weight = self._throttle = self._time = 0.0
        self._worse = 1.0

    def add(self, t: FloatArray, v: FloatArray, throttle: float, dt: float, e: Estimate,
            even: bool, sigma: float) -> None:
        """
        Add a block, as an estimate of sigma^2 with its relative variance; `sigma` is expected.

        Innovations over k steps, e_j = v_j - phi^k v_{j-k} less their mean, have variance
        g + N: g = sigma^2 (1 - phi^2k) / (2 alpha), N = noise^2 (1 + phi^2k).  k is 1 unless
        noise would hide sigma.  `even` when no sample is missing between the stamps.
        """
        n, noise = t.size, noise_variance(e)
        k = 1
        if noise > 0.0:
            k = max(1, min(math.ceil(min(2.0 * noise / (sigma ** 2 * dt), n)), n // 4,
                           int(1.0 / (e.alpha * dt))))
        later, earlier = v[k:], v[:-k]
        step = k * dt
        if not even:
            # Samples were lost, maybe: only pairs that are k steps apart.
            lag = t[k:] - t[:-k]
            usual = float(np.median(lag))
            regular = np.abs(lag - usual) < 0.5 * usual / k
            later, earlier = later[regular], earlier[regular]
            step = float(lag[regular].mean()) if later.size else usual
        m = later.size
        if m - k < _SQUARES:
            return
        phi = math.exp(-e.alpha * step)
        parts = later - phi * earlier
        total = float(parts.sum())
        per_sigma2 = (1.0 - phi * phi) / (2.0 * e.alpha)
        hidden = noise * (1.0 + phi * phi)
        # The mean of overlapping innovations takes k squares of g with it.
        g = (float(parts @ parts) - total * total / m - m * hidden
             + noise * (1.0 - phi) ** 2) / (m - k)
        expected = sigma ** 2 * per_sigma2
        share = expected / (expected + hidden)
        alike = 1.0 + share ** 2 * (k - 1) * (2 * k - 1) / (3.0 * k) + (
            2.0 * ((1.0 - share) * phi / (1.0 + phi * phi)) ** 2)
        weight = 0.5 * (m - k) * share ** 2 / alike
        self._sum += weight * g / per_sigma2
        self._throttle += weight * throttle
        self._weight += weight
        self._time += n * dt
        # Noise that is wrong, or was not found, weighs more where sigma is less than in the
        # window as a whole.
        self._worse = max(self._worse, (e.sigma / sigma) ** 2)

    def take(self, e: Estimate, throttle: float) -> tuple[float, float, float] | None:
        """
        Return throttle, ln(sigma) and its variance, when there are enough squares.

        The logarithm of a mean of squares is too low by half its relative variance.  What the
        estimate says of its own ln(sigma) holds here too, time for time: it has the errors of
        alpha and of the noise in it.
        """
        if not self._weight:
            return None
        relative = 1.0 / self._weight
        at = self._throttle / self._weight
        away = abs(at - throttle) > STEADY
        if relative > _SHARP and not away:
            return None
        mean, time, worse = self._sum / self._weight, self._time, self._worse
        self._worse = 1.0
        self._sum = self._weight = self._throttle = self._time = 0.0
        if relative > _BLUNT or mean <= 0.0:
            return None
        variance = 0.25 * relative
        # What was expected may be wrong, as at a throttle not flown before.
        worse = max(worse, e.sigma ** 2 / mean)
        if e.sigma_se > 0.0 and time > 0.0:
            variance = max(variance, (worse * e.sigma_se) ** 2 * e.duration / time)
        return at, 0.5 * (math.log(mean) + 0.5 * relative), variance
