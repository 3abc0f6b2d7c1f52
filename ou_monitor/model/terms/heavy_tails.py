"""The driving noise itself is heavy-tailed, without distinct events."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class HeavyTails(Term):
    """
    Make what the noise adds in each step Student-t, of unchanged variance.

    Defined for the spacing at which it is fitted: Student-t steps do not add up to
    Student-t steps.
    """

    NAME: ClassVar[str] = 'heavy_tails'
    FAMILY: ClassVar[str] = 'events'
    STAGE: ClassVar[Stage] = Stage.DRIVE

    dof: float = parameter('', 'degrees of freedom', 2.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Stretch) -> None:
            s.power *= (self.dof - 2.0) / (2.0 * rng.standard_gamma(0.5 * self.dof, s.t.size))

        return effect
