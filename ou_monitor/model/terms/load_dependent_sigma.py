"""The noise intensity depends on throttle: the main finding of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameters, Stage, Stretch, Term


@dataclass(frozen=True)
class LoadDependentSigma(Term):
    """
    Multiply sigma by a factor that is a straight line in ln between knots.

    Level beyond the outer knots.
    """

    NAME: ClassVar[str] = 'load_dependent_sigma'
    FAMILY: ClassVar[str] = 'intensity'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    NEEDS_THROTTLE: ClassVar[bool] = True

    throttle: tuple[float, ...] = parameters('', 'knots, rising')
    log_factor: tuple[float, ...] = parameters('', 'ln(sigma at the knot / sigma of the ou)')

    def check(self) -> None:
        """Check that the knots rise and match."""
        if len(self.throttle) != len(self.log_factor) or not self.throttle:
            raise ValueError(
                f'{self.NAME}: throttle and log_factor need the same number of values, got '
                f'{len(self.throttle)} and {len(self.log_factor)}')
        if any(b <= a for a, b in zip(self.throttle, self.throttle[1:])):
            raise ValueError(f'{self.NAME}.throttle must rise, got {list(self.throttle)}')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Stretch) -> None:
            s.sigma *= np.exp(np.interp(s.throttle, self.throttle, self.log_factor))

        return effect
