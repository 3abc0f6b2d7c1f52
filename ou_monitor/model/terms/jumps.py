"""Steps of the supply that then relax at the rate alpha: impulses of the load."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import LawFit, log_normal, normal_scores, View
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray
from scipy.special import ndtr

# Events drawn for one segment at most: bounds time and memory.
_MOST = 5_000_000
# Share of samples with a jump in them from which jumps overlap.
_OFTEN = 0.05


@dataclass(frozen=True)
class Jumps(Term):
    """Push the state by normal amounts at the instants of a Poisson process."""

    NAME: ClassVar[str] = 'jumps'
    FAMILY: ClassVar[str] = 'events'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    ROLE: ClassVar[Role] = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('kurtosis', 'tails', 'skewness')
    IMITATES: ClassVar[tuple[str, ...]] = (
        'clock_jitter', 'glitches', 'heavy_tails', 'regime_switching', 'volatility')
    SEVERAL: ClassVar[bool] = True
    MEANING: ClassVar[str] = (
        'The supply is kicked now and then and relaxes at the rate alpha: load impulses.')
    REMEDY: ClassVar[str] = 'Look for what switches at that rate: servos, payload, radio.'
    SEPARATED_BY: ClassVar[str] = 'a recording with each consumer off in turn'

    rate: float = parameter('1/s', 'jumps per second', 0.0)
    mean: float = parameter('V', 'mean size')
    std: float = parameter('V', 'standard deviation of the size', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        waits, sizes = rng.spawn(2)
        next_at = math.nan

        def effect(s: Segment) -> None:
            nonlocal next_at
            if self.rate == 0.0:
                return
            if math.isnan(next_at):
                next_at = float(s.at[0]) + waits.standard_exponential() / self.rate
            if self.rate * (s.at[-1] - next_at) > _MOST:
                raise ValueError(f'{self.NAME}.rate of {self.rate:g} 1/s: more than {_MOST} jumps '
                                 'in one segment of samples; so many are noise')
            times = []
            while next_at <= s.at[-1]:
                times.append(next_at)
                next_at += waits.standard_exponential() / self.rate
            if not times:
                return
            when = np.array(times)
            # Within its step a jump has relaxed since it came.
            k = np.searchsorted(s.at, when)
            size = self.mean + self.std * sizes.standard_normal(when.size)
            np.add.at(s.push, k, size * np.exp(-s.alpha[k] * (s.at[k] - when)))

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit a mixture to the scores: most are N(0, 1), some have a jump in them."""
        z, var = view.z, view.variance
        found = _mixture(z[view.train], var[view.train])
        if found is None:
            return None
        share, mean, spread, unit = found
        if share > _OFTEN:
            # So many are no events: the noise itself is of another law.
            return None
        log_calm, log_jump = _parts(z, var, share, mean, spread, unit)
        both = np.logaddexp(log_calm, log_jump)
        jumped = np.exp(log_jump - both)
        s = np.sqrt(var)
        wide = np.sqrt(unit * unit + spread * spread / var)
        scores = normal_scores((1.0 - share) * ndtr(z / unit)
                               + share * ndtr((z - mean / s) / wide))
        step = 1.0 / view.rate
        push = np.where(jumped > 0.5, spread * spread + mean * mean, 0.0)
        n = view.train.stop * share
        term = cls(share / step, mean, spread)
        se = {'rate': term.rate / math.sqrt(max(n, 1.0)), 'mean': spread / math.sqrt(max(n, 1.0)),
              'std': spread / math.sqrt(2.0 * max(n, 1.0))}
        return LawFit(term, se, scores, both - log_normal(z), 4, push=push)


def _parts(z: FloatArray, var: FloatArray, share: float, mean: float, spread: float, unit: float
           ) -> tuple[FloatArray, FloatArray]:
    """Return the log densities, weights included, without and with a jump."""
    calm = math.log1p(-share) + log_normal(z, 0.0, unit * unit)
    jump = math.log(share) + log_normal(z, mean / np.sqrt(var),
                                        unit * unit + spread * spread / var)
    return calm, jump


def _mixture(z: FloatArray, var: FloatArray) -> tuple[float, float, float, float] | None:
    """Return share, mean and spread (V) of the jumps and the scale of the rest, by EM."""
    s = np.sqrt(var)
    big = np.abs(z) > 4.0
    if big.sum() < 3:
        return None
    share = float(big.mean())
    mean, spread, unit = float((z * s)[big].mean()), float((z * s)[big].std() + s.mean()), 1.0
    for _ in range(60):
        calm, jump = _parts(z, var, share, mean, spread, unit)
        weight = np.exp(jump - np.logaddexp(calm, jump))
        total = float(weight.sum())
        if total < 2.0:
            return None
        before = share
        share = min(total / z.size, 0.5)
        # What of a score is jump, by its prior and that of the noise in it.
        part = spread * spread / (spread * spread + unit * unit * var)
        size = mean + part * (z * s - mean)
        mean = float((weight * size).sum()) / total
        spread = math.sqrt(max(float((weight * ((size - mean) ** 2
                                                + part * unit * unit * var)).sum()) / total,
                               1e-12 * float(var.mean())))
        unit = math.sqrt(float(((1.0 - weight) * z * z).sum()) / (z.size - total))
        if abs(share - before) < 1e-4 * share:
            break
    return share, mean, spread, unit
