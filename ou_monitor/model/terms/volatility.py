"""sigma wanders slowly, unrelated to throttle: temperature, ageing of the supply."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.laws import climb, curvature_se, normal_scores
from ou_monitor.model.terms.recursion import first_order
from ou_monitor.model.terms.term import (
    Effect, LawFit, parameter, Role, Stage, Stretch, Term, View)
from ou_monitor.records import FloatArray
from scipy.special import ndtr


@dataclass(frozen=True)
class Volatility(Term):
    """Multiply sigma by exp of an OU, taken as constant within a step."""

    NAME: ClassVar[str] = 'volatility'
    FAMILY: ClassVar[str] = 'intensity'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    ROLE: ClassVar[Role] = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('clustering', 'kurtosis')

    std: float = parameter('', 'standard deviation of ln sigma', 0.0)
    rate: float = parameter('1/s', 'relaxation rate of ln sigma', 0.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        before = 0.0

        def effect(s: Stretch) -> None:
            nonlocal before
            phi = np.exp(-self.rate * s.step)
            e = self.std * np.sqrt(-np.expm1(-2.0 * self.rate * s.step))
            log = first_order(phi, e * rng.standard_normal(s.t.size), before)
            before = float(log[-1])
            s.sigma *= np.exp(log)

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit a log-variance that wanders, taken as constant over short stretches."""
        z, step = view.z, 1.0 / view.rate
        size = max(1, z.size // _STRETCHES)
        squares = np.add.reduceat(z * z, np.arange(0, z.size, size))
        sizes = np.diff(np.append(np.arange(0, z.size, size), z.size)).astype(np.float64)
        trained = view.train.stop // size

        def value(x: FloatArray) -> float:
            if not (-4.0 < x[0] < 1.0 and -7.0 < x[1] < 5.0):
                return -math.inf
            return float(_grid(squares[:trained], sizes[:trained], size * step, x)[1].sum())

        x, _ = max((climb(value, [math.log(0.3), math.log(rate), 0.0], most=20)
                    for rate in (0.1, 1.0)), key=lambda pair: pair[1])
        x, _ = climb(value, x, size=0.2, most=50)
        before, density, levels = _grid(squares, sizes, size * step, x)
        scores = _scores(z, before, levels, size)[:z.size]
        base = -0.5 * squares
        gain = np.repeat((density - base) / sizes, size)[:z.size]
        e = curvature_se(value, x)
        term = cls(math.exp(x[0]), math.exp(x[1]))
        return LawFit(term, {'std': term.std * float(e[0]), 'rate': term.rate * float(e[1])},
                      scores, gain, 3)


def _scores(z: FloatArray, before: FloatArray, levels: FloatArray, size: int) -> FloatArray:
    """Return normal scores, each given all samples before it in its stretch, too."""
    count = before.shape[0]
    padded = np.zeros(count * size)
    padded[:z.size] = z
    z = padded.reshape(count, size, 1)
    std = np.exp(levels)
    log_density = -levels - 0.5 * (z / std) ** 2
    known = np.cumsum(log_density, axis=1) - log_density
    weight = before[:, None, :] * np.exp(known - known.max(axis=2, keepdims=True))
    chance = (weight * ndtr(z / std)).sum(axis=2) / weight.sum(axis=2)
    return normal_scores(chance.ravel())


# Stretches that a recording is cut into, and levels of ln sigma.
_STRETCHES = 1500
_LEVELS = 31


def _grid(squares: FloatArray, sizes: FloatArray, span: float, x: FloatArray
          ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the law of the level before each stretch, its log density, and the levels."""
    nodes = np.linspace(-2.8, 2.8, _LEVELS)
    levels = x[2] + math.exp(x[0]) * nodes
    keep = math.exp(-math.exp(x[1]) * span)
    kernel = np.exp(-0.5 * (nodes[None, :] - keep * nodes[:, None]) ** 2
                    / max(1.0 - keep * keep, (0.5 * (nodes[1] - nodes[0])) ** 2))
    kernel /= kernel.sum(axis=1, keepdims=True)
    law = np.exp(-0.5 * nodes * nodes)
    law /= law.sum()
    log_density = -sizes[:, None] * levels - 0.5 * squares[:, None] * np.exp(-2.0 * levels)
    top = log_density.max(axis=1)
    weight = np.exp(log_density - top[:, None])
    before = np.empty((squares.size, _LEVELS))
    density = np.empty(squares.size)
    for k in range(squares.size):
        before[k] = law
        law = law * weight[k]
        total = law.sum()
        density[k] = total
        law = (law / total) @ kernel
    return before, np.log(density) + top, levels
