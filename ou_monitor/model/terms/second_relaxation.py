"""A second real pole: two OU time scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.segment import Effect, first_order, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray

# Relaxation times in a recording, at least.
_LEAST = 3.0


@dataclass(frozen=True)
class SecondRelaxation(Term):
    """Add an independent OU."""

    NAME: ClassVar[str] = 'second_relaxation'
    FAMILY: ClassVar[str] = 'slow'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    ROLE: ClassVar[Role] = Role.BLOCK
    FREE: ClassVar[tuple[str, ...]] = ('alpha', 'sigma')
    DEAR: ClassVar[bool] = True
    BROAD: ClassVar[bool] = True
    SIGNS: ClassVar[tuple[str, ...]] = ('band', 'autocorrelation')
    STATES: ClassVar[int] = 1
    IMITATES: ClassVar[tuple[str, ...]] = ('flicker_noise', 'regime_switching')
    SEVERAL: ClassVar[bool] = True
    RECURS: ClassVar[bool] = True
    MEANING: ClassVar[str] = (
        'A second relaxation of its own rate adds to the first: a second storage element.')
    REMEDY: ClassVar[str] = 'Keep both in the model; one alpha alone describes neither.'
    SEPARATED_BY: ClassVar[str] = 'a recording ten times as long, throttle held still'

    alpha: float = parameter('1/s', 'its relaxation rate', 0.0, above=True)
    sigma: float = parameter('V/sqrt(s)', 'its noise intensity', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        before = 0.0

        def effect(s: Segment) -> None:
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
        slowest = _LEAST / float(view.at[-1])
        found = [cls(a, 0.5 * spread * math.sqrt(2.0 * a))
                 for a in (rate / 60.0, rate / 15.0, rate / 4.0) if a > slowest]
        return [*found, cls(6.0 * rate, 0.3 * spread * math.sqrt(12.0 * rate))]

    def holds(self, view: View) -> bool:
        """Return whether it relaxes within the recording: else it is a trend."""
        return self.alpha * float(view.at[-1]) > _LEAST

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return its one state."""
        phi = np.exp(-self.alpha * s.step)
        q = self.sigma * self.sigma * -np.expm1(-2.0 * self.alpha * s.step) / (2.0 * self.alpha)
        return phi[:, None, None], q[:, None, None], np.ones(1)
