"""Isolated bad samples that do not enter the dynamics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class Glitches(Term):
    """Add a normal error to a sample now and then."""

    NAME: ClassVar[str] = 'glitches'
    FAMILY: ClassVar[str] = 'events'
    STAGE: ClassVar[Stage] = Stage.SENSOR

    probability: float = parameter('', 'share of samples that are bad', 0.0, 1.0)
    std: float = parameter('V', 'standard deviation of the error', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        turns, sizes = rng.spawn(2)

        def effect(s: Stretch) -> None:
            bad = turns.random(s.t.size) < self.probability
            s.voltage[bad] += self.std * sizes.standard_normal(int(bad.sum()))

        return effect
