"""
From the cutoff that a law wants to the cutoff in force.

limits -> dead band -> smoothing in ln(fc), fast for a certain sigma -> slew limit -> 0.45 of the
sample rate, but not below fmin.  An unknown cutoff gives the fallback.  The cutoff in force never
leaves fmin..fmax, whatever the rate is.

Over many samples, the distance to the aim, in ln(cutoff), falls linearly while slewing and then as
exp(-t / constant). A search finds the transition; two numbers give all samples of a stretch, and
all stretches are computed at once.
"""

from __future__ import annotations

from bisect import bisect_left
import enum
import math

import numpy as np
from ou_monitor.online.settings import FilterSettings
from ou_monitor.records import FloatArray

# Convergence tolerance, in ln(cutoff).
ARRIVED = 1e-6


class CutoffWay:
    """
    Stretches of the way to the aims; `slewing`: whether the slew limit cut the last move, or None.

    elapsed, shape (n + 1,): s before each of n samples and at the end; dt: of each, s; most: 1/s.
    """

    def __init__(self, elapsed: FloatArray, dt: FloatArray, most: float) -> None:
        self.slewing: bool | None = None
        self._elapsed, self._dt, self._most = elapsed, dt, most
        # Floats of Python one by one, without a list of all.
        self._time: memoryview[float] = elapsed.data  # type: ignore[assignment]
        self._shortest, self._longest = float(dt.min()), float(dt.max())
        self._bounds: dict[float, tuple[float, float]] = {}
        # Of each stretch: first sample, ln of the aim, distance, its line's slope and its rate.
        self._first: list[int] = []
        self._parts: list[tuple[float, float, float, float]] = []

    def go(self, first: int, last: int, aim: float, gap: float, constant: float) -> float:
        """Approach an aim, Hz, over samples first..last - 1; return the remaining distance."""
        time, most, end = self._time, self._most, math.log(aim)
        bounds = self._bounds.get(constant)
        if bounds is None:
            bounds = self._bounds[constant] = (
                self._limit(self._shortest, constant), self._limit(self._longest, constant))
        low, high = bounds
        k = first
        while k < last and gap:
            far, now = abs(gap), time[k]
            line = rate = 0.0
            if far > high * (1.0 + 1e-12):
                self.slewing = True
                line = math.copysign(most, gap)
                after = bisect_left(time, now + (far - high) / most, k + 1, last)
                left = gap - line * (time[after] - now)
            elif far > low * (1.0 - 1e-12):
                # The length of the step decides whether it is cut.
                after, dt = k + 1, float(self._dt[k])
                self.slewing = far > self._limit(dt, constant)
                if self.slewing:
                    line = math.copysign(most, gap)
                    left = gap - line * dt
                else:
                    rate = 1.0 / constant if constant > 0.0 else 0.0
                    left = gap * math.exp(-rate * dt) if constant > 0.0 else 0.0
            else:
                self.slewing = False
                if constant <= 0.0:
                    gap = 0.0
                    break
                rate, after = 1.0 / constant, last
                left = gap * math.exp(-rate * (time[last] - now))
                if abs(left) < ARRIVED:
                    after = bisect_left(time, now + constant * math.log(far / ARRIVED),
                                        k + 1, last)
                    left = 0.0
            if abs(left) < ARRIVED:
                # The last of them is at the aim.
                left, after = 0.0, after - 1
            if after > k:
                self._first.append(k)
                self._parts.append((end, gap, line, rate))
            gap, k = left, after
        if k < last and not gap:
            self._first.append(k)
            self._parts.append((end, 0.0, 0.0, 0.0))
        return gap

    def cutoff(self) -> FloatArray:
        """Return the cutoff at each sample, Hz, shape (n,)."""
        n = self._dt.size
        parts = np.array(self._parts)
        first = np.array(self._first)
        if not parts[:, 1].any():
            return np.repeat(np.exp(parts[:, 0]), np.diff(first, append=n))
        sizes = np.diff(first, append=n)
        aim, gap, line, rate = (np.repeat(one, sizes) for one in parts.T)
        gone = self._elapsed[1:] - np.repeat(self._elapsed[first], sizes)
        rate *= -gone
        line *= gone
        gap *= np.exp(rate)
        gap -= line
        aim -= gap
        return np.asarray(np.exp(aim, out=aim))

    def _limit(self, dt: float, constant: float) -> float:
        """Return the distance beyond which a step is cut by the slew limit."""
        if math.isinf(self._most):
            return math.inf
        return self._most * dt / (-math.expm1(-dt / constant) if constant > 0.0 else 1.0)


LN2 = math.log(2.0)
# Highest cutoff as a share of the sample rate (Betaflight allows 0.475).
OF_RATE = 0.45
# Samples over which the sample rate is averaged; factor off the mean that makes an interval odd;
# odd intervals in a row that mean a new rate.
INTERVALS = 100
ODD = 5.0
_NEW = 5


class Bound(enum.Enum):
    """What decides the cutoff at this sample; the value is its text."""

    NONE = 'the law'
    LOWEST = 'fmin'
    LAG = 'fmin by max_lag'
    HIGHEST = 'fmax'
    RATE = '0.45 of the sample rate'
    SLEW = 'the slew limit'
    SMOOTHING = 'the smoothing'
    DEAD_BAND = 'the dead band'
    FALLBACK = 'the fallback'


class SampleInterval:
    """
    Mean time between samples, s, over some 100 of them; 0 before the second sample.

    Intervals over five times the mean are gaps and left out, unless a third of all are gaps. Five
    intervals in a row that are off by a factor of five are a new rate and restart the mean.
    """

    __slots__ = ('_long', '_n', '_short', 'mean')

    def __init__(self) -> None:
        self.mean = 0.0
        self._n = self._short = self._long = 0

    def add(self, dt: float) -> float:
        """Take an interval above 0, s; return the mean."""
        if dt > ODD * self.mean:
            self._short, self._long = 0, self._long + 2
            if self._n and self._long < 2 * _NEW:
                return self.mean
            return self._restart(dt)
        if self.mean > ODD * dt:
            self._short += 1
            if self._short >= _NEW:
                return self._restart(dt)
        else:
            # Two normal intervals make up for a gap.
            self._short, self._long = 0, max(self._long - 1, 0)
        if self._n < INTERVALS:
            self._n += 1
        self.mean += (dt - self.mean) / self._n
        return self.mean

    @property
    def settled(self) -> bool:
        """Whether the mean covers its full number of samples."""
        return self._n == INTERVALS

    def went_on(self, mean: float, samples: int) -> None:
        """Take a number of normal intervals by their mean (mean in s)."""
        self.mean = mean
        self._short, self._long = 0, max(self._long - samples, 0)

    def _restart(self, dt: float) -> float:
        self.mean, self._n = dt, 1
        self._short = self._long = 0
        return dt


def time_constant(settings: FilterSettings, error: float) -> float:
    """
    Return the time constant of the cutoff for a relative error of sigma.

    A level that wanders as a random walk of intensity q, seen with an error e
    over a correlation time T, is tracked best (steady Kalman filter) with the
    time constant e sqrt(T) / q: proportional to the error.  So it is
    `smoothing` at `smoothing_error`, in proportion elsewhere, within a factor
    of `smoothing_range` (Betaflight moves its notches 1 to 10 times as fast).

    result in s.
    """
    if error != error:
        return settings.smoothing
    most = settings.smoothing_range
    return settings.smoothing * min(max(error / settings.smoothing_error, 1.0 / most), most)


class CutoffControl:
    """The cutoff in force, and what limits it."""

    def __init__(self, settings: FilterSettings) -> None:
        self._settings = settings
        self._lowest = settings.lowest
        self._aim = self._moving = self._cutoff = settings.fallback
        self._wanted = math.nan
        self._started = self._follow_exactly = self._slewing = False

    @property
    def cutoff(self) -> float:
        """Cutoff in force, Hz."""
        return self._cutoff

    @property
    def wanted(self) -> float:
        """Cutoff that the law wants, within fmin..fmax, Hz; NaN when it does not know."""
        return self._clip(self._wanted)

    @property
    def bound(self) -> Bound:
        """Return what decides the cutoff in force."""
        s = self._settings
        if self._cutoff < self._moving:
            if self._cutoff > self._lowest:
                return Bound.RATE
            return Bound.LAG if s.max_lag else Bound.LOWEST
        if self._moving != self._aim:
            return Bound.SLEW if self._slewing else Bound.SMOOTHING
        if self._wanted != self._wanted:
            return Bound.FALLBACK
        if self._wanted <= self._lowest:
            return Bound.LAG if s.max_lag else Bound.LOWEST
        if self._wanted >= s.fmax:
            return Bound.HIGHEST
        return Bound.NONE if self._wanted == self._aim else Bound.DEAD_BAND

    def configure(self, settings: FilterSettings) -> None:
        """Change settings; the cutoff stays where it is, inside the new limits."""
        self._settings = settings
        self._lowest = settings.lowest
        self._moving = self._clip(self._moving)
        self._aim = self._clip(self._aim)
        self._cutoff = self._clip(min(self._cutoff, self._moving))
        self._follow_exactly = True
        if not self._started:
            self._aim = self._moving = self._cutoff = settings.fallback

    def update(self, wanted: float, error: float, dt: float, interval: float) -> float:
        """
        Take the law's cutoff; return the cutoff in force.

        wanted in Hz, dt in s, interval in s, result in Hz.
        """
        self._choose(wanted)
        if not self._started:
            self._started, self._moving = True, self._aim
        elif self._moving != self._aim and dt > 0.0:
            self._move(error, dt)
        self._limit(interval)
        return self._cutoff

    def run(self, begin: list[int], wanted: list[float], error: list[float],
            dt: FloatArray, interval: FloatArray) -> FloatArray:
        """
        Take the law's cutoffs from some samples on; return what `update` would have returned.

        begin: where each wanted cutoff begins, the first 0.

        wanted in Hz, dt and interval in s, shape (n,), result in Hz.
        """
        s = self._settings
        elapsed = np.concatenate(([0.0], np.cumsum(dt)))
        way = CutoffWay(elapsed, dt, s.slew * LN2 if s.slew else math.inf)
        aim, gap = math.nan, 0.0
        for first, last, one, of in zip(begin, [*begin[1:], dt.size], wanted, error):
            old = self._aim
            self._choose(one)
            if first == 0 or old != self._aim:
                gap += math.log(self._aim / (self._moving if first == 0 else old))
            if gap or self._aim != aim:
                aim = self._aim
                gap = way.go(first, last, aim, gap, time_constant(s, of))
        if way.slewing is not None:
            self._slewing = way.slewing
        self._moving = self._aim * math.exp(-gap) if gap else self._aim
        cutoff = np.minimum(way.cutoff(), OF_RATE / interval)
        np.clip(cutoff, self._lowest, s.fmax, out=cutoff)
        self._limit(float(interval[-1]))
        return cutoff

    def _choose(self, wanted: float) -> None:
        """Set the aim: the wanted cutoff once it is outside the dead band around the old aim."""
        if wanted != wanted:
            self._wanted, self._aim = wanted, self._settings.fallback
            self._follow_exactly = True
            return
        if wanted == self._wanted and not self._follow_exactly:
            return
        self._wanted = wanted
        inside = self._clip(wanted)
        band = self._settings.dead_band * LN2
        if self._follow_exactly or not self._started or abs(math.log(inside / self._aim)) > band:
            self._aim = inside
        self._follow_exactly = False

    def _move(self, error: float, dt: float) -> None:
        s = self._settings
        gap = math.log(self._aim / self._moving)
        constant = time_constant(s, error)
        step = gap * -math.expm1(-dt / constant) if constant > 0.0 else gap
        most = s.slew * LN2 * dt if s.slew else math.inf
        self._slewing = abs(step) > most
        if self._slewing:
            step = math.copysign(most, step)
        # Stop at the tolerance instead of creeping on.
        arrived = abs(gap - step) < ARRIVED
        self._moving = self._aim if arrived else self._moving * math.exp(step)

    def _limit(self, interval: float) -> None:
        """Bring the moving cutoff into force (interval in s; 0: not known)."""
        most = OF_RATE / interval if interval > 0.0 else math.inf
        self._cutoff = self._clip(min(self._moving, most))

    def _clip(self, cutoff: float) -> float:
        """Return a cutoff within fmin..fmax, Hz; NaN stays."""
        if cutoff != cutoff:
            return cutoff
        return min(max(cutoff, self._lowest), self._settings.fmax)
