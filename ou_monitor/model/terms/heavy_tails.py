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
from scipy.special import gammaln, stdtr


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
        """Fit a scaled Student-t to the scores, the scale free."""
        z = view.z[view.train]

        def value(x: FloatArray) -> float:
            return float(_log_t(z, math.exp(x[0]), math.exp(x[1])).sum())

        x, _ = climb(value, [math.log(5.0), 0.0])
        dof, scale = math.exp(x[0]), math.exp(x[1])
        if dof <= 2.01 or dof > 200.0:
            return None
        gain = _log_t(view.z, dof, scale) - log_normal(view.z)
        unit = scale * math.sqrt((dof - 2.0) / dof)
        scores = np.where(view.z < 0.0, normal_scores(stdtr(dof, view.z / unit)),
                          -normal_scores(stdtr(dof, -view.z / unit)))
        return LawFit(cls(dof), {'dof': dof * float(curvature_se(value, x)[0])}, scores, gain, 2,
                      power=unit * unit * (dof + (view.z / unit) ** 2) / (dof + 1.0))


def _log_t(z: FloatArray, dof: float, scale: float) -> FloatArray:
    """Return the log density of a Student-t of standard deviation `scale`."""
    if dof <= 2.0:
        return np.full(z.size, -math.inf)
    unit = scale * math.sqrt((dof - 2.0) / dof)
    head = gammaln(0.5 * (dof + 1.0)) - gammaln(0.5 * dof) - 0.5 * math.log(dof * math.pi)
    result: FloatArray = head - math.log(unit) - 0.5 * (dof + 1.0) * np.log1p(
        (z / unit) ** 2 / dof)
    return result
