r"""
The law `kalman` of the voltage itself: an OU around its level, seen in white noise.

The level is the estimator's and has an error, which is an OU of `LEVEL_TIME` beside the voltage's
own; without a level the voltage counts as a random walk.  The state is the deviation from the
level and the error of the level, both exact over a step of any length.  The estimate is the one of
least mean square error (Kalman 1960; Anderson & Moore, Optimal Filtering, 1979, ch. 3), with sigma
where the truth would have to stand.

Its lag is that of the steady filter with the gain of the moment, over the mean step.  Where it
exceeds the limit the output is mixed with what is unfiltered, just so far that the limit is kept
(`lag.share_for_lag`).

Limits: its gain at frequency 0 is below 1.  Steps within 1 % of each other count as equal.
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import numpy as np
from ou_monitor.online.filter.cutoff_control import time_constant
from ou_monitor.online.filter.lag import phase_lag, share_for_lag
from ou_monitor.online.settings import FilterSettings
from ou_monitor.records import FloatArray, NAN

# Time over which what is not told of the level moves, s: ten of the default windows.
LEVEL_TIME = 20.0
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


class Known(NamedTuple):
    """What is known of the supply."""

    sigma: float  # Noise intensity, V/sqrt(s)
    alpha: float  # Relaxation rate, 1/s
    level_se: float  # Standard error of the level, V; NaN: there is no level


class Step(NamedTuple):
    """The model over one step: transition, driving and stationary variance of each state."""

    # All covariances are diagonal; shape (2,).
    phi: FloatArray
    drive: FloatArray
    still: FloatArray


class VoltageKalman:
    """
    Kalman filter of the voltage, V, from a first one x on (level of the supply in V, or NaN).

    `y` is the output, V; `lag` and `mixed` are those of `LearnedWiener`.
    """

    def __init__(self, settings: FilterSettings, x: float, level: float) -> None:
        self._settings = settings
        self.y = x
        self.lag, self.mixed = NAN, 0.0
        self._log_sigma, self._known = NAN, Known(NAN, NAN, NAN)
        self._level = level if level == level else x
        # Deviation from the level, error of the level.
        self._x = [x - self._level, 0.0]
        self._cov: FloatArray | None = None
        self._forget()

    def _forget(self) -> None:
        """Have models, gain and lag made anew."""
        self._models: dict[int, Step] = {}
        self._key: int | None = None
        self._moving = True
        self._gain, self._told = [0.0, 0.0], [NAN, NAN]

    def configure(self, settings: FilterSettings) -> None:
        """Change settings; the estimate goes on."""
        self._settings = settings
        self._forget()

    def advance(self, dt: float, interval: float, x: float, slope: float, sigma: float,
                error: float, alpha: float, level: float, level_se: float) -> float:
        """Take a sample (dt in s, interval in s, alpha in 1/s, level in V, level_se in V)."""
        if level == level and level != self._level:
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
        deviation, wrong = self._x[0] * float(step.phi[0]), self._x[1] * float(step.phi[1])
        off = x - self._level - deviation - wrong
        self._x = [deviation + self._gain[0] * off, wrong + self._gain[1] * off]
        found = self._level + self._x[0] + self._x[1]
        self.y = found + self.mixed * (x - found)
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
        if level == level:
            unsure = min(level_se, _LARGEST) if level_se > 0.0 else 0.0
        old, now = self._known, Known(math.exp(self._log_sigma), alpha, unsure)
        if (abs(now.sigma - old.sigma) <= _SAME * old.sigma
                and abs(alpha - old.alpha) <= _SAME * old.alpha
                and _alike(unsure, old.level_se)):
            return
        if self._cov is not None and unsure > old.level_se:
            more = self._cov.copy()
            more[1, 1] += unsure * unsure - old.level_se * old.level_se
            self._cov = more
        self._known = now
        self._models.clear()
        self._moving = True

    def _model(self, key: int, dt: float) -> Step:
        step = self._models.get(key)
        if step is None:
            if len(self._models) >= _MODELS:
                self._models.clear()
            step = self._models[key] = step_model(self._known, dt)
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
        p = np.diag(step.still) if self._cov is None else (
            step.phi[:, None] * self._cov * step.phi + np.diag(step.drive))
        seen = p.sum(axis=1)
        total = float(seen.sum()) + white
        gain = seen / total if total > 0.0 else np.zeros_like(seen)
        return gain, p - np.outer(gain, seen)

    def _tell(self, phi: FloatArray, gain: FloatArray, interval: float) -> None:
        """Tell the lag of the filter as it stands, and what share of the input bounds it."""
        s = self._settings
        back = cmath.exp(-2j * math.pi * s.lag_frequency * interval)
        loop = (np.eye(2) - gain[:, None]) * phi
        try:
            h = complex(np.linalg.solve(np.eye(2) - loop * back, gain).sum())
        except np.linalg.LinAlgError:
            # Nothing is corrected, nothing decays: it has no response.
            return
        most = math.radians(phase_lag(s.order, s.lowest, s.lag_frequency))
        self.mixed = share_for_lag(h, 1.0 + 0.0j, most)
        self.lag = math.degrees(-cmath.phase(h + self.mixed * (1.0 - h)))


def step_model(known: Known, dt: float) -> Step:
    """Return the model for a step of `dt`, s (dt in s)."""
    levelled = known.level_se == known.level_se
    slow = 1.0 / LEVEL_TIME
    error = known.level_se if levelled else 0.0
    both = (_ou(known.alpha if levelled else 0.0, known.sigma, dt),
            _ou(slow, error * math.sqrt(2.0 * slow), dt))
    return Step(*(np.array(one) for one in zip(*both, strict=True)))


def _ou(rate: float, intensity: float, dt: float) -> tuple[float, float, float]:
    """Return transition, driving and stationary variance of an OU; of a random walk at rate 0."""
    if rate == 0.0:
        # Nothing is known of where it starts: the first sample decides.
        drive = intensity * intensity * dt
        return 1.0, drive, 1e6 * drive
    still = intensity * intensity / (2.0 * rate)
    return math.exp(-rate * dt), -still * math.expm1(-2.0 * rate * dt), still


def _alike(one: float, other: float) -> bool:
    """Tell whether two errors of the level are about the same, or both not known."""
    if one != one or other != other:
        return one != one and other != other
    return other / _SAME_LEVEL <= one <= other * _SAME_LEVEL
