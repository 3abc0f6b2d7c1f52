"""
How late the throttle is, behind the voltage that answers to it.

The answer, over what is faster than a second, is compared with throttles that are 0 to 200 ms
late; the largest correlation wins.  Limits first: a source slower than 7 Hz cannot tell, and a
delay is taken only where it leaves a quarter less of the variance than the present one.
"""

from __future__ import annotations

from collections import deque
import math

import numpy as np
from ou_monitor.online.supply_load import POWER
from ou_monitor.records import FloatArray

DELAYS: FloatArray = np.array([0.0, 0.05, 0.1, 0.15, 0.2])  # s
# What is slower than this, s, is no answer to a stick but discharge and recovery.
_SLOW = 1.0
# A third of the answer lags by 60 ms: the prior of the filter.
_SHARE, _LAG = 1.0 / 3.0, 0.06
# Time compared, s, before a first answer, and memory, s.
_FIRST, _MEMORY = 10.0, 60.0
# Residual variance of another delay over that of the present one at which it is taken.
_BETTER = 0.75
# Time, s, for which it must be so.
_LASTING = 3.0
# Pieces of a test of relation, s: answers in them are as good as independent; memory, s; fewest.
_PIECE, _PIECES_MEMORY, _FEWEST = 2.0, 120.0, 5.0
# A load that moves less than this, rms, tells of no relation.
_MOVED = 0.01
# Standard errors of a relation: one false alarm in 700 looks.
_SIGNIFICANT = 3.0
# Longest step between blocks, s, that tells these delays apart.
_LONGEST = 0.15


class LoadDelay:
    """Running correlations of voltage and load at several delays."""

    def __init__(self, delay: float = 0.0) -> None:
        self.delay = float(DELAYS[np.argmin(np.abs(DELAYS - delay))])
        self.forget()

    def forget(self) -> None:
        """Begin anew after a break in time; the delay stays."""
        self._t = math.nan
        self._past: deque[tuple[float, float]] = deque()
        self._seen = self._better = 0.0
        self._xx = 0.0
        self._xv, self._vv = np.zeros(DELAYS.size), np.zeros(DELAYS.size)
        # Of the piece that fills: time, load squared, products, voltage squared; of the
        # correlations of whole pieces: weight, sums and sums of squares.
        self._filled, self._own = 0.0, np.zeros((3, DELAYS.size))
        self._pieces, self._sum, self._squares = 0.0, self._xv * 0.0, self._xv * 0.0

    def take(self, t: float, v: float, u: float) -> bool:
        """Take a block, s, V, 0..1 as it was heard; return whether the delay is another one."""
        dt = t - self._t
        if not 0.0 < dt <= _LONGEST:
            self.forget()
        if math.isnan(self._t):
            self._t, self._load, self._slow_load, self._slow_volts = t, u ** POWER, u ** POWER, v
            return False
        self._t = t
        x = u ** POWER
        self._load = x + (self._load - x) * math.exp(-dt / _LAG)
        x += _SHARE * (self._load - x)
        keep = math.exp(-dt / _SLOW)
        self._slow_load = x + (self._slow_load - x) * keep
        self._slow_volts = v + (self._slow_volts - v) * keep
        x -= self._slow_load
        past = self._past
        past.append((t, v - self._slow_volts))
        while len(past) > 1 and past[1][0] <= t - DELAYS[-1]:
            past.popleft()
        times, volts = zip(*past)
        then = np.array(volts)[np.maximum(np.searchsorted(times, t + 1e-6 - DELAYS, 'right') - 1,
                                          0)]
        forgotten = 1.0 - dt / _MEMORY
        self._xx = self._xx * forgotten + x * x * dt
        self._xv = self._xv * forgotten + then * (x * dt)
        self._vv = self._vv * forgotten + then * then * dt
        self._filled += dt
        self._own += np.stack((np.full(DELAYS.size, x * x), x * then, then * then)) * dt
        if self._filled >= _PIECE:
            xx, xv, vv = self._own
            if xx[0] > _MOVED ** 2 * self._filled:
                r = xv / np.sqrt(np.maximum(xx * vv, 1e-300))
                keep = 1.0 - _PIECE / _PIECES_MEMORY
                self._pieces = self._pieces * keep + 1.0
                self._sum = self._sum * keep + r
                self._squares = self._squares * keep + r * r
            self._filled, self._own = 0.0, np.zeros((3, DELAYS.size))
        # The load must have changed, by a stick and not by rounding.
        self._seen += dt * (x * x > 1e-6)
        return self._seen >= _FIRST and self._choose(dt)

    @property
    def unrelated(self) -> bool:
        """Whether the correlations in pieces of 2 s are not below zero, by a t-test."""
        if self._pieces < _FEWEST:
            return False
        now = int(np.searchsorted(DELAYS, self.delay - 1e-9))
        mean = self._sum[now] / self._pieces
        variance = self._squares[now] / self._pieces - mean * mean
        return bool(mean > -_SIGNIFICANT * math.sqrt(max(0.0, variance) / (self._pieces - 1.0)))

    def _choose(self, dt: float) -> bool:
        left = 1.0 - np.minimum(self._xv, 0.0) ** 2 / np.maximum(self._xx * self._vv, 1e-300)
        best = int(np.argmin(left))
        now = int(np.searchsorted(DELAYS, self.delay - 1e-9))
        self._better = self._better + dt if left[best] < _BETTER * left[now] else 0.0
        if self._better < _LASTING:
            return False
        self._better = 0.0
        self.delay = float(DELAYS[best])
        return True
