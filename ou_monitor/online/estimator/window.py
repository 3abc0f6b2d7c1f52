"""
The window: sums over lags, kept in slots that slide, at several resolutions.

A slot covers an equal share of the window and holds everything the fit needs
of its samples: moments, and the sums of (z_j - z_{j-k}) (z_j - z_{j-k})' for
lags k = 1..K, where z is the voltage, joined by the load while throttle moves.
The window is the sum over its slots, added afresh at each fit, so nothing is
ever subtracted and nothing drifts.  The variogram form matters: products
z_j z_{j-k} lose accuracy at the ends (doc/estimation.md).

White noise hides the increments of an OU at fine steps; block means bring them
back.  Each resolution has a quarter of the rate of the one before; the fit goes
to a coarser one only when the noise asks for it, so they are made when needed.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.online.estimator.series import IntArray, Series, T, Y
from ou_monitor.records import FloatArray

# Variables while throttle moves: voltage, throttle, its square, its two lags.
LOAD_VARIABLES = 5
# Rows made at first.
_ROOM = 128


@dataclass(slots=True)
class Sums:
    """
    Sums over the samples of a window, for c variables and K lags.

    Attributes
    ----------
    row : ndarray
        All that follows, in one row.
    n : int
        Samples.
    first : ndarray, shape (c,)
        Sum of each variable (voltage less its reference).
    place : ndarray, shape (c,)
        Sum of variable times sample number, counted from the first sample.
    second : ndarray, shape (c, c)
        Sum of products of variables.
    pairs : ndarray, shape (K,)
        Pairs at each lag.
    change : ndarray, shape (K, c)
        Sum of z_j - z_{j-k}.
    spread : ndarray, shape (K, c, c)
        Sum of (z_j - z_{j-k}) (z_j - z_{j-k})'.

    """

    row: FloatArray
    n: int
    first: FloatArray
    place: FloatArray
    second: FloatArray
    pairs: FloatArray
    change: FloatArray
    spread: FloatArray


class LagSums:
    """Slots of a length, s, counted from `origin`, s, over one `Series`, for so many lags."""

    def __init__(self, series: Series, lags: int, slot: float) -> None:
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
        self.series = Series(LAGS)
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

    def _take(self, fine: Series) -> None:
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
