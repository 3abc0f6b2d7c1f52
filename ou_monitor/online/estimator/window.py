"""
The sliding window: its samples as columns that slide, and sums over lags, kept in slots.

One `Series` holds one resolution.  Columns are time, voltage, throttle and two lagged throttles;
`runs` says how many equal steps lie behind each sample, so that products over lags never reach
across a gap.  The load columns are made when the first throttle arrives.  `Thinner` makes block
means of a fast source before.

A slot covers an equal share of the window and holds everything the fit needs of its samples:
moments, and the sums of (z_j - z_{j-k}) (z_j - z_{j-k})' for lags k = 1..K, where z is the
voltage, joined by the load while throttle moves.  The window is the sum over its slots, added
afresh at each fit, so nothing is ever subtracted and nothing drifts.  The variogram form matters:
products z_j z_{j-k} lose accuracy at the ends (doc/estimation.md).

White noise hides the increments of an OU at fine steps; block means bring them back.  Each
resolution has a quarter of the rate of the one before; the fit goes to a coarser one only when the
noise asks for it, so they are made when needed.

Limits: a source whose step changes by a third or more begins anew with blocks of another size.
"""

from __future__ import annotations

from dataclasses import dataclass
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


class WindowColumns:
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


# Variables while throttle moves: voltage, throttle, its square, its two lags.
LOAD_VARIABLES = 5
# Rows made at first.
_ROOM = 128


@dataclass(slots=True)
class Sums:
    """Sums over the samples of a window, for c variables and K lags."""

    row: FloatArray  # All that follows, in one row
    n: int  # Samples
    first: FloatArray  # Sum of each variable (voltage less its reference); shape (c,)
    # Sum of variable times sample number, counted from the first sample; shape (c,).
    place: FloatArray
    second: FloatArray  # Sum of products of variables; shape (c, c)
    pairs: FloatArray  # Pairs at each lag; shape (K,)
    change: FloatArray  # Sum of z_j - z_{j-k}; shape (K, c)
    spread: FloatArray  # Sum of (z_j - z_{j-k}) (z_j - z_{j-k})'; shape (K, c, c)


class LagSums:
    """Slots of a length, s, counted from `origin`, s, over one `Series`, for so many lags."""

    def __init__(self, series: WindowColumns, lags: int, slot: float) -> None:
        self._series = series
        self._lags = lags
        self.origin = 0.0
        self.restart(slot)

    def restart(self, slot: float, variables: int = 1) -> None:
        """Forget the sums (not the samples); take slots of a new length."""
        self._slot = slot
        self._c = variables
        c, lags = variables, self._lags
        sizes = [1, c, c, c * c, lags, lags * c, lags * c * c]
        self._ends = np.cumsum(sizes).tolist()
        # Rows head..tail of the slots, the numbers of their first samples beside them.
        self._rows = np.empty((_ROOM, self._ends[-1]))
        self._begins = np.empty(_ROOM, dtype=np.int64)
        self._head = self._tail = 0
        self._summed = self._series.first
        self._open = math.nan
        self._reference: float | None = None
        self._last = Sums(np.zeros(1), 0, *(np.zeros(0) for _ in range(6)))

    @property
    def reference(self) -> float:
        """Return the voltage that moments are taken against, V."""
        return self._reference or 0.0

    def slots_of(self, t: FloatArray) -> FloatArray:
        """Return the slot of each stamp; edges are met to 1e-6, as stamps are sums of steps."""
        return np.floor((t - self.origin) / self._slot + 1e-6)

    def slot_of(self, t: float) -> int:
        """Return the slot of one stamp, as `slots_of` does."""
        return math.floor((t - self.origin) / self._slot + 1e-6)

    @property
    def throttle_std(self) -> float:
        """Return the standard deviation of throttle at the last `total`; 0 while still."""
        if self._c == 1 or not self._last.n:
            return 0.0
        mean = self._last.first[1] / self._last.n
        return math.sqrt(max(float(self._last.second[1, 1]) / self._last.n - mean * mean, 0.0))

    def total(self) -> Sums:
        """Return the sums over the window; the load takes part while throttle moves."""
        series = self._series
        variables = LOAD_VARIABLES if series.moves and series.known else 1
        if variables != self._c:
            self.restart(self._slot, variables)
        if self._reference is None and series.size:
            self._reference = float(series.column(Y)[0])
        self._summed = max(self._summed, series.first)
        while self._head < self._tail and self._begins[self._head] < series.first:
            self._head += 1
        if self._summed < series.end:
            self._take()
        self._last = self._parts(self._added())
        return self._last

    def _take(self) -> None:
        """Sum what is new; the first part of it may go on in the slot that is open."""
        series, lags, begin, end = self._series, self._lags, self._summed, self._series.end
        t = series.columns(begin, end)[T]
        self._make_room(min(end - begin, int((float(t[-1]) - float(t[0])) / self._slot) + 2))
        back = min(lags, begin - series.first + series.behind)
        z = self._variables(begin - back, end)
        runs = series.runs(begin, end)
        if back < lags:
            runs = np.minimum(runs, back + np.arange(end - begin)).astype(np.int8)
            z = np.concatenate([np.zeros((self._c, lags - back)), z], axis=1)
        self._take_slots(z, runs, t, begin)
        self._summed, self._open = end, float(self.slot_of(float(t[-1])))

    def _make_room(self, more: int) -> None:
        """Move the rows to the front, of a larger store if need be."""
        if self._tail + more <= len(self._begins):
            return
        rows, begins = self._rows[self._head:self._tail], self._begins[self._head:self._tail]
        size = max(len(self._begins), 2 * (len(begins) + more))
        self._head, self._tail = 0, len(begins)
        self._rows, self._begins = (np.concatenate([kept, np.empty(
            (size - len(kept), *kept.shape[1:]), kept.dtype)]) for kept in (rows, begins))

    def _variables(self, begin: int, end: int) -> FloatArray:
        """Return the variables of samples begin..end-1, shape (c, end - begin)."""
        y: FloatArray = self._series.columns(begin, end)[Y] - self.reference
        if self._c == 1:
            return y.reshape(1, -1)
        z = np.empty((self._c, end - begin))
        load = self._series.load(begin, end)
        z[0] = y
        z[1] = load[0]
        z[3:] = load[1:]
        unknown = np.isnan(load)
        if unknown.any():
            # Samples before the window, which pairs reach back to.
            z[1] = np.where(unknown[0], 0.0, load[0])
            z[3:] = np.where(unknown[1:], 0.0, load[1:])
        np.multiply(z[1], z[1], out=z[2])
        return z

    def _take_slots(self, z: FloatArray, runs: npt.NDArray[np.int8], t: FloatArray, begin: int
                    ) -> None:
        """Sum new samples into the rows of the slots."""
        slots = self.slots_of(t)
        cuts = np.flatnonzero(slots[1:] != slots[:-1]) + 1
        edges = [0, *cuts.tolist(), t.size]
        rows = self._sum(z, runs, edges)
        skip = 0
        if self._head < self._tail and slots[0] == self._open:
            offset = begin - int(self._begins[self._tail - 1])
            first, place = slice(1, self._ends[1]), slice(self._ends[1], self._ends[2])
            rows[0, place] += offset * rows[0, first]
            self._rows[self._tail - 1] += rows[0]
            skip = 1
        tail = self._tail + len(rows) - skip
        self._rows[self._tail:tail] = rows[skip:]
        self._begins[self._tail:tail] = np.array(edges[skip:-1]) + begin
        self._tail = tail

    def _sum(self, z: FloatArray, runs: npt.NDArray[np.int8], edges: list[int]) -> FloatArray:
        """Return one row per slot between the edges."""
        lags, size = self._lags, edges[-1]
        own = z[:, lags:]
        # Differences by lag, variable and sample.
        wide, narrow = z.strides
        back: FloatArray = np.ndarray((lags, self._c, size), np.float64, z, (lags - 1) * narrow,
                                      (-narrow, wide, narrow))
        difference = own - back
        cuts, sizes = np.array(edges[:-1]), np.array(edges[1:])
        sizes -= cuts
        rows = np.empty((cuts.size, self._ends[-1]))
        rows[:, 0] = sizes
        _, at_first, at_place, at_second, at_pairs, at_change, _ = self._ends
        if int(runs.min()) >= lags:
            rows[:, at_second:at_pairs] = sizes[:, None]
            # The sum of a difference is what enters at one end and leaves at the other.
            ends = z[:, lags - 1 + np.array(edges)[:, None] - np.arange(lags)].cumsum(axis=2)
            change = (ends[:, 1:] - ends[:, :-1]).transpose(1, 2, 0)
        else:
            valid = runs >= np.arange(1, lags + 1)[:, None]
            difference *= valid[:, None, :]
            rows[:, at_second:at_pairs] = np.add.reduceat(valid, cuts, axis=1, dtype=float).T
            change = np.add.reduceat(difference, cuts, axis=2).transpose(2, 0, 1)
        rows[:, at_pairs:at_change] = change.reshape(cuts.size, -1)
        number = np.arange(size) - np.repeat(cuts, sizes)
        moments = np.concatenate([own, own * number, *(own * one for one in own)])
        rows[:, 1:at_second] = np.add.reduceat(moments, cuts, axis=1).T
        if self._c == 1:
            difference *= difference
            rows[:, at_change:] = np.add.reduceat(difference[:, 0], cuts, axis=1).T
            return rows
        for row, low, high in zip(rows, edges[:-1], edges[1:]):
            part = difference[:, :, low:high]
            row[at_change:] = (part @ part.transpose(0, 2, 1)).ravel()
        return rows

    def _added(self) -> FloatArray:
        """Return the sum over the slots, in one row."""
        _, at_first, at_place, *_ = self._ends
        kept = slice(self._head, self._tail)
        rows = self._rows[kept]
        total: FloatArray = np.add.reduce(rows, axis=0)
        offsets = self._begins[kept] - float(self._series.first)
        total[at_first:at_place] += offsets @ rows[:, 1:at_first]
        return total

    def _parts(self, total: FloatArray) -> Sums:
        """Return views of the parts of a row."""
        c, lags = self._c, self._lags
        _, at_first, at_place, at_second, at_pairs, at_change, _ = self._ends
        return Sums(
            row=total, n=int(total[0]), first=total[1:at_first],
            place=total[at_first:at_place],
            second=total[at_place:at_second].reshape(c, c),
            pairs=total[at_second:at_pairs],
            change=total[at_pairs:at_change].reshape(lags, c),
            spread=total[at_change:].reshape(lags, c, c))


# Lags of the sums: enough while theta^24 is small; beyond, a coarser
# resolution is used (doc/estimation.md).
LAGS = 24
# theta^LAGS beyond this: the lags no longer hold the noise, go coarser.
LOST = 0.05
# Slots per window: the window is resolved to this share.
SLOTS = 40
# Samples of one resolution that make one of the next.
FACTOR = 4
# Samples below which a resolution is not worth a fit.
FEWEST = 100


class Resolution:
    """Samples and sums at one resolution of a window, s, taken from the next finer one."""

    def __init__(self, window: float, parent: Resolution | None = None) -> None:
        self.series = WindowColumns(LAGS)
        self.sums = LagSums(self.series, LAGS, window / SLOTS)
        self._window = window
        self._parent = parent
        self._taken = parent.series.first if parent else 0
        self._coarser: Resolution | None = None

    def set_window(self, window: float) -> None:
        """Change the length of the window; samples inside the new one stay."""
        self._window = window
        self.sums.restart(window / SLOTS)
        self.slide()
        if self._coarser is not None:
            self._coarser.set_window(window)

    def clear(self) -> None:
        """Forget everything."""
        self.series.clear()
        self.sums.restart(self._window / SLOTS)
        self._coarser = None

    def add(self, t: FloatArray, y: FloatArray, u: FloatArray | None, breaks: IntArray
            ) -> None:
        """Add samples (see `Series.append`) and slide the window."""
        if t.size:
            if not self.series.size:
                # Slots are counted from the first sample, so that a window's worth of
                # samples fills the window.
                self.sums.origin = self._parent.sums.origin if self._parent else float(t[0])
            self.series.append(t, y, u, breaks)
            self.slide()

    def slide(self) -> None:
        """Forget whole slots that end outside the window."""
        if not self.series.size:
            return
        slot = self._window / SLOTS
        origin, slot_of = self.sums.origin, self.sums.slot_of
        oldest = math.ceil((self.series.last(T) - origin - self._window) / slot - 1e-6)
        stamps = self.series.column(T)
        if slot_of(float(stamps[0])) >= oldest:
            return
        begin = int(stamps.searchsorted(origin + oldest * slot))
        # Where the edge was met only nearly, the sums decide which side it is.
        while begin > 0 and slot_of(float(stamps[begin - 1])) >= oldest:
            begin -= 1
        while slot_of(float(stamps[begin])) < oldest:
            begin += 1
        self.series.drop_before(self.series.first + begin)

    def coarser(self) -> Resolution:
        """Return the next coarser resolution, up to date."""
        if self._coarser is None:
            self._coarser = Resolution(self._window, self)
        self._coarser._take(self.series)
        return self._coarser

    def _take(self, fine: WindowColumns) -> None:
        """Take what a finer series has got since the last time."""
        begin = max(self._taken, fine.first)
        skipped = begin != self._taken
        if begin >= fine.end:
            return
        starts = set(np.flatnonzero(fine.runs(begin, fine.end) == 0).tolist())
        if skipped or not self.series.size:
            starts.add(0)
        edges = sorted({0, *starts, fine.end - begin})
        throttle = fine.throttle(begin, fine.end)
        columns = fine.columns(begin, fine.end)
        if throttle is not None:
            columns = np.concatenate([columns, throttle[None, :]])
        parts, breaks, count = [], [], 0
        for low, high in zip(edges[:-1], edges[1:]):
            if low in starts:
                breaks.append(count)
            whole = (high - low) // FACTOR
            stop = low + whole * FACTOR
            parts.append(columns[:, low:stop].reshape(len(columns), whole, FACTOR).mean(axis=2))
            count += whole
            self._taken = begin + (stop if high == edges[-1] else high)
        joined = np.concatenate(parts, axis=1)
        self.add(joined[0], joined[1], None if throttle is None else joined[2],
                 np.array([b for b in breaks if b < count], dtype=np.int64))
