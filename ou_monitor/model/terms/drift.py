"""A slow trend of the mean: discharge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import by_parameters, NEXT_TO_ZERO, parameter, Role, Term


@dataclass(frozen=True)
class Drift(Term):
    """
    Add rate * t + curvature * t^2, t counted from the first sample.

    A curvature of exactly 0 stands for a straight line, in a fit too.
    """

    NAME: ClassVar[str] = 'drift'
    FAMILY: ClassVar[str] = 'slow'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    ROLE: ClassVar[Role] = Role.MEAN
    # The curvature is left out of a fit where it is 0.
    LINEAR: ClassVar[tuple[str, ...]] = by_parameters(
        ('rate', 'curvature'),
        lambda term: ('rate', 'curvature') if term.curvature else ('rate',))
    SIGNS: ClassVar[tuple[str, ...]] = ('time', 'band 0')
    MEASURED: ClassVar[bool] = True
    # Time mends a little of whatever the form of a larger effect leaves.
    LEAST_SHARE: ClassVar[float] = 0.02
    MEANING: ClassVar[str] = 'The mean moves slowly with time: discharge or warming.'
    REMEDY: ClassVar[str] = 'Use a window short beside the drift, or take the trend out first.'
    SEPARATED_BY: ClassVar[str] = 'a recording several times as long'

    rate: float = parameter('V/s', 'slope at the first sample')
    curvature: float = parameter('V/s^2', 'coefficient of t^2')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            t = s.at - s.origin
            s.level += (self.rate + self.curvature * t) * t

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a straight line and a parabola."""
        return cls(0.0, 0.0), cls(0.0, NEXT_TO_ZERO)
