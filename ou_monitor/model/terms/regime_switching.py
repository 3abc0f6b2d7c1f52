"""Markov switching of the mean or of sigma, unrelated to throttle."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.hidden_chain import forward
from ou_monitor.model.terms.laws import (
    climb, curvature_se, log_normal, mixture_cdf, normal_scores)
from ou_monitor.model.terms.term import (
    Effect, LawFit, parameter, Role, Stage, Stretch, Term, View)
from ou_monitor.records import FloatArray


# Events drawn for one stretch at most: bounds time and memory.
_MOST = 5_000_000


@dataclass(frozen=True)
class RegimeSwitching(Term):
    """
    Switch between two states; in the second, add a level and multiply sigma.

    Exact in law: the instants of switching are drawn, and sigma is integrated over
    the part of a step that it holds for.
    """

    NAME: ClassVar[str] = 'regime_switching'
    FAMILY: ClassVar[str] = 'switching'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    ROLE: ClassVar[Role] = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('clustering', 'kurtosis', 'band')

    rate_up: float = parameter('1/s', 'rate of going into the second state', 0.0, above=True)
    rate_down: float = parameter('1/s', 'rate of leaving it', 0.0, above=True)
    level: float = parameter('V', 'what the second state adds to the level')
    sigma_ratio: float = parameter('', 'sigma in the second state / in the first', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        waits = rng
        up = False
        next_at = math.nan

        def effect(s: Stretch) -> None:
            nonlocal up, next_at
            if math.isnan(next_at):
                up = bool(rng.random() * (self.rate_up + self.rate_down) < self.rate_up)
                next_at = float(s.at[0]) + waits.standard_exponential() / (
                    self.rate_down if up else self.rate_up)
            changes = 2.0 / (1.0 / self.rate_up + 1.0 / self.rate_down)
            if changes * (s.at[-1] - next_at) > _MOST:
                raise ValueError(f'{self.NAME}: {changes:g} changes a second are more than '
                                 f'{_MOST} in one stretch of samples; so many are noise')
            times = []
            states = [up]
            while next_at <= s.at[-1]:
                up = not up
                times.append(next_at)
                states.append(up)
                next_at += waits.standard_exponential() / (self.rate_down if up else self.rate_up)
            when = np.array(times)
            seen = np.array(states, dtype=np.float64)
            # The state at each sample, and at the begin of each step.
            now = seen[np.searchsorted(when, s.at, side='right')]
            before = np.concatenate(([seen[0]], now[:-1]))
            s.level += self.level * now
            more = self.sigma_ratio * self.sigma_ratio - 1.0
            if more == 0.0:
                return
            factor = 1.0 + more * before
            # What is left of a change within a step: the share of the step's
            # noise that comes after it.
            k = np.searchsorted(s.at, when)
            share = np.expm1(-2.0 * s.alpha[k] * (s.at[k] - when)) / np.expm1(
                -2.0 * s.alpha[k] * s.step[k])
            np.add.at(factor, k, more * share * np.diff(seen))
            s.power *= np.maximum(factor, 0.0)

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit a hidden chain of two states that share a level and a scale."""
        best: tuple[float, FloatArray] | None = None
        z, phi = view.z[view.train], view.phi[view.train]
        spread = math.sqrt(float(np.mean(view.residual[view.train] ** 2)))
        unit = math.sqrt(float(np.median(view.variance)))
        step = 1.0 / view.rate
        # States that last a few samples only are glitches, or another law.
        fastest = math.log(min(_FASTEST, view.rate / 20.0))

        def value(x: FloatArray, most: int = 1 << 40) -> float:
            if max(x[0], x[1]) > fastest or min(x[0], x[1]) < -12.0 or abs(x[3]) > 3.0 or (
                    abs(x[4]) > 2.0):
                return -math.inf
            return float(_chain(z[:most], phi[:most], step, x)[1].sum())

        # Coordinates: ln rates, level in innovations, ln sigma ratio, ln scale.
        for dwell in (5.0 * math.exp(-fastest), 50.0 * math.exp(-fastest)):
            for level, ratio in ((0.0, 0.7), (spread / unit, 0.0)):
                rate = -math.log(dwell)
                x, top = climb(lambda p: value(p, _SHORT),
                               [rate, rate, level, ratio, -0.3 * ratio], most=50)
                if best is None or top > best[0]:
                    best = top, x
        if best is None:
            return None
        x, _ = climb(lambda p: value(p, _LONG), best[1], size=0.2, most=80)
        before, density, mean, std = _chain(view.z, view.phi, step, x)
        weight = before[:, :, None] * _transition(x, step)
        scores = normal_scores(mixture_cdf(view.z, weight.reshape(-1, 4),
                                           mean.reshape(-1, 4), std.reshape(-1, 4)))
        term = cls(math.exp(x[0]), math.exp(x[1]), float(x[2]) * unit, math.exp(x[3]))
        e = curvature_se(value, x)
        se = {'rate_up': term.rate_up * float(e[0]), 'rate_down': term.rate_down * float(e[1]),
              'level': unit * float(e[2]), 'sigma_ratio': term.sigma_ratio * float(e[3])}
        after = np.append(before[1:, 1], before[-1, 1])
        offset = None if abs(x[2]) < _NO_LEVEL else term.level * (after - after.mean())
        return LawFit(term, se, scores, density - log_normal(view.z), 5, offset=offset)


# Samples on which starts are tried, and on which the best is fitted.
_SHORT, _LONG = 8000, 30000
# Largest rate of switching, 1/s.
_FASTEST = 30.0
# A level of fewer innovations than this is none.
_NO_LEVEL = 0.2


def _transition(x: FloatArray, step: float) -> FloatArray:
    up, down = math.exp(x[0]), math.exp(x[1])
    total = up + down
    move = -math.expm1(-total * step) / total
    return np.array([[1.0 - up * move, up * move], [down * move, 1.0 - down * move]])


def _chain(z: FloatArray, phi: FloatArray, step: float, x: FloatArray
           ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the law of the state before each sample, densities, and what each pair expects."""
    state = np.array([0.0, 1.0])
    # The level enters the innovations where it changes, and a little while it is on.
    mean = x[2] * (state[None, None, :] - phi[:, None, None] * state[None, :, None])
    share = math.exp(x[1]) / (math.exp(x[0]) + math.exp(x[1]))
    centre = x[2] * (1.0 - share) * (1.0 - phi)
    mean = mean - centre[:, None, None]
    std = np.broadcast_to(math.exp(x[4]) * np.exp(x[3] * state)[None, None, :], mean.shape)
    log_density = log_normal(z[:, None, None], mean, std * std)
    before, density = forward(log_density, _transition(x, step), np.array([share, 1.0 - share]))
    return before, density, mean, std
