"""Slow, random changes of sigma that throttle does not cause: temperature, ageing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.ou import first_order
from ou_monitor.model.terms.term import (
    climb, curvature_se, Effect, LawFit, normal_scores, parameter, refine, Role, Segment, Stage,
    Term, View)
from ou_monitor.records import FloatArray
from scipy.linalg import eigh_tridiagonal
from scipy.special import comb, digamma, ndtr


@dataclass(frozen=True)
class Volatility(Term):
    """Multiply sigma and white noise by exp(a second OU), which is constant within a step."""

    NAME: ClassVar[str] = 'volatility'
    FAMILY: ClassVar[str] = 'intensity'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    ROLE: ClassVar[Role] = Role.LAW
    SLOW_FIT: ClassVar[bool] = True
    SIGNS: ClassVar[tuple[str, ...]] = ('clustering', 'kurtosis')
    IMITATES: ClassVar[tuple[str, ...]] = ('heavy_tails', 'jumps', 'regime_switching')
    MEANING: ClassVar[str] = 'sigma changes slowly at random, independent of throttle.'
    REMEDY: ClassVar[str] = 'Use an estimator window much shorter than 1/rate.'
    SEPARATED_BY: ClassVar[str] = (
        'a recording several times as long that includes the temperature')

    std: float = parameter('', 'standard deviation of ln sigma', 0.0)
    rate: float = parameter('1/s', 'relaxation rate of ln sigma', 0.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        before = 0.0

        def effect(s: Segment) -> None:
            nonlocal before
            phi = np.exp(-self.rate * s.step)
            e = self.std * np.sqrt(-np.expm1(-2.0 * self.rate * s.step))
            log = first_order(phi, e * rng.standard_normal(s.t.size), before)
            before = float(log[-1])
            s.sigma *= np.exp(log)
            s.noise = s.noise * np.exp(log)

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit an OU of ln sigma, constant within short segments."""
        return cls._best_fit(view, _start(view), known=False)

    def refit_law(self, view: View) -> LawFit | None:
        return self._best_fit(view, np.array([
            math.log(max(self.std, 1e-3)), math.log(self.rate), _start(view)[2]]), known=True)

    def holds(self, view: View) -> bool:
        """Return whether the recording has enough relaxation times; else sigma has a trend."""
        return self.rate * float(view.at[-1]) > _WANDERS

    @classmethod
    def _best_fit(cls, view: View, start: FloatArray, known: bool) -> LawFit | None:
        """Return the fit near a start."""
        size, squares, sizes = _segments(view)
        span = size / view.rate
        trained = view.train.stop // size

        def values(points: FloatArray) -> FloatArray:
            inside = np.clip(points, *_RANGE)
            return np.asarray(_grid(squares[:trained], sizes[:trained], span, inside)[1].sum(
                axis=0))

        def value(x: FloatArray) -> float:
            return float(values(x[None])[0])

        near = refine(values, start) if known else None
        if near is not None:
            x, _, e = near
        else:
            x, _ = climb(value, start, size=0.25, most=_EVALUATIONS[known])
            e = curvature_se(value, x)
        x = np.clip(x, *_RANGE)
        before, density, levels = (one[..., 0] for one in _grid(squares, sizes, span, x[None]))
        scores = _scores(view.z, before, levels, size)[:view.z.size]
        gain = np.repeat((density + 0.5 * squares) / sizes, size)[:view.z.size]
        term = cls(math.exp(x[0]), math.exp(x[1]))
        # Log probabilities of the levels, given all samples up to the end of each segment.
        log = np.log(np.maximum(before, 1e-300)) - sizes[:, None] * levels - 0.5 * squares[
            :, None] * np.exp(-2.0 * levels)
        weight = np.exp(log - log.max(axis=1)[:, None])
        # Relative to the median, so that the `ou` gets the median of sigma.
        power = weight.sum(axis=1) / (weight @ np.exp(2.0 * (x[2] - levels)))
        power = np.repeat(power, size)[:view.z.size]
        return LawFit(term, {'std': term.std * float(e[0]), 'rate': term.rate * float(e[1])},
                      scores, gain, 3, power=power, white=power)


def _segments(view: View) -> tuple[int, FloatArray, FloatArray]:
    """Return the samples per segment, and the sum of squares and the actual size of each."""
    n = view.z.size
    size = max(1, n // _SEGMENTS)
    begin = np.arange(0, n, size)
    return size, np.add.reduceat(view.z * view.z, begin), np.diff(
        np.append(begin, n)).astype(np.float64)


def _start(view: View) -> FloatArray:
    """Return std, rate and mean of ln sigma, found by moments, in the coordinates of `_grid`."""
    # The logarithm of the mean of m squares is 2 ln sigma plus an error.  The errors of different
    # segments are independent, so covariances at two lags give the variance and the rate.
    size, squares, sizes = _segments(view)
    log = 0.5 * np.log(np.maximum(squares / sizes, 1e-12))[:max(view.train.stop // size, 2)]
    c = log - log.mean()

    def covariance(lag: int) -> float:
        return float(np.mean(c[lag:] * c[:-lag]))

    near = max(covariance(1), 1e-3)
    # The rate is determined best at a lag at which the covariance has dropped clearly.
    lags = [1 << k for k in range(1, 11) if 1 << k < c.size // 4]
    far = next((lag for lag in lags if covariance(lag) < 0.6 * near), lags[-1] if lags else 0)
    fall = math.log(near / max(covariance(far), 0.05 * near)) if far else 1.0
    rate = max(fall, 0.02) / (max(far - 1, 1) * size / view.rate)
    # For a chi-squared variable, the mean of the logarithm is below the logarithm of the mean.
    below = 0.5 * (float(digamma(0.5 * size)) - math.log(0.5 * size))
    return np.array([0.5 * math.log(near), min(math.log(rate), 4.0), float(log.mean()) - below])


def _scores(z: FloatArray, before: FloatArray, levels: FloatArray, size: int) -> FloatArray:
    """Return normal scores, each also conditioned on the earlier samples of its segment."""
    count = before.shape[0]
    padded = np.zeros(count * size)
    padded[:z.size] = z
    z = padded.reshape(count, size, 1)
    # Levels with a noticeable probability in some segment.
    some = before.max(axis=0) > _NOTICED
    before, levels = before[:, some], levels[some]
    std = np.exp(levels)
    log_density = -levels - 0.5 * (z / std) ** 2
    known = np.cumsum(log_density, axis=1) - log_density
    weight = before[:, None, :] * np.exp(known - known.max(axis=2, keepdims=True))
    chance = (weight * ndtr(z / std)).sum(axis=2) / weight.sum(axis=2)
    return normal_scores(chance.ravel())


_SEGMENTS = 1500  # Number of segments in a recording
# Number of levels of ln sigma; they extend to +-8 standard deviations, because later samples may
# leave the fitted range.
_LEVELS = 65
_EVERY = 4  # Number of segments between normalisations, which prevent underflow
# Minimum number of relaxation times of ln sigma in a recording: with 2, the standard error of the
# logarithm of its variance is sqrt(2/2) = 1.
_WANDERS = 2.0
# Stationary probabilities of the levels.
_STATIONARY: FloatArray = comb(_LEVELS - 1, np.arange(_LEVELS)) / 2.0 ** (_LEVELS - 1)
# Range of ln std, ln rate (1/s) and mean of ln sigma.
_RANGE = np.array([[-4.0, -7.0, -math.inf], [1.0, 5.0, math.inf]])
_EVALUATIONS = 60, 30  # Maximum number of evaluations in a first fit, and in a refit
_NOTICED = 1e-9  # Probability below which a level is ignored


@lru_cache(maxsize=1)
def _modes() -> FloatArray:
    """Return the modes of the levels, in columns, each decaying at a multiple of the rate."""
    # Eigenvectors of Ehrenfest's urn model, symmetrised; eigenvalue j is j - (levels - 1)/2.
    k = np.arange(1.0, _LEVELS)
    return np.asarray(eigh_tridiagonal(np.zeros(_LEVELS), 0.5 * np.sqrt(k * (_LEVELS - k)))[1])


def _kernels(keep: FloatArray) -> FloatArray:
    """Return the transition probabilities between levels, shape (rates, levels, levels)."""
    # The levels are the sum of 64 two-state chains.  So their conditional mean and variance equal
    # the OU's, even if the OU is so slow that its steps are much smaller than the spacing of the
    # levels (Rouwenhorst 1995; Kopecky & Suen, Rev. Econ. Dyn. 13 (2010) 701).
    modes, root = _modes(), np.sqrt(_STATIONARY)
    powers = keep[:, None] ** np.arange(_LEVELS - 1.0, -1.0, -1.0)
    chances = (modes * powers[:, None, :]) @ modes.T * (root / root[:, None])
    np.maximum(chances, 0.0, out=chances)
    chances /= chances.sum(axis=2, keepdims=True)
    return chances


def _grid(squares: FloatArray, sizes: FloatArray, span: float, points: FloatArray
          ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return for each point: prior of levels and log density in each segment, and the levels."""
    reach = math.sqrt(_LEVELS - 1.0)
    std = np.exp(points[:, :1])
    levels = points[:, 2:] + std * np.linspace(-reach, reach, _LEVELS)
    rates, which = np.unique(points[:, 1], return_inverse=True)
    kernel = _kernels(np.exp(-np.exp(rates) * span))[which]
    weight = -0.5 * squares[:, None, None] * np.exp(-2.0 * levels)
    weight -= sizes[:, None, None] * levels
    top = weight.max(axis=2)
    weight -= top[:, :, None]
    np.exp(weight, out=weight)
    before = np.empty_like(weight)
    law = np.tile(_STATIONARY, (points.shape[0], 1))
    for k, row in enumerate(weight):
        before[k] = law
        law = ((law * row)[:, None] @ kernel)[:, 0]
        if k % _EVERY == 0:
            law /= law.sum(axis=1, keepdims=True)
    before /= before.sum(axis=2, keepdims=True)
    density = np.log(np.einsum('kpl,kpl->kp', before, weight)) + top
    return before.transpose(0, 2, 1), density, levels.T
