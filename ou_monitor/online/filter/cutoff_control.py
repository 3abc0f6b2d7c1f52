"""
From the wanted cutoff of a law to the cutoff in force.

limits -> dead band -> smoothing of ln(fc), faster if the error of sigma is small -> slew limit ->
0.45 of the sample rate.  The fallback replaces an unknown wanted cutoff.  The cutoff in force is
always within fmin..fmax, even if 0.45 of the sample rate is below fmin.
"""

from __future__ import annotations

import enum
import math

from ou_monitor.online.settings import FilterSettings

# Convergence tolerance, in ln(cutoff).
ARRIVED = 1e-6
LN2 = math.log(2.0)
# Highest cutoff as a share of the sample rate (Betaflight allows 0.475).
OF_RATE = 0.45
# Number of samples over which the sample rate is averaged; ratio to the mean, up or down, beyond
# which an interval is an outlier; number of outliers in a row that show a new rate.
INTERVALS = 100
ODD = 5.0
_NEW = 5
# Relative error of sigma to which the parameter `smoothing` refers, and maximum factor by which
# other errors change the time constant (our choice, within Betaflight's 1 to 10).
_ERROR, _RANGE = 0.1, 4.0


class Bound(enum.Enum):
    """What determines the present cutoff; the value is its text."""

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
    """Mean time between samples, s, over about 100 of them; 0 before the second sample."""

    # Intervals above five times the mean count as gaps, and are left out.  If more than about a
    # third of all intervals are gaps, or if five successive intervals are below a fifth of the
    # mean, the mean starts again.

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
            # Two normal intervals outweigh a gap.
            self._short, self._long = 0, max(self._long - 1, 0)
        if self._n < INTERVALS:
            self._n += 1
        self.mean += (dt - self.mean) / self._n
        return self.mean

    def _restart(self, dt: float) -> float:
        self.mean, self._n = dt, 1
        self._short = self._long = 0
        return dt


def time_constant(settings: FilterSettings, error: float) -> float:
    """Return the time constant of the cutoff, s, for a relative error of sigma."""
    # A random walk of intensity q, measured with an error e of correlation time T, is tracked best
    # (steady Kalman filter) with the time constant e sqrt(T) / q, which is proportional to e.
    # Betaflight varies the speed of its notches by factors from 1 to 10.
    if error != error:
        return settings.smoothing
    return settings.smoothing * min(max(error / _ERROR, 1.0 / _RANGE), _RANGE)


class CutoffControl:
    """The cutoff in force, and what limits it."""

    def __init__(self, settings: FilterSettings) -> None:
        self._settings = settings
        self._lowest = settings.lowest
        # Target; cutoff that approaches the target; cutoff in force, Hz.
        self._aim = self._moving = self.cutoff = settings.fallback
        self._wanted = math.nan
        self._started = self._follow_exactly = self._slewing = False

    @property
    def wanted(self) -> float:
        """Wanted cutoff of the law, within fmin..fmax, Hz; NaN if unknown."""
        return self._clip(self._wanted)

    @property
    def bound(self) -> Bound:
        """Return what determines the cutoff in force."""
        s = self._settings
        if self.cutoff < self._moving:
            if self.cutoff > self._lowest:
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
        """Change settings; keep the cutoff as far as the new limits allow."""
        self._settings = settings
        self._lowest = settings.lowest
        self._moving = self._clip(self._moving)
        self._aim = self._clip(self._aim)
        self.cutoff = self._clip(min(self.cutoff, self._moving))
        self._follow_exactly = True
        if not self._started:
            self._aim = self._moving = self.cutoff = settings.fallback

    def update(self, wanted: float, error: float, dt: float, interval: float) -> float:
        """Take the law's cutoff; return the cutoff in force, Hz (times in s; 0: unknown)."""
        self._choose(wanted)
        if not self._started:
            self._started, self._moving = True, self._aim
        elif self._moving != self._aim and dt > 0.0:
            self._approach(time_constant(self._settings, error), dt)
        most = OF_RATE / interval if interval > 0.0 else math.inf
        self.cutoff = self._clip(min(self._moving, most))
        return self.cutoff

    def _choose(self, wanted: float) -> None:
        """Set the target to the wanted cutoff, unless it is in the dead band of the old target."""
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

    def _approach(self, constant: float, dt: float) -> None:
        """Move towards the target over a step, s."""
        slew = self._settings.slew * LN2 or math.inf
        off, most = math.log(self._moving / self._aim), slew * dt
        step = off * math.expm1(-dt / constant) if constant else -off
        self._slewing = not -most <= step <= most
        off += math.copysign(most, step) if self._slewing else step
        # Stop within the tolerance instead of approaching the target for ever.
        self._moving = self._aim * math.exp(off) if abs(off) >= ARRIVED else self._aim

    def _clip(self, cutoff: float) -> float:
        """Return a cutoff within fmin..fmax, Hz; NaN stays."""
        if cutoff != cutoff:
            return cutoff
        return min(max(cutoff, self._lowest), self._settings.fmax)
