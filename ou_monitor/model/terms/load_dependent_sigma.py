"""The noise intensity depends on throttle: the main finding of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameters, Role, Stage, Stretch, Term, View
from ou_monitor.records import FloatArray


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
        if len(self.throttle) == 2 and self.throttle[1] - self.throttle[0] < 3.0 * _EDGE:
            # Where it steps was searched for.
            object.__setattr__(self, 'SEARCH', _STEP_PRICE)
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
        """Return the likelier two of: a straight line, a step, knots by share and by range."""
        if view.throttle is None:
            return ()
        u = view.throttle[view.train]
        square = view.z[view.train] ** 2
        low, high = np.quantile(u, [0.01, 0.99])
        if high - low < _APART:
            return ()
        inner = np.quantile(u, np.linspace(0.05, 0.95, 91))
        forms = [np.array([low, high]), np.quantile(u, [0.01, 0.25, 0.5, 0.75, 0.99]),
                 *(np.linspace(low, high, count) for count in (3, 5, 9)),
                 *(np.array([at - _EDGE, at + _EDGE]) for at in np.unique(inner))]
        made = [_to_squares(square, u, _spaced(knots)) for knots in forms]
        price = 0.5 * math.log(u.size)
        made.sort(key=lambda pair: pair[1] - price * len(pair[0][0]) - (
            _STEP_PRICE if pair[0][0][-1] - pair[0][0][0] < 3.0 * _EDGE else 0.0), reverse=True)
        return [cls(knots, factors) for (knots, factors), _ in made[:2]]

    @classmethod
    def simplest(cls, view: View) -> Sequence[Term]:
        """Return a straight line."""
        if view.throttle is None:
            return ()
        low, high = np.quantile(view.throttle[view.train], [0.01, 0.99]).tolist()
        return (cls((low, high), (0.0, 0.5)),) if high - low > _APART else ()


# What the search for the edge of a step costs, nats: ln of the edges tried.
_STEP_PRICE = 4.5
# Knots nearer than this are one, and half the width of a step, in throttle.
_APART, _EDGE = 0.02, 0.002


def _spaced(knots: FloatArray) -> FloatArray:
    """Return knots that are apart; of a step both."""
    if knots.size == 2:
        return knots
    keep = [float(knots[0])]
    for knot in knots[1:].tolist():
        if knot - keep[-1] > _APART:
            keep.append(knot)
    return np.array(keep)


def _to_squares(square: FloatArray, u: FloatArray, knots: FloatArray
                ) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], float]:
    """Return knots with factors that fit squares of scores, and the log-likelihood of these."""
    near = np.eye(knots.size)
    factors = []
    for k in range(knots.size):
        weight = np.interp(u, knots, near[k])
        factors.append(0.5 * math.log(max(float(weight @ square), 1e-9)
                                      / max(float(weight.sum()), 1e-9)))
    log = np.interp(u, knots, factors)
    value = float((-log - 0.5 * square * np.exp(-2.0 * log)).sum())
    return (tuple(knots.tolist()), tuple(f - factors[0] for f in factors)), value
