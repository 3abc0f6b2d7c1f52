"""
Markov switching of the mean or of sigma, unrelated to throttle.

The Kalman filter of the Gaussian part assumes a constant level.  After a change of the level, its
errors are large until it has converged to the new level, which takes longer with more white noise.
The convergence depends on all earlier states, which are approximated by their mean given the
samples so far (generalised pseudo-Bayesian filter of first order; Blom & Bar-Shalom, IEEE Trans.
Autom. Control 33 (1988) 780).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.model.hidden_chain import forward, log_likelihood, smoothed
from ou_monitor.model.ou import first_order
from ou_monitor.model.terms.term import (
    climb, curvature_se, Effect, LawFit, log_normal, normal_scores, parameter, Role, Segment,
    Stage, Term, View)
from ou_monitor.records import FloatArray
from scipy.linalg import expm
from scipy.special import ndtr


# Median absolute value of a normal score.
_MEDIAN = 0.6745
_ALL = 0.98  # Filter gain that counts as 1
# Maximum number of times that states and the filter's response to them are computed in turn, and
# change of the response, in standard deviations of an innovation, at which they agree.
_TURNS, _SETTLED = 30, 1e-6


def rates_between(up: float, down: float, states: int) -> FloatArray:
    """Return the transition rates between states, 1/s; 0 on the diagonal."""
    ones = np.ones((states, states))
    return up * np.triu(ones, 1) + down * np.tril(ones, -1)


def stationary_law(rates: FloatArray) -> FloatArray:
    """Return the stationary probabilities of a chain."""
    flow = np.vstack(((rates - np.diag(rates.sum(axis=1))).T / rates.max(),
                      np.ones(rates.shape[0])))
    law: FloatArray = np.linalg.lstsq(flow, np.eye(rates.shape[0] + 1)[-1], rcond=None)[0]
    return law


def step_chances(x: FloatArray, step: float, states: int) -> FloatArray:
    """Return the transition probabilities of one step, s, for coordinates x as in `Start`."""
    rates = rates_between(math.exp(x[0]), math.exp(x[1]), states)
    moved: FloatArray = expm((rates - np.diag(rates.sum(axis=1))) * step)
    return moved


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores to which a chain is fitted."""

    # As in `View`; shape (n,).
    z: FloatArray
    phi: FloatArray
    # Median standard deviation of the innovations, divided by each one's own; shape (n,).
    unit: FloatArray
    # Gain of the filter at the previous sample; shape (n,).
    trust: FloatArray
    step: float  # Time between samples, s
    # Response of the Kalman filter to the states up to two samples ago, in units of the level;
    # shape (n,).
    followed: FloatArray

    @classmethod
    def of(cls, view: View) -> Scores:
        """Return the scores of a view, with `followed` still zero."""
        unit: FloatArray = np.sqrt(float(np.median(view.variance)) / view.variance)
        trust = np.concatenate(([1.0], np.broadcast_to(view.trust, view.z.shape)[:-1]))
        if float(np.median(trust)) > _ALL:
            trust = np.ones(view.z.size)
        return cls(view.z, view.phi, unit, trust, 1.0 / view.rate, np.zeros(view.z.size))

    def part(self, part: slice) -> Scores:
        """Return the scores of a part of the samples."""
        return Scores(self.z[part], self.phi[part], self.unit[part], self.trust[part], self.step,
                      self.followed[part])

    @property
    def at_once(self) -> Scores:
        """Return the scores for a filter gain of 1."""
        return replace(self, trust=np.ones(self.z.size), followed=np.zeros(self.z.size))

    def following(self, x: FloatArray, at_once: float, states: int = 2) -> Scores:
        """Return the scores with `followed` computed for a chain with coordinates x."""
        if x[2] == 0.0 or bool((self.trust == 1.0).all()):
            return self.at_once
        kept, drawn = self.phi * (1.0 - self.trust), self.phi * self.trust
        found = replace(self, followed=np.zeros(self.z.size))
        for _ in range(_TURNS):
            # The states known so far follow from `followed`, and `followed` from these states.
            chain = chain_of(found, x, at_once, states)[0]
            known = (forward(*chain)[0] - chain[2]) @ np.arange(states)
            # With at_once the filter follows the level, otherwise the rail, which lags the level.
            moved = np.append(0.0, first_order(
                self.phi, (1.0 - self.phi) * known, 0.0)[:-1])
            behind = np.append(0.0, first_order(
                kept, drawn * (known if at_once else moved), 0.0)[:-1])
            followed = kept * (behind if at_once else behind - moved)
            change = float(np.abs(x[2] * self.unit * (followed - found.followed)).max())
            found = replace(self, followed=followed)
            if change < _SETTLED:
                break
        return found


def _direct(s: Scores, at_once: float, middle: float, states: int) -> FloatArray:
    """Return the mean score, in levels, for each pair of states, while `followed` is zero."""
    direct = np.empty((states, states, s.z.size))
    for i, j in np.ndindex(states, states):
        # With at_once, the new level less the filter's prediction from the old level; otherwise
        # the pull towards the old level.
        direct[i, j] = ((j - middle) - s.phi * s.trust * (i - middle) if at_once
                        else (1.0 - s.phi) * (i - middle))
    return direct


def chain_of(s: Scores, x: FloatArray, at_once: float, states: int = 2,
             middle: float | None = None
             ) -> tuple[tuple[FloatArray, FloatArray, FloatArray], FloatArray, FloatArray]:
    """Return the arguments of `forward`; mean scores, (states, states, n); stds by state."""
    # middle: mean state; by default the mean under the stationary law.
    state = np.arange(states, dtype=np.float64)
    chances = step_chances(x, s.step, states)
    law = stationary_law(rates_between(math.exp(x[0]), math.exp(x[1]), states))
    middle = float(law @ state) if middle is None else middle
    std = np.exp(x[4] + x[3] * state)
    mean = x[2] * s.unit * (_direct(s, at_once, middle, states) - s.followed)
    log = np.empty((states, states, s.z.size))
    for i, j in np.ndindex(states, states):
        log[i, j] = log_normal(s.z, mean[i, j], float(std[j]) ** 2)
    return (log.transpose(2, 0, 1), chances, law), mean, std


def moving(view: View, size: int) -> slice:
    """Return the part of a given size with the largest variance relative to the noise."""
    moves = (view.residual / np.sqrt(view.variance))[view.train]
    starts = range(0, moves.size - size + 1, max(size // 2, 1))
    begin = max(starts, key=lambda k: float(moves[k:k + size].var()))
    return slice(begin, begin + size)


def relaxing(view: View, faster: float) -> View:
    """Return the view for a rail that relaxes `faster` times as fast as in the present fit."""
    if faster == 1.0:
        return view
    phi = view.phi**faster
    e = view.z * np.sqrt(view.variance) + (view.phi - phi) * view.state
    inside = e[view.train]
    # Even with large levels, most innovations are noise, so their median gives its size.
    middle = float(np.median(inside))
    std = float(np.median(np.abs(inside - middle))) / _MEDIAN
    if not std > 0.0:
        return view
    spread = 1.0 - phi * phi
    variance = std * std * spread / float(np.median(spread))
    return replace(view, z=(e - middle) / np.sqrt(variance), phi=phi, variance=variance,
                   trust=1.0)


@dataclass(frozen=True, eq=False)
class Start:
    """Starting point of a fit."""

    x: FloatArray  # Two ln rates, level in std of an innovation, ln sigma ratio, ln scale
    at_once: float
    view: View


def _dwells(view: View) -> FloatArray:
    """Return initial values of the mean time in a state, s."""
    return np.array([5.0, 50.0]) * math.exp(-_fastest(view))


def _densities(view: View, other: View) -> FloatArray:
    """Return the log densities of a view's scores, per unit of another view's scores."""
    log: FloatArray = log_normal(view.z) - 0.5 * np.log(view.variance / other.variance)
    return log


def _ahead(fit: LawFit, other: LawFit, part: slice) -> float:
    """Return the gain in log-likelihood of a fit over another in a part of the samples, nats."""
    return float((fit.gain - other.gain)[part].sum())


def _first_fit(view: View, levels: bool) -> Start:
    """Return the best short fit of a chain of levels, or of sigmas."""
    best: tuple[float, Start] | None = None
    spread = math.sqrt(float(np.mean(view.residual[view.train] ** 2)))
    part = moving(view, min(_SHORT, view.train.stop))
    short, long = (-np.log(_dwells(view))).tolist()
    # The upper sigma may also be rare.
    pairs = [(short, short), (long, long), (long, short)][:3 - levels]
    for faster in _FASTER if levels else _FASTER[:1]:
        relaxed = relaxing(view, faster)
        scores = Scores.of(relaxed).at_once.part(part)
        # If levels hide a faster relaxation, they explain most of the spread.
        height = (1.0 if faster == 1.0 else 2.0) * spread / math.sqrt(
            float(np.median(relaxed.variance)))
        plain = float(_densities(view, relaxed)[part].sum())
        for up, down in pairs:
            for at_once in (1.0, 0.0)[:1 + levels]:
                start = np.array([up, down, height, 0.0, 0.0] if levels else
                                 [up, down, 0.0, _RATIO, -0.3 * _RATIO])

                def value(x: FloatArray) -> float:
                    return _value(scores, x, at_once, view)

                x, top = _climb_form(value, start, 0.4, 40)
                if best is None or top - plain > best[0]:
                    best = top - plain, Start(x, at_once, relaxed)
    assert best is not None
    return best[1]


def _value(s: Scores, x: FloatArray, at_once: float, view: View, states: int = 2,
           middle: float | None = None) -> float:
    """Return the log-likelihood of a chain."""
    if not _is_inside(x, view):
        return -math.inf
    return log_likelihood(*chain_of(s, x, at_once, states, middle)[0])


def _climb_form(value: Callable[[FloatArray], float], start: FloatArray, size: float, most: int
                ) -> tuple[FloatArray, float]:
    """Maximise over the coordinates of a form: a level or a ratio of sigmas of 0 stays 0."""
    free = (start != 0.0) | np.array([True, True, False, False, True])

    def full(x: FloatArray) -> FloatArray:
        moved = start.copy()
        moved[free] = x
        return moved

    x, top = climb(lambda x: value(full(x)), start[free], size=size, most=most)
    return full(x), top


# Maximum number of events in one segment; limits time and memory.
_MOST = 5_000_000


# Minimum number of complete stays in a state, and coefficient of variation below which the stays
# count as even: ten exponential times have a lower coefficient with a probability of 1e-3.
_STAYS, _EVEN = 10, 0.35


@dataclass(frozen=True)
class RegimeSwitching(Term):
    """
    Switch between two or three states, `level` apart; `sigma_ratio` multiplies sigma per state.

    A fit finds either: this class finds states of sigma, `SwitchingLevels` finds levels.

    The level `u0` of the `ou` is the mean over the states, and its sigma applies to the lowest
    state.  The rate from a state to each higher state is `rate_up`, to each lower state
    `rate_down`.  Exact in law: switching times are drawn, and sigma^2 is integrated over the parts
    of a step in which it is constant.
    """

    NAME = 'regime_switching'
    FAMILY = 'switching'
    STAGE = Stage.DRIVE
    ROLE = Role.LAW
    SLOW_FIT = True
    SIGNS = (
        '+clustering', '+kurtosis', '+band 0', '+band 1', '+band 2', '+band 3', 'state squared',
        'state cubed')
    IMITATES = (
        'flicker_noise', 'heavy_tails', 'jumps', 'nonlinear_restoring', 'second_relaxation',
        'volatility')
    SEVERAL = True
    MEANING = 'The supply switches between states, independent of $load.'
    REMEDY = 'Look for a load that switches on and off, or a loose contact.'
    SEPARATED_BY = 'a recording with the state of the other loads'

    rate_up: float = parameter('1/s', 'rate of switching to each higher state', 0.0, above=True)
    rate_down: float = parameter('1/s', 'rate of switching to each lower state', 0.0, above=True)
    level: float = parameter('V', 'difference in voltage from the state below')
    sigma_ratio: float = parameter('', 'ratio of sigma to sigma in the state below', 0.0)
    at_once: float = parameter(
        '', 'share of the level that acts at once; the rest relaxes at alpha', 0.0, 1.0)
    states: float = parameter('', 'number of states, 2 or 3', 2.0, 3.0)

    def check(self) -> None:
        """Check the number of states."""
        if self.states not in (2.0, 3.0):
            raise ValueError(f'{self.NAME}.states must be 2 or 3, got {self.states:g}')

    def start(self, rng: np.random.Generator) -> Effect:
        count = int(self.states)
        rates = rates_between(self.rate_up, self.rate_down, count)
        law, leave = stationary_law(rates), rates.sum(axis=1)
        middle = float(law @ np.arange(count))
        now_in = 0
        next_at = math.nan

        def effect(s: Segment) -> None:
            nonlocal now_in, next_at
            if math.isnan(next_at):
                now_in = _pick(rng, law)
                next_at = float(s.at[0]) + rng.standard_exponential() / leave[now_in]
            changes = float(law @ leave)
            if changes * (s.at[-1] - next_at) > _MOST:
                raise ValueError(f'{self.NAME}: {changes:g} changes a second exceed the limit of '
                                 f'{_MOST} per segment of samples; model them as noise')
            times = []
            states = [now_in]
            while next_at <= s.at[-1]:
                now_in = 1 - now_in if count == 2 else _pick(rng, rates[now_in])
                times.append(next_at)
                states.append(now_in)
                next_at += rng.standard_exponential() / leave[now_in]
            when = np.array(times)
            entered = np.array(states, dtype=np.float64)
            # The state at each sample, and at the beginning of each step.
            now = entered[np.searchsorted(when, s.at, side='right')]
            before = np.concatenate(([entered[0]], now[:-1]))
            s.level += self.at_once * self.level * (now - middle)
            # A change within a step affects only the part of the step after the change.
            k = np.searchsorted(s.at, when)
            slow = (1.0 - self.at_once) * self.level
            if slow != 0.0:
                push = (before - middle) * -np.expm1(-s.alpha * s.step)
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
        """Return whether enough changes are expected to call them a random process."""
        rates = rates_between(self.rate_up, self.rate_down, int(self.states))
        span = float(view.at[-1] - view.at[0])
        return float(stationary_law(rates) @ rates.sum(axis=1)) * span >= _CHANGES

    def objection(self, path: FloatArray, at: FloatArray) -> str:
        """Return an objection if the stays in one of two states are too even to be random."""
        high = path > 0.5 * (path.min() + path.max())
        stays = np.diff(at[1:][np.diff(high)])
        spread = [float(each.std() / each.mean()) for each in (stays[::2], stays[1::2])
                  if each.size >= _STAYS]
        least = min(spread, default=math.inf)
        return '' if self.states > 2.0 or least > _EVEN else (
            'its states change at random times; in the recording, the stays in one state vary by '
            f'only {100.0 * least:.0f} %, as with a periodic load')

    @classmethod
    def variants(cls) -> Sequence[type[Term]]:
        return (SwitchingLevels,)

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit a hidden chain of two or three states."""
        start = _first_fit(view, cls.EVENTS)
        two = cls._best_fit(start.view, [start.x], start.at_once, 80)
        if two is None:
            return None
        if start.view is not view:
            return replace(two, gain=two.gain + log_normal(start.view.z)
                           - _densities(view, start.view))
        # Three states if they are better.
        part, found = slice(0, min(view.train.stop, _LONG)), two
        for trial in [start.x * [1.0, 1.0, 0.6, 0.0, 1.0]] if cls.EVENTS else [
                np.array([0.0, 0.0, 0.0, ratio, -ratio]) for ratio in (0.45, 0.9)]:
            three = cls._best_fit(view, [trial], start.at_once, 70, 3)
            if three is not None and _ahead(three, found, part) > _THIRD * (found is two):
                found = three
        return found

    def refit_law(self, view: View) -> LawFit | None:
        unit = math.sqrt(float(np.median(view.variance)))
        rates, states = [math.log(self.rate_up), math.log(self.rate_down)], int(self.states)
        if self.EVENTS:
            starts = [np.array([*rates, self.level / unit, 0.0, 0.0])]
        else:
            ratio = math.log(max(self.sigma_ratio, 1e-2))
            law = stationary_law(rates_between(self.rate_up, self.rate_down, states))
            square = float(law @ np.exp(2.0 * ratio * np.arange(states)))
            # Start from two scales: one from the mean square of the scores, and 1, which is right
            # if the `ou` already has the sigma of the lowest state.
            mean = float(np.mean(view.z[view.train] ** 2))
            starts = [np.array([*rates, 0.0, ratio, scale])
                      for scale in (0.5 * math.log(mean / square), 0.0)]
        return self._best_fit(view, starts, self.at_once, 40, states)

    @classmethod
    def _best_fit(cls, view: View, starts: Sequence[FloatArray], at_once: float, most: int,
                  states: int = 2) -> LawFit | None:
        """Return the fit from the best of some starts that differ only in scale."""
        scores = Scores.of(view)
        part = slice(view.train.start, min(view.train.stop, view.train.start + _LONG))
        within = scores.part(part).following(starts[0], at_once, states)

        def value(x: FloatArray, middle: float | None = None) -> float:
            return _value(within, x, at_once, view, states, middle)

        start = max(starts, key=value)
        if states == 2:
            # Rates fitted to few changes are inaccurate; try rates counted over all samples too.
            counted = _counted_rates(forward(*chain_of(within, start, at_once)[0])[0], scores.step)
            start = max(np.array(start), np.append(counted, start[2:]), key=value)
        x, top = _climb_form(value, start, 0.2, most)
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
        # Keep the mean state fixed: `u0` is fitted too, so the rates must not move the levels.
        middle = float(chain[2] @ np.arange(states))
        e = curvature_se(lambda x: value(x, middle), x)
        se = {'rate_up': term.rate_up * float(e[0]), 'rate_down': term.rate_down * float(e[1]),
              **({'level': unit * float(e[2])} if cls.EVENTS else
                 {'sigma_ratio': term.sigma_ratio * float(e[3])})}
        after = smoothed(*chain) @ np.arange(states)
        moved = term.level * (after - after.mean())
        if at_once == 0.0:
            moved = first_order(view.phi, (1.0 - view.phi) * moved, 0.0)
        offset = moved if cls.EVENTS else None
        # Probabilities of the states, given the samples so far.
        known = np.concatenate((before[1:], before[-1:]))
        # Relative to the lowest state, so that the `ou` gets the sigma of the lowest state.
        power = 1.0 / (known @ np.exp(-2.0 * x[3] * np.arange(states)))
        return LawFit(term, se, normal, density - log_normal(view.z), 4,
                      power=None if cls.EVENTS else power, offset=offset)


@dataclass(frozen=True)
class SwitchingLevels(RegimeSwitching):
    """Switch between levels, whose changes are events: a law of sigma may stand beside them."""

    EVENTS = True


def _counted_rates(before: FloatArray, step: float) -> FloatArray:
    """Return ln of the rates of leaving two states, by counting changes of the likelier state."""
    high = before[:, 1] > 0.5
    ups, downs = (int((high[1:] & ~high[:-1]).sum()), int((~high[1:] & high[:-1]).sum()))
    spent = step * np.array([(~high).sum(), high.sum()])
    rates: FloatArray = np.log((np.array([ups, downs]) + 0.5) / np.maximum(spent, step))
    return rates


# Factors by which the rail may relax faster than in a fit without levels.
_FASTER = 1.0, 3.0, 9.0
# Number of samples for comparing starts, and for fitting from the best start.
_SHORT, _LONG = 8000, 30000
_FASTEST = 30.0  # Maximum rate of switching, 1/s
_CHANGES = 8.0  # Minimum expected number of changes in the recording
_THIRD = 10.0  # Minimum evidence for three states, nats
_RATIO = 0.7  # Initial ln of the ratio of sigmas


def _fastest(view: View) -> float:
    """Return ln of the maximum rate; states that last only a few samples are another cause."""
    return math.log(min(_FASTEST, view.rate / 20.0))


def _is_inside(x: FloatArray, view: View) -> bool:
    return bool(max(x[0], x[1]) <= _fastest(view) and min(x[0], x[1]) >= -12.0
                and abs(x[3]) <= 3.0 and abs(x[4]) <= 2.0)


def _pick(rng: np.random.Generator, weight: FloatArray) -> int:
    total = np.cumsum(weight)
    return min(int(np.searchsorted(total, rng.random() * total[-1], side='right')),
               weight.size - 1)
