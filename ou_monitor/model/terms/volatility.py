"""sigma wanders slowly, unrelated to throttle: temperature, ageing of the supply."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.recursion import first_order
from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class Volatility(Term):
    """Multiply sigma by exp of an OU, taken as constant within a step."""

    NAME: ClassVar[str] = 'volatility'
    FAMILY: ClassVar[str] = 'intensity'
    STAGE: ClassVar[Stage] = Stage.DRIVE

    std: float = parameter('', 'standard deviation of ln sigma', 0.0)
    rate: float = parameter('1/s', 'relaxation rate of ln sigma', 0.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        before = 0.0

        def effect(s: Stretch) -> None:
            nonlocal before
            phi = np.exp(-self.rate * s.step)
            e = self.std * np.sqrt(-np.expm1(-2.0 * self.rate * s.step))
            log = first_order(phi, e * rng.standard_normal(s.t.size), before)
            before = float(log[-1])
            s.sigma *= np.exp(log)

        return effect
