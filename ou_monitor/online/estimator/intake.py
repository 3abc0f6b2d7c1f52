"""
From pushes of any size to clean, ordered, evenly thinned samples.

Implausible readings become NaN.  `push` only copies into a buffer; the work is done in batches,
when the buffer is full or an estimate is asked for, so its cost per sample is that of a memory
copy.  Sorting, dropping and counting happen here and nowhere else.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.online.estimator.series import IntArray
from ou_monitor.records import Counters, FloatArray, NAN
from ou_monitor.timeline.refresh import Batch

# No supply that this monitors comes near it, V; squares and cubes of what is beyond overflow.
MOST_VOLTAGE = 1.0e6
# A throttle beyond this is none in 0..1, however generous its ends (as in recordings).
MOST_THROTTLE = 2.0
# No stamp: a century of nanoseconds since 1970 is 3e9 s.
_MOST_STAMP = 1.0e12


def readings(t: FloatArray, voltage: FloatArray, throttle: FloatArray | None
             ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return samples with NaN in place of what is no reading (t in s, V, throttle 0..1)."""
    t = _within(t, _MOST_STAMP)
    voltage = _within(voltage, MOST_VOLTAGE)
    return t, voltage, None if throttle is None else _within(throttle, MOST_THROTTLE)


def _within(values: FloatArray, most: float) -> FloatArray:
    # The comparison is false for NaN too, which stays one.
    beyond = ~(np.abs(values) <= most)
    return np.where(beyond, NAN, values) if beyond.any() else values


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
# Samples averaged to one at most: 10 MHz; stamps that lie closer are no time.
MOST_BLOCK = 1000.0
_NONE = np.empty(0, dtype=np.int64)


class Intake:
    """Buffer in front of the window, and the account of every sample pushed."""

    def __init__(self) -> None:
        self._t = np.empty(BATCH)
        self._y = np.empty(BATCH)
        self._u = np.empty(BATCH)
        self._see()
        # Whether there is throttle in the buffer; if not, what is in its column is old.
        self._loaded = False
        self._fill = 0
        self._counts: dict[str, int] = {}
        self.newest = -math.inf

    def _see(self) -> None:
        # Copying into a slice takes half the time through these that it takes through NumPy.
        self._into: tuple[Any, ...] = self._t.data, self._y.data, self._u.data

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: all but the views of the buffers."""
        return {k: v for k, v in self.__dict__.items() if k != '_into'}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of another one."""
        self.__dict__.update(state)
        self._see()

    @property
    def counters(self) -> Counters:
        """Return what became of all samples so far."""
        return Counters(**self._counts)

    @property
    def used(self) -> int:
        """Return the number of samples that entered the window."""
        return self._counts.get('used', 0)

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
        into_t, into_y, into_u = self._into
        try:
            into_t[begin:end] = t
            into_y[begin:end] = y
            if type(u) is np.ndarray:
                into_u[begin:end] = u
        except ValueError:
            # Unaligned ones, say columns of packed records.
            return self.put(t.copy(), y.copy(), u if u is None else u + 0.0)
        if u is not None:
            if not self._loaded:
                self._u[:begin] = NAN
                self._loaded = True
            if type(u) is not np.ndarray:
                self._u[begin:end] = u
        elif self._loaded:
            self._u[begin:end] = NAN
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
            if not self._loaded:
                self._u[:at] = NAN
                self._loaded = True
            self._u[at] = u
        elif self._loaded:
            self._u[at] = NAN
        self._fill = at + 1
        return True

    def count(self, **more: int) -> None:
        """Add to the counters."""
        counts = self._counts
        for name, number in more.items():
            counts[name] = counts.get(name, 0) + number

    def forget(self) -> None:
        """Take the next sample as the first one."""
        self.newest = -math.inf

    def work_off(self, window: float) -> list[Batch]:
        """Empty the buffer (window in s)."""
        n = self._fill
        self._fill = 0
        t, y = self._t[:n], self._y[:n]
        u = self._u[:n] if self._loaded else None
        self._loaded = False
        self.count(pushed=n)
        # One pass says whether all is finite: a sum of finite stamps and volts is.
        if not math.isfinite(np.add.reduce(t) + np.add.reduce(y)):
            good = np.isfinite(t) & np.isfinite(y)
            self.count(non_finite=n - int(good.sum()))
            t, y, u = t[good], y[good], None if u is None else u[good]
        if not t.size:
            return []
        first = float(t[0]) - self.newest
        shortest = longest = first
        if t.size > 1:
            steps = t[1:] - t[:-1]
            shortest = min(first, float(np.minimum.reduce(steps)))
            # The first sample of all follows nothing: no pause lies before it.
            longest = float(np.maximum.reduce(steps))
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


def as_column(values: npt.ArrayLike) -> FloatArray:
    """Return values as a float64 array of shape (n,); a scalar becomes one sample."""
    return np.atleast_1d(np.asarray(values, dtype=np.float64))
