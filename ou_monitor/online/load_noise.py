"""
White noise of a supply under load: its variance, and what successive innovations say.

ln variance = b . (1, ripple(u), sqrt|du|), learned by Fisher scoring; of a mean of n samples the
part that scatters within a block counts 1/n.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.model.load import ripple
from ou_monitor.records import FloatArray

# Standard scores beyond this are weighed down; they score this much, squared, in the noise.
CLIP, _OUTLIER = 4.0, 16.0
# Variance of a prediction, V^2, beyond which a filter has left the ground, as after a sensor that
# said megavolts: it begins anew.
DIVERGED = 1e12
# Voltages that differ by less, V, are one reading of an ADC.
_SAME = 1e-6
# A change of throttle below that is none.
_HELD = 1e-3
# Corrections after which the noise is forgotten; at first sooner, by a third of all so far, as the
# coefficients are wrong then.
_MEMORY, _FIRST, _SHARE = 2000.0, 50.0, 1.0 / 3.0


class LoadNoise:
    """Noise of blocks of samples of a pack of `volts`, V."""

    def __init__(self, volts: float, b: tuple[float, float, float] | None = None) -> None:
        # 0.4 % of the voltage, and what ripple and changes of throttle usually add; or as it
        # was in another flight, to a factor of 1.4 in the deviation.
        self.b = np.array([math.log((0.004 * volts) ** 2), 2.0, 4.0] if b is None else b)
        self._covariance = np.diag([4.0, 4.0, 9.0] if b is None else [0.5, 0.5, 1.0])
        # Of the standard scores: mean square, and correlation from one to the next.
        self.scale, self.correlation = 1.0, 0.0
        self._last, self._n = 0.0, 0
        # Step of the ADC, V, and share of the blocks that are another value than the one before.
        self._step, self._changing, self._held = math.inf, 1.0, math.nan
        self._unseen = (0.05 * volts) ** 2
        # Samples in a block, the variance within one, and that of its mean, V^2.
        self._size, self._within, self._between = 1.0, 0.0, 0.0

    def variance(self, u: float, du: float, n: int) -> float:
        """Return the variance of a mean of n samples, V^2."""
        whole = math.exp(float(self.b[0] + self.b[1] * ripple(u) + self.b[2] * math.sqrt(du)))
        return whole + self._within * max(0.0, 1.0 / n - 1.0 / self._size)

    @property
    def log_variance(self) -> tuple[float, float, float]:
        """Return b of a single sample."""
        own = 1.0
        if self._between > 0.0:
            own += self._within * (1.0 - 1.0 / self._size) / self._between
        least = 0.0 if math.isinf(self._step) else self._step ** 2 / 12.0
        whole = math.exp(float(self.b[0])) * own + least
        return math.log(whole), float(self.b[1]), float(self.b[2])

    @property
    def of_blocks(self) -> tuple[float, float, float]:
        """Return b of the mean of a block."""
        return float(self.b[0]), float(self.b[1]), float(self.b[2])

    def see(self, voltage: float) -> None:
        """Look at the steps of the ADC in the means of blocks, V."""
        step = abs(voltage - self._held)
        self._held = voltage
        changed = step > _SAME
        if changed:
            self._step = min(self._step, step)
        self._changing += max(0.002, 1.0 / (self._n + 20.0)) * (changed - self._changing)

    @property
    def rounding(self) -> float:
        """Return the variance of rounding, V^2; of a value that is held all is one rounding."""
        if math.isinf(self._step):
            # It has never changed: the step may be anything.
            return self._unseen
        return self._step ** 2 / 12.0 / max(self._changing, 0.002)

    def follow(self, score: float) -> None:
        """Take a clipped standard score: innovations in a row on one side are no news."""
        self.correlation += max(0.002, 1.0 / (self._n + 50.0)) * (
            score * self._last - self.correlation)
        self.correlation = max(0.0, min(0.9, self.correlation))
        self._last = score
        self._n += 1

    def learn(self, e: float, s: float, u: float, du: float, n: int, within: float) -> None:
        """
        Score ln variance (Fisher) by one innovation.

        e in V; s, the variance of what is predicted, and `within`, that of one of the n samples
        about their mean (NaN: unknown), in V^2.
        """
        f: FloatArray = np.array([1.0, ripple(u), math.sqrt(du)])
        R = self.variance(u, du, n)
        square = min(e * e / (s + R), _OUTLIER)
        # What the state does not know is not noise.
        share = max(R / (s + R), 0.05)
        C = self._covariance
        C *= 1.0 + 1.0 / min(_MEMORY, _FIRST + _SHARE * self._n)
        g = C @ f
        own = float(f @ g)
        # The square of a standard normal has the variance 2.
        total = own + 2.0 / share ** 2
        self.b += g * min((square - 1.0) / share / total, 0.7 / own)
        C -= np.outer(g, g) / total
        C *= min(1.0, 9.0 / float(C.diagonal().max()))
        weight = max(0.002, 1.0 / (self._n + 20.0))
        self.scale += weight * (square - self.scale)
        self._size += weight * (n - self._size)
        if n > 1 and du < _HELD:
            self._within += weight * (within - self._within)
            self._between += weight * (math.exp(float(f @ self.b)) - self._between)
