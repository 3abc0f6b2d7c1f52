"""The Ornstein-Uhlenbeck process itself: the first term of every model."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from ou_monitor.model.ou import first_order, steady
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Term
from ou_monitor.records import FloatArray

# With a nonlinear force, steps are split into parts.  Maximum length of a part, in relaxation
# times of the total force at one standard deviation (the error in law is of second order in this
# length), and maximum number of parts.
_PART = 0.05
_PARTS_MOST = 1_000_000
# Maximum number of parts whose random numbers are stored at once.
_DRAWS = 100_000


@dataclass(frozen=True)
class OU(Term):
    """
    dU = -alpha (U - u0) dt + sigma dW, exact in law at any spacing.

    Uhlenbeck & Ornstein, Phys. Rev. 36 (1930) 823.  A nonlinear force (`Segment.bend`) is
    integrated by Strang splitting, weak order 2.
    """

    NAME: ClassVar[str] = 'ou'
    STAGE: ClassVar[Stage] = Stage.STATE
    FREE: ClassVar[tuple[str, ...]] = ('alpha', 'sigma')
    LIVE: ClassVar[bool] = True

    alpha: float = parameter('1/s', 'relaxation rate', 0.0, above=True)
    sigma: float = parameter('V/sqrt(s)', 'noise intensity', 0.0)
    u0: float = parameter('V', 'level')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        before = 0.0
        parts = rng.spawn(1)[0]

        def effect(s: Segment) -> None:
            nonlocal before
            kicks = rng.standard_normal(s.t.size)
            if s.bend == (0.0, 0.0):
                phi, std = _transition(s)
                kicks *= std
                if not (steady(s.push) and s.push[0] == 0.0):
                    kicks += s.push
                s.x = first_order(phi, kicks, before)
            else:
                s.x = _nonlinear(s, kicks, before, parts)
            before = float(s.x[-1])

        return effect


def _transition(s: Segment) -> tuple[FloatArray, FloatArray]:
    """Return the decay of the state in each step, and the deviation of the added noise, V."""
    n = s.step.size
    # If all steps and alphas are equal, two values suffice: one for the first sample, which may
    # follow a gap, and one for the others.
    some = slice(2) if steady(s.step[1:]) and steady(s.alpha[1:]) else slice(n)
    alpha, step = s.alpha[some], s.step[some]
    phi = _extended(n, np.exp(-alpha * step))
    std = _extended(n, np.sqrt(-np.expm1(-2.0 * alpha * step) / (2.0 * alpha)))
    std *= s.sigma
    if not (steady(s.power) and s.power[0] == 1.0):
        std *= np.sqrt(s.power)
    return phi, std


def _extended(n: int, values: FloatArray) -> FloatArray:
    """Return n values: the given ones, then repeats of the last one."""
    if values.size == n:
        return values
    filled = np.full(n, values[-1])
    filled[:values.size] = values
    return filled


def _nonlinear(s: Segment, kicks: FloatArray, before: float, rng: np.random.Generator
               ) -> FloatArray:
    """Return the state under a nonlinear force; `rng` draws for the parts of split steps."""
    square, cube = s.bend
    # After 20 relaxation times, the law is stationary; the first step may be infinite.
    span = np.minimum(s.step, 20.0 / s.alpha)
    wanted = (s.alpha + _stiffness(s)) * span / _PART
    if not (wanted < _PARTS_MOST).all():
        raise ValueError('nonlinear_restoring: the voltage diverges, or the force is too strong '
                         f'for a step of {float(span[np.argmax(wanted)]):g} s')
    parts = np.maximum(1, np.ceil(wanted)).astype(np.int64)
    h = span / parts
    phi = np.exp(-s.alpha * h)
    spread = s.sigma * np.sqrt(-np.expm1(-2.0 * s.alpha * h) / (2.0 * s.alpha) * s.power)
    x = np.empty(s.t.size)
    # Bundles of samples limit memory, and do not change the order of the draws.
    for some in _bundles(parts):
        cut = parts[some]
        draws = np.empty(int(cut.sum()))
        whole = np.repeat(cut == 1, cut)
        draws[whole] = kicks[some][cut == 1]
        draws[~whole] = rng.standard_normal(draws.size - int(np.count_nonzero(whole)))
        draws *= np.repeat(spread[some], cut)
        path = []
        feed = iter(draws.tolist())
        for count, a, step, push in zip(cut.tolist(), phi[some].tolist(), h[some].tolist(),
                                        s.push[some].tolist(), strict=True):
            by_square, by_cube = 0.5 * step * square, step * cube
            for _ in range(count):
                # Half a part of -cube x^3 (exact flow) and of -square x^2 (midpoint rule), then
                # the exact law of the linear force, then both halves in reverse order.
                before /= math.sqrt(1.0 + by_cube * before * before)
                middle = before - 0.5 * by_square * before * before
                before -= by_square * middle * middle
                before = a * before + next(feed)
                middle = before - 0.5 * by_square * before * before
                before -= by_square * middle * middle
                before /= math.sqrt(1.0 + by_cube * before * before)
                if not (-1e6 < before < 1e6 and -0.5 < by_square * before < 0.5):
                    raise ValueError('nonlinear_restoring: the voltage diverges; increase cube, '
                                     'so that the force restores where square x^2 exceeds '
                                     'alpha x')
            before += push
            path.append(before)
        x[some] = path
    return x


def _bundles(parts: npt.NDArray[np.int64]) -> list[slice]:
    """Return slices of samples with about `_DRAWS` parts each, or of one sample with more."""
    bundle = np.cumsum(parts) // _DRAWS
    edges = [0, *(np.flatnonzero(np.diff(bundle)) + 1).tolist(), parts.size]
    return [slice(first, last) for first, last in zip(edges, edges[1:])]


def _stiffness(s: Segment) -> FloatArray:
    """Return the rate that the nonlinear force adds at one standard deviation, 1/s, (n,)."""
    square, cube = s.bend
    var = s.sigma * s.sigma / (2.0 * s.alpha)
    if cube > 0.0:
        # With a purely cubic force, the variance is 0.48 sigma / sqrt(cube).
        var = np.minimum(var, 0.48 * s.sigma / math.sqrt(cube))
    stiffness: FloatArray = abs(square) * np.sqrt(var) + cube * var
    return stiffness
