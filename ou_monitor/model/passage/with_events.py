"""
First passage of an OU that is pushed and switched at random instants.

Units: base stationary standard deviations, counted towards the barrier, and
relaxation times.  A finite Markov chain changes the intensity and the mean; jumps
push the state.  Both are events.  The chance of passage is split by whether there
is an event within the span s,

    P = exp(-n s) P0 + (1 - exp(-n s)) H,   n the rate of events in the present state.

P0, without event, is the law of `passage_law`; H, given one or more, is smooth and
never far below the chance that a single event leads beyond; ln(-ln(1 - H)) is
tabulated by barrier b, gap g = b - x and ln s.  It is solved for all barriers and states at once:
implicit in the pull and the noise (exponentially fitted differences, BDF2),
extrapolated in what the events bring.

Limits: H within 2 % where one event brings it, within 20 % where it takes several
rare ones and P is 1e-7; events that come more than some 50 times in a relaxation
time are noise rather than events, and only roughly told.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model.passage.law import passage_probability, spline
from ou_monitor.records import FloatArray
from scipy.linalg import solve_banded
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

# The table: barriers b = 6 sinh(u), gaps g = 0.25 sinh(v), and spans even in ln s.
_B_SCALE, _B_LOW, _B_HIGH, _B_NODES = 6.0, -2.0, 200.0, 62
_G_SCALE, _G_HIGH, _G_NODES = 0.25, 210.0, 160
_S_LOW, _S_HIGH, _S_NODES = 1e-3, 100.0, 47
# Steps from one span of the table to the next, at least; events in a step, and
# steps in all, at most.
_STEPS, _EVENTS, _MOST = 3, 0.3, 1200
# H is taken as between these.
_LEAST, _NEARLY = 1e-250, 1.0 - 1e-7

_U = np.linspace(math.asinh(_B_LOW / _B_SCALE), math.asinh(_B_HIGH / _B_SCALE), _B_NODES)
_B = _B_SCALE * np.sinh(_U)
_DV = math.asinh(_G_HIGH / _G_SCALE) / (_G_NODES - 1)
_G = _G_SCALE * np.sinh(_DV * np.arange(_G_NODES))
_DS = math.log(_S_HIGH / _S_LOW) / (_S_NODES - 1)
_PAD = 5


@dataclass(frozen=True, eq=False)
class Jump:
    """
    Pushes of normal size at the instants of a Poisson process.

    Attributes
    ----------
    rate : float
        Per relaxation time.
    mean, std : float
        Of the size, towards the barrier.

    """

    rate: float
    mean: float
    std: float


@dataclass(frozen=True, eq=False)
class Chain:
    """
    A Markov chain of r states that the OU is in.

    Attributes
    ----------
    rates : ndarray, shape (r, r)
        From state to state, per unit of time; 0 on the diagonal.
    level : ndarray, shape (r,)
        Mean, towards the barrier or in volts, as said where it is used.
    at_once : ndarray, shape (r,)
        The part of `level` that comes at once; the rest at the rate alpha.
    ratio : ndarray, shape (r,)
        Factor on the noise intensity.
    law : ndarray, shape (r,)
        Stationary probabilities.

    """

    rates: FloatArray
    level: FloatArray
    at_once: FloatArray
    ratio: FloatArray
    law: FloatArray

    def times(self, other: Chain) -> Chain:
        """Return the chain of both, independent of each other."""
        one, two = np.eye(self.law.size), np.eye(other.law.size)
        return Chain(np.kron(self.rates, two) + np.kron(one, other.rates),
                     np.add.outer(self.level, other.level).ravel(),
                     np.add.outer(self.at_once, other.at_once).ravel(),
                     np.outer(self.ratio, other.ratio).ravel(),
                     np.outer(self.law, other.law).ravel())


@dataclass(frozen=True, eq=False)
class EventTable:
    """
    H of all states of a chain, by barrier, gap and span.

    Attributes
    ----------
    coefficients : tuple of ndarray, each of shape (barriers, gaps, spans)
        Spline coefficients of ln(-ln(1 - H)) of each state.

    """

    coefficients: tuple[FloatArray, ...]

    def log_hazard(self, b: FloatArray, gap: FloatArray, s: FloatArray) -> FloatArray:
        """Return ln(-ln(1 - H))."""
        at = np.empty((3, b.size))
        at[0] = (np.arcsinh(np.clip(b, _B_LOW, _B_HIGH) / _B_SCALE) - _U[0]) / (_U[1] - _U[0])
        at[1] = np.arcsinh(np.minimum(gap, _G_HIGH) / _G_SCALE) / _DV
        at[2] = np.log(np.clip(s, _S_LOW, _S_HIGH) / _S_LOW) / _DS
        at += _PAD
        return np.stack([map_coordinates(c, at, order=3, mode='mirror', prefilter=False)
                         for c in self.coefficients])


def longest() -> float:
    """Return the longest span of the tables, in relaxation times."""
    return _S_HIGH


def without_event(b: FloatArray, gap: FloatArray, s: FloatArray, level: FloatArray,
                  ratio: FloatArray) -> FloatArray:
    """Return the passage probability in each state while no event comes."""
    size = ratio[:, None]
    far = (b - level) / size
    return passage_probability(far - gap / size, far, s)


def build(chain: Chain, jumps: tuple[Jump, ...]) -> EventTable:
    """Solve for H."""
    states = chain.law.size
    jump_rate = sum(jump.rate for jump in jumps)
    leave = chain.rates.sum(axis=1) + jump_rate
    moves = sum((jump.rate * _moved(jump.mean, jump.std) for jump in jumps),
                np.zeros((_G_NODES, _G_NODES)))
    switches = [(i, j, chain.rates[i, j] * _moved(chain.at_once[j] - chain.at_once[i], 0.0))
                for i in range(states) for j in range(states) if chain.rates[i, j] > 0.0]

    def brought(p: FloatArray) -> FloatArray:
        """Return what events bring per unit of time, shape (states, barriers, gaps)."""
        total = p @ moves.T if jumps else np.zeros_like(p)
        for i, j, matrix in switches:
            total[i] += p[j] @ matrix.T
        return total

    low, main, high = _generator(chain, leave)
    shape = (states, _B_NODES, _G_NODES)
    b, gap = (v.ravel() for v in np.meshgrid(_B, _G, indexing='ij'))
    # One after the other: without event, and with.
    begin = np.exp(-leave * _S_LOW)[:, None] * without_event(b, gap, np.full(b.size, _S_LOW),
                                                             chain.level[:, None],
                                                             chain.ratio)
    now = np.zeros((2, *shape))
    now[0] = begin.reshape(shape)
    passed = np.zeros(shape)
    passed[..., 0] = 1.0
    now[1] = _S_LOW * brought(0.5 * (now[0] + passed))
    now[1, ..., 0] = -np.expm1(-leave * _S_LOW)[:, None]
    before, h_before, s = now, 0.0, _S_LOW
    gain = before_gain = brought(now.sum(axis=0))
    table = np.empty((states, _B_NODES, _G_NODES, _S_NODES))
    fast, left = float(leave.max()), _MOST
    for k in range(_S_NODES):
        share = -np.expm1(-leave * s)[:, None, None]
        table[..., k] = np.log(-np.log1p(-np.clip(now[1] / share, _LEAST, _NEARLY)))
        if k == _S_NODES - 1:
            break
        to = _S_LOW * math.exp(_DS * (k + 1))
        steps = max(_STEPS, math.ceil((to - s) * fast / _EVENTS))
        left -= steps
        if left < 0:
            # So many events have made it forget its begin: passages come steadily.
            table[..., k + 1:] = table[..., k:k + 1] + _DS * np.arange(1, _S_NODES - k)
            break
        h = (to - s) / steps
        for _ in range(steps):
            s += h
            w = h / h_before if h_before else 0.0
            a0, a1, a2 = (1.0 + 2.0 * w) / (1.0 + w), 1.0 + w, w * w / (1.0 + w)
            right = (a1 * now - a2 * before) / h
            right[1] += (1.0 + w) * gain - w * before_gain
            after = _implicit(low, main, high, a0 / h, right, np.exp(-leave * s))
            before, now, h_before = now, after, h
            before_gain, gain = gain, brought(after.sum(axis=0))
    return EventTable(tuple(spline(part) for part in table))


def _implicit(low: FloatArray, main: FloatArray, high: FloatArray, inverse: float,
              right: FloatArray, calm: FloatArray) -> FloatArray:
    """Solve (inverse - L) p = right with the values at the barrier known."""
    after = np.empty_like(right)
    after[0, ..., 0] = calm[:, None]
    after[1, ..., 0] = 1.0 - calm[:, None]
    known = right[..., 1:].copy()
    known[..., 0] += low[..., 1] * after[..., 0]
    bands = np.zeros((3, *main.shape[:2], _G_NODES - 1))
    bands[0, ..., 1:] = -high[..., 1:-1]
    bands[1] = inverse - main[..., 1:]
    bands[2, ..., :-1] = -low[..., 2:]
    solved = solve_banded((1, 1), bands.reshape(3, -1), known.reshape(2, -1).T,
                          overwrite_ab=True, overwrite_b=True, check_finite=False)
    after[..., 1:] = solved.T.reshape(known.shape)
    return after


def _generator(chain: Chain, leave: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Return the weights of the node before, of the node and of the one after.

    Each of shape (states, barriers, gaps).  P_s = D P_gg + (b - g - level) P_g -
    n P, with differences fitted to exponentials: positive for any drift.
    """
    noise = (chain.ratio**2)[:, None, None]
    drift = _B[:, None] - _G - chain.level[:, None, None]
    back = np.concatenate(([1.0], np.diff(_G)))
    ahead = np.concatenate((np.diff(_G), [1.0]))
    mean = 0.5 * (back + ahead)

    def flow(z: FloatArray) -> FloatArray:
        """Return z / (exp(z) - 1)."""
        z = np.clip(z, -500.0, 500.0)
        small = np.abs(z) < 1e-6
        fitted: FloatArray = np.where(small, 1.0 - 0.5 * z,
                                      z / np.expm1(np.where(small, 1.0, z)))
        return fitted

    high = noise * flow(-drift * ahead / noise) / (ahead * mean)
    low = noise * flow(drift * back / noise) / (back * mean)
    # Paths come back from beyond the last node.
    high[..., -1] = 0.0
    low[..., -1] = np.maximum(-drift[..., -1], 0.0) / back[-1]
    return low, -(low + high) - leave[:, None, None], high


def _moved(mean: float, std: float) -> FloatArray:
    """
    Return the chances to be moved from gap to gap, shape (gaps, gaps).

    A push towards the barrier of normal size; between nodes the function is taken
    as linear, so that the mean is kept.  The first node is the barrier and all
    beyond it, the last all that is farther.
    """
    to = _G[:, None] - mean - _G
    if std > 0.0:
        z = to / std
        # E[(gap after - node)+].
        over = to * ndtr(z) + std * np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    else:
        over = np.maximum(to, 0.0)
    beyond = -np.diff(over, axis=1) / np.diff(_G)
    chance: FloatArray = np.empty_like(to)
    chance[:, 0] = 1.0 - beyond[:, 0]
    chance[:, 1:-1] = beyond[:, :-1] - beyond[:, 1:]
    chance[:, -1] = beyond[:, -1]
    # At the barrier it is passed already.
    chance[0] = 0.0
    chance[0, 0] = 1.0
    np.maximum(chance, 0.0, out=chance)
    return chance
