"""The white noise of the measurement follows throttle: ripple of the ESCs, read by the ADC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
# A fit stays within: a factor of e^4 on the variance, at the ripple's peak and for a step of
# full throttle.
_MOST = 8.0


@dataclass(frozen=True)
class LoadDependentNoise(Term):
    """
    Multiply the variance of the white noise by exp(ripple r(u) + change sqrt|du|).

    r(u) = u (1.4 - u)/0.49 is the ripple current of an ESC over throttle, 1 at u = 0.7; du is the
    change of throttle in the last 20 ms.  It changes what `measurement_noise` adds, and nothing
    without one.
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
    change: float = parameter('', 'the same for a change of throttle from 0 to 1 within 20 ms')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        recent = _Recent()

        def effect(s: Segment) -> None:
            power = self.ripple * ripple(s.throttle)
            if self.change:
                power += self.change * np.sqrt(np.abs(s.throttle - recent(s.at, s.throttle)))
            s.noise = s.noise * np.exp(0.5 * np.clip(power, -_MOST, _MOST))

        return effect

    def free(self) -> tuple[str, ...]:
        """Return both: logarithms, of either sign."""
        return 'ripple', 'change'

    def moved(self, name: str, by: float) -> LoadDependentNoise:
        """Return the term with one logarithm moved."""
        value = min(max(getattr(self, name) + by, -_MOST), _MOST)
        return replace(self, **{name: value})

    def per_coordinate(self, name: str) -> float:
        """Return 1: both are logarithms already."""
        return 1.0

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return what the logarithms of the squared scores say."""
        if view.throttle is None:
            return ()
        u = view.throttle[view.train]
        columns = np.column_stack((
            np.ones(u.size), ripple(u),
            np.sqrt(np.abs(u - _Recent()(view.at[view.train], u)))))
        # The logarithm of a squared normal score, cut from below: those next to zero say nothing.
        log = np.log(np.maximum(view.z[view.train] ** 2, 1e-3))
        beta = np.linalg.lstsq(columns, log, rcond=1e-8)[0]
        bound = np.clip(beta, -0.5 * _MOST, 0.5 * _MOST).tolist()
        return (cls(bound[1], bound[2]),)


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
