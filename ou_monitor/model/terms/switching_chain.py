"""
Chains of two or three levels in the scores of a filter: what each pair of states expects of them.

A filter that knows of no levels takes a change of one for noise at first, and follows it the more
slowly the more white noise there is; what it has followed depends on all states before.  Their
mean, as known at each sample, stands for them (generalised pseudo-Bayesian filter of first order;
Blom & Bar-Shalom, IEEE Trans. Autom. Control 33 (1988) 780).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.model.hidden_chain import log_likelihood
from ou_monitor.model.terms.laws import log_normal, View
from ou_monitor.model.terms.segment import first_order
from ou_monitor.records import FloatArray
from scipy.linalg import expm

# Median of the size of a normal score.
_MEDIAN = 0.6745
# Share of an error that a filter takes for the rail's from which it takes all; a level of fewer
# innovations than this is none.
_ALL, NO_LEVEL = 0.98, 0.2
# Correlation of what levels leave from which there is a rail at all.
_LEAST = 1e-3
# Shares of its noise that an `ou` without levels may have, and heights of levels over the spread.
_CALMER, _HEIGHTS = (0.1, 0.01), (0.7, 1.2, 2.0)


def rates_between(up: float, down: float, states: int) -> FloatArray:
    """Return the rates from each state to each other, 1/s; 0 on the diagonal."""
    ones = np.ones((states, states))
    return up * np.triu(ones, 1) + down * np.tril(ones, -1)


def stationary_law(rates: FloatArray) -> FloatArray:
    """Return the stationary law of a chain."""
    flow = np.vstack(((rates - np.diag(rates.sum(axis=1))).T / rates.max(),
                      np.ones(rates.shape[0])))
    law: FloatArray = np.linalg.lstsq(flow, np.eye(rates.shape[0] + 1)[-1], rcond=None)[0]
    return law


def step_chances(x: FloatArray, step: float, states: int) -> FloatArray:
    """Return the chances to go from state to state within a step."""
    rates = rates_between(math.exp(x[0]), math.exp(x[1]), states)
    moved: FloatArray = expm((rates - np.diag(rates.sum(axis=1))) * step)
    return moved


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores that a chain is fitted to."""

    # As in `View`; shape (n,).
    z: FloatArray
    phi: FloatArray
    unit: FloatArray  # How much of a score the median standard deviation is; shape (n,)
    # Share of the error before each that the filter has taken for the rail's; shape (n,).
    trust: FloatArray
    step: float  # From sample to sample, s
    # What the filter has followed of the states up to two samples ago, in states; shape (n,).
    followed: FloatArray

    @classmethod
    def of(cls, view: View) -> Scores:
        """Return those of a view, as if nothing had been followed."""
        unit: FloatArray = np.sqrt(float(np.median(view.variance)) / view.variance)
        trust = np.concatenate(([1.0], np.broadcast_to(view.trust, view.z.shape)[:-1]))
        if float(np.median(trust)) > _ALL:
            trust = np.ones(view.z.size)
        return cls(view.z, view.phi, unit, trust, 1.0 / view.rate, np.zeros(view.z.size))

    def part(self, part: slice) -> Scores:
        """Return a part."""
        return Scores(self.z[part], self.phi[part], self.unit[part], self.trust[part], self.step,
                      self.followed[part])

    @property
    def at_once(self) -> Scores:
        """Return them as if the filter had followed each error at once."""
        return replace(self, trust=np.ones(self.z.size), followed=np.zeros(self.z.size))

    def following(self, x: FloatArray, at_once: float, states: int = 2) -> Scores:
        """Return them with what the filter has followed of a chain with coordinates x."""
        if abs(x[2]) < NO_LEVEL or bool((self.trust == 1.0).all()):
            return self.at_once
        chances = step_chances(x, self.step, states)
        law = stationary_law(rates_between(math.exp(x[0]), math.exp(x[1]), states))
        middle = float(law @ np.arange(states))
        std = np.exp(x[4] + x[3] * np.arange(states))
        # What each pair expects, but for what was followed; in sizes that a loop takes.
        direct = _direct(self, at_once, middle, states)
        height = (x[2] * self.unit).tolist()
        scale = [(float(-0.5 / s**2), float(1.0 / s)) for s in std]
        weights = [[float(chances[i, j]) for j in range(states)] for i in range(states)]
        before = law.tolist()
        pairs = list(np.ndindex(states, states))
        kept = (self.phi * (1.0 - self.trust)).tolist()
        drawn = (self.phi * self.trust).tolist()
        phi = self.phi.tolist()
        rows = [direct[i, j].tolist() for i, j in pairs]
        z, found = self.z.tolist(), [0.0] * self.z.size
        followed = moved = 0.0
        for k in range(len(z)):
            known = sum(p * s for s, p in enumerate(before)) - middle
            # The state before the sample: the level itself, or the rail that goes there.
            found[k] = behind = kept[k] * (followed if at_once else followed - moved)
            logs = []
            for m, (i, j) in enumerate(pairs):
                off = z[k] - height[k] * (rows[m][k] - behind)
                logs.append(scale[j][0] * off * off)
            top = max(logs)
            tops = [0.0] * states
            for m, (i, j) in enumerate(pairs):
                tops[j] += before[i] * weights[i][j] * scale[j][1] * math.exp(logs[m] - top)
            total = sum(tops)
            before = [p / total for p in tops] if total > 0.0 else law.tolist()
            if at_once:
                followed = kept[k] * followed + drawn[k] * known
            else:
                followed = kept[k] * followed + drawn[k] * moved
                moved = phi[k] * moved + (1.0 - phi[k]) * known
        return replace(self, followed=np.array(found))


def _direct(s: Scores, at_once: float, middle: float, states: int) -> FloatArray:
    """Return what each pair of states expects of each error at once, in states."""
    direct = np.empty((states, states, s.z.size))
    for i, j in np.ndindex(states, states):
        # The level itself, less what the filter makes of the one before; or the pull to it.
        direct[i, j] = ((j - middle) - s.phi * s.trust * (i - middle) if at_once
                        else (1.0 - s.phi) * (i - middle))
    return direct


def chain_of(s: Scores, x: FloatArray, at_once: float, states: int = 2
             ) -> tuple[tuple[FloatArray, FloatArray, FloatArray], FloatArray, FloatArray]:
    """
    Return what a filter takes, and what each pair of states expects.

    The mean of each pair, shape (states, states, n), and the deviation of each state.
    """
    state = np.arange(states, dtype=np.float64)
    chances = step_chances(x, s.step, states)
    law = stationary_law(rates_between(math.exp(x[0]), math.exp(x[1]), states))
    std = np.exp(x[4] + x[3] * state)
    mean = x[2] * s.unit * (_direct(s, at_once, float(law @ state), states) - s.followed)
    log = np.empty((states, states, s.z.size))
    for i, j in np.ndindex(states, states):
        log[i, j] = log_normal(s.z, mean[i, j], float(std[j]) ** 2)
    return (log.transpose(2, 0, 1), chances, law), mean, std


def moving(view: View, size: int) -> slice:
    """Return the segment of a size in which the voltage moves most beside its noise."""
    moves = (view.residual / np.sqrt(view.variance))[view.train]
    starts = range(0, moves.size - size + 1, max(size // 2, 1))
    begin = max(starts, key=lambda k: float(moves[k:k + size].var()))
    return slice(begin, begin + size)


def relaxing(view: View, faster: float) -> View:
    """
    Return what a rail that relaxes faster leaves over.

    The relaxation that was fitted without levels is that of both together.
    """
    if faster == 1.0:
        return view
    phi = view.phi**faster
    e = view.z * np.sqrt(view.variance) + (view.phi - phi) * view.state
    inside = e[view.train]
    # Most of what it leaves is noise, however large the levels are.
    middle = float(np.median(inside))
    std = float(np.median(np.abs(inside - middle))) / _MEDIAN
    if not std > 0.0:
        return view
    spread = 1.0 - phi * phi
    variance = std * std * spread / float(np.median(spread))
    return replace(view, z=(e - middle) / np.sqrt(variance), phi=phi, variance=variance,
                   trust=1.0)


def calm_levels(view: View, part: slice, spread: float, rates: FloatArray
                ) -> tuple[FloatArray, float, View] | None:
    """
    Return coordinates of levels under white noise, and the view that shows them; None for none.

    An `ou` that was fitted with the levels follows them; one with less noise of its own does not.
    Heights are tried up to that of two levels that make all of the spread, V.
    """
    if bool((Scores.of(view).trust == 1.0).all()):
        return None
    best: tuple[float, FloatArray, View] | None = None
    for share in _CALMER:
        calm = _calmer(view, share)
        scores, unit = Scores.of(calm).part(part), math.sqrt(float(np.median(calm.variance)))
        for height in _HEIGHTS:
            for rate in rates.tolist():
                x = np.array([rate, rate, height * spread / unit, 0.0, 0.0])
                chain = chain_of(scores.following(x, 1.0), x, 1.0)[0]
                top = log_likelihood(*chain) - 0.5 * float(np.log(calm.variance[part]).sum())
                if best is None or top > best[0]:
                    best = top, x, calm
    assert best is not None
    return best[1], 1.0, best[2]


def _calmer(view: View, share: float) -> View:
    """Return what a rail with a share of its noise leaves over, the white noise being the same."""
    keep = min(float(np.median(view.phi[view.train])), 1.0 - 1e-9)
    trust = float(np.median(np.broadcast_to(view.trust, view.z.shape)[view.train]))
    variance = float(np.median(view.variance))
    ahead, white = trust * variance, (1.0 - trust) * variance
    drive = share * (ahead - keep * keep * ahead * white / (ahead + white))
    ahead, _ = _settled(keep, drive / (1.0 - keep * keep), white)
    return _filtered(view, keep, ahead / (ahead + white), ahead + white)


def _filtered(view: View, keep: float, trust: float, variance: float) -> View:
    """Return what a settled filter leaves over (keep in a usual step, variance in V^2)."""
    phi = view.phi**(math.log(keep) / math.log(float(np.median(view.phi[view.train]))))
    before = np.concatenate(([0.0], view.residual[:-1]))
    e = view.residual - first_order(phi * (1.0 - trust), phi * trust * before, 0.0)
    e -= float(np.median(e[view.train]))
    variances = variance * view.variance / float(np.median(view.variance))
    return replace(view, z=e / np.sqrt(variances), phi=phi, variance=variances, trust=trust)


def without_levels(view: View, levels: FloatArray) -> View:
    """
    Return what a rail leaves over on which levels lie, V: with the levels, as it relaxes without.

    An OU, or an OU in white noise, by the covariances of what the levels leave at lags up to 2:
    whichever predicts that better.
    """
    r = (view.residual - levels)[view.train]
    r = r - r.mean()
    near, next_, far = (float(r[k:] @ r[:r.size - k]) / r.size for k in range(3))
    if not near > 0.0 or not next_ > _LEAST * near:
        return view
    usual = float(np.median(view.phi[view.train]))
    best: tuple[float, float, float] | None = None
    for keep, power in ((next_ / near, near), (far / next_, next_**2 / max(far, _LEAST * near))):
        keep, power = min(max(keep, _LEAST), usual), min(power, near)
        ahead, white = _settled(keep, power, near - power)
        trust = ahead / (ahead + white)
        e = r[1:] - first_order(np.full(r.size - 1, keep * (1.0 - trust)),
                                keep * trust * r[:-1], 0.0)
        variance = float(np.mean(e * e))
        if best is None or variance < best[0]:
            best = variance, keep, trust
    assert best is not None
    variance, keep, trust = best
    return _filtered(view, keep, trust, variance)


def _settled(keep: float, power: float, white: float) -> tuple[float, float]:
    """Return the variance of an OU before each sample once a filter has settled, and the noise."""
    drive = power * (1.0 - keep * keep)
    b = white * (1.0 - keep * keep) - drive
    return 0.5 * (-b + math.sqrt(b * b + 4.0 * drive * white)), white
