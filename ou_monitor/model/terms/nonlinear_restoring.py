"""The pull back is not linear: constant-power load, softening near brown-out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class NonlinearRestoring(Term):
    """
    Add square * x^2 + cube * x^3 to the force alpha x that pulls back.

    Integrated by the `ou` (weak order 2).  A square alone has no stationary law: it
    needs a cube that holds it.
    """

    NAME: ClassVar[str] = 'nonlinear_restoring'
    FAMILY: ClassVar[str] = 'restoring'
    STAGE: ClassVar[Stage] = Stage.DRIVE

    square: float = parameter('1/(V s)', 'coefficient of x^2')
    cube: float = parameter('1/(V^2 s)', 'coefficient of x^3', 0.0)

    def check(self) -> None:
        """Check that the force pulls back at large deviations."""
        if self.square != 0.0 and self.cube == 0.0:
            raise ValueError(f'{self.NAME}: square needs a cube above 0, else the voltage runs '
                             'away')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Stretch) -> None:
            s.bend = (s.bend[0] + self.square, s.bend[1] + self.cube)

        return effect
