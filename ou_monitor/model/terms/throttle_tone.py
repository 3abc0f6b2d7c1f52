"""A line whose frequency follows throttle: commutation of the motors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.lines import order_lines
from ou_monitor.model.terms.term import Effect, parameter, Role, Stage, Stretch, Term, View
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class ThrottleTone(Term):
    """Add amplitude * sin(phase), the phase running at idle + slope * throttle."""

    NAME: ClassVar[str] = 'throttle_tone'
    FAMILY: ClassVar[str] = 'line'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.MEAN
    LINEAR: ClassVar[tuple[str, ...]] = ('amplitude', 'phase')
    SIGNS: ClassVar[tuple[str, ...]] = ('order', 'line')
    SEARCH: ClassVar[float] = 9.0

    amplitude: float = parameter('V', 'peak', 0.0)
    idle: float = parameter('Hz', 'frequency at zero throttle, below 0 where it folds back')
    slope: float = parameter('Hz', 'what full throttle adds to it')
    phase: float = parameter('rad', 'phase at the first sample')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        turns = 0.0

        def effect(s: Stretch) -> None:
            nonlocal turns
            step = np.where(np.isfinite(s.step), s.step, 0.0)
            run = turns + np.cumsum((self.idle + self.slope * s.throttle) * step)
            turns = float(run[-1]) % 1.0
            s.level += self.amplitude * np.sin(2.0 * math.pi * run + self.phase)

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the strongest lines of what is left over."""
        return [cls(0.0, idle, slope, 0.0) for idle, slope in order_lines(view)]

    def columns(self, s: Stretch) -> FloatArray:
        """Return the line in phase and in quadrature."""
        made = []
        for phase in (0.0, 0.5 * math.pi):
            level = replace(s, level=np.zeros(s.t.size))
            replace(self, amplitude=1.0, phase=phase).start(np.random.default_rng(0))(level)
            made.append(level.level)
        return np.stack(made, axis=1)

    def linear_values(self) -> list[float]:
        """Return the coefficients of the columns."""
        return [self.amplitude * math.cos(self.phase), self.amplitude * math.sin(self.phase)]

    def with_linear(self, beta: Sequence[float]) -> ThrottleTone:
        """Return the line with these coefficients."""
        return replace(self, amplitude=math.hypot(*beta), phase=math.atan2(beta[1], beta[0]))
