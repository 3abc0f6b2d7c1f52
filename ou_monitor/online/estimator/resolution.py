"""
The window at several resolutions, each a quarter of the rate of the one before.

White noise hides the increments of an OU at fine steps; block means bring them
back.  The fit starts at the finest resolution and goes to a coarser one only
when the noise asks for it, so coarser ones are made when first needed.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.online.estimator.lagsums import LagSums
from ou_monitor.online.estimator.series import IntArray, Series, T
from ou_monitor.records import FloatArray

# Lags of the sums: enough while theta^24 is small; beyond, a coarser
# resolution is used (doc/estimation.md).
LAGS = 24
# Slots per window: the window is resolved to this share.
SLOTS = 40
# Samples of one resolution that make one of the next.
FACTOR = 4
# Samples below which a resolution is not worth a fit.
FEWEST = 100


class Resolution:
    """
    Samples and sums at one resolution.

    Parameters
    ----------
    window : float
        Length of the window, s.
    parent : Resolution, optional
        The next finer one, from which this one takes its samples.

    """

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
        self._coarser.catch_up()
        return self._coarser

    def catch_up(self) -> None:
        """Take what the finer resolution has got since the last time."""
        if self._parent is None:
            return
        fine = self._parent.series
        begin = max(self._taken, fine.first)
        skipped = begin != self._taken
        if begin >= fine.end:
            return
        runs = fine.runs(begin, fine.end)
        starts = np.flatnonzero(runs == 0)
        if (skipped or not self.series.size) and (not starts.size or starts[0] != 0):
            starts = np.concatenate(([0], starts))
        edges = starts.tolist()
        if not edges or edges[0] != 0:
            edges = [0, *edges]
        edges.append(fine.end - begin)
        throttle = fine.throttle(begin, fine.end)
        columns = fine.columns(begin, fine.end)
        if throttle is not None:
            columns = np.concatenate([columns, throttle[None, :]])
        is_start = set(starts.tolist())
        parts, breaks, count = [], [], 0
        for low, high in zip(edges[:-1], edges[1:]):
            if low in is_start:
                breaks.append(count)
            whole = (high - low) // FACTOR
            stop = low + whole * FACTOR
            parts.append(columns[:, low:stop].reshape(len(columns), whole, FACTOR).mean(axis=2))
            count += whole
            self._taken = begin + (stop if high == edges[-1] else high)
        joined = np.concatenate(parts, axis=1)
        self.add(joined[0], joined[1], None if throttle is None else joined[2],
                 np.array([b for b in breaks if b < count], dtype=np.int64))
