"""
Sums over lags, kept in slots that slide with the window.

A slot covers an equal share of the window and holds everything the fit needs
of its samples: moments, and the sums of (z_j - z_{j-k}) (z_j - z_{j-k})' for
lags k = 1..K, where z is the voltage, joined by the load while throttle moves.
The window is the sum over its slots, added afresh at each fit, so nothing is
ever subtracted and nothing drifts.  The variogram form matters: products
z_j z_{j-k} lose accuracy at the ends (doc/estimation.md).
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from ou_monitor.online.compiled import kernels
from ou_monitor.online.series import Series, T, Y
from ou_monitor.records import FloatArray

# Variables while throttle moves: voltage, throttle, its square, its two lags.
LOAD_VARIABLES = 5


@dataclass(frozen=True)
class Sums:
    """
    Sums over the samples of a window, for c variables and K lags.

    Attributes
    ----------
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

    n: int
    first: FloatArray
    place: FloatArray
    second: FloatArray
    pairs: FloatArray
    change: FloatArray
    spread: FloatArray


class LagSums:
    """
    Slots over one `Series`.

    Parameters
    ----------
    series : Series
        The samples.
    lags : int
        Number of lags K.
    slot : float
        Length of a slot, s; slots are counted from `origin`, s.

    """

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
        self._begins: list[int] = []
        self._rows = np.empty((0, self._ends[-1]))
        self._summed = self._series.first
        self._open = math.nan
        self._reference: float | None = None
        self._last = Sums(0, *(np.zeros(0) for _ in range(6)))

    @property
    def reference(self) -> float:
        """Return the voltage that moments are taken against, V."""
        return self._reference or 0.0

    def slots_of(self, t: FloatArray) -> FloatArray:
        """Return the slot of each stamp; edges are met to 1e-6, as stamps are sums of steps."""
        return np.floor((t - self.origin) / self._slot + 1e-6)

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
        gone = 0
        while gone < len(self._begins) and self._begins[gone] < series.first:
            gone += 1
        if gone:
            del self._begins[:gone]
            self._rows = self._rows[gone:]
        self._summed = max(self._summed, series.first)
        if self._summed < series.end:
            self._take()
        self._last = self._added()
        return self._last

    def _take(self) -> None:
        """Sum what is new; the first part of it may go on in the slot that is open."""
        series, begin = self._series, self._summed
        slots = self.slots_of(series.columns(begin, series.end)[T])
        cuts = (np.flatnonzero(slots[1:] != slots[:-1]) + 1 + begin).tolist()
        edges = [begin, *cuts, series.end]
        rows = self._sum(edges)
        begins = edges[:-1]
        if self._begins and slots[0] == self._open:
            offset = begin - self._begins[-1]
            first, place = slice(1, self._ends[1]), slice(self._ends[1], self._ends[2])
            rows[0, place] += offset * rows[0, first]
            self._rows[-1] += rows[0]
            rows, begins = rows[1:], begins[1:]
        self._rows = np.concatenate([self._rows, rows])
        self._begins += begins
        self._summed, self._open = series.end, float(slots[-1])

    def _sum(self, edges: list[int]) -> FloatArray:
        """Return one row per slot between the edges."""
        series, lags = self._series, self._lags
        begin, end = edges[0], edges[-1]
        back = min(lags, begin - series.first + series.behind)
        y = series.columns(begin - back, end)[Y] - self.reference
        if self._c == 1:
            z = y[None, :]
        else:
            load = series.load(begin - back, end)
            u, fast, slow = np.where(np.isfinite(load), load, 0.0)
            z = np.stack([y, u, u * u, fast, slow])
        runs = series.runs(begin, end)
        if back < lags:
            runs = np.minimum(runs, back + np.arange(end - begin))
            z = np.concatenate([np.zeros((self._c, lags - back)), z], axis=1)
        fast_sums = kernels()
        if fast_sums is not None:
            rows = np.empty((len(edges) - 1, self._ends[-1]))
            fast_sums.slot_sums(z, runs.astype(np.int64), np.array(edges) - begin, lags, rows)
            return rows
        own = z[:, lags:]
        windows = np.lib.stride_tricks.sliding_window_view(z, end - begin, axis=1)
        difference = own[:, None, :] - windows[:, lags - 1::-1, :]
        whole = bool(runs.min() >= lags)
        cuts = np.array(edges[:-1]) - begin
        sizes = np.diff(np.array(edges))
        rows = np.empty((cuts.size, self._ends[-1]))
        rows[:, 0] = sizes
        _, at_first, at_place, at_second, at_pairs, at_change, _ = self._ends
        if whole:
            rows[:, at_second:at_pairs] = sizes[:, None]
        else:
            valid = runs >= np.arange(1, lags + 1)[:, None]
            difference *= valid
            rows[:, at_second:at_pairs] = np.add.reduceat(valid, cuts, axis=1, dtype=float).T
        if self._c == 1:
            y, change = own[0], difference[0]
            number = np.arange(y.size) - np.repeat(cuts, sizes)
            moments = np.add.reduceat(np.stack([y, y * number, y * y]), cuts, axis=1)
            rows[:, 1:4] = moments.T
            rows[:, at_pairs:at_change] = np.add.reduceat(change, cuts, axis=1).T
            change *= change
            rows[:, at_change:] = np.add.reduceat(change, cuts, axis=1).T
            return rows
        for row, cut, size in zip(rows, cuts.tolist(), sizes.tolist()):
            part = own[:, cut:cut + size]
            by_lag = difference[:, :, cut:cut + size].transpose(1, 0, 2)
            row[1:at_first] = part.sum(axis=1)
            row[at_first:at_place] = part @ np.arange(size, dtype=np.float64)
            row[at_place:at_second] = (part @ part.T).ravel()
            row[at_pairs:at_change] = by_lag.sum(axis=2).ravel()
            row[at_change:] = (by_lag @ by_lag.transpose(0, 2, 1)).ravel()
        return rows

    def _added(self) -> Sums:
        rows, c, lags = self._rows, self._c, self._lags
        _, at_first, at_place, at_second, at_pairs, at_change, _ = self._ends
        total = rows.sum(axis=0)
        offsets = np.array(self._begins, dtype=np.float64) - self._series.first
        return Sums(
            n=int(total[0]), first=total[1:at_first],
            place=total[at_first:at_place] + offsets @ rows[:, 1:at_first],
            second=total[at_place:at_second].reshape(c, c),
            pairs=total[at_second:at_pairs],
            change=total[at_pairs:at_change].reshape(lags, c),
            spread=total[at_change:].reshape(lags, c, c))
