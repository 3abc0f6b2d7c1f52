"""
How much an intensity wanders: a random walk whose speed is learned with it.

A bank of scalar Kalman filters, one for each speed, weighted by how well each has
foretold what came (multiple models; Magill, IEEE Trans. Autom. Control 10 (1965)
434).  Limits: one speed at a time, the same for all throttles; what is seen of it
is forgotten over minutes.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.records import FloatArray

# Speeds that are weighed: variance gained per second.  From a rail that stays as it is to
# one whose sigma changes by a quarter within a second.
_SPEEDS = np.array([0.0, 1e-4, 5e-4, 2e-3, 8e-3, 3e-2])
# What is believed before any data.
_PRIOR = np.array([0.15, 0.2, 0.2, 0.2, 0.15, 0.1])
# Time over which what was seen is forgotten, s.
_MEMORY = 120.0
# An observation further off than this many standard deviations counts as that far.
_FAR = 4.0
# Variance before any data: twofold either way is common.
_WIDE = 0.5


class Wander:
    """
    A level that walks at random, seen through noise.

    Attributes
    ----------
    value, variance : float
        Where it is by all that has been seen, and how well that is known.
    speed : float
        Variance that it gains per second, as far as is known.
    fast_speed : float
        The same, the faster of what may be counted more.

    """

    def __init__(self) -> None:
        self._mean = np.zeros(_SPEEDS.size)
        self._variance = np.full(_SPEEDS.size, _WIDE)
        self._log = np.log(_PRIOR)
        self._weight: FloatArray = _PRIOR.copy()

    def elapse(self, dt: float) -> None:
        """Let time go by, s."""
        self._variance += _SPEEDS * dt
        # Towards the first belief.
        keep = math.exp(-dt / _MEMORY)
        self._log = keep * self._log + (1.0 - keep) * np.log(_PRIOR)
        self._weigh()

    def correct(self, seen: float, variance: float) -> None:
        """Take an observation."""
        total = self._variance + variance
        away = np.clip((seen - self._mean) / np.sqrt(total), -_FAR, _FAR)
        gain = self._variance / total
        self._mean += gain * away * np.sqrt(total)
        self._variance *= 1.0 - gain
        self._log -= 0.5 * (away * away + np.log(total))
        self._weigh()

    def _weigh(self) -> None:
        self._log -= self._log.max()
        weight = np.exp(self._log)
        self._weight = weight / weight.sum()

    @property
    def value(self) -> float:
        """Where it is."""
        return float(self._weight @ self._mean)

    @property
    def variance(self) -> float:
        """How well `value` is known, the filters' disagreement included."""
        return float(self._weight @ (self._variance + (self._mean - self.value) ** 2))

    @property
    def speed(self) -> float:
        """Return the variance that it gains per second."""
        return float(self._weight @ _SPEEDS)

    @property
    def fast_speed(self) -> float:
        """Return the same where the faster count by their speed, as tails feel them."""
        speed = self.speed
        return float(self._weight @ _SPEEDS**2) / speed if speed > 0.0 else 0.0
