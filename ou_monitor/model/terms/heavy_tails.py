"""The driving noise itself is heavy-tailed, without distinct events."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import (
    climb, curvature_se, LawFit, log_normal, normal_scores, View)
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray
from scipy.special import gammainccinv, gammaincinv, ndtr


@dataclass(frozen=True)
class HeavyTails(Term):
    """
    Make what the noise adds in each step Student-t, of unchanged variance.

    Defined for the spacing at which it is fitted: Student-t steps do not add up to
    Student-t steps.
    """

    NAME: ClassVar[str] = 'heavy_tails'
    FAMILY: ClassVar[str] = 'events'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    ROLE: ClassVar[Role] = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('kurtosis', 'tails')
    IMITATES: ClassVar[tuple[str, ...]] = (
        'clock_jitter', 'glitches', 'jumps', 'regime_switching', 'volatility')
    MEANING: ClassVar[str] = 'The driving noise itself has heavy tails, without distinct events.'
    REMEDY: ClassVar[str] = 'Expect large excursions more often than a normal law predicts.'
    SEPARATED_BY: ClassVar[str] = 'a recording several times as long, at a higher rate'

    dof: float = parameter('', 'degrees of freedom', 2.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.power *= (self.dof - 2.0) / (2.0 * rng.standard_gamma(0.5 * self.dof, s.t.size))

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit a scaled Student-t, in what else the scores have that is normal, the scale free."""
        share = np.broadcast_to(view.driven, view.z.shape)
        square, shares, count = _cells(view.z[view.train], share[view.train])

        def value(x: FloatArray) -> float:
            return float(count @ _Mixture(square, shares, math.exp(x[0]), math.exp(x[1])).log())

        x, _ = climb(value, [math.log(5.0), 0.0])
        dof, scale = math.exp(x[0]), math.exp(x[1])
        if dof <= 2.01 or dof > 200.0:
            return None
        law = _Mixture(view.z * view.z, share, dof, scale)
        scores = np.copysign(normal_scores(law.beyond()), view.z)
        return LawFit(cls(dof), {'dof': dof * float(curvature_se(value, x)[0])}, scores,
                      law.log() - log_normal(view.z), 2,
                      power=law.power() if float(np.median(share)) > _ALONE else None)


class _Mixture:
    """
    Scores of which a share of the variance is Student-t and the rest normal.

    A Student-t is normal with a variance that is the inverse of a gamma: a sum over its logarithm,
    at points so near that the sum is the integral.

    """

    def __init__(self, square: FloatArray, share: FloatArray, dof: float, scale: float) -> None:
        if dof <= 2.0:
            self._log = np.full(square.size, -math.inf)
            return
        half = 0.5 * dof
        ends = np.log(gammaincinv(half, _OUTSIDE)), np.log(gammainccinv(half, _OUTSIDE))
        gamma = np.exp(np.linspace(*ends, _POINTS))
        log = half * np.log(gamma) - gamma
        weight = np.exp(log - log.max())
        self._weight = weight / weight.sum()
        self._factor = (half - 1.0) / gamma
        self._scale, self._square = scale, square
        self._variance = scale * scale * (1.0 + share[:, None] * (self._factor - 1.0))
        log = np.log(self._weight) - 0.5 * (
            np.log(2.0 * math.pi * self._variance) + square[:, None] / self._variance)
        top = log.max(axis=1)
        self._density = np.exp(log - top[:, None])
        self._log = top + np.log(self._density.sum(axis=1))

    def log(self) -> FloatArray:
        """Return log densities."""
        return self._log

    def beyond(self) -> FloatArray:
        """Return the chance of a score on the same side that is farther out."""
        return np.asarray(ndtr(-np.sqrt(self._square[:, None] / self._variance)) @ self._weight)

    def power(self) -> FloatArray:
        """Return the inverse of the mean precision of the Student-t, given the score."""
        posterior = self._density / self._density.sum(axis=1, keepdims=True)
        return np.asarray(self._scale ** 2 / (posterior @ (1.0 / self._factor)))


def _cells(z: FloatArray, share: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return squares and shares of cells of scores, and how many each has."""
    edges = np.unique(np.quantile(share, np.linspace(0.0, 1.0, _SHARES + 1)[1:-1]))
    row = np.searchsorted(edges, share)
    column = np.minimum(np.arcsinh(np.abs(z)) / _WIDTH, _CELLS - 1).astype(np.int64)
    _, cell = np.unique(row * _CELLS + column, return_inverse=True)
    count = np.bincount(cell).astype(np.float64)
    return (np.bincount(cell, z * z) / count, np.bincount(cell, share) / count, count)


# Share of the Student-t from which it is the only noise.  Beside another, each sample's own power
# would explain all of it, and a fit around that power finds no white noise: the variance is the
# same without.
_ALONE = 0.99
# Points of the variance, and the chance outside of them; shares, and cells of scores, that a fit
# tells apart.
_POINTS, _OUTSIDE = 40, 1e-10
_SHARES, _CELLS, _WIDTH = 8, 300, 0.03
