"""
One time line: samples of any source, in order, each reading once, and an account of all of them.

Node, estimator and bench take their samples from here, so the rules of a sample cannot differ:

- a stamp or a voltage that is not finite, or implausible, is dropped (`non_finite`);
- an implausible throttle or current is unknown at that sample;
- a stamp behind the newest is sorted in where it comes in one push with what it is late for;
  what comes later than that, or has the stamp of another sample, is dropped (`late`);
- a stamp that is earlier, or later, by more than a pause begins a new time line;
- a reading that a logger repeats counts once (`held`, timeline/refresh.py).

Limits: repeats are recognised from 64 samples on; until then they count as readings, and what is
taken from here says so when it begins again without them (`Batch.again`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.records import Counters, FloatArray, NAN
from ou_monitor.timeline.refresh import Batch, refresh_period, Repeats

# No supply that this monitors comes near it, V; squares and cubes of what is beyond overflow.
MOST_VOLTAGE = 1.0e6
# No current that this monitors comes near it, A.
MOST_CURRENT = 1.0e6
# A throttle beyond this is none in 0..1, however generous its ends.
MOST_THROTTLE = 2.0
# No stamp: a century of nanoseconds since 1970 is 3e9 s.
_MOST_STAMP = 1.0e12
# Samples collected before a batch is worked off: large enough that NumPy's
# overhead per call vanishes, small enough to stay in the cache.
BATCH = 32768
# Samples looked at for repeats, the fewest, and new ones from one look to the next.
TAIL, _ENOUGH, _LOOK = 1024, 64, 256
# Where repeats are looked for: a third of the samples repeat at two a reading, or more.
_TIED = 0.25


def plausible(values: FloatArray, most: float) -> FloatArray:
    """Return values with NaN in place of what is beyond `most` either way."""
    # The comparison is false for NaN too, which stays one.
    beyond = ~(np.abs(values) <= most)
    return np.where(beyond, NAN, values) if beyond.any() else values


def hold(values: FloatArray) -> FloatArray:
    """Return values with each unknown one replaced by the last that is known."""
    known = np.isfinite(values)
    place = np.maximum.accumulate(np.where(known, np.arange(values.size), -1))
    return np.where(place < 0, NAN, values[place]) if values.size else values


def plausible_samples(t: FloatArray, voltage: FloatArray, throttle: FloatArray | None
                      ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return samples with NaN in place of what is implausible (t in s, V, throttle 0..1)."""
    return (plausible(t, _MOST_STAMP), plausible(voltage, MOST_VOLTAGE),
            None if throttle is None else plausible(throttle, MOST_THROTTLE))


class TimeLine:
    """Buffer, order and account of the samples of one source."""

    def __init__(self) -> None:
        self._columns = np.empty((4, BATCH))
        self._see()
        # Whether there are throttles and currents in the buffer; if not, theirs are old.
        self._loaded = [False, False]
        self._fill = 0
        self._counts: dict[str, int] = {}
        self.newest = -math.inf
        self._repeats = Repeats()
        # Raw samples of this time line, t, V, throttle and current; new ones since the last look.
        self._tail = np.empty((4, 0))
        self._unseen, self._looked = 0, False

    def _see(self) -> None:
        # Copying into a slice takes half the time through these that it takes through NumPy.
        self._into: tuple[Any, ...] = tuple(column.data for column in self._columns)

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
        """Return the number of samples that were passed on."""
        return self._counts.get('used', 0)

    @property
    def waiting(self) -> int:
        """Return the number of samples not yet worked off."""
        return self._fill

    @property
    def period(self) -> float:
        """Return the samples a reading; 1 where none repeats."""
        return self._repeats.period

    def put(self, t: FloatArray, y: FloatArray, u: FloatArray | float | None,
            i: FloatArray | None = None) -> bool:
        """Copy samples into the buffer; return False, and do nothing, without room."""
        begin = self._fill
        end = begin + len(t)
        if end > BATCH:
            return False
        into = self._into
        try:
            into[0][begin:end] = t
            into[1][begin:end] = y
            for k, more in enumerate((u, i)):
                if type(more) is np.ndarray:
                    into[2 + k][begin:end] = more
        except ValueError:
            # Unaligned ones, say columns of packed records.
            return self.put(t.copy(), y.copy(), u if u is None else u + 0.0,
                            i if i is None else i + 0.0)
        for k, more in enumerate((u, i)):
            self._fill_load(k, more, begin, end)
        self._fill = end
        return True

    def put_one(self, t: float, y: float, u: float | None) -> bool:
        """Copy one sample into the buffer; return False, and do nothing, without room."""
        at = self._fill
        if at == BATCH:
            return False
        self._columns[0, at] = t
        self._columns[1, at] = y
        if u is not None or self._loaded[0]:
            self._fill_load(0, u, at, at + 1)
        if self._loaded[1]:
            self._fill_load(1, None, at, at + 1)
        self._fill = at + 1
        return True

    def _fill_load(self, k: int, more: FloatArray | float | None, begin: int, end: int) -> None:
        """Take throttle (0) or current (1) of the samples from `begin` on."""
        column = self._columns[2 + k]
        if more is not None:
            if not self._loaded[k]:
                column[:begin] = NAN
                self._loaded[k] = True
            if type(more) is not np.ndarray:
                column[begin:end] = more
        elif self._loaded[k]:
            column[begin:end] = NAN

    def count(self, **more: int) -> None:
        """Add to the counters."""
        counts = self._counts
        for name, number in more.items():
            counts[name] = counts.get(name, 0) + number

    def forget(self) -> None:
        """Take the next sample as the first one; the period of repeats stays known."""
        self.newest = -math.inf
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._repeats.forget()
        self._tail = np.empty((4, 0))
        self._unseen, self._looked = 0, False

    def work_off(self, pause: float) -> list[Batch]:
        """Empty the buffer; return what is to be taken, in order (pause in s)."""
        n = self._fill
        self._fill = 0
        t, y = self._columns[0, :n], self._columns[1, :n]
        u, i = (self._columns[2 + k, :n] if self._loaded[k] else None for k in (0, 1))
        self._loaded = [False, False]
        return self.take(t, y, u, i, pause)

    def take(self, t: FloatArray, y: FloatArray, u: FloatArray | None, i: FloatArray | None,
             pause: float) -> list[Batch]:
        """
        Take samples past the buffer; return the readings among them, in order.

        t in s, y in V, throttle 0..1, current in A, each of shape (n,); pause in s.
        """
        return [part for batch in self.order(t, y, u, i, pause) for part in self._readings(batch)]

    def order(self, t: FloatArray, y: FloatArray, u: FloatArray | None, i: FloatArray | None,
              pause: float) -> list[Batch]:
        """Take samples as `take` does; return all of them, repeats included, in order."""
        self.count(pushed=t.size)
        # One pass says whether all is finite: a sum of finite stamps and volts is.
        if not math.isfinite(np.add.reduce(t) + np.add.reduce(y)):
            good = np.isfinite(t) & np.isfinite(y)
            self.count(non_finite=t.size - int(good.sum()))
            t, y, u, i = _picked(good, t, y, u, i)
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
        if shortest > 0.0 and (longest <= pause or first == longest == math.inf):
            self._accept(t)
            return [Batch(t, y, u, i, shortest, longest, restart=False)]
        return self._untangle(t, y, u, i, pause)

    def _accept(self, t: FloatArray) -> None:
        self.count(used=t.size)
        self.newest = float(t[-1])

    def _untangle(self, t: FloatArray, y: FloatArray, u: FloatArray | None, i: FloatArray | None,
                  pause: float) -> list[Batch]:
        """Split where time starts anew, sort what is late, drop stamps that are there twice."""
        if pause == math.inf:
            batch = self._ordered(t, y, u, i, restart=False)
            return [] if batch is None else [batch]
        newest = np.maximum.accumulate(np.concatenate(([self.newest], t)))[:-1]
        fresh = (t < newest - pause) | (t > newest + pause)
        batches: list[Batch] = []
        begin = 0
        # Where time jumps, the running maximum starts again: one split at a time.
        while begin < t.size:
            jumps = np.flatnonzero(fresh[begin:])
            restart = bool(jumps.size and jumps[0] == 0) and math.isfinite(self.newest)
            later = jumps[jumps > 0]
            end = begin + int(later[0]) if later.size else t.size
            part = slice(begin, end)
            batch = self._ordered(*_picked(part, t, y, u, i), restart)
            if batch is not None:
                batches.append(batch)
            begin = end
            if begin < t.size:
                rest = np.concatenate(([self.newest], t[begin:]))
                rest[0] = -math.inf
                newest = np.maximum.accumulate(rest)[:-1]
                fresh[begin:] = (t[begin:] < newest - pause) | (t[begin:] > newest + pause)
                fresh[begin] = True
        return batches

    def _ordered(self, t: FloatArray, y: FloatArray, u: FloatArray | None, i: FloatArray | None,
                 restart: bool) -> Batch | None:
        if restart:
            self.newest = -math.inf
            self.count(resets=1)
        t, y, u, i = _picked(np.argsort(t, kind='stable'), t, y, u, i)
        keep = (np.diff(t, prepend=self.newest) > 0.0) & (t > self.newest)
        self.count(late=t.size - int(keep.sum()))
        t, y, u, i = _picked(keep, t, y, u, i)
        if not t.size:
            return None
        steps = np.diff(t, prepend=self.newest)
        self._accept(t)
        return Batch(t, y, u, i, float(steps.min()), float(steps.max()), restart)

    def _readings(self, batch: Batch) -> list[Batch]:
        """Drop repeats; begin again without them when the source is found to repeat."""
        if batch.restart:
            self._begin_anew()
        whole = np.concatenate([self._tail, batch.columns()], axis=1)
        self._unseen += batch.t.size
        self._tail = whole[:, -TAIL:].copy()
        before = self._repeats.period
        if self._unseen >= (_LOOK if self._looked else _ENOUGH):
            self._unseen, self._looked = 0, True
            self._repeats.period = self._refresh(before)
        if self._repeats.period == 1.0:
            if before > 1.0:
                self._repeats.forget()
            return [batch]
        again = before == 1.0
        if again:
            self._repeats.forget()
            batch = Batch.of(whole, batch.restart, again=True)
        kept = self._repeats.drop(batch)
        dropped = batch.t.size - (0 if kept is None else kept.t.size)
        self.count(held=dropped, used=-dropped)
        return [] if kept is None else [kept]

    def _refresh(self, known: float) -> float:
        """Return the samples a reading in the tail."""
        y = self._tail[1]
        if known == 1.0 and float(np.mean(y[1:] == y[:-1])) <= _TIED:
            return 1.0
        return refresh_period(y, known)


def _picked(which: Any, t: FloatArray, y: FloatArray, u: FloatArray | None, i: FloatArray | None,
            ) -> tuple[FloatArray, FloatArray, FloatArray | None, FloatArray | None]:
    """Return some of the samples."""
    return (t[which], y[which], None if u is None else u[which],
            None if i is None else i[which])


def as_column(values: npt.ArrayLike) -> FloatArray:
    """Return values as a float64 array of shape (n,); a scalar becomes one sample."""
    return np.atleast_1d(np.asarray(values, dtype=np.float64))
