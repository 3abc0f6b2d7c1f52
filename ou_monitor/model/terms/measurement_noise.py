"""White noise of the sensor on top of what the rail does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class MeasurementNoise(Term):
    """Add independent normal errors."""

    NAME: ClassVar[str] = 'measurement_noise'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.SENSOR
    ROLE: ClassVar[Role] = Role.NOISE
    FREE: ClassVar[tuple[str, ...]] = ('std',)
    SIGNS: ClassVar[tuple[str, ...]] = ('-autocorrelation', '+band')
    MAY_LEAVE: ClassVar[float] = 0.3
    MEANING: ClassVar[str] = 'White noise of the sensor adds to the voltage of the rail.'
    REMEDY: ClassVar[str] = (
        'Average in the ADC or use a finer range; alpha and sigma fitted without it are too high.')
    SEPARATED_BY: ClassVar[str] = (
        'the same rail at several times the sampling rate, or the input of the ADC shorted')

    std: float = parameter('V', 'standard deviation', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.voltage += self.std * s.noise * rng.standard_normal(s.t.size)

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a share of the one-step error."""
        error = math.sqrt(float(np.median(view.variance)))
        return [cls(0.1 * error), cls(0.4 * error)]

    def holds(self, view: View) -> bool:
        """Return whether it is there at all beside the one-step error."""
        return self.variance() > _LEAST * float(np.median(view.variance))

    def variance(self) -> float:
        """Return the variance that this term adds to each measurement, V^2."""
        return self.std * self.std

    def variances(self, s: Segment) -> FloatArray | float:
        """Return the same at each sample."""
        return self.variance() * np.square(s.noise)


# Share of the one-step variance below which white noise is none: it moves the likelihood of n
# samples by n/4 of its square, so that 10^7 samples would not show it.
_LEAST = 1e-3
