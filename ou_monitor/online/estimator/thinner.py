"""
Fast sources: the usual step between samples, and means of blocks of them.

Limits: a source whose step changes by a third or more begins anew with blocks of another size.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.online.estimator.series import IntArray
from ou_monitor.records import FloatArray, NAN
from ou_monitor.timeline.line import BATCH, Batch

# Samples from which the rate is known.
MIN_FOR_RATE = 8
# A step that differs from the usual one by more than this share breaks the run.
UNEVEN = 0.5
# The usual step is taken anew when a batch's median differs by this factor.
NEW_RATE = 1.3
# Stamps remembered for that from batch to batch.
MEMORY = 32
# Samples averaged to one at most: 10 MHz; stamps that lie closer are no time.
MOST_BLOCK = 1000.0
_NONE = np.empty(0, dtype=np.int64)


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
        self._last = -math.inf
        self._continues = False

    def waiting(self, since: float) -> FloatArray:
        """Return the stamps, not before `since`, that wait for the rate or for a whole block."""
        stamps: FloatArray = self._rest[0]
        return stamps[stamps >= since]

    def take(self, batch: Batch
             ) -> tuple[FloatArray, FloatArray, FloatArray | None, IntArray, bool]:
        """Return the samples to keep."""
        t, y, u = batch.t, batch.y, batch.u
        restart = False
        even = self._is_even(batch.shortest) and self._is_even(batch.longest)
        if not even:
            restart = self._learn(np.concatenate([self._stamps, t]))
        if t.size >= MEMORY:
            self._stamps = t[-MEMORY:].copy()
        else:
            self._stamps = np.concatenate([self._stamps, t])[-MEMORY:]
        if self.m == 0:
            self._rest = np.concatenate([self._rest, _stack(t, y, u)], axis=1)
            empty = np.empty(0)
            return empty, empty, empty, _NONE, False
        if self.m > 1 and even:
            return (*self._even_blocks(t, y, u), restart)
        if self.m > 1:
            return (*self._blocks(np.concatenate([self._rest, _stack(t, y, u)], axis=1)),
                    restart)
        if self._rest.size:
            t, y, u = np.concatenate([self._rest, _stack(t, y, u)], axis=1)
            self._rest = np.empty((3, 0))
            self._last = -math.inf
        breaks = _NONE
        if not even:
            steps = np.diff(t, prepend=self._last)
            breaks = np.flatnonzero(~(np.abs(steps - self.step) <= UNEVEN * self.step))
        self._last = float(t[-1])
        return t, y, u, breaks, restart

    def _is_even(self, step: float) -> bool:
        return abs(step - self.step) <= UNEVEN * self.step

    def _learn(self, stamps: FloatArray) -> bool:
        """Take the usual step anew; return whether the block size changed."""
        if stamps.size < MIN_FOR_RATE:
            return False
        step = float(np.median(np.diff(stamps[-BATCH:])))
        if self.m and self.step / NEW_RATE < step < self.step * NEW_RATE:
            return False
        before, self.step = self.m, step
        self.m = max(1, round(min(1.0 / step / self._fastest, MOST_BLOCK)))
        return before not in (0, self.m)

    def _even_blocks(self, t: FloatArray, y: FloatArray, u: FloatArray | None
                     ) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
        """Do what `_blocks` does where there is no break, without copying the samples."""
        m, waiting = self.m, self._rest.shape[1]
        count = (waiting + t.size) // m
        if not count:
            self._rest = np.concatenate([self._rest, _stack(t, y, u)], axis=1)
            return (*np.empty((3, 0)), _NONE)
        means = np.empty((3, count))
        # What waits makes the first block, with what it lacks.
        skip = m - waiting if waiting else 0
        begin = 1 if waiting else 0
        stop = skip + (count - begin) * m
        for mean, rest, column in zip(means, self._rest, (t, y, u)):
            if column is None:
                mean[:] = NAN
                continue
            if waiting:
                mean[0] = np.add.reduce(np.concatenate([rest, column[:skip]]))
            np.add.reduce(column[skip:stop].reshape(-1, m), axis=1, out=mean[begin:])
            mean /= m
        self._rest = _stack(t[stop:], y[stop:], None if u is None else u[stop:])
        breaks = _NONE if self._continues else np.zeros(1, dtype=np.int64)
        self._continues = True
        return (*means, breaks)

    def _blocks(self, columns: FloatArray
                ) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
        """Average whole blocks; what is left waits, or is left out before a break."""
        t, m = columns[0], self.m
        gaps = np.flatnonzero(np.abs(np.diff(t) - self.step) > UNEVEN * m * self.step) + 1
        starts = [0, *gaps.tolist(), t.size]
        parts, breaks, count = [], [], 0
        if not self._continues:
            breaks.append(0)
        for low, high in zip(starts[:-1], starts[1:]):
            if low:
                breaks.append(count)
            whole = (high - low) // m
            stop = low + whole * m
            parts.append(columns[:, low:stop].reshape(3, whole, m).mean(axis=2))
            count += whole
            self._rest = columns[:, stop:high].copy()
        t, y, u = np.concatenate(parts, axis=1)
        self._continues = bool(len(parts[-1][0])) or (self._continues and len(parts) == 1)
        return t, y, u, np.array([b for b in breaks if b < count], dtype=np.int64)


def _stack(t: FloatArray, y: FloatArray, u: FloatArray | None) -> FloatArray:
    return np.stack([t, y, np.full(t.size, NAN) if u is None else u])
