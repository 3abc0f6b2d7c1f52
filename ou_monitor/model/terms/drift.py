"""A slow trend of the mean: discharge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class Drift(Term):
    """Add rate * t + curvature * t^2, t counted from the first sample."""

    NAME: ClassVar[str] = 'drift'
    FAMILY: ClassVar[str] = 'slow'
    STAGE: ClassVar[Stage] = Stage.LEVEL

    rate: float = parameter('V/s', 'slope at the first sample')
    curvature: float = parameter('V/s^2', 'coefficient of t^2')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Stretch) -> None:
            t = s.at - s.origin
            s.level += (self.rate + self.curvature * t) * t

        return effect
