"""
Markov switching (paper, 3.2): generators, their laws, exact jumps.

The chain x(t) on n states has the generator Q: Q[x, y] is the rate of going
from x to y, 1/s, and every row sums to zero. All states must be reachable from
all: then the stationary law pi (pi Q = 0) is unique, and the potential
R0 = integral_0^inf (exp(Q t) - Pi) dt exists. Holding times are exponential
and the next state comes from an alias table, so a jump costs the same for any
number of states.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from scipy.linalg import expm
from scipy.sparse.csgraph import connected_components

IntArray = npt.NDArray[np.intp]

# A row may miss zero by this share of the largest rate: rounding of the input.
ROW_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Generator:
    """Generator of an irreducible Markov chain on a finite number of states."""

    # Rates, 1/s; read-only. The diagonal is set to minus the sum of the row's other rates, to the
    # last digit; shape (n, n).
    q: FloatArray

    def __post_init__(self) -> None:
        """Check that this is a generator with one stationary law."""
        if np.iscomplexobj(self.q):
            raise ValueError('rates must be real, 1/s')
        q = np.array(self.q, dtype=np.float64)
        check_rates(q)
        np.fill_diagonal(q, 0.0)
        check_classes(q)
        np.fill_diagonal(q, -q.sum(axis=1))
        q.setflags(write=False)
        object.__setattr__(self, 'q', q)

    @classmethod
    def telegraph(cls, up: float, down: float) -> Generator:
        """Return two states, off (0) and on (1)."""
        return cls(np.array([[-up, up], [down, -down]]))

    @property
    def size(self) -> int:
        """Return the number of states n."""
        return len(self.q)

    @property
    def leaving(self) -> FloatArray:
        """Return the rates q(x) of leaving each state, 1/s, shape (n,)."""
        return -np.diag(self.q)

    @cached_property
    def stationary(self) -> FloatArray:
        """
        Return the stationary law pi, shape (n,).

        Elimination without subtractions (Grassmann, Taksar & Heyman, Oper.
        Res. 33 (1985) 1107): every entry to full relative precision, however
        far apart the rates are.
        """
        p = self.q / np.abs(self.q).max()
        np.fill_diagonal(p, 0.0)
        for k in range(self.size - 1, 0, -1):
            p[:k, k] /= p[k, :k].sum()
            p[:k, :k] += np.outer(p[:k, k], p[k, :k])
        law = np.ones(self.size)
        for k in range(1, self.size):
            law[k] = law[:k] @ p[:k, k]
        law /= law.sum()
        law.setflags(write=False)
        return law

    @cached_property
    def projector(self) -> FloatArray:
        """Return Pi, shape (n, n): every row is the stationary law."""
        return np.tile(self.stationary, (self.size, 1))

    @cached_property
    def potential(self) -> FloatArray:
        """
        Return R0 = integral_0^inf (exp(Q t) - Pi) dt, s, shape (n, n).

        (s Pi - Q)^-1 - Pi / s is the same for every s > 0; the mean rate of
        leaving keeps the matrix to invert well scaled.
        """
        rate = float(self.leaving.mean())
        scaled = np.linalg.inv(self.projector - self.q / rate)
        potential = np.asarray((scaled - self.projector) / rate)
        potential.setflags(write=False)
        return potential

    @cached_property
    def jump_probabilities(self) -> FloatArray:
        """Return the kernel P of the embedded chain, shape (n, n), with a zero diagonal."""
        p = self.q / self.leaving[:, None]
        np.fill_diagonal(p, 0.0)
        return np.asarray(p)

    @property
    def jump_rate(self) -> float:
        """Return the mean number of jumps per second in the stationary law."""
        return float(self.stationary @ self.leaving)

    @cached_property
    def _table(self) -> AliasTable:
        """Return the alias table of the embedded chain."""
        return AliasTable(self.jump_probabilities)

    def sped_up(self, factor: float) -> Generator:
        """Return the chain on the clock factor * t, with `factor` times the rates."""
        if not 0.0 < factor < np.inf:
            raise ValueError(f'factor must be positive and finite, got {factor}')
        return Generator(self.q * factor)

    def transition(self, t: float) -> FloatArray:
        """Return exp(Q t), shape (n, n): the law at time t s, row by starting state."""
        if not 0.0 <= t < np.inf:
            raise ValueError(f't must be zero or positive and finite, got {t} s')
        return np.asarray(expm(self.q * t))

    def starts(
        self, paths: int, rng: np.random.Generator, start: int | None = None,
    ) -> IntArray:
        """Return first states, from the stationary law unless one is given."""
        if paths < 1:
            raise ValueError(f'paths must be 1 or more, got {paths}')
        if start is None:
            return np.asarray(rng.choice(self.size, paths, p=self.stationary), dtype=np.intp)
        if not isinstance(start, (int, np.integer)) or not 0 <= start < self.size:
            raise ValueError(f'start must be a state 0..{self.size - 1}, got {start}')
        return np.full(paths, start, dtype=np.intp)

    def segments(
        self, edges: FloatArray, state: IntArray, rng: np.random.Generator,
    ) -> Iterator[tuple[int, IntArray | slice, IntArray, FloatArray]]:
        """
        Advance an ensemble of paths from jump to jump, stopping at every edge.

        Yields interval, paths, their states and the time spent in them; at an edge all paths.

        edges in s.
        """
        rates, everyone = self.leaving, slice(None)
        hold = rng.standard_exponential(state.size) / rates[state]
        for k, width in enumerate(np.diff(edges)):
            left = np.full(state.size, width)
            which = np.flatnonzero(hold < left)
            while which.size:
                held, at = hold[which], state[which]
                yield k, which, at, held
                rest = left[which] - held
                at = self._table.draw(at, rng)
                new = rng.standard_exponential(which.size) / rates[at]
                left[which], state[which], hold[which] = rest, at, new
                which = which[new < rest]
            yield k, everyone, state.copy(), left
            hold -= left


class AliasTable:
    """
    Draws from the rows of a stochastic matrix in constant time.

    Walker, ACM Trans. Math. Software 3 (1977) 253: `keep`, shape (n, n), the chance to keep the
    column first chosen, `other` the column taken otherwise.
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

    def draw(self, rows: IntArray, rng: np.random.Generator) -> IntArray:
        """Return one column for each of the given rows, any shape."""
        u = rng.random(rows.shape) * self.size
        column = u.astype(np.intp)
        cell = rows * self.size + column
        return np.where(u - column < self._flat_keep[cell], column, self._flat_other[cell])


def _named(states: Sequence[int] | npt.NDArray[np.intp]) -> str:
    """Return ``state 2`` or ``states 0, 3``, cut where there are many."""
    names = [str(int(state)) for state in states]
    said = ', '.join(names[:8]) + (', ...' if len(names) > 8 else '')
    return ('state ' if len(names) == 1 else 'states ') + said


def check_rates(q: FloatArray) -> None:
    """Refuse what is no generator at all (q in 1/s)."""
    if q.ndim != 2 or q.shape[0] != q.shape[1]:
        raise ValueError(f'Q must be square, got shape {q.shape}')
    if len(q) < 2:
        raise ValueError('Q must have two states or more: one state never switches')
    if not np.isfinite(q).all():
        row, column = np.argwhere(~np.isfinite(q))[0]
        raise ValueError(f'Q[{row}, {column}] is {q[row, column]}: rates must be finite, 1/s')
    off = q - np.diag(np.diag(q))
    if (off < 0.0).any():
        row, column = np.unravel_index(np.argmin(off), q.shape)
        raise ValueError(
            f'Q[{row}, {column}] = {q[row, column]:g} 1/s is negative: only the diagonal may be')
    largest = float(np.abs(q).max())
    defect = q.sum(axis=1)
    row = int(np.argmax(np.abs(defect)))
    if abs(defect[row]) > ROW_TOLERANCE * largest:
        raise ValueError(
            f'row {row} of Q sums to {defect[row]:.6g} 1/s, not to 0 (tolerance '
            f'{ROW_TOLERANCE * largest:.3g} 1/s): its diagonal entry should be '
            f'{-off[row].sum():.6g}')


def check_classes(rates: FloatArray) -> None:
    """Refuse chains that do not visit every state for ever (rates in 1/s)."""
    absorbing = np.flatnonzero(rates.sum(axis=1) == 0.0)
    if absorbing.size:
        raise ValueError(f'{_named(absorbing)} absorbing: no rate leaves, so the switching stops')
    count, label = connected_components(rates > 0.0, directed=True, connection='strong')
    if count == 1:
        return
    leaks = (rates > 0.0) & (label[:, None] != label[None, :])
    closed = [c for c in range(count) if not leaks[label == c].any()]
    if len(closed) > 1:
        classes = '; '.join(_named(np.flatnonzero(label == c)) for c in closed[:4])
        raise ValueError(
            f'the chain falls apart into {len(closed)} closed classes ({classes}): it has no '
            'single stationary law; give each class its own generator')
    transient = np.flatnonzero(label != closed[0])
    raise ValueError(
        f'{_named(transient)} transient: left once and for all; give the generator of the '
        'other states')
