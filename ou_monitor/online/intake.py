"""
From pushes of any size to clean, ordered, evenly thinned samples.

`push` only copies into a buffer; the work is done in batches, when the buffer
is full or an estimate is asked for, so its cost per sample is that of a
memory copy.  Sorting, dropping and counting happen here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt

from ou_monitor.online.compiled import kernels
from ou_monitor.online.series import IntArray
from ou_monitor.records import Counters, FloatArray, NAN

# Samples collected before a batch is worked off: large enough that NumPy's
# overhead per call vanishes, small enough to stay in the cache.
BATCH = 32768
# Samples from which the rate is told.
MIN_FOR_RATE = 8
# A step that differs from the usual one by more than this share breaks the run.
UNEVEN = 0.5
# The usual step is taken anew when a batch's median differs by this factor.
NEW_RATE = 1.3
# Stamps remembered for that from batch to batch.
MEMORY = 32
_NONE = np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class Batch:
    """
    Clean samples in order; views that hold until the next push.

    Attributes
    ----------
    t, y : ndarray, shape (n,)
        Stamps (s, strictly increasing) and voltage (V).
    u : ndarray, shape (n,), or None
        Throttle, NaN where unknown; None: unknown throughout.
    shortest, longest : float
        Least and largest step, from the sample before on, s.
    restart : bool
        Whether everything before this batch is to be forgotten.

    """

    t: FloatArray
    y: FloatArray
    u: FloatArray | None
    shortest: float
    longest: float
    restart: bool


class Intake:
    """Buffer in front of the window, and the account of every sample pushed."""

    def __init__(self) -> None:
        self._t = np.empty(BATCH)
        self._y = np.empty(BATCH)
        self._u = np.full(BATCH, NAN)
        self._loaded = False
        self._fill = 0
        self.counters = Counters()
        self.newest = -math.inf

    @property
    def waiting(self) -> int:
        """Return the number of samples not yet worked off."""
        return self._fill

    def put(self, t: FloatArray, y: FloatArray, u: FloatArray | float | None) -> bool:
        """Copy samples into the buffer; return False, and do nothing, without room."""
        begin = self._fill
        end = begin + len(t)
        if end > BATCH:
            return False
        self._t[begin:end] = t
        self._y[begin:end] = y
        if u is not None:
            self._u[begin:end] = u
            self._loaded = True
        self._fill = end
        return True

    def put_one(self, t: float, y: float, u: float | None) -> bool:
        """Copy one sample into the buffer; return False, and do nothing, without room."""
        at = self._fill
        if at == BATCH:
            return False
        self._t[at] = t
        self._y[at] = y
        if u is not None:
            self._u[at] = u
            self._loaded = True
        self._fill = at + 1
        return True

    def count(self, **more: int) -> None:
        """Add to the counters."""
        c = self.counters
        self.counters = replace(c, **{k: getattr(c, k) + v for k, v in more.items() if v})

    def forget(self) -> None:
        """Take the next sample as the first one."""
        self.newest = -math.inf

    def work_off(self, window: float, step: float) -> list[Batch]:
        """
        Empty the buffer.

        Parameters
        ----------
        window : float
            Length of the window, s: a step back or a pause longer than this
            starts a new window.
        step : float
            The usual step, s; NaN when not known.

        Returns
        -------
        list of Batch
            Usually one; good until the next `put`.

        """
        n = self._fill
        self._fill = 0
        t, y = self._t[:n], self._y[:n]
        u = self._u[:n] if self._loaded else None
        if self._loaded:
            # The next batch may come without throttle.
            u = self._u[:n].copy()
            self._u[:n] = NAN
            self._loaded = False
        self.count(pushed=n)
        fast = kernels()
        if fast is not None and (1.0 + UNEVEN) * step < window and fast.check(
                t, y, self.newest, (1.0 - UNEVEN) * step, (1.0 + UNEVEN) * step):
            self._accept(t)
            return [Batch(t, y, u, step, step, restart=False)]
        # One pass says whether all is finite: a sum of finite stamps and volts is.
        if not math.isfinite(float(t.sum()) + float(y.sum())):
            good = np.isfinite(t) & np.isfinite(y)
            self.count(non_finite=n - int(good.sum()))
            t, y, u = t[good], y[good], None if u is None else u[good]
        if not t.size:
            return []
        first = float(t[0]) - self.newest
        shortest = longest = first
        if t.size > 1:
            steps = t[1:] - t[:-1]
            shortest = min(first, float(steps.min()))
            # The first sample of all follows nothing: no pause lies before it.
            longest = float(steps.max())
            longest = longest if first == math.inf else max(longest, first)
        if shortest > 0.0 and (longest <= window or first == longest == math.inf):
            self._accept(t)
            return [Batch(t, y, u, shortest, longest, restart=False)]
        return self._untangle(t, y, u, window)

    def _accept(self, t: FloatArray) -> None:
        self.count(used=t.size)
        self.newest = float(t[-1])

    def _untangle(self, t: FloatArray, y: FloatArray, u: FloatArray | None, window: float
                  ) -> list[Batch]:
        """Split where time starts anew, sort what is late, drop repeats."""
        newest = np.maximum.accumulate(np.concatenate(([self.newest], t)))[:-1]
        fresh = (t < newest - window) | (t > newest + window)
        batches: list[Batch] = []
        begin = 0
        # Where time jumps, the running maximum starts again: one split at a time.
        while begin < t.size:
            jumps = np.flatnonzero(fresh[begin:])
            restart = bool(jumps.size and jumps[0] == 0) and math.isfinite(self.newest)
            later = jumps[jumps > 0]
            end = begin + int(later[0]) if later.size else t.size
            part = slice(begin, end)
            batch = self._ordered(
                t[part], y[part], None if u is None else u[part], restart)
            if batch is not None:
                batches.append(batch)
            begin = end
            if begin < t.size:
                rest = np.concatenate(([self.newest], t[begin:]))
                rest[0] = -math.inf
                newest = np.maximum.accumulate(rest)[:-1]
                fresh[begin:] = (t[begin:] < newest - window) | (t[begin:] > newest + window)
                fresh[begin] = True
        return batches

    def _ordered(self, t: FloatArray, y: FloatArray, u: FloatArray | None, restart: bool
                 ) -> Batch | None:
        if restart:
            self.newest = -math.inf
            self.count(resets=1)
        order = np.argsort(t, kind='stable')
        t, y, u = t[order], y[order], None if u is None else u[order]
        keep = (np.diff(t, prepend=self.newest) > 0.0) & (t > self.newest)
        self.count(late=t.size - int(keep.sum()))
        t, y, u = t[keep], y[keep], None if u is None else u[keep]
        if not t.size:
            return None
        steps = np.diff(t, prepend=self.newest)
        self._accept(t)
        return Batch(t, y, u, float(steps.min()), float(steps.max()), restart)


class Thinner:
    """
    Learns the rate of the source, and averages blocks of m samples where it is too fast.

    Parameters
    ----------
    fastest : float
        Highest rate at which samples are kept, Hz.

    """

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

    @property
    def waiting(self) -> int:
        """Return the number of samples that wait for the rate, or for a whole block."""
        return int(self._rest.shape[1])

    @property
    def waits_since(self) -> float:
        """Return the stamp of the first sample that waits, s; NaN for none."""
        return float(self._rest[0, 0]) if self._rest.shape[1] else NAN

    def take(self, batch: Batch
             ) -> tuple[FloatArray, FloatArray, FloatArray | None, IntArray, bool]:
        """
        Return the samples to keep.

        Parameters
        ----------
        batch : Batch
            Clean samples.

        Returns
        -------
        t, y, u : ndarray, shape (k,)
            Samples or block means; the stamp of a block is the mean stamp.
        breaks : ndarray of int
            Before which of them equal spacing is broken.
        restart : bool
            Whether the block size changed, so that what came before does not
            go with these.

        """
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
        self.m = max(1, round(1.0 / (step * self._fastest)))
        return before not in (0, self.m)

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


def as_column(values: npt.ArrayLike) -> FloatArray:
    """Return values as a float64 array of shape (n,); a scalar becomes one sample."""
    return np.atleast_1d(np.asarray(values, dtype=np.float64))
