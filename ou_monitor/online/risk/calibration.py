"""
A flight's own law of the lowest voltage of a horizon, from horizons that are complete.

(lowest - start) / s = b0 + b1 (mu - start) / s + k e with mean mu and deviation s as the load
filter has them: least squares that forget, e of Student's t with five degrees of freedom.
Now and then a law is wrong: a share of horizons is then as the excursions are.  That share is
counted with the rule of succession, each horizon as likely as the two make it.
Overlapping horizons count as step / horizon each.

Limits: one bias and one gain for all throttles; between two horizons all is interpolated.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.records import FloatArray
from scipy.special import stdtr

# Degrees of freedom: tails of a model that is wrong now and then.
FREEDOM = 5.0
_NORM = math.exp(math.lgamma(0.5 * FREEDOM + 0.5) - math.lgamma(0.5 * FREEDOM)) / math.sqrt(
    math.pi * (FREEDOM - 2.0))
# Horizons' worth of the prior, its variance, and the prior of bias and gain.
_PRIOR, _PRIOR_VARIANCE = 5.0, 3.0
_BIAS, _GAIN = 0.5, 0.4
# Memory, s; largest square of a miss that counts; misses beyond 3 deviations weigh less.
MEMORY, _LARGEST, _HUBER = 120.0, 36.0, 3.0
# Error of the model as a share of the drop.
_SHARE = 0.1


def density(x: FloatArray, mean: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return the density of Student's t of that mean and deviation, elementwise."""
    z = (x - mean) / deviation
    return np.asarray(_NORM / deviation * (1.0 + z * z / (FREEDOM - 2.0)) ** (
        -0.5 * (FREEDOM + 1.0)))


def below(level: float, mean: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return P(x < level) of that Student's t, elementwise."""
    return np.asarray(stdtr(FREEDOM, (level - mean) / deviation
                            * math.sqrt(FREEDOM / (FREEDOM - 2.0))))


class LowestLaw:
    """Bias, gain and spread of the lowest voltage: b0, b1, k^2, and the errors of b0 and b1."""

    def __init__(self, values: FloatArray) -> None:
        self.values = values

    def moments(self, mean: FloatArray, deviation: FloatArray, start: float
                ) -> tuple[FloatArray, FloatArray]:
        """Return mean and deviation, V, of the lowest voltage, errors of the law included."""
        bias, gain, variance, c00, c01, c11 = self.values.tolist()
        deviation = np.hypot(deviation, _SHARE * (start - mean))
        x = (mean - start) / deviation
        return start + deviation * (bias + gain * x), deviation * np.sqrt(
            variance + c00 + 2.0 * c01 * x + c11 * x * x)


class Calibrator:
    """Learns a `LowestLaw` from completed horizons."""

    def __init__(self) -> None:
        self._prior = np.diag([_BIAS ** -2, _GAIN ** -2])
        self._first = self._prior @ (0.0, 1.0)
        self._information, self._weighted = self._prior.copy(), self._first.copy()
        self._count = self._squares = 0.0
        self._settle()

    def _settle(self) -> None:
        self._b = np.linalg.solve(self._information, self._weighted)
        self._variance = (_PRIOR * _PRIOR_VARIANCE + self._squares) / (_PRIOR + self._count)
        errors = np.linalg.inv(self._information) * self._variance
        self.law = LowestLaw(np.array([*self._b, self._variance, errors[0, 0], errors[0, 1],
                                       errors[1, 1]]))

    def add(self, low: float, mean: float, deviation: float, start: float, weight: float,
            elapsed: float) -> None:
        """Learn from a completed horizon: lowest, predicted and first voltage, V."""
        deviation = math.hypot(deviation, _SHARE * (start - mean))
        keep = math.exp(-elapsed / MEMORY)
        row = np.array([1.0, (mean - start) / deviation])
        y = (low - start) / deviation
        miss = y - float(row @ self._b)
        least = weight * min(1.0, _HUBER * math.sqrt(self._variance) / max(abs(miss), 1e-9))
        self._count = self._count * keep + weight
        self._squares = self._squares * keep + weight * min(miss * miss, _LARGEST)
        self._information = self._prior + (
            self._information - self._prior) * keep + least * np.outer(row, row)
        self._weighted = self._first + (self._weighted - self._first) * keep + least * y * row
        self._settle()


class FarShare:
    """
    Share of horizons that are not as a law says.

    Parameters
    ----------
    right : float
        Horizons that a law counts as right before any; one counts as wrong.

    """

    def __init__(self, right: float = 1.0) -> None:
        self._right, self._wrong = right, 1.0
        self._first = right

    @property
    def value(self) -> float:
        """Return the share."""
        return self._wrong / (self._wrong + self._right)

    def add(self, law: float, far: float, weight: float, elapsed: float) -> float:
        """Learn from the densities, 1/V, of a lowest voltage; return that of both together."""
        keep = math.exp(-elapsed / MEMORY)
        share = self.value
        both = share * far + (1.0 - share) * law
        wrong = share * far / both if both > 0.0 else 1.0
        self._wrong = 1.0 + (self._wrong - 1.0) * keep + weight * wrong
        self._right = self._first + (self._right - self._first) * keep + weight * (1.0 - wrong)
        return both
