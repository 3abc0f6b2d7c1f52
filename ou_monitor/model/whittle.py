"""
Fits to a periodogram: of all time scales of a recording at once, in milliseconds.

The ordinates of a long series are nearly independent exponentials with the spectrum for their
means (Whittle, Ark. Mat. 2 (1953) 423); in bins they are gamma.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.records import FloatArray

# Ordinates taken one by one, at the slow end, and bins to the octave above.
_SINGLE, _TO_OCTAVE = 16, 10
# Scores beyond this say nothing of a spectrum: outliers.
_FAR = 5.0
# Rounds of scoring, the step of its numerical derivatives, a gain that is none, nats, and how far
# a coordinate moves at once.
_ROUNDS, _STEP, _SETTLED, _MOST = 25, 1e-3, 0.01, 1.0
# Damping of a step at first and at most.
_DAMPED, _STUCK = 1e-3, 1e4


@dataclass(frozen=True, eq=False)
class Ordinates:
    """The periodogram of scores, in bins."""

    # Mean of the ordinates of each bin; 1 for white scores of variance 1; shape (k,).
    power: FloatArray
    count: FloatArray  # Ordinates of each; shape (k,)
    omega: FloatArray  # Middle, radians per sample; shape (k,)

    @classmethod
    def of(cls, z: FloatArray) -> Ordinates:
        """Return those of a series of scores, outliers cut."""
        z = np.clip(z, -_FAR, _FAR)
        power = np.abs(np.fft.rfft(z - z.mean())[1:-1]) ** 2 / z.size
        first = min(_SINGLE, power.size)
        more = max(2, round(_TO_OCTAVE * math.log2(max(power.size / first, 2.0))))
        edges = np.unique(np.concatenate((
            np.arange(first), np.geomspace(first, power.size, more).round())).astype(int))
        total = np.concatenate(([0.0], np.cumsum(power)))
        count = np.diff(edges).astype(np.float64)
        return cls(np.diff(total[edges]) / count, count,
                   np.pi * (edges[:-1] + edges[1:] + 1.0) / z.size)

    def likelihood(self, log: FloatArray) -> float:
        """Return the log-likelihood of a spectrum, given by its logarithm, nats."""
        return -float(self.count @ (log + self.power * np.exp(-log)))

    def climb(self, log_of: Callable[[FloatArray], FloatArray], start: FloatArray
              ) -> tuple[FloatArray, float]:
        """
        Return the coordinates of the likeliest spectrum near a start, and its gain.

        log_of gives the logarithm of a spectrum; the gain is over white scores, nats.
        """
        x = np.asarray(start, dtype=np.float64)
        log = log_of(x)
        value, damping = self.likelihood(log), _DAMPED
        for _ in range(_ROUNDS):
            slopes = np.stack([(log_of(x + step) - log) / _STEP
                               for step in _STEP * np.eye(x.size)], axis=1)
            weighted = self.count[:, None] * slopes
            information = slopes.T @ weighted
            gradient = weighted.T @ (self.power * np.exp(-log) - 1.0)
            scale = np.sqrt(information.diagonal()) + 1e-9
            information = information / np.outer(scale, scale)
            gain = 0.0
            while gain <= 0.0 and damping < _STUCK:
                by = np.linalg.solve(information + damping * np.eye(x.size), gradient / scale)
                move = np.clip(by / scale, -_MOST, _MOST)
                there = log_of(x + move)
                gain = self.likelihood(there) - value
                damping *= 0.1 if gain > 0.0 else 10.0
            if not gain > 0.0:
                break
            x, log, value = x + move, there, value + gain
            if gain < _SETTLED:
                break
        return x, value - self.likelihood(np.zeros(self.power.size))
