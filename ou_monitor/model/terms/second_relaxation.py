"""A second real pole: two OU time scales."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.recursion import first_order
from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class SecondRelaxation(Term):
    """Add an independent OU."""

    NAME: ClassVar[str] = 'second_relaxation'
    FAMILY: ClassVar[str] = 'slow'
    STAGE: ClassVar[Stage] = Stage.LEVEL

    alpha: float = parameter('1/s', 'its relaxation rate', 0.0, above=True)
    sigma: float = parameter('V/sqrt(s)', 'its noise intensity', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        before = 0.0

        def effect(s: Stretch) -> None:
            nonlocal before
            phi = np.exp(-self.alpha * s.step)
            var = -np.expm1(-2.0 * self.alpha * s.step) / (2.0 * self.alpha)
            x = first_order(phi, self.sigma * np.sqrt(var) * rng.standard_normal(s.t.size), before)
            before = float(x[-1])
            s.level += x

        return effect
