"""A line whose frequency follows throttle: commutation of the motors."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class ThrottleTone(Term):
    """Add amplitude * sin(phase), the phase running at idle + slope * throttle."""

    NAME: ClassVar[str] = 'throttle_tone'
    FAMILY: ClassVar[str] = 'line'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = True

    amplitude: float = parameter('V', 'peak', 0.0)
    idle: float = parameter('Hz', 'frequency at zero throttle', 0.0)
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
