"""Markov switching of the mean or of sigma, unrelated to throttle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.hidden_chain import forward, log_likelihood, smoothed
from ou_monitor.model.terms.laws import (
    climb, curvature_se, LawFit, log_normal, normal_scores, View)
from ou_monitor.model.terms.segment import Effect, first_order, Segment, Stage
from ou_monitor.model.terms.switching_chain import (
    calm_levels, chain_of, moving, NO_LEVEL, rates_between, relaxing, Scores, stationary_law,
    step_chances, without_levels)
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray
from scipy.special import ndtr

# Events drawn for one segment at most: bounds time and memory.
_MOST = 5_000_000


@dataclass(frozen=True)
class RegimeSwitching(Term):
    """
    Switch between two or three states; each adds a level and multiplies sigma once more.

    From any state to any higher one at `rate_up`, to any lower one at `rate_down`.
    Exact in law: the instants of switching are drawn, and sigma is integrated over
    the part of a step that it holds for.
    """

    NAME: ClassVar[str] = 'regime_switching'
    FAMILY: ClassVar[str] = 'switching'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    ROLE: ClassVar[Role] = Role.LAW
    DEAR: ClassVar[bool] = True
    SIGNS: ClassVar[tuple[str, ...]] = (
        '+clustering', '+kurtosis', '+band 0', '+band 1', '+band 2', '+band 3', 'state squared',
        'state cubed')
    IMITATES: ClassVar[tuple[str, ...]] = (
        'flicker_noise', 'heavy_tails', 'jumps', 'nonlinear_restoring', 'second_relaxation',
        'volatility')
    SEVERAL: ClassVar[bool] = True
    MEANING: ClassVar[str] = 'The supply switches between two states, unrelated to throttle.'
    REMEDY: ClassVar[str] = 'Look for a consumer that goes on and off, or a loose contact.'
    SEPARATED_BY: ClassVar[str] = 'the state of other consumers recorded beside it'

    rate_up: float = parameter('1/s', 'rate of going to each higher state', 0.0, above=True)
    rate_down: float = parameter('1/s', 'rate of going to each lower state', 0.0, above=True)
    level: float = parameter('V', 'what each further state adds to the level')
    sigma_ratio: float = parameter('', 'sigma in a state / in the one below', 0.0)
    at_once: float = parameter(
        '', 'share of the level that comes at once; the rest at the rate alpha', 0.0, 1.0)
    states: float = parameter('', 'number of states, 2 or 3', 2.0, 3.0)

    def check(self) -> None:
        """Check that states can be counted."""
        if self.states not in (2.0, 3.0):
            raise ValueError(f'{self.NAME}.states must be 2 or 3, got {self.states:g}')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        count = int(self.states)
        rates = rates_between(self.rate_up, self.rate_down, count)
        leave = rates.sum(axis=1)
        now_in = 0
        next_at = math.nan

        def effect(s: Segment) -> None:
            nonlocal now_in, next_at
            if math.isnan(next_at):
                now_in = _pick(rng, stationary_law(rates))
                next_at = float(s.at[0]) + rng.standard_exponential() / leave[now_in]
            changes = float(stationary_law(rates) @ leave)
            if changes * (s.at[-1] - next_at) > _MOST:
                raise ValueError(f'{self.NAME}: {changes:g} changes a second are more than '
                                 f'{_MOST} in one segment of samples; so many are noise')
            times = []
            states = [now_in]
            while next_at <= s.at[-1]:
                now_in = 1 - now_in if count == 2 else _pick(rng, rates[now_in])
                times.append(next_at)
                states.append(now_in)
                next_at += rng.standard_exponential() / leave[now_in]
            when = np.array(times)
            entered = np.array(states, dtype=np.float64)
            # The state at each sample, and at the begin of each step.
            now = entered[np.searchsorted(when, s.at, side='right')]
            before = np.concatenate(([entered[0]], now[:-1]))
            s.level += self.at_once * self.level * now
            # What is left of a change within a step: the share of the step's
            # pull, and of its noise, that comes after it.
            k = np.searchsorted(s.at, when)
            slow = (1.0 - self.at_once) * self.level
            if slow != 0.0:
                push = before * -np.expm1(-s.alpha * s.step)
                np.add.at(push, k, -np.expm1(-s.alpha[k] * (s.at[k] - when)) * np.diff(entered))
                s.push += slow * push
            if self.sigma_ratio == 1.0:
                return
            factor = self.sigma_ratio ** (2.0 * before)
            share = np.expm1(-2.0 * s.alpha[k] * (s.at[k] - when)) / np.expm1(
                -2.0 * s.alpha[k] * s.step[k])
            np.add.at(factor, k, share * np.diff(self.sigma_ratio ** (2.0 * entered)))
            s.power *= np.maximum(factor, 0.0)

        return effect

    def holds(self, view: View) -> bool:
        """Return whether so many changes are expected that they are a law, not a few steps."""
        rates = rates_between(self.rate_up, self.rate_down, int(self.states))
        span = float(view.at[view.train.stop - 1] - view.at[0])
        return float(stationary_law(rates) @ rates.sum(axis=1)) * span >= _CHANGES

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit a hidden chain of two states that share a level and a scale."""
        # The best with a level of its own, and without.
        best: dict[bool, tuple[float, FloatArray, float, View]] = {}
        spread = math.sqrt(float(np.mean(view.residual[view.train] ** 2)))
        first = slice(0, min(_SHORT, view.train.stop))
        busy = moving(view, first.stop)
        # Coordinates: ln rates, level in innovations, ln sigma ratio, ln scale.
        shortest = math.exp(-_fastest(view))
        for faster in _FASTER:
            relaxed = relaxing(view, faster)
            unit = math.sqrt(float(np.median(relaxed.variance)))
            scores = Scores.of(relaxed).at_once
            # Two levels that hide how fast the rail relaxes make most of the spread.
            height = (1.0 if faster == 1.0 else 2.0) * spread / unit
            # Densities of volts, over those without states.
            plain = log_normal(view.z) - 0.5 * np.log(view.variance / relaxed.variance)

            def value(x: FloatArray) -> float:
                if not _inside(x, view):
                    return -math.inf
                chain = chain_of(scores.part(part), x, once)[0]
                return log_likelihood(*chain) - float(plain[part].sum())

            for dwell in (5.0 * shortest, 50.0 * shortest):
                for level, ratio, once in ((0.0, 0.7, 1.0), (height, 0.0, 1.0),
                                           (height, 0.0, 0.0)):
                    if level == 0.0 and faster > 1.0:
                        continue
                    part = busy if level else first
                    rate = -math.log(dwell)
                    x, top = climb(value, [rate, rate, level, ratio, -0.3 * ratio], most=40)
                    if (level != 0.0) not in best or top > best[level != 0.0][0]:
                        best[level != 0.0] = top, x, once, relaxed
        two: LawFit | None = None
        trials = list(best.values())
        hidden = calm_levels(view, busy, spread, -np.log([5.0 * shortest, 50.0 * shortest]))
        if hidden is not None:
            trials.append((0.0, *hidden))
        levels = [trial[1] for trial in trials if trial[1] is not best.get(False, (0.0, None))[1]]
        while trials:
            _, x, once, relaxed = trials.pop()
            fit = cls._finished(relaxed, [x], once, 80)
            if fit is None:
                continue
            if any(x is start for start in levels) and fit.offset is not None:
                # The residual without the levels shows how fast the rail relaxes, and its noise.
                again = without_levels(view, fit.offset)
                unit = math.sqrt(float(np.median(again.variance)))
                term = fit.term
                assert isinstance(term, RegimeSwitching)
                trials.append((0.0, np.array([
                    math.log(term.rate_up), math.log(term.rate_down), term.level / unit, 0.0,
                    0.0]), once, again))
            if relaxed is not view:
                fit = replace(fit, gain=fit.gain + log_normal(relaxed.z) - log_normal(view.z)
                              - 0.5 * np.log(relaxed.variance / view.variance))
            if two is None or float((fit.gain - two.gain)[view.train].sum()) > 0.0:
                two, begin, at_once, chosen = fit, x, once, relaxed
        if two is None or chosen is not view:
            return two
        if two.power is None:
            slow, ahead, states = _slow_levels(view)
            if slow is not None and ahead > max(float(two.gain[view.train].sum()), _SLOW_AHEAD):
                # Fitted is the relaxation of both; that of the noise alone comes with the fit.
                return cls._finished(view, [slow], 0.0, 1, states) or two
        # Three states: of sigma, or of the level, whichever the two differ in.
        starts = [np.array([0.0, 0.0, 0.0, ratio, -ratio]) for ratio in (0.45, 0.9)]
        if two.power is None:
            starts = [np.array(begin) * [1.0, 1.0, 0.6, 0.0, 1.0]]
        part, found = slice(0, min(view.train.stop, _LONG)), two
        for start in starts:
            three = cls._finished(view, [start], at_once, 70, 3)
            ahead = _THIRD if found is two else 0.0
            if three is not None and float((three.gain - found.gain)[part].sum()) > ahead:
                found = three
        return found

    def refit_law(self, view: View) -> LawFit | None:
        """Fit again, from where it was."""
        unit = math.sqrt(float(np.median(view.variance)))
        ratio = math.log(max(self.sigma_ratio, 1e-2))
        states = int(self.states)
        law = stationary_law(rates_between(self.rate_up, self.rate_down, states))
        square = float(law @ np.exp(2.0 * ratio * np.arange(states)))
        # Such that the mean square is that of the scores, or 1, as in clear levels; 0 where the
        # `ou` has the sigma of the lowest state.
        mean = float(np.mean(view.z[view.train] ** 2)) if abs(self.level) < unit else 1.0
        starts = [np.array([math.log(self.rate_up), math.log(self.rate_down), self.level / unit,
                            ratio, scale])
                  for scale in (0.5 * math.log(mean / square), 0.0)]
        return self._finished(view, starts, self.at_once, 40, states)

    @classmethod
    def _finished(cls, view: View, starts: Sequence[FloatArray], at_once: float, most: int,
                  states: int = 2) -> LawFit | None:
        """Return the fit near the best of some starts, which differ in scale alone."""
        scores = Scores.of(view)
        part = slice(view.train.start, min(view.train.stop, view.train.start + _LONG))
        within = scores.part(part).following(starts[0], at_once, states)

        def value(x: FloatArray) -> float:
            if not _inside(x, view):
                return -math.inf
            return log_likelihood(*chain_of(within, x, at_once, states)[0])

        start = max(starts, key=value)
        if states == 2:
            # Few changes in few samples say little of rates; what is counted in all says more.
            counted = _counted(forward(*chain_of(within, start, at_once)[0])[0], scores.step)
            start = max(np.array(start), np.append(counted, start[2:]), key=value)
        x, top = climb(value, start, size=0.2, most=most)
        if top == -math.inf:
            return None
        unit = math.sqrt(float(np.median(view.variance)))
        chain, mean, std = chain_of(scores.following(x, at_once, states), x, at_once, states)
        before, density = forward(*chain)
        chance = np.zeros(view.z.size)
        for i, j in np.ndindex(states, states):
            chance += before[:, i] * chain[1][i, j] * ndtr((view.z - mean[i, j]) / std[j])
        normal = normal_scores(chance)
        term = cls(math.exp(x[0]), math.exp(x[1]), float(x[2]) * unit, math.exp(x[3]),
                   at_once, float(states))
        e = curvature_se(value, x)
        se = {'rate_up': term.rate_up * float(e[0]), 'rate_down': term.rate_down * float(e[1]),
              'level': unit * float(e[2]), 'sigma_ratio': term.sigma_ratio * float(e[3])}
        after = smoothed(*chain) @ np.arange(states)
        moved = term.level * (after - after.mean())
        if at_once == 0.0:
            moved = first_order(view.phi, (1.0 - view.phi) * moved, 0.0)
        offset = None if abs(x[2]) < NO_LEVEL else moved
        # As known at each sample.
        known = np.concatenate((before[1:], before[-1:]))
        # Over the sigma of the lowest state, which so becomes that of the `ou`.
        power = 1.0 / (known @ np.exp(-2.0 * x[3] * np.arange(states)))
        return LawFit(term, se, normal, density - log_normal(view.z), 5,
                      power=None if abs(x[3]) < _NO_RATIO else power, offset=offset)


def _counted(before: FloatArray, step: float) -> FloatArray:
    """Return the logarithms of the rates that the likelier of two states is left at."""
    high = before[:, 1] > 0.5
    ups, downs = (int((high[1:] & ~high[:-1]).sum()), int((~high[1:] & high[:-1]).sum()))
    spent = step * np.array([(~high).sum(), high.sum()])
    rates: FloatArray = np.log((np.array([ups, downs]) + 0.5) / np.maximum(spent, step))
    return rates


def _slow_levels(view: View) -> tuple[FloatArray | None, float, int]:
    """
    Return a start for levels that last much longer than the noise, and its evidence.

    Means over half a relaxation time are levels and a first-order noise, of which
    the correlation is fitted with them: that of the samples is of both together.
    """
    r = view.residual[view.train]
    a = -math.log(min(max(float(np.median(view.phi[view.train])), 1e-6), 1.0 - 1e-6))
    size = max(1, round(0.5 / a))
    count = r.size // size
    if count < 100:
        return None, 0.0, 2
    mean = r[:count * size].reshape(count, size).mean(axis=1)
    spread = float(mean.std())
    if not spread > 0.0:
        return None, 0.0, 2
    mean = (mean - mean.mean()) / spread
    step = size / view.rate
    # What throttle does to the noise is none of the levels'.
    noisy = view.variance[view.train][:count * size].reshape(count, size).mean(axis=1)[1:]
    noisy /= math.exp(float(np.mean(np.log(noisy))))

    def value(x: FloatArray, states: int) -> float:
        if max(x[0], x[1]) > _fastest(view) or min(x[0], x[1]) < -6.0 or abs(x[4]) > 4.0:
            return -math.inf
        law = stationary_law(rates_between(math.exp(x[0]), math.exp(x[1]), states))
        keep, state = math.tanh(x[3]), np.arange(states)
        level = x[2] * (state - law @ state)
        log = np.empty((states, states, count - 1))
        for i, j in np.ndindex(states, states):
            e = mean[1:] - level[j] - keep * (mean[:-1] - level[i])
            log[i, j] = log_normal(e, 0.0, math.exp(2.0 * x[4]) * noisy)
        return log_likelihood(log.transpose(2, 0, 1), step_chances(x, step, states), law)

    # Without a level the rates say nothing: correlation and scale alone.
    keep = float(mean[1:] @ (mean[:-1] / noisy)) / float(mean[:-1] @ (mean[:-1] / noisy))
    rest = mean[1:] - keep * mean[:-1]
    least = float(log_normal(rest, 0.0, float(np.mean(rest**2 / noisy)) * noisy).sum())
    best: tuple[float, FloatArray, int] | None = None
    for states, level in ((2, 1.7), (3, 1.2)):
        for dwell in (0.5, 2.0):
            rate = -math.log(dwell * (states - 1))
            x, top = climb(lambda x: value(x, states), [rate, rate, level, 0.5 * keep, -0.5],
                           most=120)
            top -= _THIRD * (states - 2)
            if best is None or top > best[0]:
                best = top, x, states
    if best is None:
        return None, 0.0, 2
    unit = math.sqrt(float(np.median(view.variance)))
    x = best[1]
    return np.array([x[0], x[1], x[2] * spread / unit, 0.0, 0.0]), best[0] - least, best[2]


# How much faster the rail may relax than it seems to with levels on it.
_FASTER = 1.0, 3.0, 9.0
# Evidence from which slow levels are tried, nats.
_SLOW_AHEAD = 8.0
# Samples on which starts are tried, and on which the best is fitted.
_SHORT, _LONG = 8000, 30000
# Largest rate of switching, 1/s.
_FASTEST = 30.0
# Changes in the part fitted, at least.
_CHANGES = 8.0
# Evidence from which there are three states, nats.
_THIRD = 10.0
# A ratio of which the logarithm is less than this is 1.
_NO_RATIO = 0.05


def _fastest(view: View) -> float:
    """Return the logarithm of the largest rate: states of a few samples are another law."""
    return math.log(min(_FASTEST, view.rate / 20.0))


def _inside(x: FloatArray, view: View) -> bool:
    """Return whether coordinates are in their range."""
    return bool(max(x[0], x[1]) <= _fastest(view) and min(x[0], x[1]) >= -12.0
                and abs(x[3]) <= 3.0 and abs(x[4]) <= 2.0)


def _pick(rng: np.random.Generator, weight: FloatArray) -> int:
    """Draw a number with the given weights."""
    total = np.cumsum(weight)
    return min(int(np.searchsorted(total, rng.random() * total[-1], side='right')),
               weight.size - 1)
