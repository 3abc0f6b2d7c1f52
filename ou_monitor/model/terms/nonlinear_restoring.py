"""A nonlinear restoring force, due to a constant-power load or softening near brown-out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import log_normal, View
from ou_monitor.model.terms.segment import Segment, Stage
from ou_monitor.model.terms.term import LawFit, parameter, Role, Term
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class NonlinearRestoring(Term):
    """Add square * x^2 + cube * x^3 to the force alpha x; a square requires a cube above 0."""

    NAME: ClassVar[str] = 'nonlinear_restoring'
    FAMILY: ClassVar[str] = 'restoring'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    ROLE: ClassVar[Role] = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('state squared', 'state cubed')
    IMITATES: ClassVar[tuple[str, ...]] = ('regime_switching',)
    MEANING: ClassVar[str] = (
        'The restoring force is not proportional to the deviation: a constant-power load, or '
        'softening near brown-out.')
    REMEDY: ClassVar[str] = (
        'Expect deep excursions to be longer and more frequent than the linear model predicts.')
    SEPARATED_BY: ClassVar[str] = 'larger excursions: load steps in both directions'

    square: float = parameter('1/(V s)', 'coefficient of x^2')
    cube: float = parameter('1/(V^2 s)', 'coefficient of x^3', 0.0)

    def check(self) -> None:
        """Check that the force is restoring at large deviations."""
        if self.square != 0.0 and self.cube == 0.0:
            raise ValueError(f'{self.NAME}: square needs a cube above 0, else the voltage '
                             'diverges')

    def change(self, s: Segment) -> None:
        """Add the nonlinear coefficients to the force."""
        s.bend = (s.bend[0] + self.square, s.bend[1] + self.cube)

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Regress the innovations on the square, the cube, or both, of the previous deviation."""
        found = [fit for powers in ((2,), (3,), (2, 3))
                 if (fit := cls._fit_powers(view, powers)) is not None]
        penalty = 0.5 * math.log(view.train.stop)
        return max(found, default=None,
                   key=lambda fit: float(fit.gain[view.train].sum()) - penalty * fit.free)

    @classmethod
    def _fit_powers(cls, view: View, powers: tuple[int, ...]) -> LawFit | None:
        """Fit a change of the linear force, and coefficients of the given powers."""
        train = view.train
        span = np.where(np.isfinite(view.step), view.step, 0.0)
        s, x = np.sqrt(view.variance), view.state
        columns = np.stack((x, *(-x**power for power in powers)), axis=1) * (span / s)[:, None]
        columns -= columns[train].mean(axis=0)
        inside = columns[train]
        gram = inside.T @ inside
        scale = np.sqrt(gram.diagonal())
        if not (scale > 0.0).all():
            return None
        inverse = np.linalg.pinv(gram / np.outer(scale, scale)) / np.outer(scale, scale)
        error = np.sqrt(np.maximum(inverse.diagonal(), 0.0))
        alpha = -math.log(min(max(float(np.median(view.phi[1:])), 1e-300), 1.0 - 1e-9)) * view.rate
        shift = view.z * s + (view.phi - 1.0) * x
        widest = float(np.median(view.variance[train]))

        def scored(b: FloatArray, part: slice) -> tuple[FloatArray, FloatArray]:
            """Return scores and log densities of a part for the coefficients b."""
            by = dict(zip(powers, b[1:].tolist(), strict=True))
            move, spread = _linearised(x[part], span[part], alpha - b[0], by.get(2, 0.0),
                                       by.get(3, 0.0), widest)
            e = (shift[part] - move) / s[part]
            if part == train:
                level[0] = float(e.mean())
                level[1] = float(np.mean((e - level[0]) ** 2 / spread))
            spread *= level[1]
            scores = (e - level[0]) / np.sqrt(spread)
            return scores, log_normal(scores) - 0.5 * np.log(spread)

        level = [0.0, 1.0]
        # Start from a regression that treats the force as constant within each step.  Overflows
        # are harmless: they come from bad coefficients or a stuck sensor.
        with np.errstate(over='ignore', invalid='ignore'):
            b = _maximise(lambda b: scored(b, train)[1], inverse @ (inside.T @ view.z[train]),
                          error)
            if not alpha > b[0]:
                return None
            scored(b, train)
            scores, density = scored(b, slice(None))
        if not np.isfinite(density).all():
            return None
        by = dict(zip(powers, b[1:].tolist(), strict=True))
        errors = dict(zip(powers, error[1:].tolist(), strict=True))
        square, cube = by.get(2, 0.0), by.get(3, 0.0)
        if cube < 0.0:
            # The voltage would diverge.
            return None
        # Raise the cube until the voltage is stable in spite of the square.
        cube = max(cube, _HOLDS * square * square / alpha)
        return LawFit(cls(square, cube), {'square': errors.get(2, math.nan),
                                          'cube': errors.get(3, math.nan)}, scores,
                      density - log_normal(view.z), len(powers))


def _linearised(x: FloatArray, span: FloatArray, linear: float, square: float, cube: float,
                variance: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean change of x in each step, V, and its variance relative to `variance`."""
    # In each part of the step, the force is linearised about the deviation at the beginning of the
    # part, and the mean effect of the curvature is added (Shoji & Ozaki, Stoch. Anal. Appl. 16
    # (1998) 733).  Beyond the extremum of a softening force, the force is taken as constant.
    tops = np.roots([3.0 * cube, 2.0 * square, linear])
    tops = tops[np.isreal(tops)].real
    low = np.max(tops, initial=-np.inf, where=tops < 0.0)
    high = np.min(tops, initial=np.inf, where=tops > 0.0)

    def slope(y: FloatArray) -> FloatArray:
        turns: FloatArray = -(linear + (2.0 * square + 3.0 * cube * y) * y) * span
        return turns

    steepest = -float(slope(np.clip(x, low, high)).min())
    parts = int(min(max(math.ceil(steepest / _TURN), 1), _PARTS))
    span, noise = span / parts, variance / parts
    at, spread = x, np.zeros(x.size)
    for _ in range(parts):
        y = np.clip(at, low, high)
        turn = np.clip(slope(y), -_STIFF, -_FLAT)
        grown = np.expm1(turn) / turn
        curve = -(square + 3.0 * cube * y)
        force = -(linear + (square + cube * y) * y) * y + curve * spread
        at = at + (force * grown + curve * noise * (grown - 1.0) / turn) * span
        spread = spread * np.exp(2.0 * turn) + noise * np.expm1(2.0 * turn) / (2.0 * turn)
    return at - x, spread / variance


def _maximise(density: Callable[[FloatArray], FloatArray], b: FloatArray, error: FloatArray
              ) -> FloatArray:
    """Maximise the likelihood from b by Fisher scoring with numerical derivatives."""
    now = density(b)
    for _ in range(_ROUNDS):
        scores = np.stack([density(b + _NEAR * step) - now for step in np.diag(error)],
                          axis=1) / _NEAR
        if not np.isfinite(scores).all():
            break
        move = error * (np.linalg.pinv(scores.T @ scores) @ scores.sum(axis=0))
        for share in (1.0, 0.3, 0.1):
            new = density(b + share * move)
            gain = float((new - now).sum())
            if gain > 0.0:
                b, now = b + share * move, new
                break
        if not gain > _SETTLED:
            break
    return b


# Minimum cube, in square^2/alpha (above 1/4 the force has only one zero).
_HOLDS = 0.26
# Slope of the force times the step: maximum, minimum, and maximum in one part of a step.  Maximum
# number of parts of a step.
_STIFF, _FLAT, _TURN, _PARTS = 20.0, 1e-9, 0.4, 6
# Maximum number of rounds of scoring, and minimum gain of a round to start another, nats.
_ROUNDS, _SETTLED = 5, 0.05
# Step of the numerical derivatives, in standard errors.
_NEAR = 0.1
