"""White noise of the sensor on top of what the rail does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class MeasurementNoise(Term):
    """Add independent normal errors."""

    NAME: ClassVar[str] = 'measurement_noise'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.SENSOR

    std: float = parameter('V', 'standard deviation', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Stretch) -> None:
            s.voltage += self.std * rng.standard_normal(s.t.size)

        return effect
