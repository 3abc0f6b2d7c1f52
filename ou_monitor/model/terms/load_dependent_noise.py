"""The white noise of the measurement follows throttle: ripple of the ESCs, read by the ADC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.load import ripple
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.measurement_noise import MeasurementNoise
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray

# A change of throttle is counted over this time, s, or over one sample where those are farther
# apart: what the filter onboard takes as one correction.
_SPAN = 0.02
# Stamps nearer than this are one, s.
_HAIR = 1e-9
# A fit stays within a factor of e^4 on the deviation at the ripple's peak; and within these ratios
# for a step of throttle, of which the least is none.
_MOST = 8.0
_LEAST_STEP, _MOST_STEP = 1e-3, 1e5
# Ratios that a start is chosen from.
_STEPS = np.geomspace(0.1, 1e4, 26)


@dataclass(frozen=True)
class LoadDependentNoise(Term):
    """
    Multiply the variance of the white noise by exp(ripple r(u)) + (step du)^2.

    r(u) = u (1.4 - u)/0.49 is the ripple current of an ESC over throttle, 1 at u = 0.7; du is the
    change of throttle in the last 20 ms: throttle and voltage are not read at one moment, so that
    an error as large as the change is added.  It changes what `measurement_noise` adds, and
    nothing without one.
    """

    NAME: ClassVar[str] = 'load_dependent_noise'
    FAMILY: ClassVar[str] = 'intensity'
    STAGE: ClassVar[Stage] = Stage.INSTRUMENT
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.DRIVE
    SIGNS: ClassVar[tuple[str, ...]] = ('variance throttle', 'variance change')
    MEASURED: ClassVar[bool] = True
    CHANGES: ClassVar[type[Term] | None] = MeasurementNoise
    # In white noise that the rail hides, one looks like the other.
    MEANING: ClassVar[str] = (
        'The white noise of the reading grows with throttle or with its changes: ripple of the '
        'ESCs, which the ADC samples.')
    REMEDY: ClassVar[str] = (
        'Put capacitance at the ESCs or a filter before the ADC; weigh readings at high throttle '
        'less.')
    SEPARATED_BY: ClassVar[str] = (
        'the same flight at several times the sampling rate: white noise has no memory there '
        'either')

    ripple: float = parameter('', 'ln of the factor on the variance at throttle 0.7')
    step: float = parameter(
        '', 'what a change of throttle from 0 to 1 within 20 ms adds, over that deviation', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        recent = _Recent()

        def effect(s: Segment) -> None:
            factor = np.exp(np.clip(self.ripple * ripple(s.throttle), -_MOST, _MOST))
            if self.step:
                factor += np.square(self.step * (s.throttle - recent(s.at, s.throttle)))
            s.noise = s.noise * np.sqrt(factor)

        return effect

    def free(self) -> tuple[str, ...]:
        """Return both: logarithms, the first of either sign."""
        return 'ripple', 'step'

    def moved(self, name: str, by: float) -> LoadDependentNoise:
        """Return the term with one logarithm moved."""
        if name == 'step':
            return replace(self, step=min(max(
                self.step * math.exp(by), _LEAST_STEP), _MOST_STEP))
        return replace(self, ripple=min(max(self.ripple + by, -_MOST), _MOST))

    def per_coordinate(self, name: str) -> float:
        """Return the derivative of a parameter with respect to its logarithm."""
        return self.step if name == 'step' else 1.0

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the slope that the logarithms of the squared scores have, and the best step."""
        if view.throttle is None:
            return ()
        u = view.throttle[view.train]
        square = view.z[view.train] ** 2
        moved = np.square(u - _Recent()(view.at[view.train], u))
        # Where throttle rests, ripple alone is seen.  The logarithm of a squared normal score, cut
        # from below: those next to zero say nothing.
        still = moved <= float(np.median(moved))
        columns = np.column_stack((np.ones(u.size), ripple(u)))
        log = np.log(np.maximum(square[still], 1e-3))
        beta = np.linalg.lstsq(columns[still], log, rcond=1e-8)[0]
        slope = float(np.clip(beta[1], -0.5 * _MOST, 0.5 * _MOST))
        base = np.exp(slope * ripple(u))

        def cost(step: float) -> float:
            factor = base + step * step * moved
            # Of any scale: the measurement noise beside it is fitted.
            return 0.5 * float(np.log(factor).mean()) + 0.5 * math.log(
                max(float((square / factor).mean()), 1e-300))

        return (cls(slope, min(_STEPS.tolist(), key=cost)),)


class _Recent:
    """Throttle `_SPAN` before each sample, or that of the sample before where it is older."""

    def __init__(self) -> None:
        self._times = np.empty(0)
        self._values = np.empty(0)

    def __call__(self, at: FloatArray, throttle: FloatArray) -> FloatArray:
        """Return it for the next samples (at in s)."""
        done = self._times.size
        times = np.concatenate((self._times, at))
        values = np.concatenate((self._values, throttle))
        hair = _HAIR + 2.0 * np.spacing(np.abs(at))
        then = np.searchsorted(times, at - _SPAN + hair, side='right') - 1
        then = np.clip(then, 0, None)
        # Never later than the sample before.
        then = np.minimum(then, np.maximum(np.arange(done, times.size) - 1, 0))
        keep = max(int(then[-1]) - 1, 0)
        self._times, self._values = times[keep:], values[keep:]
        return np.asarray(values[then], dtype=np.float64)
