"""The Ornstein-Uhlenbeck process itself: the first term of every model."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.recursion import first_order
from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term
from ou_monitor.records import FloatArray

# With a force that is not linear, a step is cut into parts of at most this
# many relaxation times; the error of the law is of second order in it.
_PART = 0.05


@dataclass(frozen=True)
class OU(Term):
    """
    dU = -alpha (U - u0) dt + sigma dW, exact in law at any spacing.

    Uhlenbeck & Ornstein, Phys. Rev. 36 (1930) 823.  A force that is not linear
    (`Stretch.bend`) is integrated by Strang splitting, weak order 2.
    """

    NAME: ClassVar[str] = 'ou'
    STAGE: ClassVar[Stage] = Stage.STATE

    alpha: float = parameter('1/s', 'relaxation rate', 0.0, above=True)
    sigma: float = parameter('V/sqrt(s)', 'noise intensity', 0.0)
    u0: float = parameter('V', 'level')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        before = 0.0
        parts = rng.spawn(1)[0]

        def effect(s: Stretch) -> None:
            nonlocal before
            kicks = rng.standard_normal(s.t.size)
            if s.bend == (0.0, 0.0):
                phi = np.exp(-s.alpha * s.step)
                var = -np.expm1(-2.0 * s.alpha * s.step) / (2.0 * s.alpha)
                e = s.sigma * np.sqrt(var * s.power) * kicks + s.push
                s.x = first_order(phi, e, before)
            else:
                s.x = _bent(s, kicks, before, parts)
            before = float(s.x[-1])

        return effect


def _bent(s: Stretch, kicks: FloatArray, before: float, rng: np.random.Generator) -> FloatArray:
    """Return the state under a force that is not linear; steps that are cut draw from rng."""
    square, cube = s.bend
    x = np.empty(s.t.size)
    for k in range(s.t.size):
        alpha, step = float(s.alpha[k]), float(s.step[k])
        # Stationary from some relaxations before the first sample on.
        span = min(step, 20.0 / alpha)
        parts = max(1, math.ceil(alpha * span / _PART))
        h = span / parts
        phi = math.exp(-alpha * h)
        spread = float(s.sigma[k]) * math.sqrt(
            -math.expm1(-2.0 * alpha * h) / (2.0 * alpha) * float(s.power[k]))
        draws = [float(kicks[k])] if parts == 1 else rng.standard_normal(parts).tolist()
        for draw in draws:
            before -= 0.5 * h * (square + cube * before) * before * before
            before = phi * before + spread * draw
            before -= 0.5 * h * (square + cube * before) * before * before
            if not -1e6 < before < 1e6:
                raise ValueError('nonlinear_restoring: the voltage runs away; the force must '
                                 'pull back at large deviations (cube > 0 when square is not 0)')
        before += float(s.push[k])
        x[k] = before
    return x
