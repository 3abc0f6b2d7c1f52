"""The pull back is not linear: constant-power load, softening near brown-out."""

from __future__ import annotations

from dataclasses import dataclass
import math
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
        """Regress the innovations on square, cube, or both, of the deviation before them."""
        found = [fit for powers in ((2,), (3,), (2, 3))
                 if (fit := cls._regressed(view, powers)) is not None]
        price = 0.5 * math.log(view.train.stop)
        return max(found, default=None,
                   key=lambda fit: float(fit.gain[view.train].sum()) - price * fit.free)

    @classmethod
    def _regressed(cls, view: View, powers: tuple[int, ...]) -> LawFit | None:
        """Return the fit with some powers; the linear force is fitted again with them."""
        span = np.where(np.isfinite(view.step), view.step, 0.0)
        s, x = np.sqrt(view.variance), view.state
        columns = np.stack((x, *(-x**power for power in powers)), axis=1) * (span / s)[:, None]
        columns -= columns[view.train].mean(axis=0)
        inside = columns[view.train]
        gram = inside.T @ inside
        scale = np.sqrt(gram.diagonal())
        if not (scale > 0.0).all():
            return None
        inverse = np.linalg.pinv(gram / np.outer(scale, scale)) / np.outer(scale, scale)
        b = inverse @ (inside.T @ view.z[view.train])
        by = dict(zip(powers, b[1:].tolist(), strict=True))
        error = dict(zip(powers, np.sqrt(np.maximum(inverse.diagonal()[1:], 0.0)).tolist(),
                         strict=True))
        square, cube = by.get(2, 0.0), by.get(3, 0.0)
        # A steeper force also leaves less noise at the end of a step.
        part = 1.0 - np.clip((2.0 * square * x + 3.0 * cube * x * x) * span, -0.5, 0.5)
        part /= float(np.mean(part[view.train]))
        scores = (view.z - columns @ b) / np.sqrt(part)
        gain = log_normal(scores) - 0.5 * np.log(part) - log_normal(view.z)
        # A force that would push away at large deviations is held just short of it.
        alpha = -math.log(max(float(np.median(view.phi[1:])), 1e-300)) * view.rate
        cube = max(cube, _HOLDS * square * square / alpha)
        return LawFit(cls(square, cube), {'square': error.get(2, math.nan),
                                          'cube': error.get(3, math.nan)}, scores, gain,
                      len(powers))


# Cube at least, in square^2/alpha: from 1/4 on the force has one zero only.
_HOLDS = 0.26
