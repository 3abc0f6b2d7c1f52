"""The relaxation rate depends on throttle; the paper assumes that it does not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class LoadDependentAlpha(Term):
    """Multiply alpha by exp(slope * throttle)."""

    NAME: ClassVar[str] = 'load_dependent_alpha'
    FAMILY: ClassVar[str] = 'restoring'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    NEEDS_THROTTLE: ClassVar[bool] = True

    slope: float = parameter('', 'ln of the factor at full throttle')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Stretch) -> None:
            s.alpha *= np.exp(self.slope * s.throttle)

        return effect
