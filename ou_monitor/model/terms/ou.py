"""The Ornstein-Uhlenbeck process, the first term of every model; a nonlinear force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.ou import first_order
from ou_monitor.model.terms.term import (
    Effect, LawFit, log_normal, parameter, Role, Segment, Stage, Term, View)
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

    NAME = 'ou'
    STAGE = Stage.STATE
    FREE = ('alpha', 'sigma')
    LIVE = True

    alpha: float = parameter('1/s', 'relaxation rate', 0.0, above=True)
    sigma: float = parameter('V/sqrt(s)', 'noise intensity', 0.0)
    u0: float = parameter('V', 'level')

    def start(self, rng: np.random.Generator) -> Effect:
        before = 0.0
        parts = rng.spawn(1)[0]

        def effect(s: Segment) -> None:
            nonlocal before
            kicks = rng.standard_normal(s.t.size)
            if s.bend == (0.0, 0.0):
                kicks = kicks * np.sqrt(s.added * s.power) + s.push
                s.x = first_order(s.phi, kicks, before)
            else:
                s.x = _nonlinear(s, kicks, before, parts)
            before = float(s.x[-1])

        return effect


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


@dataclass(frozen=True)
class NonlinearRestoring(Term):
    """Add square * x^2 + cube * x^3 to the force alpha x; a square requires a cube above 0."""

    NAME = 'nonlinear_restoring'
    FAMILY = 'restoring'
    STAGE = Stage.DRIVE
    ROLE = Role.LAW
    SIGNS = ('state squared', 'state cubed')
    IMITATES = ('regime_switching',)
    MEANING = (
        'The restoring force is not proportional to the deviation: a constant-power load, or '
        'softening near brown-out.')
    REMEDY = (
        'Expect deep excursions to be longer and more frequent than the linear model predicts.')
    SEPARATED_BY = 'larger excursions: load steps in both directions'

    square: float = parameter('1/(V s)', 'coefficient of x^2')
    cube: float = parameter('1/(V^2 s)', 'coefficient of x^3', 0.0)

    def check(self) -> None:
        """Check that the force is restoring at large deviations."""
        if self.square != 0.0 and self.cube == 0.0:
            raise ValueError(f'{self.NAME}: square needs a cube above 0, else the voltage '
                             'diverges')

    def change(self, s: Segment) -> None:
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
