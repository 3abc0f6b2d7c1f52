"""
Frequencies of the motors: as their speeds come, else from throttle by a law that is learned.

The law is f = a + b sqrt(u), learned from the noise itself.  A motor in hover gives thrust in
proportion to its speed squared, so that f grows with the square root of throttle where the
controller makes throttle a thrust, and with an offset where it does not.  Each pair of a frequency
at `LOW` and one at `HIGH` is a law; each frame tells how much of its noise a notch at each
frequency would take away; a law is as good as the share of all noise so far that it would have
taken away, old frames forgotten.  The best one is in force: a median of the data would follow the
most frequent peak, this follows the loud ones, which are what is to be removed.  No data of the
future enter.

Limits: lines that fold at half the sample rate fall with throttle and are not followed; speeds
of single motors are not told apart.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.online.notch.biquads import HIGHEST
from ou_monitor.records import FloatArray

NAN = math.nan
# A speed that has changed so often, and then not for so many mean times between changes (and
# never less than s), has stopped coming: no motor in flight holds its speed to the last digit.
_CHANGES, _FROZEN, _LEAST = 20, 50.0, 1.0


class MotorSpeeds:
    """Newest speeds of the motors (per_unit: Hz for one of what comes; stale_after in s)."""

    def __init__(self, per_unit: float, stale_after: float) -> None:
        self._per_unit, self._stale_after = per_unit, stale_after
        self._speeds: list[float] = []
        self._heard = self._changed = self._first = -math.inf
        self._changes = 0

    def configure(self, per_unit: float, stale_after: float) -> None:
        """Change the unit, and the age that is too old, s."""
        if per_unit != self._per_unit:
            self._speeds = []
        self._per_unit, self._stale_after = per_unit, stale_after

    def take(self, t: float, values: Sequence[float]) -> None:
        """Take what came at t, s; nothing that is a number: nothing came."""
        speeds = [abs(one) * self._per_unit if math.isfinite(one) else NAN for one in values]
        if all(one != one for one in speeds):
            return
        if self._first == -math.inf or t < self._heard:
            self._first, self._changes = t, 0
            self._changed = t
        elif any(one != other for one, other in zip(speeds, self._speeds)
                 if one == one or other == other):
            self._changes += 1
            self._changed = t
        self._speeds, self._heard = speeds, t

    def now(self, t: float, most: int) -> list[float]:
        """Return the speeds of at most so many groups of motors, Hz; empty: not known."""
        if not most or not t - self._heard <= self._stale_after:
            return []
        if self._changes >= _CHANGES:
            usual = (self._changed - self._first) / self._changes
            if t - self._changed > max(_FROZEN * usual, _LEAST):
                return []
        if len(self._speeds) <= most:
            return self._speeds
        # Places of motors that are not there stay 0.
        known = sorted(one for one in self._speeds if one > 0.0)
        if len(known) <= most:
            return known
        # Neighbours in speed share a notch.
        edges = [round(k * len(known) / most) for k in range(most + 1)]
        return [sum(known[a:b]) / (b - a) for a, b in zip(edges, edges[1:])]


# Square roots of throttle at which a law is told: the middle of what is flown.
LOW, HIGH = 0.4, 0.85
_GRID = 48
# Width of the notch that weighs the laws, over frequency.
_WIDTH = 0.5
# s over which frames are forgotten: the speed at one throttle falls with the charge, in minutes.
_MEMORY = 30.0
# Share of noise that the prior gives to the law f ~ sqrt(u), frames that it counts for, and
# its spread in a / f(HIGH).
_PRIOR, _FRAMES, _SPREAD = 0.1, 8.0, 0.3


class MotorLaw:
    """The law in force, `a` and `b` in Hz, NaN while not known, and all others (all in Hz)."""

    def __init__(self, frequencies: FloatArray, fmin: float, rate: float) -> None:
        highest = HIGHEST * rate
        self._grid: FloatArray = np.geomspace(fmin, max(highest, fmin * 1.01), _GRID)
        warped = np.tan(np.pi * np.minimum(frequencies / rate, 0.499))
        off = warped[None, :] / np.tan(np.pi * self._grid / rate)[:, None]
        cut = (_WIDTH * off)**2
        self._removed: FloatArray = cut / ((1.0 - off * off)**2 + cut)
        at_low, at_high = np.meshgrid(self._grid, self._grid, indexing='ij')
        rising = at_high >= at_low * (1.0 - 1e-9)
        self._low, self._high = at_low[rising], at_high[rising]
        self._b = (self._high - self._low) / (HIGH - LOW)
        self._a = self._low - self._b * LOW
        off = self._a / (_SPREAD * self._high)
        self._prior: FloatArray = _FRAMES * _PRIOR * np.exp(-0.5 * off**2)
        self._found: FloatArray = np.zeros_like(self._low)
        self._log = (np.log(self._grid[0]), np.log(self._grid[1] / self._grid[0]))
        self.a = self.b = np.nan

    def frequency(self, root: float) -> float:
        """Return the frequency at a square root of throttle, Hz."""
        return float(self.a + self.b * root)

    def learn(self, power: FloatArray, root: float, passed: float,
              lost: float) -> None:
        """
        Take a frame.

        power: share of the usual noise in each bin, summed over the channels, shape (K,);
        passed in s; lost: factor by which what was counts for less.
        """
        keep = float(np.exp(-passed / _MEMORY))
        removed = self._removed @ power
        f = self._a + self._b * root
        place = np.clip((np.log(np.maximum(f, self._grid[0])) - self._log[0]) / self._log[1],
                        0.0, _GRID - 1.001)
        whole = place.astype(np.intp)
        part = place - whole
        got = removed[whole] * (1.0 - part) + removed[whole + 1] * part
        # Outside the grid there is no notch.
        got = np.where((f >= self._grid[0] * 0.999) & (f <= self._grid[-1] * 1.001), got, 0.0)
        self._found = keep * lost * self._found + got
        score = self._found + self._prior
        best = int(np.argmax(score))
        # Around the best one all that are nearly as good: the mean is finer than the grid.
        near = score - 0.98 * score[best]
        near = np.where((near > 0.0)
                        & (np.abs(np.log(self._low / self._low[best])) < 2.5 * self._log[1])
                        & (np.abs(np.log(self._high / self._high[best])) < 2.5 * self._log[1]),
                        near, 0.0)
        total = float(np.sum(near))
        low, high = (float(np.sum(near * one)) / total for one in (self._low, self._high))
        self.b = (high - low) / (HIGH - LOW)
        self.a = low - self.b * LOW
