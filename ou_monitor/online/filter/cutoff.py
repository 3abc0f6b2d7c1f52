"""
Laws from sigma to the wanted cutoff, and the cutoff in force.

**Laws.** The supply U is an Ornstein-Uhlenbeck process of intensity sigma and rate alpha, and the
signal contains `coupling` times its deviation.  With w = 2 pi fc, the output variance is then
(coupling sigma)^2 V(w).  V is the integral of |H(iq)|^2 / (alpha^2 + q^2) over all angular
frequencies q, divided by 2 pi:

    low-pass, order 1     V = w / (2 alpha (w + alpha))
    low-pass, order 2     V = w (sqrt2 w + alpha) / (2 sqrt2 alpha (w^2 + sqrt2 w alpha + alpha^2))
    derivative, order 1   V = w^2 / (2 (w + alpha))
    derivative, order 2   V = w^3 / (2 sqrt2 (w^2 + sqrt2 w alpha + alpha^2))

All of these grow with w, so each variance belongs to one cutoff.

White noise: if the input is linear between samples, a step of the filter is
z' = F z + a x_(k-1) + b x_k (`transition` of `filter_state`).  So for independent
samples of variance 1, the stationary covariance is

    C = F C F^T + a a^T + b b^T + F b a^T + a b^T F^T.

Adjacent slopes (x_k - x_(k-1)) / dt of such samples have a correlation of -1/2.  With the
slopes as input, and g = a + b, C solves

    C dt^2 = F C F^T dt^2 + 2 g g^T - F g g^T - g g^T F^T.

Limits: the laws are for the stationary output at a constant cutoff, and ignore noise
above half the sample rate, which is aliased.

**Cutoff in force**: limits -> dead band -> smoothing of ln(fc), faster if the error of sigma is
small -> slew limit -> 0.45 of the sample rate.  The fallback replaces an unknown wanted cutoff.
The cutoff in force is always within fmin..fmax, even if 0.45 of the sample rate is below fmin.
"""

from __future__ import annotations

import enum
from functools import cache
import math

import numpy as np
from ou_monitor.online.filter.filter_state import transition
from ou_monitor.online.settings import FilterSettings
from ou_monitor.records import FloatArray, NAN

# Range of angles (2 pi cutoff interval) in the table, and step of their logarithms.  With this
# step, interpolation, and the power law below the range, are accurate to 1e-4.
_LEAST_ANGLE, _MOST_ANGLE, _STEP = 1e-4, 300.0, 0.02
# Minimum rise of ln noise from angle to angle; with less, all noise passes, and the table ends.
_STILL = 1e-6


def white_noise(mode: str, order: int, angle: float) -> float:
    """Return the output variance for independent samples of variance 1."""
    step = transition(order, angle)
    f, a, b = step[:, :2], step[:, 2], step[:, 3]
    if mode == 'lowpass':
        drive, mixed = np.outer(a, a) + np.outer(b, b), np.outer(f @ b, a)
    else:
        g = a + b
        drive, mixed = 2.0 * np.outer(g, g), -np.outer(f @ g, g)
    # Solve C = F C F^T + drive for the elements of C.
    return float(np.linalg.solve(
        np.eye(4) - np.kron(f, f), (drive + mixed + mixed.T).ravel())[0])


@cache
def _table(mode: str, order: int) -> tuple[FloatArray, FloatArray, float]:
    """Return ln of angles, ln of their noise, and the exponent of the noise below the range."""
    count = math.ceil(math.log(_MOST_ANGLE / _LEAST_ANGLE) / _STEP) + 1
    angle = math.log(_LEAST_ANGLE) + _STEP * np.arange(count)
    noise = np.log([white_noise(mode, order, one) for one in np.exp(angle).tolist()])
    rises = np.diff(noise) >= _STILL
    if not rises.all():
        angle, noise = (one[:1 + int(np.argmin(rises))] for one in (angle, noise))
    return (np.asarray(angle, np.float64), np.asarray(noise, np.float64),
            1.0 if mode == 'lowpass' else 1.0 + order)


def held_cutoff(mode: str, order: int, fmax: float, times: float, interval: float) -> float:
    """Return `relative_cutoff`, Hz, for independent samples every `interval` seconds."""
    angle, noise, power = _table(mode, order)
    log = math.log(TWO_PI * fmax * interval)
    before = math.log(white_noise(mode, order, math.exp(log))) if log > angle[-1] else (
        np.interp(log, angle, noise) + power * min(log - angle[0], 0.0))
    wanted = before - 2.0 * math.log(times)
    found = angle[0] + (wanted - noise[0]) / power if wanted < noise[0] else (
        np.interp(wanted, noise, angle))
    return math.exp(found) / (TWO_PI * interval)


TWO_PI = 2.0 * math.pi
_ROOT2 = math.sqrt(2.0)
_ROOT8 = 2.0 * _ROOT2


def wanted_cutoff(settings: FilterSettings, sigma: float, alpha: float, interval: float) -> float:
    """Return the law's cutoff, Hz, NaN if sigma is unknown (V/sqrt(s), 1/s, interval in s)."""
    if not (math.isfinite(sigma) and sigma >= 0.0):
        return NAN
    s = settings
    if s.law == 'threshold':
        # The paper, section 6.
        return s.fmax if sigma <= s.sigma_ref else s.lowest
    # Law constant_noise: the cutoff at which the rms of the output noise has the wanted value, by
    # default the rms at `sigma_ref` and fmax.  Without `coupling`, the noise is taken as white,
    # with a variance proportional to sigma^2.  (`lowpass` has the law kalman.)
    if s.coupling:
        rate = alpha if 1e-6 <= alpha <= 1e9 else s.alpha
        rms = s.noise_wanted or s.coupling * s.sigma_ref * math.sqrt(
            supply_noise(s.mode, s.order, s.fmax, rate))
        wanted = cutoff_for_noise(s.mode, s.order, rms, s.coupling * sigma, rate)
    else:
        wanted = s.fmax if sigma <= s.sigma_ref else relative_cutoff(
            s.mode, s.order, s.fmax, sigma / s.sigma_ref, interval)
    return min(max(wanted, s.lowest), s.fmax)


def relative_cutoff(mode: str, order: int, fmax: float, times: float, interval: float) -> float:
    """Return the cutoff, Hz, that keeps the output rms of fmax if white noise grows by `times`."""
    # interval in s; 0: a continuous signal.  The condition keeps within the range of `_table`.
    if interval > 0.0 and 1e-6 < TWO_PI * fmax * interval < 1e2 and times < 1e3:
        return held_cutoff(mode, order, fmax, times, interval)
    # Far below the sample rate, white noise of two-sided density N has the variance N w / 2 (order
    # 1) or N w / (2 sqrt 2) (order 2) after a low-pass: rms ~ sqrt(fc), so fc = fmax / times^2.
    if mode == 'lowpass':
        return fmax / (times * times)
    # Derivative, order 2: N int w'^2 |H|^2 dw' / 2 pi = N w^3 / (2 sqrt 2), so rms ~ fc^(3/2) and
    # fc = fmax / times^(2/3).  Order 1: only sampling makes the integral finite; for independent
    # samples of variance v it is v w^2, so fc = fmax / times.
    return float(fmax * times ** (-2.0 / 3.0)) if order == 2 else fmax / times


def supply_noise(mode: str, order: int, cutoff: float, alpha: float) -> float:
    """Return V as defined at the top of this module (cutoff in Hz, alpha in 1/s)."""
    w = TWO_PI * cutoff
    if order == 1:
        return (0.5 * w / (alpha * (w + alpha)) if mode == 'lowpass' else
                0.5 * w * w / (w + alpha))
    spread = _ROOT8 * (w * w + _ROOT2 * w * alpha + alpha * alpha)
    if mode == 'lowpass':
        return w * (_ROOT2 * w + alpha) / (alpha * spread)
    return w ** 3 / spread


# Range of ln of the cutoff, Hz, in the search.
_LOGS = -14.0, 21.0


def cutoff_for_noise(mode: str, order: int, rms: float, intensity: float,
                     alpha: float) -> float:
    """Return the cutoff, Hz, at which the supply's noise has a given rms; inf if always below."""
    if intensity <= 1e-12 * rms:
        return math.inf
    wanted = (rms / intensity) ** 2
    low, high = _LOGS
    if supply_noise(mode, order, math.exp(high), alpha) <= wanted:
        return math.inf
    while high - low > 1e-12:
        middle = 0.5 * (low + high)
        if supply_noise(mode, order, math.exp(middle), alpha) <= wanted:
            low = middle
        else:
            high = middle
    return math.exp(low)


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
