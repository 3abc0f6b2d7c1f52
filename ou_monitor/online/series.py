"""
The samples of the window: columns in arrays that slide.

One `Series` holds one resolution.  Columns are time, voltage, throttle and two
lagged throttles; `runs` says how many equal steps lie behind each sample, so
that products over lags never reach across a gap.  The load columns are made
when the first throttle arrives.
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
    if state == u0 and (u == u0).all():
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
    """
    Columns over a sliding window, addressed by a sample number that only grows.

    Parameters
    ----------
    reach : int
        This many samples stay readable behind the window, for pairs that
        reach back; `runs` counts up to it.

    """

    def __init__(self, reach: int) -> None:
        self._main = np.empty((2, 256))
        self._load: FloatArray | None = None
        self._run = np.empty(256, dtype=np.int8)
        self._head = 0
        self._tail = 0
        self._reach = reach
        self._behind = 0
        self._last_move = self._last_break = -1
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
        """Return stamps and voltage (2, end - begin) of samples begin..end-1 (a view)."""
        shift = self._head - self.first
        return self._main[:, begin + shift:end + shift]

    def load(self, begin: int, end: int) -> FloatArray:
        """Return throttle and its lags (3, end - begin); NaN where unknown."""
        if self._load is None:
            return np.full((3, end - begin), math.nan)
        shift = self._head - self.first
        return self._load[:, begin + shift:end + shift]

    def column(self, which: int) -> FloatArray:
        """Return one column of the window (a view)."""
        if which < U:
            return self._main[which, self._head:self._tail]
        return self.load(self.first, self.end)[which - U]

    def all_columns(self) -> FloatArray:
        """Return the whole window, shape (5, n) (a copy)."""
        return np.concatenate([self.columns(self.first, self.end),
                               self.load(self.first, self.end)])

    def runs(self, begin: int, end: int) -> npt.NDArray[np.int8]:
        """Return how many equal steps lie behind each sample, capped (a view)."""
        shift = self._head - self.first
        return self._run[begin + shift:end + shift]

    def last(self, which: int) -> float:
        """Return the newest value of a column; NaN when there is none."""
        if not self.size:
            return math.nan
        if which < U:
            return float(self._main[which, self._tail - 1])
        return math.nan if self._load is None else float(self._load[which - U, self._tail - 1])

    def append(self, t: FloatArray, y: FloatArray, u: FloatArray | None, breaks: IntArray
               ) -> None:
        """
        Add samples.

        Parameters
        ----------
        t, y : ndarray, shape (n,)
            Stamps (s, increasing) and voltage (V).
        u : ndarray, shape (n,), or None
            Throttle, NaN where unknown; None: unknown throughout.
        breaks : ndarray of int
            Positions, 0..n-1, before which equal spacing is broken; the first
            sample of all is always a break.

        """
        n = t.size
        self._make_room(n)
        at = slice(self._tail, self._tail + n)
        had = self.size > 0
        self._main[T, at], self._main[Y, at] = t, y
        if u is not None or self._load is not None:
            self._take_load(t, u, at, had)
        before = int(self._run[self._tail - 1]) if had or self._behind else -1
        run = self._run[at]
        run[:] = self._reach
        first = min(n, max(self._reach - before, 0))
        run[:first] = np.arange(before + 1, before + 1 + first)
        for position in breaks.tolist():
            first = min(n - position, self._reach)
            run[position:] = self._reach
            run[position:position + first] = np.arange(first)
            self._last_break = self.end + position
        self._tail += n

    def _take_load(self, t: FloatArray, u: FloatArray | None, at: slice, had: bool) -> None:
        """Fill throttle and its lags, and note where throttle last moved."""
        if self._load is None:
            self._load = np.full((3, self._run.size), math.nan)
        load = self._load
        if u is None or (math.isnan(u[0]) and bool(np.isnan(u).all())):
            load[:, at] = math.nan
            return
        before, stamp = self.last(U), self.last(T)
        lags = [self.last(FAST), self.last(SLOW)]
        if had and before == lags[0] == lags[1] and bool((u == before).all()):
            load[:, at] = before
            return
        load[0, at] = u
        for row, tau, state in ((1, LOAD_LAGS[0], lags[0]), (2, LOAD_LAGS[1], lags[1])):
            load[row, at] = lagged(t, u, tau, (stamp, before, state))
        moving = (u != load[1, at]) | (u != load[2, at])
        moving &= ~np.isnan(u)
        if had:
            moving[0] |= u[0] != before
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
        self._last_move = self._last_break = -1
        self._load = None

    def _make_room(self, n: int) -> None:
        if self._tail + n <= self._run.size:
            return
        begin = self._head - self._behind
        kept = self._tail - begin
        # Three times what is needed: a sample is moved once in two windows.
        wanted = 3 * (kept + n) + 256
        main, run = np.empty((2, wanted)), np.empty(wanted, dtype=np.int8)
        main[:, :kept] = self._main[:, begin:self._tail]
        run[:kept] = self._run[begin:self._tail]
        if self._load is not None:
            load = np.full((3, wanted), math.nan)
            load[:, :kept] = self._load[:, begin:self._tail]
            self._load = load
        self._main, self._run = main, run
        self._head, self._tail = self._behind, kept
