"""
A low-pass, or filtered derivative, whose cutoff follows the noise of the supply.

sigma -> law -> wanted cutoff -> limits, smoothing, slew -> cutoff in force (`cutoff`) -> filter
(`filter_state`) -> output.

The derivative is the same low-pass, applied to the slope of the input.  It does not jump when the
cutoff changes, and is exact for an input that is linear between samples.

With the law `kalman`, the output comes from `learned_wiener`.  The low-pass runs in parallel, at
the cutoff of equal lag, and gives the output while sigma is unknown.

Limits: the cutoff is constant within a step; frequencies above half the sample rate are aliased by
the sampling, before the filter.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.online.filter.cutoff import (
    Bound, CutoffControl, OF_RATE, SampleInterval, wanted_cutoff)
from ou_monitor.online.filter.filter_state import (
    cutoff_for_lag, LowPassState, most_lag, phase_lag)
from ou_monitor.online.filter.learned_wiener import LearnedWiener
from ou_monitor.online.settings import FilterSettings
from ou_monitor.records import FloatArray, NAN

_TWO_PI = 2.0 * math.pi
# Limits within which nothing overflows: maximum signal; maximum stamp, s; minimum step, s.
LARGEST, LATEST, SHORTEST = 1e150, 1e18, 1e-12
# Minimum length of a gap, in mean intervals; number of samples before gaps are counted.
_GAP, _KNOWN = 5.0, 10
# Number of samples converted to Python floats at a time; limits memory.
_PIECE = 16384
# Relative change of the mean interval at which the law is evaluated again: five standard
# deviations of the mean of 100 intervals that jitter uniformly by up to a third.
_MOVED = 0.1

_Maybe = npt.ArrayLike | None


@dataclass
class FilterCounters:
    """Counts of samples by outcome."""

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
        # For the law `kalman`; None until sigma is known for the first time.
        self._kalman: LearnedWiener | None = None
        self._known = False
        self._sigma = NAN
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

        With `shadow`, the cutoff that would be in force; with `kalman`, the cutoff of a low-pass
        of equal lag.
        """
        by_lag = self._equivalent_cutoff()
        return by_lag if by_lag == by_lag else self._control.cutoff

    @property
    def wanted(self) -> float:
        """Cutoff that the law requests, within fmin..fmax, Hz; NaN if unknown."""
        by_lag = self._equivalent_cutoff()
        return by_lag if by_lag == by_lag else self._control.wanted

    @property
    def highest(self) -> float:
        """Highest cutoff that the sample rate allows, Hz; inf while the rate is unknown."""
        return OF_RATE / self._interval.mean if self._interval.mean > 0.0 else math.inf

    @property
    def bound(self) -> Bound:
        """Return what determines the cutoff in force."""
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
        return self.phase_lag / (360.0 * self._settings.lag_frequency)

    def configure(self, **options: object) -> None:
        """
        Change options; the output does not jump, and the cutoff follows.

        If `shadow` changes, the output moves from one signal to the other with
        the time constant of the filter.

        Raises
        ------
        ValueError
            For an option that cannot be used (no option changes then), or for
            another mode: its output has another unit, so make a new filter.

        """
        settings = FilterSettings.from_options(options, base=self._settings)
        if settings.mode != self._settings.mode and self._t is not None:
            raise ValueError(
                f"mode cannot change from '{self._settings.mode}' to '{settings.mode}' while "
                'filtering: the output would change its unit; make a new filter')
        self._settings = settings
        self._control.configure(settings)
        self._law_inputs = None
        if settings.law != 'kalman':
            self._kalman, self._known = None, False
        elif self._kalman is not None:
            self._kalman.configure(settings)
        if self._t is not None:
            self._offset = self._out - self._source()

    def filter(self, t: npt.ArrayLike, x: npt.ArrayLike,  # noqa: A003
               sigma: npt.ArrayLike, *, sigma_se: _Maybe = None, alpha: _Maybe = None,
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
            Standard error of ln sigma, as in `Estimate` (0.1: 10 %); the cutoff
            follows faster if the error is smaller.
        alpha : float or array_like, shape (n,), optional
            Relaxation rate of the supply, 1/s; NaN or omitted: the parameter.

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
                  for one in (sigma, sigma_se, alpha)]
        for name, one in zip(('sigma', 'sigma_se', 'alpha'), others, strict=True):
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
             alpha: float = NAN) -> float:
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
                self._start_kalman(x, sigma)
            self._control.update(self._law_cutoff(sigma, alpha, 0.0), error, 0.0, 0.0)
            self._state.y = self._raw = self._out = 0.0 if derivative else x
            self._t, self._x = t, x
            return self._out
        dt = t - self._t
        if dt < SHORTEST:
            if dt < 0.0:
                # Continue from the earlier stamp.
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
            self._run_kalman(dt, interval, x, sigma, error, alpha)
        cutoff = self._control.update(
            self._law_cutoff(sigma, alpha, interval), error, dt, interval)
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
        """Return the output without the transition that follows a change of its source."""
        if self._settings.shadow:
            return self._raw
        return self._kalman.y if self._kalman is not None and self._known else self._state.y

    def _start_kalman(self, x: float, sigma: float) -> None:
        """Create the Kalman filter if sigma is known."""
        self._known = math.isfinite(sigma) and sigma >= 0.0
        if self._known:
            self._sigma = sigma
            self._kalman = LearnedWiener(self._settings, x)

    def _run_kalman(self, dt: float, interval: float, x: float, sigma: float, error: float,
                    alpha: float) -> None:
        """Run the Kalman filter, with the last known sigma."""
        begun = self._kalman is None
        if self._kalman is None:
            self._start_kalman(x, sigma)
        if self._kalman is None:
            return
        known = math.isfinite(sigma) and sigma >= 0.0
        if known:
            self._sigma = sigma
        rate = alpha if 1e-6 <= alpha <= 1e9 else self._settings.alpha
        self._kalman.advance(dt, interval, x, (x - self._x) / dt, self._sigma, error, rate)
        if begun:
            self._offset = self._out - self._kalman.y
        if known != self._known:
            self._known = known
            self._offset += self._state.y - self._kalman.y if known else (
                self._kalman.y - self._state.y)

    def _law_cutoff(self, sigma: float, alpha: float, interval: float) -> float:
        """Return the wanted cutoff of the law, evaluated again only if an input has changed."""
        s = self._settings
        if s.law == 'kalman':
            return self._equivalent_cutoff()
        # Jitter of the stamps must not cause a new search.
        if abs(interval - self._law_interval) > _MOVED * self._law_interval:
            self._law_interval = interval
        # Replace NaN, which never equals itself.
        inputs = (*(one if one == one else math.inf for one in (sigma, alpha)),
                  self._law_interval)
        if inputs != self._law_inputs:
            self._wanted = wanted_cutoff(s, sigma, alpha, self._law_interval)
            self._law_inputs = inputs
        return self._wanted

    def _equivalent_cutoff(self) -> float:
        """Return the cutoff, within fmin..fmax, that lags like the Kalman filter, Hz."""
        s = self._settings
        if self._kalman is None or not self._known:
            return NAN
        lag, mean = self._kalman.lag, self._interval.mean
        if lag != lag:
            return NAN
        found = OF_RATE / mean if mean > 0.0 else s.fmax
        if lag > phase_lag(s.order, found, s.lag_frequency):
            found = cutoff_for_lag(s.order, min(lag, 0.999 * most_lag(s.order)), s.lag_frequency)
        return min(max(found, s.lowest), s.fmax)
