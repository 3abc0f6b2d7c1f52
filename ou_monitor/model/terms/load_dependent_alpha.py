"""The relaxation rate depends on throttle; the paper assumes that it does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import Live, parameter, Role, Term


@dataclass(frozen=True)
class LoadDependentAlpha(Term):
    """Multiply alpha by exp(slope * throttle)."""

    NAME: ClassVar[str] = 'load_dependent_alpha'
    FAMILY: ClassVar[str] = 'restoring'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.DRIVE
    FREE: ClassVar[tuple[str, ...]] = ('slope',)
    SIGNS: ClassVar[tuple[str, ...]] = ('state throttle',)
    MEASURED: ClassVar[bool] = True
    LIVE: ClassVar[Live] = Live.BY_THROTTLE
    MEANING: ClassVar[str] = 'The relaxation rate depends on throttle.'
    REMEDY: ClassVar[str] = (
        'Fit each load level on its own (analyze); a single alpha is wrong at all levels but one.')
    SEPARATED_BY: ClassVar[str] = 'throttle held for 50 relaxation times at each of several levels'

    slope: float = parameter('', 'ln of the factor at full throttle')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.alpha *= np.exp(self.slope * s.throttle)

        return effect

    def moved(self, name: str, by: float) -> LoadDependentAlpha:
        """Return the term with its slope moved."""
        return replace(self, slope=self.slope + by)

    def per_coordinate(self, name: str) -> float:
        """Return 1: the slope is that of a logarithm already."""
        return 1.0

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the constant rate."""
        return () if view.throttle is None else (cls(0.0),)
