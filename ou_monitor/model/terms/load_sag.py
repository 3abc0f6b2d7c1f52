"""The mean falls with throttle: IR drop of battery, leads and regulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class LoadSag(Term):
    """Subtract linear * throttle + square * throttle^2 from the level."""

    NAME: ClassVar[str] = 'load_sag'
    FAMILY: ClassVar[str] = 'load'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = True

    linear: float = parameter('V', 'fall at full throttle, linear part')
    square: float = parameter('V', 'fall at full throttle, square part')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Stretch) -> None:
            s.level -= (self.linear + self.square * s.throttle) * s.throttle

        return effect
