"""The noise intensity depends on throttle: the main finding of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameters, Role, Stage, Stretch, Term, View


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
    ROLE: ClassVar[Role] = Role.DRIVE
    SIGNS: ClassVar[tuple[str, ...]] = ('variance throttle',)

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

    def free(self) -> tuple[str, ...]:
        """Return the knots but the first, which sigma of the ou stands for."""
        return tuple(f'log_factor {k}' for k in range(1, len(self.log_factor)))

    def moved(self, name: str, by: float) -> LoadDependentSigma:
        """Return the term with one knot moved."""
        at = int(name.split()[1])
        factors = tuple(f + by * (k == at) for k, f in enumerate(self.log_factor))
        return replace(self, log_factor=factors)

    def per_coordinate(self, name: str) -> float:
        """Return 1: a knot is a logarithm already."""
        return 1.0

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return knots over the range of the throttle, level."""
        if view.throttle is None:
            return ()
        knots = np.unique(np.round(np.quantile(view.throttle[view.train],
                                               [0.01, 0.25, 0.5, 0.75, 0.99]), 4))
        keep = [float(knots[0])]
        for knot in knots[1:]:
            if knot - keep[-1] > 0.02:
                keep.append(float(knot))
        return (cls(tuple(keep), (0.0,) * len(keep)),) if len(keep) > 1 else ()
