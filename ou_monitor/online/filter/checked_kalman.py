r"""
The Kalman filter of a signal beside fixed low-passes: the one of least error by the signal itself.

What is assumed of a signal may be wrong, and then the filter of least error is not.  With x =
s + n and the noise n known, the error of any filter y of x follows without s (Stein 1981):

    E (y - s)^2 = E (y - x)^2 + 2 E y n - E n^2,

and of a derivative y, with the difference quotients x' = s' + n',

    E (y - s')^2 = E y^2 - 2 E y x' + 2 E y n' + E s'^2.

With the weights h of the past samples, white noise of variance v and an OU of variance V and
correlation r from sample to sample, E y n = h_0 v + V sum_k h_k r^k.  Running means of it tell of
each filter what it would have come to.

Limits: `n0`, `coupling` and sigma have to be right.  The means are over some 30 s: within them the
choice is late.  The low-passes are an octave or less apart.
"""

from __future__ import annotations

from copy import copy
import math

from ou_monitor.online.filter.filter_state import LowPassState
from ou_monitor.online.filter.lag import phase_lag
from ou_monitor.online.filter.signal_kalman import SignalKalman
from ou_monitor.online.settings import FilterSettings

NAN = math.nan
_TWO_PI = 2.0 * math.pi
# Low-passes from the lowest to the highest cutoff; s over which errors are averaged, and over
# which the output moves to another filter.
_PASSES, _MEMORY, _MOVE = 9, 30.0, 0.05
# The first choice, s: a signal is lost by a filter that is too slow for what comes after a calm,
# a derivative by noise through one that is too fast.
_FIRST, _FIRST_SLOPE = 1.0, 0.3
# s between choices (a manoeuvre after a calm is seen at once), and between looks at the noise.
_CHOOSE, _LOOK = 0.01, 0.1
# A choice is left for one of less than so much of its error.
_BETTER = 0.95


class CheckedKalman:
    """
    `SignalKalman`, or a fixed low-pass in its place.

    Parameters
    ----------
    settings : FilterSettings
        Signal, noise, mode, order and limits.
    x : float
        Signal as measured, where it begins.
    level : float
        Level of the supply, V, where it is the signal; NaN: not known.

    Attributes
    ----------
    y : float
        Output: the signal, or its slope in mode derivative (unit/s).

    """

    def __init__(self, settings: FilterSettings, x: float, level: float) -> None:
        self.kalman = SignalKalman(settings, x, level)
        self.y = self.kalman.y
        self._x = x
        self._offset = 0.0
        self._begin(settings)

    def _begin(self, settings: FilterSettings) -> None:
        """Begin the comparison anew."""
        self._settings = settings
        self._slope = settings.mode == 'derivative'
        self._checked = settings.signal_check and bool(settings.signal_bandwidth)
        step = (settings.fmax / settings.lowest) ** (1.0 / (_PASSES - 1))
        self._cutoffs = [settings.lowest * step**k for k in range(_PASSES)]
        self._passes = [LowPassState(self.y) for _ in self._cutoffs]
        self._errors = [0.0] * (_PASSES + 1)
        self._crossed = [0.0] * (_PASSES + 1)
        self._rest = 0.0
        self._for = self._since = self._looked = 0.0
        self._noise = NAN
        # The Kalman filter is the last.
        self._chosen = _PASSES

    def __copy__(self) -> CheckedKalman:
        """Return one that goes its own way."""
        other = object.__new__(CheckedKalman)
        other.__dict__.update(self.__dict__)
        other.kalman = copy(self.kalman)
        other._passes = [copy(one) for one in self._passes]
        other._errors, other._crossed = list(self._errors), list(self._crossed)
        return other

    @property
    def lag(self) -> float:
        """Lag of the output at `lag_frequency`, degrees; NaN while not known."""
        if self._chosen < _PASSES:
            s = self._settings
            return phase_lag(s.order, self._cutoffs[self._chosen], s.lag_frequency)
        return self.kalman.lag

    @property
    def mixed(self) -> float:
        """Share of what is unfiltered in the output, 0..1, for the limit of the lag."""
        return self.kalman.mixed if self._chosen == _PASSES else 0.0

    def configure(self, settings: FilterSettings) -> None:
        """Change settings; the estimate goes on."""
        self.kalman.configure(settings)
        self._begin(settings)

    def advance(self, dt: float, interval: float, x: float, slope: float, sigma: float,
                error: float, alpha: float, level: float, level_se: float) -> float:
        """Take a sample, as `SignalKalman` does (dt in s, alpha in 1/s, level in V)."""
        found = self.kalman.advance(dt, interval, x, slope, sigma, error, alpha, level, level_se)
        if not self._checked:
            self.y = found
            return found
        start, end = (slope, slope) if self._slope else (self._x, x)
        self._x = x
        order = self._settings.order
        outs = [one.advance(order, _TWO_PI * f * dt, start, end)
                for one, f in zip(self._passes, self._cutoffs, strict=True)]
        outs.append(found)
        self._for += dt
        share = max(dt / self._for, -math.expm1(-dt / _MEMORY))
        errors = self._errors
        for k, y in enumerate(outs):
            one = y * (y - 2.0 * slope) if self._slope else (y - x) * (y - x)
            errors[k] += share * (one - errors[k])
        if self._slope:
            self._rest += share * (slope * slope - self._rest)
        self._since += dt
        self._looked += dt
        if self._looked >= _LOOK or not self._noise == self._noise:
            self._look_at_noise(interval, alpha)
        if self._since >= _CHOOSE and self._for >= (_FIRST_SLOPE if self._slope else _FIRST):
            self._since = 0.0
            self._choose(outs, alpha)
        self.y = outs[self._chosen]
        if self._offset:
            self._offset *= math.exp(-dt / _MOVE)
            self.y += self._offset
        return self.y

    def _look_at_noise(self, interval: float, alpha: float) -> None:
        """Take what of the noise is in each output now into the means."""
        s = self._settings
        white = s.n0 / interval
        supply = (s.coupling * self.kalman.sigma)**2 / (2.0 * alpha)
        keep = math.exp(-alpha * interval)
        share = max(self._looked / self._for, -math.expm1(-self._looked / _MEMORY))
        for k in range(_PASSES + 1):
            now = self._cross(k, interval, white, supply, keep)
            if now == now:
                self._crossed[k] += share * (now - self._crossed[k])
        noise = (2.0 * (white + supply * (1.0 - keep)) / interval**2 if self._slope
                 else white + supply)
        self._noise = noise if not self._noise == self._noise else (
            self._noise + share * (noise - self._noise))
        self._looked = 0.0

    def _choose(self, outs: list[float], alpha: float) -> None:
        """Take the filter of least error, where that is clear; the output moves to it."""
        # What all have in common.
        rest = self._rest - self._noise if self._slope else -self._noise
        crossed = self._crossed
        left = [a + 2.0 * b + rest for a, b in zip(self._errors, crossed, strict=True)]
        best = min(range(_PASSES + 1), key=left.__getitem__)
        if best == self._chosen:
            return
        # The noise of a mean over `seen` independent spans of the supply.
        seen = alpha * min(self._for, _MEMORY)
        sure = 2.0 * abs(crossed[best] - crossed[self._chosen]) * math.sqrt(2.0 / seen)
        old = left[self._chosen]
        if left[best] < old - (1.0 - _BETTER) * max(old, 0.0) - sure:
            self._offset += outs[self._chosen] - outs[best]
            self._chosen = best

    def _cross(self, k: int, interval: float, white: float, supply: float,
               keep: float) -> float:
        """Return E y n of a filter, or E y n' of a derivative."""
        if k < _PASSES:
            first, second, all_of = _weights(
                self._settings.order, _TWO_PI * self._cutoffs[k] * interval, self._slope,
                interval, keep)
        else:
            first, second = self.kalman.transfer(interval, 0.0)
            all_of, _ = self.kalman.transfer(interval, keep)
            if self.kalman.mixed and not self._slope:
                first, all_of = first + self.kalman.mixed, all_of + self.kalman.mixed
            elif self.kalman.mixed:
                quotient = self.kalman.mixed / interval
                first, second = first + quotient, second - quotient
                all_of += quotient * (1.0 - keep)
        now = white * first + supply * all_of
        if not self._slope:
            return now
        before = white * second + supply * (first * keep + (all_of - first) / max(keep, 1e-12))
        return (now - before) / interval


def _weights(order: int, angle: float, slope: bool, interval: float,
             ratio: float) -> tuple[float, float, float]:
    """Return h_0, h_1 and sum_k h_k ratio^k of a low-pass (interval in s)."""
    def step(y: float, s: float, start: float, end: float) -> tuple[float, float]:
        one = LowPassState(y)
        one.slope = s
        one.advance(order, angle, start, end)
        return one.y, one.slope
    (f11, f21), (f12, f22) = step(1.0, 0.0, 0.0, 0.0), step(0.0, 1.0, 0.0, 0.0)
    (a1, a2), (b1, b2) = step(0.0, 0.0, 1.0, 0.0), step(0.0, 0.0, 0.0, 1.0)
    if slope:
        g1, g2 = (a1 + b1) / interval, (a2 + b2) / interval
        # The quotient of a sample and the one before, held over the step.
        second = f12 * g2 - f22 * g1
        zeros = [g1, second - g1, -second]
    else:
        zeros = [b1, a1 - f22 * b1 + f12 * b2, f12 * a2 - f22 * a1]
    trace, det = f11 + f22, f11 * f22 - f12 * f21
    first = zeros[0]
    all_of = (zeros[0] + ratio * (zeros[1] + ratio * zeros[2])) / (
        1.0 - ratio * (trace - ratio * det))
    return first, zeros[1] + trace * first, all_of
