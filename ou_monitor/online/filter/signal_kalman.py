r"""
Kalman filter of a signal in the noise of the supply: the law `kalman`.

The signal is one of

    the voltage itself, an Ornstein-Uhlenbeck process (OU) around its level, where
    the level is the estimator's and has an error that is estimated beside it;
    an OU of `signal_rms` and rate 2 pi signal_bandwidth (one pole);
    a Butterworth process of two poles, s'' + sqrt2 w s' + w^2 s = white,

seen with `coupling` times the deviation of the supply (an OU) and white noise
of density n0; see `signal_model`.  The estimate is the one of least mean square
error (Kalman 1960; Anderson & Moore, Optimal Filtering, 1979, ch. 3), with
sigma where the truth would have to stand.

Its lag is that of the steady filter with the gain of the moment, over the mean
step.  Where it exceeds the limit the output is mixed with what is unfiltered,
just so far that the limit is kept (`lag.share_for_lag`).

Limits: what is assumed of the signal decides; its gain at frequency 0 is below
1, and the slope of what is steady is not 0.  Steps within 1 % of each other
count as equal.
"""

from __future__ import annotations

import cmath
import math

import numpy as np
from ou_monitor.online.filter.cutoff_control import time_constant
from ou_monitor.online.filter.lag import phase_lag, share_for_lag
from ou_monitor.online.filter.signal_model import has_beside, Known, size_of, Step, step_model
from ou_monitor.online.settings import FilterSettings
from ou_monitor.records import FloatArray, NAN

# Relative change of sigma, alpha or the step that is worth another model; of the error of the
# level, as a factor.
_SAME = 0.01
_SAME_LEVEL = 1.5
# Relative change of the gain below which it has settled, and that for which the lag is told anew.
_SETTLED, _TOLD = 1e-9, 1e-3
# Models of different steps that are kept.
_MODELS = 64
# Nothing beyond this can overflow when it is squared and multiplied by what it may be.
_LARGEST = 1e60


class SignalKalman:
    """
    Kalman filter of the signal that the settings describe.

    Parameters
    ----------
    settings : FilterSettings
        Signal, noise, mode and limits of the lag.
    x : float
        Signal as measured, where it begins.
    level : float
        Level of the supply, V, where it is the signal; NaN: not known.

    Attributes
    ----------
    y : float
        Output: the signal, or its slope in mode derivative (unit/s).
    lag : float
        Lag of the output at `lag_frequency`, degrees; NaN while not known.
    mixed : float
        Share of what is unfiltered in it, 0..1, for the limit of the lag.

    """

    def __init__(self, settings: FilterSettings, x: float, level: float) -> None:
        self._settings = settings
        # Whether the slope is wanted: the second of the state.
        self._slot = 1 if settings.mode == 'derivative' else 0
        self.y = 0.0 if self._slot else x
        self.lag, self.mixed = NAN, 0.0
        self._log_sigma, self._known = NAN, Known(NAN, NAN, NAN)
        self._level = level if level == level else x
        self._lay_out(x, 0.0)

    def _lay_out(self, signal: float, slope: float) -> None:
        """Begin from an estimate, of which nothing is known but itself."""
        s = self._settings
        size = size_of(s)
        # Whether the signal is the voltage itself, and what is seen beside it.
        self._own, self._beside = not s.signal_bandwidth, has_beside(s)
        self._x = [0.0] * size
        self._x[0] = signal - (self._level if self._own else 0.0)
        if not self._own and s.signal_poles == 2:
            self._x[1] = slope
        self._look = np.zeros(size)
        self._look[0] = 1.0
        if self._beside:
            self._look[-1] = 1.0
        self._cov: FloatArray | None = None
        self._forget()

    def _forget(self) -> None:
        """Have models, gain and lag made anew."""
        self._models: dict[int, Step] = {}
        self._key: int | None = None
        self._moving = True
        self._gain, self._told = [0.0] * len(self._x), [NAN] * len(self._x)

    def configure(self, settings: FilterSettings) -> None:
        """Change settings; the estimate goes on."""
        old, self._settings = self._settings, settings
        signal = self._x[0] + (self._level + self._x[1] if self._own else 0.0)
        slope = 0.0 if self._own or old.signal_poles == 1 else self._x[1]
        if size_of(old) != size_of(settings) or any(
                bool(getattr(old, name)) != bool(getattr(settings, name))
                for name in ('signal_bandwidth', 'coupling')) or (
                old.signal_poles != settings.signal_poles):
            if not settings.signal_bandwidth:
                self._level = signal
            self._lay_out(signal, slope)
        self._forget()

    def advance(self, dt: float, interval: float, x: float, slope: float, sigma: float,
                error: float, alpha: float, level: float, level_se: float) -> float:
        """Take a sample (dt in s, interval in s, alpha in 1/s, level in V, level_se in V)."""
        if self._own and level == level and level != self._level:
            # The error of the level takes it up, so that what comes out stays.
            self._x[1] -= level - self._level
            self._level = level
        self._learn(sigma, error, alpha, level, level_se, dt)
        key = round(math.log(dt) / _SAME)
        if key != self._key:
            self._key, self._moving = key, True
        step = self._model(key, dt)
        if self._moving:
            self._correct(step, interval)
        old = self._x
        new = [sum(a * b for a, b in zip(row, old, strict=True)) for row in step.rows]
        off = x - new[0]
        if self._own:
            off -= self._level
        if self._beside:
            off -= new[-1]
        self._x = [a + k * off for a, k in zip(new, self._gain, strict=True)]
        found = self._x[self._slot]
        if self._own:
            found += self._level + self._x[1]
        self.y = found + self.mixed * ((slope if self._slot else x) - found)
        return self.y

    def _learn(self, sigma: float, error: float, alpha: float, level: float, level_se: float,
               dt: float) -> None:
        """Follow sigma in its logarithm; make new models for what has changed enough."""
        wanted = math.log(min(max(sigma, 1.0 / _LARGEST), _LARGEST))
        if self._log_sigma != self._log_sigma:
            self._log_sigma = wanted
        constant = time_constant(self._settings, error)
        self._log_sigma += (wanted - self._log_sigma) * (
            -math.expm1(-dt / constant) if constant > 0.0 else 1.0)
        unsure = NAN
        if self._own and level == level:
            unsure = min(level_se, _LARGEST) if level_se > 0.0 else 0.0
        old, now = self._known, Known(math.exp(self._log_sigma), alpha, unsure)
        if (abs(now.sigma - old.sigma) <= _SAME * old.sigma
                and abs(alpha - old.alpha) <= _SAME * old.alpha
                and _alike(unsure, old.level_se)):
            return
        if self._cov is not None and unsure > old.level_se:
            more = self._cov.copy()
            more[-1, -1] += unsure * unsure - old.level_se * old.level_se
            self._cov = more
        self._known = now
        self._models.clear()
        self._moving = True

    def _model(self, key: int, dt: float) -> Step:
        step = self._models.get(key)
        if step is None:
            if len(self._models) >= _MODELS:
                self._models.clear()
            step = self._models[key] = step_model(self._settings, self._known, dt)
        return step

    def _correct(self, step: Step, interval: float) -> None:
        """Bring the covariance over a step, and the gain; the same until it has settled."""
        white = self._settings.n0 / interval
        before = self._gain
        gain, self._cov = self._gain_over(step, white)
        self._gain = gain.tolist()
        self._moving = any(abs(a - b) > _SETTLED * abs(a) for a, b in
                           zip(self._gain, before, strict=True))
        even = self._model(round(math.log(interval) / _SAME), interval)
        if even is not step:
            gain, _ = self._gain_over(even, white)
        if any(not abs(a - b) <= _TOLD * abs(a) for a, b in
               zip(gain.tolist(), self._told, strict=True)):
            self._told = gain.tolist()
            self._tell(even.phi, gain, interval)

    def _gain_over(self, step: Step, white: float) -> tuple[FloatArray, FloatArray]:
        """Return the gain after a step and the covariance with it."""
        p = step.still if self._cov is None else step.phi @ self._cov @ step.phi.T + step.drive
        seen = p @ self._look
        total = float(self._look @ seen) + white
        gain = seen / total if total > 0.0 else np.zeros_like(seen)
        return gain, p - np.outer(gain, seen)

    @property
    def sigma(self) -> float:
        """Return the sigma that it goes by, V/sqrt(s)."""
        return math.exp(self._log_sigma)

    def transfer(self, interval: float, ratio: float) -> tuple[float, float]:
        """
        Return sum_k h_k ratio^k and h_1 of the weights h of past samples, and h_0 at ratio 0.

        interval in s.
        """
        phi = self._model(round(math.log(interval) / _SAME), interval).phi
        gain = np.array(self._gain)
        one = np.eye(gain.size)
        loop = (one - np.outer(gain, self._look)) @ phi
        try:
            state = np.linalg.solve(one - loop * ratio, gain)
        except np.linalg.LinAlgError:
            return math.nan, math.nan
        share = 1.0 - self.mixed
        return share * float(state[self._slot]), share * float((loop @ gain)[self._slot])

    def _tell(self, phi: FloatArray, gain: FloatArray, interval: float) -> None:
        """Tell the lag of the filter as it stands, and what share of the input bounds it."""
        s = self._settings
        w = 2.0 * math.pi * s.lag_frequency
        back = cmath.exp(-1j * w * interval)
        one = np.eye(gain.size)
        loop = (one - np.outer(gain, self._look)) @ phi
        try:
            state = np.linalg.solve(one - loop * back, gain)
        except np.linalg.LinAlgError:
            # Nothing is corrected, nothing decays: it has no response.
            return
        h = complex(self._look @ state if self._own else state[self._slot])
        raw = 1.0 + 0.0j
        if self._slot:
            # Both behind the true derivative.
            h /= 1j * w
            raw = (1.0 - back) / (1j * w * interval)
        most = math.radians(phase_lag(s.order, s.lowest, s.lag_frequency))
        self.mixed = share_for_lag(h, raw, most)
        self.lag = math.degrees(-cmath.phase(h + self.mixed * (raw - h)))


def _alike(one: float, other: float) -> bool:
    """Tell whether two errors of the level are about the same, or both not known."""
    if one != one or other != other:
        return one != one and other != other
    return other / _SAME_LEVEL <= one <= other * _SAME_LEVEL
