"""
The samples of the window: columns in arrays that slide.

One `Series` holds one resolution.  Columns are time, voltage, throttle and two
lagged throttles; `runs` says how many equal steps lie behind each sample, so
that products over lags never reach across a gap.  The load columns are made
when the first throttle arrives.  `Thinner` makes block means of a fast source before.

Limits: a source whose step changes by a third or more begins anew with blocks of another size.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray, NAN
from ou_monitor.timeline.line import BATCH, Batch

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
# After this long without a change of throttle all lags have settled, s.
LOOK_BACK = 16.0 * LOAD_LAGS[1]
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


def lagged(t: FloatArray, u: FloatArray, tau: float, before: tuple[float, float, float]
           ) -> FloatArray:
    """Return a first-order lag of the throttle, exact for held input (tau in s)."""
    unknown = np.isnan(u)
    if 0 < np.count_nonzero(unknown) < u.size:
        place = np.maximum.accumulate(np.where(unknown, -1, np.arange(u.size)))
        filled = u[np.where(place < 0, np.flatnonzero(~unknown)[0], place)]
        out = lagged(t, filled, tau, before).copy()
        out[unknown] = math.nan
        return out
    t0, u0, state = before
    if math.isnan(state):
        t0, u0, state = float(t[0]), float(u[0]), float(u[0])
    if state == u0 and not np.count_nonzero(u != u0):
        return u
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


class Series:
    """
    Columns over a sliding window, addressed by a sample number that only grows.

    `reach` samples stay readable behind the window, for pairs that reach back.
    """

    def __init__(self, reach: int) -> None:
        self._main = np.empty((2, 256))
        self._load: FloatArray | None = None
        self._run = np.empty(256, dtype=np.int8)
        self._head = 0
        self._tail = 0
        self._reach = reach
        self._behind = 0
        self._last_break = self._last_unknown = -1
        self._moved_at = -math.inf
        self._lagged_to = 0
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
        """Return how many samples before `first` can still be paired with."""
        return min(self._behind, self._reach)

    @property
    def moves(self) -> bool:
        """Whether throttle, or its lag, moved in the window."""
        return (self._tail > self._head
                and self._main.item(T, self._head) <= self._moved_at + LOOK_BACK)

    @property
    def known(self) -> bool:
        """Whether throttle is known throughout the window."""
        return self._load is not None and self._last_unknown < self.first

    @property
    def even(self) -> bool:
        """Whether equal spacing is unbroken in the window."""
        return self._last_break <= self.first

    def columns(self, begin: int, end: int) -> FloatArray:
        """Return stamps and voltage (2, end - begin) of samples begin..end-1 (a view)."""
        shift = self._head - self.first
        return self._main[:, begin + shift:end + shift]

    def store(self, begin: int) -> tuple[FloatArray, npt.NDArray[np.int8], int, int]:
        """Return stamps and voltage, runs, and where in them sample `begin` and the end are."""
        return self._main, self._run, begin + self._head - self.first, self._tail

    def load(self, begin: int, end: int) -> FloatArray:
        """Return throttle and its lags (3, end - begin); NaN where unknown."""
        if self._load is None:
            return np.full((3, end - begin), math.nan)
        self._lag()
        shift = self._head - self.first
        return self._load[:, begin + shift:end + shift]

    def column(self, which: int) -> FloatArray:
        """Return one column of the window (a view)."""
        if which < U:
            column: FloatArray = self.columns(self.first, self.end)[which]
        else:
            column = self.load(self.first, self.end)[which - U]
        return column

    def throttle(self, begin: int, end: int) -> FloatArray | None:
        """Return the throttle of samples begin..end-1 (a view); None when never known."""
        if self._load is None:
            return None
        shift = self._head - self.first
        return self._load[0, begin + shift:end + shift]

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
            return self._main.item(which, self._tail - 1)
        if self._load is None:
            return math.nan
        if which > U:
            self._lag()
        return self._load.item(which - U, self._tail - 1)

    def append(self, t: FloatArray, y: FloatArray, u: FloatArray | None, breaks: IntArray
               ) -> None:
        """Add samples."""
        n = t.size
        self._make_room(n)
        at = slice(self._tail, self._tail + n)
        had = self.size > 0 or self._behind > 0
        self._main[T, at], self._main[Y, at] = t, y
        if u is not None:
            self._take_throttle(t, u, at, had)
        elif self._load is not None:
            self._load[0, at] = math.nan
        if u is None:
            self._last_unknown = self.end + n - 1
        before = int(self._run[self._tail - 1]) if had else -1
        run = self._run[at]
        run[:] = self._reach
        first = min(n, max(self._reach - before, 0))
        if first:
            run[:first] = np.arange(before + 1, before + 1 + first)
        for position in breaks.tolist():
            first = min(n - position, self._reach)
            run[position:] = self._reach
            run[position:position + first] = np.arange(first)
            self._last_break = self.end + position
        self._tail += n

    def _take_throttle(self, t: FloatArray, u: FloatArray, at: slice, had: bool) -> None:
        """Store the throttle, and note where it was unknown and where it last moved."""
        if self._load is None:
            self._load = np.empty((3, self._run.size))
            self._load[:, :self._tail] = math.nan
            self._lagged_to = self.end
        before = float(self._load[0, self._tail - 1]) if had else math.nan
        self._load[0, at] = u
        if before == u[0] and not np.count_nonzero(u != before):
            return
        change = u[1:] != u[:-1]
        if math.isnan(float(u.sum())):
            unknown = np.isnan(u)
            self._last_unknown = self.end + int(np.flatnonzero(unknown)[-1])
            change &= ~(unknown[1:] | unknown[:-1])
        places = np.flatnonzero(change)
        if places.size:
            self._moved_at = float(t[places[-1] + 1])
        elif before != u[0] and not math.isnan(before) and not math.isnan(u[0]):
            self._moved_at = float(t[0])

    def _lag(self) -> None:
        """Bring the lagged throttle up to date."""
        load, shift = self._load, self._head - self.first
        begin, end = max(self._lagged_to, self.first - self._behind), self.end
        if load is None or begin >= end:
            return
        at = slice(begin + shift, end + shift)
        t, u = self._main[T, at], load[0, at]
        self._lagged_to = end
        before = [math.nan] * 4
        if begin > self.first - self._behind:
            last = at.start - 1
            before = [float(self._main[T, last]), *load[:, last].tolist()]
        t0, u0 = before[:2]
        if before == [t0, u0, u0, u0] and not np.count_nonzero(u != u0):
            load[1:, at] = u0
            return
        for row, tau in enumerate(LOAD_LAGS, 1):
            load[row, at] = lagged(t, u, tau, (t0, u0, before[row + 1]))

    def drop_before(self, number: int) -> None:
        """Forget the samples numbered below `number`."""
        count = min(max(number - self.first, 0), self.size)
        self._head += count
        self.first += count
        self._behind += count

    def _trim(self) -> None:
        """Let go of what neither pairs nor lags reach back to."""
        keep = self._reach
        if self._load is not None and self.size:
            # The lags remember longer than the pairs do.
            stamps = self._main[T, self._head - self._behind:self._head]
            keep = max(keep, stamps.size - int(np.searchsorted(
                stamps, self._main[T, self._head] - LOOK_BACK)))
        self._behind = min(self._behind, keep)

    def clear(self) -> None:
        """Forget all samples; numbering goes on."""
        self.first = self.end
        self._head = self._tail = self._behind = 0
        self._last_break = self._last_unknown = -1
        self._moved_at = -math.inf
        self._load = None

    def _make_room(self, n: int) -> None:
        if self._tail + n <= self._run.size:
            return
        self._trim()
        begin = self._head - self._behind
        kept = self._tail - begin
        wanted = 2 * kept + n + 256
        main, run, load = self._main, self._run, self._load
        if wanted > run.size or 4 * wanted < run.size:
            # Half as much again, so that each sample moves but once or so.
            size = wanted + wanted // 2
            main, run = np.empty((2, size)), np.empty(size, dtype=np.int8)
            load = None if load is None else np.empty((3, size))
        # Never overlaps: what is kept begins behind where it goes, as n did not fit.
        main[:, :kept] = self._main[:, begin:self._tail]
        run[:kept] = self._run[begin:self._tail]
        if load is not None and self._load is not None:
            load[:, :kept] = self._load[:, begin:self._tail]
        self._main, self._run, self._load = main, run, load
        self._head, self._tail = self._behind, kept


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
