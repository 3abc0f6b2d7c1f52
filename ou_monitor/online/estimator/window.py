"""
The readings of a sliding window: store them, average those of a fast source, lag the throttle.

Limits: if a source changes its step by a third or more, the window restarts with other blocks.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.records import FloatArray, NAN
from ou_monitor.timeline import BATCH, Batch

# Time constants, s, with which the load may follow throttle: motors follow the command within
# 5 to 20 ms, and the current settles within 40 ms (doc/estimation.md).
LOAD_LAGS = (0.010, 0.040)
# After this long without a change of throttle all lags have settled, s.
LOOK_BACK = 16.0 * LOAD_LAGS[1]

# Maximum exponent; exp(_SPAN) is far below the largest double.
_SPAN = 300.0
# Difference from the throttle below which a lagged throttle has settled.
_SETTLED = 1e-7
# Minimum samples to determine the rate.
MIN_FOR_RATE = 8
# A step that differs from the usual one by more than this share breaks the run.
UNEVEN = 0.5
# The usual step is measured again when a batch's median differs by this factor.
NEW_RATE = 1.3
# Number of stamps kept from batch to batch for that median.
MEMORY = 32
# Maximum samples per block, for sources up to 10 MHz; stamps that are closer are invalid.
MOST_BLOCK = 1000.0


class Kept:
    """The newest readings in columns; row 0 holds the stamps, s.  Old ones are dropped."""

    def __init__(self, rows: int) -> None:
        self._store = np.empty((rows, 1024))
        self._size = 0

    @property
    def columns(self) -> FloatArray:
        """Return what is kept, shape (rows, n); a view."""
        return self._store[:, :self._size]

    def cut(self, size: int) -> None:
        """Forget all but the first `size` readings."""
        self._size = size

    def append(self, columns: FloatArray, reach: float, most: int = 1 << 62) -> None:
        """Add readings; keep those of the last `reach` seconds, but no more than `most`."""
        count = columns.shape[1]
        if self._size + count > self._store.shape[1]:
            # One more, to show that there are data before the window.
            first = max(0, int(np.searchsorted(
                self.columns[0], columns[0, -1] - reach)) - 1, self._size + count - most - 1)
            old = self.columns[:, first:]
            self._store = np.empty((len(old), 2 * (old.shape[1] + count)))
            self._size = old.shape[1]
            self._store[:, :self._size] = old
        self._store[:, self._size:self._size + count] = columns
        self._size += count


def lagged(t: FloatArray, u: FloatArray, tau: float) -> FloatArray:
    """Return a first-order lag of the throttle, exact for held input (t, tau in s)."""
    unknown = np.isnan(u)
    if 0 < np.count_nonzero(unknown) < u.size:
        place = np.maximum.accumulate(np.where(unknown, -1, np.arange(u.size)))
        filled = u[np.where(place < 0, np.flatnonzero(~unknown)[0], place)]
        out = lagged(t, filled, tau).copy()
        out[unknown] = math.nan
        return out
    t0, u0 = float(t[0]), float(u[0])
    state = u0
    out = np.empty_like(u)
    begin = 0
    while begin < t.size:
        end = t.size
        if float(t[-1]) - t0 > _SPAN * tau:
            end = max(int(np.searchsorted(t, t0 + _SPAN * tau)), begin + 1)
        weight = np.exp(np.minimum((t[begin:end] - t0) / tau, 2.0 * _SPAN))
        gain = weight.copy()
        gain[0] -= 1.0
        gain[1:] -= weight[:-1]
        gain[0] *= u0
        gain[1:] *= u[begin:end - 1]
        np.add.accumulate(gain, out=gain)
        gain += state
        np.divide(gain, weight, out=out[begin:end])
        t0, u0, state = float(t[end - 1]), float(u[end - 1]), float(out[end - 1])
        begin = end
    near = np.abs(out - u) < _SETTLED
    out[near] = u[near]
    return out


class Thinner:
    """Learns the rate of the source, and averages blocks of m samples beyond `fastest`, Hz."""

    def __init__(self, fastest: float) -> None:
        self._fastest = fastest
        self.m = 0
        self.step = NAN
        self.forget()

    def forget(self) -> None:
        """Take the next samples as the first ones; the rate stays known."""
        self._rest = np.empty((3, 0))
        self._stamps = np.empty(0)

    def waiting(self, since: float) -> FloatArray:
        """Return the stamps, not before `since`, that wait for the rate or for a whole block."""
        stamps: FloatArray = self._rest[0]
        return stamps[stamps >= since]

    def take(self, batch: Batch) -> tuple[FloatArray, bool]:
        """Return stamps, voltage and throttle to keep, and whether they begin anew."""
        t = batch.t
        columns = batch.columns[:3]
        restart = False
        even = self._is_even(batch.shortest) and self._is_even(batch.longest)
        if not even:
            restart = self._learn(np.concatenate([self._stamps, t]))
        if t.size >= MEMORY:
            self._stamps = t[-MEMORY:].copy()
        else:
            self._stamps = np.concatenate([self._stamps, t])[-MEMORY:]
        columns = np.concatenate([self._rest, columns], axis=1)
        if self.m == 0:
            self._rest = columns
            return columns[:, :0], False
        if self.m > 1:
            return self._blocks(columns), restart
        self._rest = columns[:, :0]
        return columns, restart

    def _is_even(self, step: float) -> bool:
        return abs(step - self.step) <= UNEVEN * self.step

    def _learn(self, stamps: FloatArray) -> bool:
        """Update the usual step; return whether the block size changed."""
        if stamps.size < MIN_FOR_RATE:
            return False
        step = float(np.median(np.diff(stamps[-BATCH:])))
        if self.m and self.step / NEW_RATE < step < self.step * NEW_RATE:
            return False
        before, self.step = self.m, step
        self.m = max(1, round(min(1.0 / step / self._fastest, MOST_BLOCK)))
        return before not in (0, self.m)

    def _blocks(self, columns: FloatArray) -> FloatArray:
        """Average whole blocks; an incomplete block waits, or is dropped before a break."""
        m = self.m
        gaps = np.flatnonzero(np.abs(np.diff(columns[0]) - self.step) > UNEVEN * m * self.step) + 1
        parts = []
        for part in np.split(columns, gaps, axis=1):
            whole = part.shape[1] // m
            parts.append(part[:, :whole * m].reshape(3, whole, m).mean(axis=2))
            self._rest = part[:, whole * m:].copy()
        return np.concatenate(parts, axis=1)
