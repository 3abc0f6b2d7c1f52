"""The pull back is not linear: constant-power load, softening near brown-out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.laws import log_normal
from ou_monitor.model.terms.term import (
    Effect, LawFit, parameter, Role, Stage, Stretch, Term, View)


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
    ROLE: ClassVar[Role] = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('state squared', 'state cubed')

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

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Regress the innovations on square and cube of the deviation before them."""
        span = np.where(np.isfinite(view.step), view.step, 0.0)
        s, x = np.sqrt(view.variance), view.state
        columns = np.stack((x, -x * x, -x**3), axis=1) * (span / s)[:, None]
        columns -= columns[view.train].mean(axis=0)
        inside = columns[view.train]
        gram = inside.T @ inside
        scale = np.sqrt(gram.diagonal())
        if not (scale > 0.0).all():
            return None
        inverse = np.linalg.pinv(gram / np.outer(scale, scale)) / np.outer(scale, scale)
        b = inverse @ (inside.T @ view.z[view.train])
        # A steeper force also leaves less noise at the end of a step.
        part = 1.0 - np.clip((2.0 * b[1] * x + 3.0 * b[2] * x * x) * span, -0.5, 0.5)
        part /= float(np.mean(part[view.train]))
        scores = (view.z - columns @ b) / np.sqrt(part)
        gain = log_normal(scores) - 0.5 * np.log(part) - log_normal(view.z)
        se = np.sqrt(np.maximum(inverse.diagonal(), 0.0))
        # A force that would push away at large deviations is held just short of it.
        cube = max(float(b[2]), 0.0)
        square = float(b[1]) if cube > 0.0 else 0.0
        return LawFit(cls(square, cube), {'square': float(se[1]), 'cube': float(se[2])}, scores,
                      gain, 3)
