"""
The way of a cutoff over many samples: slewing, smoothing, at its aim.

The distance to the aim, in ln(cutoff), falls on a line while it slews and as exp(-t / constant)
behind: where the one gives way to the other is found by search, and the samples of a stretch
come from its two numbers, all stretches at once.
"""

from __future__ import annotations

from bisect import bisect_left
import math

import numpy as np
from ou_monitor.records import FloatArray

# A rest of the way, in ln(cutoff), that is not worth a step.
ARRIVED = 1e-6


class CutoffWay:
    """
    Stretches of one way.

    Parameters
    ----------
    elapsed : ndarray, shape (n + 1,)
        Time before each sample, and at the end, s.
    dt : ndarray, shape (n,)
        Time of each sample, s.
    most : float
        Slew limit, 1/s.

    Attributes
    ----------
    slewing : bool or None
        Whether the last move was cut by the slew limit; None: there was no move.

    """

    def __init__(self, elapsed: FloatArray, dt: FloatArray, most: float) -> None:
        self.slewing: bool | None = None
        self._elapsed, self._dt, self._most = elapsed, dt, most
        # Floats of Python one by one, without a list of all.
        self._time: memoryview[float] = elapsed.data  # type: ignore[assignment]
        self._shortest, self._longest = float(dt.min()), float(dt.max())
        self._bounds: dict[float, tuple[float, float]] = {}
        # Of each stretch: first sample, ln of the aim, distance, its line's slope and its rate.
        self._first: list[int] = []
        self._parts: list[tuple[float, float, float, float]] = []

    def go(self, first: int, last: int, aim: float, gap: float, constant: float) -> float:
        """Go from a distance to an aim, Hz, over samples first..last - 1; return what is left."""
        time, most, end = self._time, self._most, math.log(aim)
        bounds = self._bounds.get(constant)
        if bounds is None:
            bounds = self._bounds[constant] = (
                self._limit(self._shortest, constant), self._limit(self._longest, constant))
        low, high = bounds
        k = first
        while k < last and gap:
            far, now = abs(gap), time[k]
            line = rate = 0.0
            if far > high * (1.0 + 1e-12):
                self.slewing = True
                line = math.copysign(most, gap)
                after = bisect_left(time, now + (far - high) / most, k + 1, last)
                left = gap - line * (time[after] - now)
            elif far > low * (1.0 - 1e-12):
                # Steps of one length are cut, of another not.
                after, dt = k + 1, float(self._dt[k])
                self.slewing = far > self._limit(dt, constant)
                if self.slewing:
                    line = math.copysign(most, gap)
                    left = gap - line * dt
                else:
                    rate = 1.0 / constant if constant > 0.0 else 0.0
                    left = gap * math.exp(-rate * dt) if constant > 0.0 else 0.0
            else:
                self.slewing = False
                if constant <= 0.0:
                    gap = 0.0
                    break
                rate, after = 1.0 / constant, last
                left = gap * math.exp(-rate * (time[last] - now))
                if abs(left) < ARRIVED:
                    after = bisect_left(time, now + constant * math.log(far / ARRIVED),
                                        k + 1, last)
                    left = 0.0
            if abs(left) < ARRIVED:
                # The last of them is at the aim.
                left, after = 0.0, after - 1
            if after > k:
                self._first.append(k)
                self._parts.append((end, gap, line, rate))
            gap, k = left, after
        if k < last and not gap:
            self._first.append(k)
            self._parts.append((end, 0.0, 0.0, 0.0))
        return gap

    def cutoff(self) -> FloatArray:
        """Return the cutoff at each sample, Hz, shape (n,)."""
        n = self._dt.size
        parts = np.array(self._parts)
        first = np.array(self._first)
        if not parts[:, 1].any():
            return np.repeat(np.exp(parts[:, 0]), np.diff(first, append=n))
        sizes = np.diff(first, append=n)
        aim, gap, line, rate = (np.repeat(one, sizes) for one in parts.T)
        gone = self._elapsed[1:] - np.repeat(self._elapsed[first], sizes)
        rate *= -gone
        line *= gone
        gap *= np.exp(rate)
        gap -= line
        aim -= gap
        return np.asarray(np.exp(aim, out=aim))

    def _limit(self, dt: float, constant: float) -> float:
        """Return the distance beyond which a step is cut by the slew limit."""
        if math.isinf(self._most):
            return math.inf
        return self._most * dt / (-math.expm1(-dt / constant) if constant > 0.0 else 1.0)
