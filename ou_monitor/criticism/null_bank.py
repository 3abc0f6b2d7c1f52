"""
Null distribution of the statistics, by simulation.

Recordings of the fitted baseline, with the stamps and the throttle of the data,
go through the same fit and the same statistics.  Theory suffices for lines that follow
throttle, which take longest, and for what comes after large errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.criticism.battery import Covariates, statistics
from ou_monitor.criticism.composite import Composite, covariates_of
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.records import FloatArray
from scipy.signal import lfilter
from scipy.special import stdtr, stdtrit

# Recordings simulated.
SIZE = 24
# The spread found by so few is drawn towards 1, which theory gives, as by this
# many more.
_PRIOR = 24.0
# Degrees of freedom of a score divided by such a spread: its square has variance w^2 2/(m - 1) for
# a weight w of m draws, as a chi square of (m - 1)/w^2 degrees over them.  Of 8700 recordings of a
# plain OU (2000 to 6000 samples, five throttles and rates) 0.89 % have a family chance below 1 %,
# and 0.14 % below 0.1 %; by the normal law it would be 1.52 and 0.31 %.
_FREEDOM = (SIZE - 1) * ((SIZE + _PRIOR) / SIZE) ** 2


@dataclass(frozen=True)
class NullBank:
    """Means and spreads of the statistics under the baseline."""

    # By statistic.
    mean: dict[str, float]
    std: dict[str, float]

    def standardised(self, values: dict[str, float]) -> dict[str, float]:
        """Return statistics as they would be N(0, 1) under the baseline."""
        return {name: (value - self.mean.get(name, 0.0)) / self.std.get(name, 1.0)
                for name, value in values.items()}


def criticise(samples: Samples, composite: Composite, bank: NullBank) -> dict[str, float]:
    """Return the statistics of a model, as they would be N(0, 1) if it were right."""
    return bank.standardised(statistics(composite.z, covariates_of(samples, composite)))


def simulate_bank(given: Covariates, phi: float, rng: np.random.Generator, size: int = SIZE
                  ) -> NullBank:
    """Simulate the bank of the plain OU."""
    rows = []
    n = given.at.size
    for _ in range(size):
        y = lfilter([1.0], [1.0, -phi], rng.standard_normal(n))
        z, state = refit(y)
        rows.append(statistics(z, replace(given, state=state, large=None), lines=False))
    return _summary(rows)


def simulate_bank_of(samples: Samples, composite: Composite, rng: np.random.Generator,
                     size: int = SIZE) -> NullBank:
    """
    Simulate the bank of a model that is more than the `ou`.

    A step of the ADC that is as large as the noise leaves errors that are
    neither normal nor independent, however right the model is.
    """
    model, rows, given = SupplyModel(composite.terms), [], covariates_of(samples, composite)
    for _ in range(size):
        y = model.simulate(samples.t, rng, samples.throttle)
        drawn = samples.spread(y, samples.cell, rng)
        fit = evaluate(drawn, composite.terms)
        state = np.concatenate(([0.0], (drawn.voltage - fit.mean)[:-1]))
        rows.append(statistics(fit.z, replace(given, state=state, large=None), lines=False))
    return _summary(rows)


def _summary(rows: list[dict[str, float]]) -> NullBank:
    """Return means and spreads, the spreads drawn towards 1."""
    weight = len(rows) / (len(rows) + _PRIOR)
    mean, std = {}, {}
    for name in rows[0]:
        v = np.array([row[name] for row in rows if name in row])
        # What is far from normal has a mean of its own, known as well as may be.
        strange = abs(float(v.mean())) > 4.0 * float(v.std()) / math.sqrt(v.size) + 1.0
        mean[name] = (1.0 if strange else weight) * float(v.mean())
        std[name] = math.sqrt(weight * float(v.var(ddof=1)) + 1.0 - weight)
    return NullBank(mean, std)


def refit(y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the scores and the states of a series after the fit of the baseline to it."""
    before = np.concatenate(([y[0]], y[:-1]))
    a, b = before - before.mean(), y - y.mean()
    phi = float(a @ b) / float(a @ a)
    e = b - phi * a
    return e / e.std(), np.concatenate(([0.0], b[:-1]))


def family_chance(largest: float, count: int) -> float:
    """Return the chance that the largest of `count` scores of a bank is at least so large."""
    one = 2.0 * float(stdtr(_FREEDOM, -abs(largest)))
    return -math.expm1(count * math.log1p(-min(one, 1.0 - 1e-16)))


def family_edge(chance: float, count: int) -> float:
    """Return the score that the largest of `count` exceeds by so small a chance."""
    one = -math.expm1(math.log1p(-chance) / count)
    return -float(stdtrit(_FREEDOM, 0.5 * one))
