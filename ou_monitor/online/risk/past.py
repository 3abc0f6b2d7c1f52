"""
The last minutes of a flight in blocks: how low the voltage went, and what throttle did.

Limits: a source slower than the blocks fills them by holding its last value; across a longer
silence nothing is held, and no horizon that contains it is complete.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.records import FloatArray, NAN

# Length of a block, s, how much is kept, s, and the silence that is not bridged, s.
BLOCK, KEPT, SILENCE = 0.05, 300.0, 2.5
# Throttle within this of the highest counts as at the peak.
AT_PEAK = 0.05


class Past:
    """
    Blocks of the flight so far.

    Rows of `table`: lowest and last median of three voltages, V; mean and highest throttle.
    """

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self.table: FloatArray = np.empty((4, 0))
        self._start = self._end = NAN
        self._tail: FloatArray = np.empty(0)

    @property
    def end(self) -> float:
        """Stamp at which the last complete block ends, s; NaN before any."""
        return float(self._start + self.table.shape[1] * BLOCK)

    def push(self, t: FloatArray, voltage: FloatArray, throttle: FloatArray) -> None:
        """Add samples with rising stamps, s, finite voltages, V, and throttles, 0..1."""
        pauses = np.flatnonzero(np.diff(t, prepend=self.end if self._tail.size else t[0]) > KEPT)
        if pauses.size:
            # Nothing from before is kept.
            self._clear()
            t, voltage, throttle = (x[pauses[-1]:] for x in (t, voltage, throttle))
        v = np.concatenate((self._tail, voltage))
        if not self._tail.size:
            v = np.concatenate((v[:1], v[:1], v))
        medians = np.maximum(np.minimum(v[:-2], v[1:-1]),
                             np.minimum(np.maximum(v[:-2], v[1:-1]), v[2:]))
        self._tail = v[-2:]
        if not math.isfinite(self._start):
            self._start = float(t[0])
        at = np.floor((t - self._start) / BLOCK).astype(np.intp)
        begin = np.flatnonzero(np.diff(at, prepend=-1))
        count = np.diff(begin, append=at.size)
        rows = np.stack([np.minimum.reduceat(medians, begin), medians[begin + count - 1],
                         np.add.reduceat(throttle, begin) / count,
                         np.maximum.reduceat(throttle, begin)])
        self._place(at[begin], rows, count)

    def _place(self, at: np.ndarray, rows: FloatArray, count: np.ndarray) -> None:
        """Put rows where they belong; what lies between is held, or unknown."""
        old = self.table.shape[1]
        if at[0] < old:
            # The block was begun by the samples before.
            last = self.table[:, at[0]]
            rows[0, 0] = min(rows[0, 0], last[0])
            rows[3, 0] = max(rows[3, 0], last[3])
        new = np.full((4, max(at[-1] + 1 - old, 0)), NAN)
        table = np.concatenate((self.table, new), axis=1)
        table[:, at] = rows
        filled = np.concatenate(([old - 1] if old else [], at[at >= old])).astype(np.intp)
        for a, b in zip(filled[:-1], filled[1:]):
            if 1 < b - a <= SILENCE / BLOCK:
                table[:, a + 1:b] = table[[1, 1, 2, 2], a][:, None]
        extra = table.shape[1] - round(KEPT / BLOCK)
        if extra > 0:
            table = table[:, extra:]
            self._start += extra * BLOCK
        self.table = table

    def flown(self) -> tuple[float, float]:
        """Return the lowest and the highest throttle; NaN without any."""
        known = self.table[2:, np.isfinite(self.table[2])]
        return (float(known[0].min()), float(known[1].max())) if known.size else (NAN, NAN)

    def activity(self) -> float:
        """Return the usual sqrt|du| from one block to the next in the last minute."""
        change = np.abs(np.diff(self.table[2, -round(60.0 / BLOCK):]))
        change = change[np.isfinite(change)]
        return float(np.sqrt(change).mean()) if change.size else 0.0

    def became(self, t: float, horizon: float) -> tuple[float, float, float] | None:
        """
        Return what a horizon, s, from t on was: lowest voltage, V, highest throttle, s there.

        None when it is not complete, or gone, or has a silence in it.
        """
        begin = math.floor((t - self._start) / BLOCK) + 1
        end = begin + max(1, round(horizon / BLOCK))
        if begin < 0 or end > self.table.shape[1]:
            return None
        low, _, mean, high = self.table[:, begin:end]
        lowest, peak = float(low.min()), float(high.max())
        if math.isnan(lowest):
            return None
        at = int((mean >= peak - AT_PEAK).sum())
        return lowest, peak, max(at, 1) * BLOCK

    def drops(self, horizon: float) -> FloatArray:
        """Return how far below its beginning each completed horizon, s, went, V; oldest first."""
        width = max(1, round(horizon / BLOCK))
        low, last = self.table[0], self.table[1]
        if low.size <= width:
            return np.empty(0)
        drop = last[:-width] - sliding(np.minimum, low[1:], width)
        return np.asarray(drop[np.isfinite(drop)])


def sliding(least: np.ufunc, x: FloatArray, width: int) -> FloatArray:
    """Return the minimum, or the maximum, of each run of so many values, by doubling."""
    size, out = 1, x
    while 2 * size <= width:
        out = least(out[:-size], out[size:])
        size *= 2
    rest = width - size
    return np.asarray(least(out[:out.size - rest], out[rest:]) if rest else out)
