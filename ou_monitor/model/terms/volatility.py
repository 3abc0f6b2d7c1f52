"""sigma wanders slowly, unrelated to throttle: temperature, ageing of the supply."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import climb, curvature_se, normal_scores, refine, View
from ou_monitor.model.terms.segment import Effect, first_order, Segment, Stage
from ou_monitor.model.terms.term import LawFit, parameter, Role, Term
from ou_monitor.records import FloatArray
from scipy.special import comb, digamma, ndtr


@dataclass(frozen=True)
class Volatility(Term):
    """Multiply sigma by exp of an OU, taken as constant within a step."""

    NAME: ClassVar[str] = 'volatility'
    FAMILY: ClassVar[str] = 'intensity'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    ROLE: ClassVar[Role] = Role.LAW
    DEAR: ClassVar[bool] = True
    SIGNS: ClassVar[tuple[str, ...]] = ('clustering', 'kurtosis')
    IMITATES: ClassVar[tuple[str, ...]] = ('heavy_tails', 'jumps', 'regime_switching')
    MEANING: ClassVar[str] = 'The intensity of the noise wanders slowly, unrelated to throttle.'
    REMEDY: ClassVar[str] = 'Keep the window of the estimator short beside that time.'
    SEPARATED_BY: ClassVar[str] = (
        'a recording several times as long, temperature recorded beside it')

    std: float = parameter('', 'standard deviation of ln sigma', 0.0)
    rate: float = parameter('1/s', 'relaxation rate of ln sigma', 0.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        before = 0.0

        def effect(s: Segment) -> None:
            nonlocal before
            phi = np.exp(-self.rate * s.step)
            e = self.std * np.sqrt(-np.expm1(-2.0 * self.rate * s.step))
            log = first_order(phi, e * rng.standard_normal(s.t.size), before)
            before = float(log[-1])
            s.sigma *= np.exp(log)

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit a log-variance that wanders, taken as constant over short segments."""
        return cls._climbed(view, _start(view), known=False)

    def refit_law(self, view: View) -> LawFit | None:
        """Fit again, from where it was."""
        return self._climbed(view, np.array([
            math.log(max(self.std, 1e-3)), math.log(self.rate), _start(view)[2]]), known=True)

    def holds(self, view: View) -> bool:
        """Return whether it wanders: a recording of fewer relaxations shows a trend of sigma."""
        return self.rate * float(view.at[-1]) > _WANDERS

    @classmethod
    def _climbed(cls, view: View, start: FloatArray, known: bool) -> LawFit | None:
        """Return the fit near a start."""
        size, squares, sizes = _segments(view)
        span = size / view.rate
        trained = view.train.stop // size

        def values(points: FloatArray) -> FloatArray:
            found = np.full(points.shape[0], -math.inf)
            inside = np.flatnonzero((np.abs(points[:, 0] + 1.5) < 2.5)
                                    & (np.abs(points[:, 1] + 1.0) < 6.0))
            # Those of one rate share the chances from level to level.
            for rate in np.unique(points[inside, 1]).tolist():
                at = inside[points[inside, 1] == rate]
                found[at] = _grid(squares[:trained], sizes[:trained], span, points[at])[1].sum(
                    axis=0)
            return found

        def value(x: FloatArray) -> float:
            return float(values(x[None])[0])

        near = refine(values, start) if known else None
        if near is not None:
            x, _, e = near
        else:
            x, top = climb(value, start, size=0.25, most=_EVALUATIONS[known])
            if top == -math.inf:
                return None
            e = curvature_se(value, x)
        before, density, levels = (one[..., 0] for one in _grid(squares, sizes, span, x[None]))
        scores = _scores(view.z, before, levels, size)[:view.z.size]
        gain = np.repeat((density + 0.5 * squares) / sizes, size)[:view.z.size]
        term = cls(math.exp(x[0]), math.exp(x[1]))
        # As known at the end of each segment.
        log = np.log(np.maximum(before, 1e-300)) - sizes[:, None] * levels - 0.5 * squares[
            :, None] * np.exp(-2.0 * levels)
        weight = np.exp(log - log.max(axis=1)[:, None])
        # Over the median, which so becomes the sigma of the `ou`.
        power = weight.sum(axis=1) / (weight @ np.exp(2.0 * (x[2] - levels)))
        return LawFit(term, {'std': term.std * float(e[0]), 'rate': term.rate * float(e[1])},
                      scores, gain, 3, power=np.repeat(power, size)[:view.z.size])


def _segments(view: View) -> tuple[int, FloatArray, FloatArray]:
    """Return samples in a segment, the sums of squares, and what each segment really has."""
    n = view.z.size
    size = max(1, n // _SEGMENTS)
    begin = np.arange(0, n, size)
    return size, np.add.reduceat(view.z * view.z, begin), np.diff(
        np.append(begin, n)).astype(np.float64)


def _start(view: View) -> FloatArray:
    """
    Return std, rate and mean of ln sigma, as `_grid` has them, by moments.

    The logarithm of the mean of m squares is 2 ln sigma and an error that does
    not depend on its neighbours; so the covariances at two lags give variance
    and rate.
    """
    size, squares, sizes = _segments(view)
    log = 0.5 * np.log(np.maximum(squares / sizes, 1e-12))[:max(view.train.stop // size, 2)]
    c = log - log.mean()

    def covariance(lag: int) -> float:
        return float(np.mean(c[lag:] * c[:-lag]))

    near = max(covariance(1), 1e-3)
    # Where a good part of it is gone: there it says most of the rate.
    lags = [1 << k for k in range(1, 11) if 1 << k < c.size // 4]
    far = next((lag for lag in lags if covariance(lag) < 0.6 * near), lags[-1] if lags else 0)
    fall = math.log(near / max(covariance(far), 0.05 * near)) if far else 1.0
    rate = max(fall, 0.02) / (max(far - 1, 1) * size / view.rate)
    # The mean of the logarithm of a chi square is below the logarithm of its mean.
    below = 0.5 * (float(digamma(0.5 * size)) - math.log(0.5 * size))
    return np.array([0.5 * math.log(near), min(math.log(rate), 4.0), float(log.mean()) - below])


def _scores(z: FloatArray, before: FloatArray, levels: FloatArray, size: int) -> FloatArray:
    """Return normal scores, each given all samples before it in its segment, too."""
    count = before.shape[0]
    padded = np.zeros(count * size)
    padded[:z.size] = z
    z = padded.reshape(count, size, 1)
    # Levels without weight in any segment.
    some = before.max(axis=0) > _BELIEVED
    before, levels = before[:, some], levels[some]
    std = np.exp(levels)
    log_density = -levels - 0.5 * (z / std) ** 2
    known = np.cumsum(log_density, axis=1) - log_density
    weight = before[:, None, :] * np.exp(known - known.max(axis=2, keepdims=True))
    chance = (weight * ndtr(z / std)).sum(axis=2) / weight.sum(axis=2)
    return normal_scores(chance.ravel())


# Segments that a recording is cut into, levels of ln sigma (they reach 8 standard
# deviations: it may go beyond the range of the fit), products between two
# scalings: few, for a segment can be unlikely at all levels but one.
_SEGMENTS = 1500
_LEVELS = 65
_EVERY = 4
# Relaxations of ln sigma in a recording, from which its variance is known to a factor of e:
# sqrt(2/2) = 1.
_WANDERS = 2.0
# Chances of the levels.
_STATIONARY: FloatArray = comb(_LEVELS - 1, np.arange(_LEVELS)) / 2.0 ** (_LEVELS - 1)
# Evaluations of a fit from afar and from nearby; chance below which a level counts as none.
_EVALUATIONS = 60, 30
_BELIEVED = 1e-9


@lru_cache(maxsize=8)
def _rouwenhorst(keep: float) -> FloatArray:
    """
    Return the chances to go from level to level, shape (levels, levels).

    Conditional mean and variance are those of the OU however slow it is, where
    steps are much smaller than from one level to the next (Rouwenhorst 1995;
    Kopecky & Suen, Rev. Econ. Dyn. 13 (2010) 701).

    """
    stay, go = 0.5 * (1.0 + keep), 0.5 * (1.0 - keep)
    chances = np.array([[stay, go], [go, stay]])
    for n in range(3, _LEVELS + 1):
        larger = np.zeros((n, n))
        larger[:-1, :-1] += stay * chances
        larger[:-1, 1:] += go * chances
        larger[1:, :-1] += go * chances
        larger[1:, 1:] += stay * chances
        larger[1:-1] /= 2.0
        chances = larger
    return chances


def _grid(squares: FloatArray, sizes: FloatArray, span: float, points: FloatArray
          ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return law before each segment, log density, levels; points of one rate side by side."""
    reach = math.sqrt(_LEVELS - 1.0)
    std = np.exp(points[:, :1])
    levels = points[:, 2:] + std * np.linspace(-reach, reach, _LEVELS)
    kernel = _rouwenhorst(math.exp(-math.exp(float(points[0, 1])) * span))
    weight = -0.5 * squares[:, None, None] * np.exp(-2.0 * levels)
    weight -= sizes[:, None, None] * levels
    top = weight.max(axis=2)
    weight -= top[:, :, None]
    np.exp(weight, out=weight)
    before = np.empty_like(weight)
    law = np.tile(_STATIONARY, (points.shape[0], 1))
    for k, row in enumerate(weight):
        before[k] = law
        law = (law * row) @ kernel
        if k % _EVERY == 0:
            law /= law.sum(axis=1, keepdims=True)
    before /= before.sum(axis=2, keepdims=True)
    density = np.log(np.einsum('kpl,kpl->kp', before, weight)) + top
    return before.transpose(0, 2, 1), density, levels.T
