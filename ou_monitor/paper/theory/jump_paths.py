"""
Exact sample paths of a finite Markov chain in continuous time.

Holding times are exponential and the next state comes from an alias table
(Walker, ACM Trans. Math. Software 3 (1977) 253), so a jump costs the same
for any number of states. One long path is drawn in blocks of bounded memory;
an ensemble advances all of its paths together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

IntArray = npt.NDArray[np.intp]

# Jumps held in memory at once.
BLOCK = 65_536


class AliasTable:
    """
    Draws from the rows of a stochastic matrix in constant time.

    A chain that visits its states in a fixed order needs no draws.

    Attributes
    ----------
    keep : ndarray, shape (n, n)
        Probability of keeping the column first chosen.
    other : ndarray, shape (n, n)
        Column taken otherwise.

    """

    def __init__(self, probabilities: FloatArray) -> None:
        """Build the table of a stochastic matrix of shape (n, n)."""
        n = len(probabilities)
        self.size = n
        self.keep = np.zeros((n, n))
        self.other = np.zeros((n, n), dtype=np.intp)
        for row, law in enumerate(probabilities):
            weight = (law * n).tolist()
            # What rounding leaves of an impossible column goes to the likeliest one.
            self.other[row] = int(np.argmax(law))
            small = [k for k, w in enumerate(weight) if w < 1.0]
            large = [k for k, w in enumerate(weight) if w >= 1.0]
            while small and large:
                less, more = small.pop(), large[-1]
                self.keep[row, less], self.other[row, less] = weight[less], more
                weight[more] -= 1.0 - weight[less]
                if weight[more] < 1.0:
                    small.append(large.pop())
            for k in large + small:
                self.keep[row, k] = 1.0 if law[k] > 0.0 else 0.0
        self._flat_keep, self._flat_other = self.keep.ravel(), self.other.ravel()
        self._lists = self.keep.tolist(), self.other.tolist()
        self._order = _visiting_order(probabilities)

    def draw(self, rows: IntArray, rng: np.random.Generator) -> IntArray:
        """Return one column for each of the given rows, any shape."""
        u = rng.random(rows.shape) * self.size
        column = u.astype(np.intp)
        cell = rows * self.size + column
        return np.where(u - column < self._flat_keep[cell], column, self._flat_other[cell])

    def walk(self, start: int, jumps: int, rng: np.random.Generator) -> IntArray:
        """Return the states of the embedded chain, one jump after the other."""
        if self._order is not None:
            place = int(np.flatnonzero(self._order == start)[0])
            return self._order[(place + np.arange(jumps + 1)) % self.size]
        states = np.empty(jumps + 1, dtype=np.intp)
        states[0] = state = start
        u = rng.random(jumps) * self.size
        column = u.astype(np.intp)
        keep, other = self._lists
        for k, (c, rest) in enumerate(zip(column.tolist(), (u - column).tolist(), strict=True)):
            state = c if rest < keep[state][c] else other[state][c]
            states[k + 1] = state
        return states


def _visiting_order(probabilities: FloatArray) -> IntArray | None:
    """Return the states in the order in which a cycle visits them, or None."""
    if np.count_nonzero(probabilities) != len(probabilities):
        return None
    follower = probabilities.argmax(axis=1)
    order = [0]
    while len(order) < len(follower):
        order.append(int(follower[order[-1]]))
    return np.array(order, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class JumpPath:
    """
    A piecewise constant path, or a piece of one.

    Attributes
    ----------
    times : ndarray, shape (k,)
        When each state is entered, s; the first is the begin of the piece.
    states : ndarray of int, shape (k,)
        The state from each of these times on.
    end : float
        End of the piece, s.

    """

    times: FloatArray
    states: IntArray
    end: float

    def state_at(self, t: npt.ArrayLike) -> IntArray:
        """Return the state at given times; at a jump the new one (t in s)."""
        at = np.asarray(t, dtype=np.float64)
        self._check_inside(at)
        return self.states[np.searchsorted(self.times, at, side='right') - 1]

    def occupation(self, edges: npt.ArrayLike, states: int) -> FloatArray:
        """Return the time spent in every state in each interval, exactly (edges in s)."""
        grid = np.asarray(edges, dtype=np.float64)
        if grid.ndim != 1 or grid.size < 2 or not (np.diff(grid) > 0.0).all():
            raise ValueError('edges must be two or more increasing times, s')
        self._check_inside(grid)
        inside = self.times[(self.times > grid[0]) & (self.times < grid[-1])]
        cuts = np.sort(np.concatenate([grid, inside]), kind='stable')
        state = self.states[np.searchsorted(self.times, cuts[:-1], side='right') - 1]
        cell = (np.searchsorted(grid, cuts[:-1], side='right') - 1) * states + state
        spent = np.bincount(cell, np.diff(cuts), minlength=(grid.size - 1) * states)
        return np.asarray(spent, dtype=np.float64).reshape(grid.size - 1, states)

    def _check_inside(self, t: FloatArray) -> None:
        """Refuse times outside the path."""
        if t.size and not (t.min() >= self.times[0] and t.max() <= self.end):
            raise ValueError(
                f'times {t.min():g}..{t.max():g} s lie outside the path, which covers '
                f'{self.times[0]:g}..{self.end:g} s')


def pieces(
    table: AliasTable, rates: FloatArray, duration: float, start: int,
    rng: np.random.Generator, block: int,
) -> Iterator[JumpPath]:
    """Draw one path piece by piece, in memory for `block` jumps (rates in 1/s, duration in s)."""
    now = 0.0
    while True:
        states = table.walk(start, block, rng)
        start = int(states[-1])
        states = states[:-1]
        leave = now + np.cumsum(rng.standard_exponential(block) / rates[states])
        times = np.concatenate([[now], leave[:-1]])
        now = float(leave[-1])
        if now >= duration:
            keep = max(1, int(np.searchsorted(times, duration, side='left')))
            yield JumpPath(times[:keep], states[:keep], duration)
            return
        yield JumpPath(times, states, now)


def segments(
    table: AliasTable, rates: FloatArray, edges: FloatArray, state: IntArray,
    rng: np.random.Generator,
) -> Iterator[tuple[int, IntArray | slice, IntArray, FloatArray]]:
    """
    Advance an ensemble of paths from jump to jump, stopping at every edge.

    rates in 1/s, edges in s.
    """
    everyone = slice(None)
    hold = rng.standard_exponential(state.size) / rates[state]
    for k, width in enumerate(np.diff(edges)):
        left = np.full(state.size, width)
        which = np.flatnonzero(hold < left)
        while which.size:
            held, at = hold[which], state[which]
            yield k, which, at, held
            rest = left[which] - held
            at = table.draw(at, rng)
            new = rng.standard_exponential(which.size) / rates[at]
            left[which], state[which], hold[which] = rest, at, new
            which = which[new < rest]
        yield k, everyone, state.copy(), left
        hold -= left
