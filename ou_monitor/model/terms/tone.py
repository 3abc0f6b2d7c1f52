"""A line at a fixed frequency: ESC switching or its alias, a DC-DC converter."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class Tone(Term):
    """
    Add amplitude * sin(2 pi frequency t + phase), whose phase may wander.

    The phase does a random walk that widens the line to `linewidth` (full width at
    half of its height).
    """

    NAME: ClassVar[str] = 'tone'
    FAMILY: ClassVar[str] = 'line'
    STAGE: ClassVar[Stage] = Stage.LEVEL

    amplitude: float = parameter('V', 'peak', 0.0)
    frequency: float = parameter('Hz', 'frequency', 0.0, above=True)
    phase: float = parameter('rad', 'phase at the first sample')
    linewidth: float = parameter('Hz', 'width of the line; 0: a pure tone', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        wander = 0.0

        def effect(s: Stretch) -> None:
            nonlocal wander
            phase = 2.0 * math.pi * ((s.at - s.origin) * self.frequency % 1.0) + self.phase
            if self.linewidth > 0.0:
                step = np.where(np.isfinite(s.step), s.step, 0.0)
                walk = wander + np.cumsum(np.sqrt(2.0 * math.pi * self.linewidth * step)
                                          * rng.standard_normal(s.t.size))
                wander = float(walk[-1])
                phase += walk
            s.level += self.amplitude * np.sin(phase)

        return effect
