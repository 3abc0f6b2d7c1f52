"""
A low-pass, or filtered derivative, whose cutoff follows the noise of the supply.

sigma -> law (`cutoff_laws`) -> wanted cutoff -> limits, smoothing, slew
(`cutoff_control`) -> cutoff in force -> filter (`filter_state`) -> output.

The derivative is the same low-pass, applied to the slope of the input.  It does not jump when the
cutoff changes, and is exact for an input that is linear between samples.

With the law `kalman` the output comes from `VoltageKalman` or `learned_wiener`.  The low-pass runs
in parallel at the cutoff of equal lag, and takes over while sigma is unknown.

The law `kalman` for the voltage itself: an OU around its level, measured with white noise.  The
level is the estimator's; its error is a second OU, with time constant `LEVEL_TIME`.  Without a
level the voltage counts as a random walk.  The state is the deviation from the level and the error
of the level, both exact over a step of any length.  The estimate has the least mean square error
(Kalman 1960; Anderson & Moore, Optimal Filtering, 1979, ch. 3), with the estimated sigma in place
of the true one.

Its lag is that of the steady filter with the present gain, over the mean step.  If it exceeds the
limit, just enough of the unfiltered input is mixed in to keep the limit (`lag.share_for_lag`).

Limits: the cutoff is constant within a step; frequencies above half the sample rate are aliased
before any filter.  The gain of `kalman` at frequency 0 is below 1; steps within 1 % of each other
count as equal.
"""

from __future__ import annotations

import cmath
from copy import copy
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from ou_monitor.online.filter.cutoff_control import (
    Bound, CutoffControl, OF_RATE, SampleInterval, time_constant)
from ou_monitor.online.filter.cutoff_laws import noise_left, wanted_cutoff
from ou_monitor.online.filter.filter_state import LowPassState
from ou_monitor.online.filter.lag import cutoff_for_lag, delay, most_lag, phase_lag, share_for_lag
from ou_monitor.online.filter.learned_wiener import LearnedWiener
from ou_monitor.online.settings import FilterSettings
from ou_monitor.records import FloatArray, NAN

# Time constant of the error of the level, s: ten default windows.
LEVEL_TIME = 20.0
# Relative change of sigma, alpha or the step, and factor in the error of the level, above which
# the model is computed again.
_SAME = 0.01
_SAME_LEVEL = 1.5
# Relative change of the gain below which it has settled, and above which the lag is computed
# again.
_SETTLED, _LAG_CHANGES = 1e-9, 1e-3
# Maximum number of step lengths whose models are kept.
_MODELS = 64
# Magnitude up to which squares and products cannot overflow.
_HIGHEST = 1e60


class KalmanInputs(NamedTuple):
    """Known properties of the supply."""

    sigma: float  # Noise intensity, V/sqrt(s)
    alpha: float  # Relaxation rate, 1/s
    level_se: float  # Standard error of the level, V; NaN: there is no level


class KalmanStep(NamedTuple):
    """The model over one step: transition, driving and stationary variance of each state."""

    # All covariances are diagonal; shape (2,).
    phi: FloatArray
    drive: FloatArray
    still: FloatArray


class VoltageKalman:
    """Kalman filter of the voltage, V; for `y`, `lag` and `mixed` see `LearnedWiener`."""

    def __init__(self, settings: FilterSettings, x: float, level: float) -> None:
        self._settings = settings
        self.y = x
        self.lag, self.mixed = NAN, 0.0
        self._log_sigma, self._known = NAN, KalmanInputs(NAN, NAN, NAN)
        self._level = level if level == level else x
        # Deviation from the level, error of the level.
        self._x = [x - self._level, 0.0]
        self._cov: FloatArray | None = None
        self._forget()

    def _forget(self) -> None:
        """Forget models, gain and lag."""
        self._models: dict[int, KalmanStep] = {}
        self._key: int | None = None
        self._moving = True
        self._gain, self._lag_gain = [0.0, 0.0], [NAN, NAN]

    def configure(self, settings: FilterSettings) -> None:
        """Change settings; keep the estimate."""
        self._settings = settings
        self._forget()

    def advance(self, dt: float, interval: float, x: float, slope: float, sigma: float,
                error: float, alpha: float, level: float, level_se: float) -> float:
        """Take a sample (dt in s, interval in s, alpha in 1/s, level in V, level_se in V)."""
        if level == level and level != self._level:
            # The error of the level absorbs the change, so that the output does not jump.
            self._x[1] -= level - self._level
            self._level = level
        self._learn(sigma, error, alpha, level, level_se, dt)
        key = round(math.log(dt) / _SAME)
        if key != self._key:
            self._key, self._moving = key, True
        step = self._model(key, dt)
        if self._moving:
            self._correct(step, interval)
        deviation, wrong = self._x[0] * float(step.phi[0]), self._x[1] * float(step.phi[1])
        off = x - self._level - deviation - wrong
        self._x = [deviation + self._gain[0] * off, wrong + self._gain[1] * off]
        found = self._level + self._x[0] + self._x[1]
        self.y = found + self.mixed * (x - found)
        return self.y

    def _learn(self, sigma: float, error: float, alpha: float, level: float, level_se: float,
               dt: float) -> None:
        """Smooth ln sigma; compute new models after sufficient changes."""
        wanted = math.log(min(max(sigma, 1.0 / _HIGHEST), _HIGHEST))
        if self._log_sigma != self._log_sigma:
            self._log_sigma = wanted
        constant = time_constant(self._settings, error)
        self._log_sigma += (wanted - self._log_sigma) * (
            -math.expm1(-dt / constant) if constant > 0.0 else 1.0)
        unsure = NAN
        if level == level:
            unsure = min(level_se, _HIGHEST) if level_se > 0.0 else 0.0
        old, now = self._known, KalmanInputs(math.exp(self._log_sigma), alpha, unsure)
        if (abs(now.sigma - old.sigma) <= _SAME * old.sigma
                and abs(alpha - old.alpha) <= _SAME * old.alpha
                and _nearly_equal(unsure, old.level_se)):
            return
        if self._cov is not None and unsure > old.level_se:
            more = self._cov.copy()
            more[1, 1] += unsure * unsure - old.level_se * old.level_se
            self._cov = more
        self._known = now
        self._models.clear()
        self._moving = True

    def _model(self, key: int, dt: float) -> KalmanStep:
        step = self._models.get(key)
        if step is None:
            if len(self._models) >= _MODELS:
                self._models.clear()
            step = self._models[key] = step_model(self._known, dt)
        return step

    def _correct(self, step: KalmanStep, interval: float) -> None:
        """Advance covariance and gain by a step, until they have settled."""
        white = self._settings.n0 / interval
        before = self._gain
        gain, self._cov = self._gain_over(step, white)
        self._gain = gain.tolist()
        self._moving = any(abs(a - b) > _SETTLED * abs(a) for a, b in
                           zip(self._gain, before, strict=True))
        even = self._model(round(math.log(interval) / _SAME), interval)
        if even is not step:
            gain, _ = self._gain_over(even, white)
        if any(not abs(a - b) <= _LAG_CHANGES * abs(a) for a, b in
               zip(gain.tolist(), self._lag_gain, strict=True)):
            self._lag_gain = gain.tolist()
            self._update_lag(even.phi, gain, interval)

    def _gain_over(self, step: KalmanStep, white: float) -> tuple[FloatArray, FloatArray]:
        p = np.diag(step.still) if self._cov is None else (
            step.phi[:, None] * self._cov * step.phi + np.diag(step.drive))
        seen = p.sum(axis=1)
        total = float(seen.sum()) + white
        gain = seen / total if total > 0.0 else np.zeros_like(seen)
        return gain, p - np.outer(gain, seen)

    def _update_lag(self, phi: FloatArray, gain: FloatArray, interval: float) -> None:
        """Compute the present lag, and the share of the input that limits it."""
        s = self._settings
        back = cmath.exp(-2j * math.pi * s.lag_frequency * interval)
        loop = (np.eye(2) - gain[:, None]) * phi
        try:
            h = complex(np.linalg.solve(np.eye(2) - loop * back, gain).sum())
        except np.linalg.LinAlgError:
            # No correction and no decay: the response is undefined.
            return
        most = math.radians(phase_lag(s.order, s.lowest, s.lag_frequency))
        self.mixed = share_for_lag(h, 1.0 + 0.0j, most)
        self.lag = math.degrees(-cmath.phase(h + self.mixed * (1.0 - h)))


def step_model(known: KalmanInputs, dt: float) -> KalmanStep:
    """Return the model for a step (dt in s)."""
    levelled = known.level_se == known.level_se
    slow = 1.0 / LEVEL_TIME
    error = known.level_se if levelled else 0.0
    both = (_ou(known.alpha if levelled else 0.0, known.sigma, dt),
            _ou(slow, error * math.sqrt(2.0 * slow), dt))
    return KalmanStep(*(np.array(one) for one in zip(*both, strict=True)))


def _ou(rate: float, intensity: float, dt: float) -> tuple[float, float, float]:
    """Return transition, driving and stationary variance of an OU; of a random walk at rate 0."""
    if rate == 0.0:
        # The initial value is unknown: the first sample determines it.
        drive = intensity * intensity * dt
        return 1.0, drive, 1e6 * drive
    still = intensity * intensity / (2.0 * rate)
    return math.exp(-rate * dt), -still * math.expm1(-2.0 * rate * dt), still


def _nearly_equal(one: float, other: float) -> bool:
    """Return whether two errors of the level are nearly equal, or both unknown."""
    if one != one or other != other:
        return one != one and other != other
    return other / _SAME_LEVEL <= one <= other * _SAME_LEVEL


_TWO_PI = 2.0 * math.pi
# Signals and stamps beyond this, and steps below it, overflow in the filter.
LARGEST, LATEST, SHORTEST = 1e150, 1e18, 1e-12
# Minimum gap in mean intervals, and minimum number of samples in the mean to count one.
_GAP, _KNOWN = 5.0, 10
# Number of samples that are converted to Python floats at a time; limits memory.
_PIECE = 16384
# Relative change of the mean interval at which the law is evaluated again: five standard
# deviations of the mean of 100 intervals that jitter uniformly by up to a third.
_MOVED = 0.1

_Maybe = npt.ArrayLike | None


@dataclass
class FilterCounters:
    """Numbers of samples by outcome."""

    samples: int = 0  # Samples used
    # Samples that were not finite or beyond 1e150, or whose stamp was not finite or beyond 1e18 s.
    non_finite: int = 0
    repeated: int = 0  # Samples less than 1 ps after the previous one
    back: int = 0  # Samples with an earlier stamp, from which time continues
    gaps: int = 0  # Steps of more than five mean intervals


class AdaptiveLowPass:
    """
    Low-pass filter with a cutoff driven by sigma.

    Parameters
    ----------
    **options
        Fields of `FilterSettings`, as the parameters of the node.

    Raises
    ------
    ValueError
        For an option that is unknown or out of range, or that contradicts
        another.

    Examples
    --------
    >>> import numpy as np
    >>> from ou_monitor import AdaptiveLowPass
    >>> lowpass = AdaptiveLowPass(law='threshold', sigma_ref=0.3, fmin=20.0, fmax=100.0)
    >>> t = np.arange(2000) / 1000.0
    >>> y = lowpass.filter(t, np.sin(6.0 * t), sigma=0.1)      # quiet supply: open
    >>> y.shape, round(lowpass.cutoff)
    ((2000,), 100)

    """

    def __init__(self, **options: object) -> None:
        self._settings = FilterSettings.from_options(options)
        self._control = CutoffControl(self._settings)
        self._state = LowPassState()
        # For the law kalman; None until sigma is known for the first time.
        self._kalman: VoltageKalman | LearnedWiener | None = None
        self._known = False
        self._sigma = NAN
        # State before a parameter changed, until the next sample.
        self._before: VoltageKalman | LearnedWiener | None = None
        self._interval = SampleInterval()
        self.counters = FilterCounters()
        self._t: float | None = None
        self._x = 0.0
        self._raw = self._offset = 0.0
        self._out = NAN
        self._law_inputs: tuple[float, ...] | None = None
        self._wanted = NAN
        # Mean interval at the last evaluation of the law, s.
        self._law_interval = 0.0

    @property
    def settings(self) -> FilterSettings:
        """Return the present settings."""
        return self._settings

    @property
    def cutoff(self) -> float:
        """
        Cutoff in force, within fmin..fmax, Hz.

        With `shadow`, the one that would be in force; with `kalman`, that of a low-pass of equal
        lag.
        """
        by_lag = self._equivalent_cutoff()
        return self._within_limits(by_lag) if by_lag == by_lag else self._control.cutoff

    @property
    def wanted(self) -> float:
        """Cutoff that the law requests, within fmin..fmax, Hz; NaN if unknown."""
        by_lag = self._equivalent_cutoff()
        return self._within_limits(by_lag) if by_lag == by_lag else self._control.wanted

    @property
    def highest(self) -> float:
        """Highest cutoff that the sample rate allows, Hz; inf while the rate is unknown."""
        return OF_RATE / self._interval.mean if self._interval.mean > 0.0 else math.inf

    def _within_limits(self, cutoff: float) -> float:
        s = self._settings
        return min(max(cutoff, s.lowest), s.fmax)

    @property
    def bound(self) -> Bound:
        """Return what decides the cutoff in force."""
        if self._kalman is not None and self._known:
            if self._kalman.mixed:
                return Bound.LAG if self._settings.max_lag else Bound.LOWEST
            by_lag = self._equivalent_cutoff()
            if by_lag >= self._settings.fmax:
                return Bound.HIGHEST
            return Bound.NONE if by_lag < self.highest * (1.0 - 1e-9) else Bound.RATE
        return self._control.bound

    @property
    def phase_lag(self) -> float:
        """Lag of the present filter at `lag_frequency`, degrees."""
        s = self._settings
        if self._kalman is not None and self._known and self._kalman.lag == self._kalman.lag:
            return self._kalman.lag
        return phase_lag(s.order, self.cutoff, s.lag_frequency)

    @property
    def delay(self) -> float:
        """Phase delay of the present filter at `lag_frequency`, s."""
        return delay(self.phase_lag, self._settings.lag_frequency)

    @property
    def noise_left(self) -> float:
        """
        Share of the variance of white noise that passes the low-pass, to 1 %.

        With the law `kalman`, that of the low-pass of equal lag; 1 with `shadow`, and until
        the sample rate is known.
        """
        by_lag = self._equivalent_cutoff()
        cutoff = by_lag if by_lag == by_lag else self._control.cutoff
        angle = _TWO_PI * cutoff * self._interval.mean
        if self._settings.shadow or not angle > 0.0:
            return 1.0
        return noise_left(self._settings.order, round(100.0 * math.log(angle)))

    def configure(self, **options: object) -> None:
        """
        Change options; the output does not jump, and the cutoff follows.

        If `shadow` changes, the output moves from one signal to the other with
        the time constant of the filter.

        Raises
        ------
        ValueError
            For an option that cannot be used (no option changes then), or
            another mode, whose output has another unit: make a new filter.

        """
        settings = FilterSettings.from_options(options, base=self._settings)
        if settings.mode != self._settings.mode and self._t is not None:
            raise ValueError(
                f"mode cannot change from '{self._settings.mode}' to '{settings.mode}' while "
                'filtering: the output would change its unit; make a new filter')
        other = settings.of_voltage != self._settings.of_voltage
        self._settings = settings
        self._control.configure(settings)
        self._law_inputs = None
        if settings.law != 'kalman' or other:
            self._kalman, self._before, self._known = None, None, False
        elif self._kalman is not None:
            self._before = copy(self._kalman)
            self._kalman.configure(settings)
        if self._t is not None:
            self._offset = self._out - self._source()

    def filter(self, t: npt.ArrayLike, x: npt.ArrayLike,  # noqa: A003
               sigma: npt.ArrayLike, *, sigma_se: _Maybe = None, alpha: _Maybe = None,
               throttle: _Maybe = None, level: _Maybe = None, level_se: _Maybe = None,
               ) -> FloatArray | float:
        """
        Filter samples.

        Parameters
        ----------
        t : float or array_like, shape (n,)
            Stamps, s.  A repeated or earlier stamp does not change the output
            and is counted; time continues from an earlier stamp.
        x : float or array_like, shape (n,)
            Signal, any unit.  NaN and infinite samples are counted and do not
            move the output.
        sigma : float or array_like, shape (n,)
            Noise intensity, V/sqrt(s); NaN means unknown (fallback cutoff).
        sigma_se : float or array_like, shape (n,), optional
            Standard error of ln sigma, as in `Estimate` (0.1: 10 %): the smaller
            it is, the faster the cutoff follows.
        alpha : float or array_like, shape (n,), optional
            Relaxation rate of the supply, 1/s; NaN or omitted: the parameter.
        throttle : float or array_like, shape (n,), optional
            Throttle, 0..1, for the law `throttle`.
        level : float or array_like, shape (n,), optional
            Level of the supply at the present throttle, V (`Estimate.u0`), for
            the law `kalman` of the voltage itself.
        level_se : float or array_like, shape (n,), optional
            Standard error of the level, V; NaN or omitted: it is exact.

        Returns
        -------
        float or ndarray, shape (n,)
            Filtered signal, or its derivative in unit/s (0 at the first
            sample); NaN until the first finite sample.

        Raises
        ------
        ValueError
            When the shapes differ.

        """
        stamps, signal = np.asarray(t, dtype=np.float64), np.asarray(x, dtype=np.float64)
        if stamps.shape != signal.shape or stamps.ndim > 1:
            raise ValueError('t and x must be two numbers or two arrays of one shape (n,): got '
                             f'{stamps.shape} and {signal.shape}')
        others = [np.asarray(NAN if one is None else one, dtype=np.float64)
                  for one in (sigma, sigma_se, alpha, throttle, level, level_se)]
        names = ('sigma', 'sigma_se', 'alpha', 'throttle', 'level', 'level_se')
        for name, one in zip(names, others, strict=True):
            if one.shape not in ((), stamps.shape):
                raise ValueError(
                    f'{name} must be one number or of the shape of t, {stamps.shape}: got '
                    f'{one.shape}')
        if stamps.ndim == 0:
            return self.step(float(stamps), float(signal), *map(float, others))
        out: FloatArray = np.empty(stamps.size)
        columns = np.broadcast_arrays(stamps, signal, *others)
        for begin in range(0, stamps.size, _PIECE):
            part = slice(begin, begin + _PIECE)
            out[part] = [self.step(*one) for one in zip(
                *(column[part].tolist() for column in columns))]
        return out

    def step(self, t: float, x: float, sigma: float, sigma_se: float = NAN,
             alpha: float = NAN, throttle: float = NAN, level: float = NAN,
             level_se: float = NAN) -> float:
        """Filter one sample like `filter`, but faster; NaN for unknown inputs."""
        if not (abs(x) < LARGEST and abs(t) < LATEST):
            self.counters.non_finite += 1
            return self._out
        error = sigma_se if sigma_se >= 0.0 else NAN
        derivative = self._settings.mode == 'derivative'
        if self._t is None:
            self.counters.samples += 1
            if self._settings.law == 'kalman':
                # The lag is unknown before the first step.
                self._start_kalman(x, sigma, level)
            self._control.update(self._law_cutoff(sigma, alpha, throttle, 0.0), error, 0.0, 0.0)
            self._state.y = self._raw = self._out = 0.0 if derivative else x
            self._t, self._x = t, x
            return self._out
        dt = t - self._t
        if dt < SHORTEST:
            if dt < 0.0:
                # The next slope begins at the earlier stamp.
                self._t, self._x = t, x
                self.counters.back += 1
            else:
                self.counters.repeated += 1
            return self._out
        self.counters.samples += 1
        if dt > _GAP * self._interval.mean and self.counters.samples > _KNOWN:
            self.counters.gaps += 1
        interval = self._interval.add(dt)
        if self._settings.law == 'kalman':
            about = (level if abs(level) < LARGEST else NAN, level_se)
            self._run_kalman(dt, interval, x, sigma, error, alpha, about)
        cutoff = self._control.update(
            self._law_cutoff(sigma, alpha, throttle, interval), error, dt, interval)
        angle = _TWO_PI * cutoff * dt
        start, end = self._x, x
        if derivative:
            start = end = (x - self._x) / dt
        self._t, self._x, self._raw = t, x, end
        self._state.advance(self._settings.order, angle, start, end)
        self._out = self._source()
        if self._offset:
            self._offset *= math.exp(-angle)
            self._out += self._offset
        return self._out

    def _source(self) -> float:
        """Return the output without the transition after a switch of `shadow`."""
        if self._settings.shadow:
            return self._raw
        return self._kalman.y if self._kalman is not None and self._known else self._state.y

    def _start_kalman(self, x: float, sigma: float, level: float) -> None:
        """Make the Kalman filter at the first known sigma."""
        self._known = math.isfinite(sigma) and sigma >= 0.0
        if self._known:
            self._sigma = sigma
            self._kalman = (
                VoltageKalman(self._settings, x, level if abs(level) < LARGEST else NAN)
                if self._settings.of_voltage else LearnedWiener(self._settings, x))

    def _run_kalman(self, dt: float, interval: float, x: float, sigma: float, error: float,
                    alpha: float, level: tuple[float, float]) -> None:
        """Run the Kalman filter, with the last known sigma."""
        begun = self._kalman is None
        if self._kalman is None:
            self._start_kalman(x, sigma, level[0])
        if self._kalman is None:
            return
        known = math.isfinite(sigma) and sigma >= 0.0
        if known:
            self._sigma = sigma
        rate = alpha if 1e-6 <= alpha <= 1e9 else self._settings.alpha
        sample = (dt, interval, x, (x - self._x) / dt, self._sigma, error, rate, *level)
        self._kalman.advance(*sample)
        if begun:
            self._offset = self._out - self._kalman.y
        elif self._before is not None:
            # The output continues from what the old parameters would have given.
            self._offset += self._before.advance(*sample) - self._kalman.y
        self._before = None
        if known != self._known:
            self._known = known
            self._offset += self._state.y - self._kalman.y if known else (
                self._kalman.y - self._state.y)

    def _law_cutoff(self, sigma: float, alpha: float, throttle: float, interval: float) -> float:
        """Return the wanted cutoff of the law, evaluated again only if an input has changed."""
        s = self._settings
        if s.law == 'kalman':
            return self._equivalent_cutoff()
        # Jitter of the stamps needs no new search.
        if abs(interval - self._law_interval) > _MOVED * self._law_interval:
            self._law_interval = interval
        # Replace NaN, which never equals itself.
        inputs = (*(one if one == one else math.inf for one in (sigma, alpha, throttle)),
                  self._law_interval)
        if inputs != self._law_inputs:
            self._wanted = wanted_cutoff(s, sigma, alpha, throttle, self._law_interval)
            self._law_inputs = inputs
        return self._wanted

    def _equivalent_cutoff(self) -> float:
        """Return the cutoff of the low-pass with the lag of the Kalman filter, Hz."""
        s = self._settings
        if self._kalman is None or not self._known:
            return NAN
        lag, mean = self._kalman.lag, self._interval.mean
        if lag != lag:
            return NAN
        highest = OF_RATE / mean if mean > 0.0 else s.fmax
        if lag <= phase_lag(s.order, highest, s.lag_frequency):
            return highest
        return cutoff_for_lag(s.order, min(lag, 0.999 * most_lag(s.order)), s.lag_frequency)
