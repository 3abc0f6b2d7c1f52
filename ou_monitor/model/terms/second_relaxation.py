"""A second real pole: two OU time scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.recursion import first_order
from ou_monitor.model.terms.term import Effect, parameter, Role, Stage, Stretch, Term, View
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class SecondRelaxation(Term):
    """Add an independent OU."""

    NAME: ClassVar[str] = 'second_relaxation'
    FAMILY: ClassVar[str] = 'slow'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    ROLE: ClassVar[Role] = Role.BLOCK
    FREE: ClassVar[tuple[str, ...]] = ('alpha', 'sigma')
    DEAR: ClassVar[bool] = True
    SIGNS: ClassVar[tuple[str, ...]] = ('band', 'autocorrelation')

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

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return poles slower and faster than that of the ou, of less variance."""
        rate = -math.log(max(float(np.median(view.phi[1:])), 1e-300)) * view.rate
        spread = float(np.std(view.residual))
        slowest = 3.0 / float(view.at[-1])
        found = [cls(a, 0.5 * spread * math.sqrt(2.0 * a))
                 for a in (rate / 60.0, rate / 15.0, rate / 4.0) if a > slowest]
        return [*found, cls(6.0 * rate, 0.3 * spread * math.sqrt(12.0 * rate))]

    def block(self, s: Stretch) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return its one state."""
        phi = np.exp(-self.alpha * s.step)
        q = self.sigma * self.sigma * -np.expm1(-2.0 * self.alpha * s.step) / (2.0 * self.alpha)
        return phi[:, None, None], q[:, None, None], np.ones(1)
