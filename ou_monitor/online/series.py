"""
The samples of the window: columns in arrays that slide.

One `Series` holds one resolution.  Columns are time, voltage, throttle, two
lagged throttles, and `run`: how many equal steps lie behind each sample (so
that products over lags never reach across a gap).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ou_monitor.records import FloatArray

IntArray = npt.NDArray[np.int64]

# Lags of the supply behind the throttle that the load can take, s: motors
# follow the command within 5..20 ms, the current settles within 40 ms
# (doc/estimation.md).
LOAD_LAGS = (0.010, 0.040)

T, Y, U, FAST, SLOW = range(5)
COLUMNS = 5

# exp(_SPAN) stays far inside the range of a double.
_SPAN = 300.0
# A lagged throttle this near to the throttle has settled.
_SETTLED = 1e-7


def lagged(t: FloatArray, u: FloatArray, tau: float, before: tuple[float, float, float]
           ) -> FloatArray:
    """
    Return a first-order lag of the throttle, exact for held input.

    Parameters
    ----------
    t, u : ndarray, shape (n,)
        Stamps, s, increasing, and throttle, 0..1.
    tau : float
        Time constant, s.
    before : tuple of float
        Stamp, throttle and lagged value of the sample before; NaN for none
        (the lag starts settled).

    Returns
    -------
    ndarray, shape (n,)
        Lagged throttle.

    """
    t0, u0, state = before
    if math.isnan(state):
        t0, u0, state = float(t[0]), float(u[0]), float(u[0])
    if (state == u0 and (u == u0).all()) or bool(np.isnan(u).all()):
        return u
    out = np.empty_like(u)
    held = np.concatenate(([u0], u[:-1]))
    begin = 0
    while begin < t.size:
        end = max(int(np.searchsorted(t, t0 + _SPAN * tau)), begin + 1)
        elapsed = np.minimum((t[begin:end] - t0) / tau, 2.0 * _SPAN)
        weight = np.exp(elapsed)
        gain = np.diff(weight, prepend=1.0)
        out[begin:end] = (state + np.cumsum(held[begin:end] * gain)) / weight
        t0, state = float(t[end - 1]), float(out[end - 1])
        begin = end
    near = np.abs(out - u) < _SETTLED
    out[near] = u[near]
    return out


class Series:
    """Columns over a sliding window, addressed by a sample number that only grows."""

    def __init__(self, reach: int) -> None:
        self._data = np.empty((COLUMNS, 256))
        self._run = np.empty(256, dtype=np.int64)
        self._head = 0
        self._tail = 0
        # This many samples stay behind the window, for pairs that reach back.
        self._reach = reach
        self._behind = 0
        self._last_move = -1
        self._last_break = -1
        self.first = 0

    @property
    def size(self) -> int:
        """Return the number of samples held."""
        return self._tail - self._head

    @property
    def end(self) -> int:
        """Return the number that the next sample will get."""
        return self.first + self.size

    @property
    def behind(self) -> int:
        """Return how many samples before `first` can still be read."""
        return self._behind

    @property
    def moves(self) -> bool:
        """Whether throttle, or its lag, moved in the window."""
        return self._last_move >= self.first

    @property
    def even(self) -> bool:
        """Whether equal spacing is unbroken in the window."""
        return self._last_break <= self.first

    def columns(self, begin: int, end: int) -> FloatArray:
        """Return columns (5, end - begin) of the samples numbered begin..end-1 (a view)."""
        shift = self._head - self.first
        return self._data[:, begin + shift:end + shift]

    def column(self, which: int) -> FloatArray:
        """Return one column of all the samples held (a view)."""
        return self._data[which, self._head:self._tail]

    def runs(self, begin: int, end: int) -> IntArray:
        """Return how many equal steps lie behind each sample, capped (a view)."""
        shift = self._head - self.first
        return self._run[begin + shift:end + shift]

    def last(self, which: int) -> float:
        """Return the newest value of a column."""
        return float(self._data[which, self._tail - 1])

    def append(self, t: FloatArray, y: FloatArray, u: FloatArray, breaks: IntArray) -> None:
        """
        Add samples.

        Parameters
        ----------
        t, y, u : ndarray, shape (n,)
            Stamps (s, increasing), voltage (V), throttle (NaN when unknown).
        breaks : ndarray of int
            Positions, 0..n-1, before which equal spacing is broken; the first
            sample of all is always a break.

        """
        n = t.size
        self._make_room(n)
        at = slice(self._tail, self._tail + n)
        had = self.size
        self._data[T, at], self._data[Y, at], self._data[U, at] = t, y, u
        self._lag(t, u, at, had)
        run = np.arange(1, n + 1)
        run += int(self._run[self._tail - 1]) if had or self._behind else -1
        for position in breaks:
            run[position:] = np.arange(n - position)
            self._last_break = self.end + int(position)
        np.minimum(run, self._reach, out=self._run[at])
        self._tail += n

    def _lag(self, t: FloatArray, u: FloatArray, at: slice, had: bool) -> None:
        """Fill the lagged throttle, and note where throttle last moved."""
        if math.isnan(u[0]) and bool(np.isnan(u).all()):
            self._data[FAST:, at] = math.nan
            return
        for which, tau in ((FAST, LOAD_LAGS[0]), (SLOW, LOAD_LAGS[1])):
            before = (math.nan,) * 3
            if had:
                before = (self.last(T), self.last(U), self.last(which))
            self._data[which, at] = lagged(t, u, tau, before)
        moving = (u != self._data[SLOW, at]) | (u != self._data[FAST, at])
        moving &= ~np.isnan(u)
        if had:
            moving[0] |= u[0] != self.last(U)
        if moving.any():
            self._last_move = self.end + int(np.flatnonzero(moving)[-1])

    def drop_before(self, number: int) -> None:
        """Forget the samples numbered below `number`."""
        count = min(max(number - self.first, 0), self.size)
        self._head += count
        self.first += count
        self._behind = min(self._behind + count, self._reach)

    def clear(self) -> None:
        """Forget all samples; numbering goes on."""
        self.first = self.end
        self._head = self._tail = self._behind = 0
        self._last_move = -1

    def _make_room(self, n: int) -> None:
        capacity = self._run.size
        if self._tail + n <= capacity:
            return
        begin = self._head - self._behind
        kept = self._tail - begin
        # Twice what is needed: each sample is moved a bounded number of times.
        wanted = 2 * (kept + n) + 256
        data, run = np.empty((COLUMNS, wanted)), np.empty(wanted, dtype=np.int64)
        data[:, :kept] = self._data[:, begin:self._tail]
        run[:kept] = self._run[begin:self._tail]
        self._data, self._run = data, run
        self._head, self._tail = self._behind, kept
