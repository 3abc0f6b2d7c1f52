"""A slow trend of the mean: discharge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Role, Stage, Stretch, Term, View


@dataclass(frozen=True)
class Drift(Term):
    """Add rate * t + curvature * t^2, t counted from the first sample."""

    NAME: ClassVar[str] = 'drift'
    FAMILY: ClassVar[str] = 'slow'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    ROLE: ClassVar[Role] = Role.MEAN
    LINEAR: ClassVar[tuple[str, ...]] = ('rate', 'curvature')
    SIGNS: ClassVar[tuple[str, ...]] = ('time', 'band 0')

    rate: float = parameter('V/s', 'slope at the first sample')
    curvature: float = parameter('V/s^2', 'coefficient of t^2')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Stretch) -> None:
            t = s.at - s.origin
            s.level += (self.rate + self.curvature * t) * t

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the one there is: it is linear."""
        return (cls(0.0, 0.0),)
