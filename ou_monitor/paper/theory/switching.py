"""
Markov switching (paper, 3.2): generators, their laws, exact jump paths.

The chain x(t) on n states has the generator Q: Q[x, y] is the rate of going
from x to y, 1/s, and every row sums to zero. All states must be reachable from
all: then the stationary law pi (pi Q = 0) is unique, and the potential
R0 = integral_0^inf (exp(Q t) - Pi) dt exists.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from ou_monitor.paper.theory.generator_checks import check_classes, check_rates
from ou_monitor.paper.theory.jump_paths import (
    AliasTable, BLOCK, IntArray, JumpPath, pieces, segments)
from ou_monitor.records import FloatArray
from scipy.linalg import expm


@dataclass(frozen=True, eq=False)
class Generator:
    """
    Generator of an irreducible Markov chain on a finite number of states.

    Attributes
    ----------
    q : ndarray, shape (n, n)
        Rates, 1/s; read-only. The diagonal is set to minus the sum of the
        row's other rates, to the last digit.

    """

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

    @classmethod
    def cycle(cls, rates: npt.ArrayLike) -> Generator:
        """
        Return n phases visited in turn.

        k equal phases together last an Erlang time, of relative spread
        1/sqrt(k): a switching period with jitter.

        rates in 1/s.
        """
        rate = np.asarray(rates, dtype=np.float64)
        if rate.ndim != 1 or rate.size < 2:
            raise ValueError(f'rates must be two or more, got shape {rate.shape}')
        q = np.diag(-rate)
        q[np.arange(rate.size), np.roll(np.arange(rate.size), -1)] = rate
        return cls(q)

    @classmethod
    def birth_death(cls, up: npt.ArrayLike, down: npt.ArrayLike) -> Generator:
        """Return n states in a row, left for the neighbours only."""
        rise, fall = np.asarray(up, dtype=np.float64), np.asarray(down, dtype=np.float64)
        if rise.ndim != 1 or rise.shape != fall.shape or not rise.size:
            raise ValueError(
                f'up and down must have the same shape (n - 1,), got {rise.shape} and '
                f'{fall.shape}')
        q = np.diag(rise, 1) + np.diag(fall, -1)
        return cls(q - np.diag(q.sum(axis=1)))

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
    def embedded(self) -> FloatArray:
        """Return the law rho = pi q / sum(pi q) of the embedded chain, shape (n,)."""
        flux = self.stationary * self.leaving
        return np.asarray(flux / flux.sum())

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

    def stream(
        self, duration: float, rng: np.random.Generator, start: int | None = None, *,
        block: int = BLOCK,
    ) -> Iterator[JumpPath]:
        """Draw one exact path in pieces of at most `block` jumps (duration in s)."""
        if not 0.0 < duration < np.inf:
            raise ValueError(f'duration must be positive and finite, got {duration} s')
        if block < 1:
            raise ValueError(f'block must be 1 or more, got {block}')
        first = int(self.starts(1, rng, start)[0])
        # A short path need not pay for a whole block.
        likely = int(min(1.2 * self.jump_rate * duration, BLOCK)) + 64
        return pieces(self._table, self.leaving, duration, first, rng, min(block, likely))

    def sample_path(
        self, duration: float, rng: np.random.Generator, start: int | None = None,
    ) -> JumpPath:
        """Draw one exact path; arguments as for `stream`."""
        drawn = list(self.stream(duration, rng, start))
        return JumpPath(
            np.concatenate([piece.times for piece in drawn]),
            np.concatenate([piece.states for piece in drawn]), drawn[-1].end)

    def sample_many(
        self, edges: npt.ArrayLike, paths: int, rng: np.random.Generator,
        start: int | None = None,
    ) -> tuple[IntArray, FloatArray]:
        """Draw an ensemble: states on a grid and exact times spent between (edges in s)."""
        grid = np.asarray(edges, dtype=np.float64)
        if grid.ndim != 1 or not grid.size or not np.isfinite(grid).all() or \
                (np.diff(grid) < 0.0).any():
            raise ValueError('edges must be finite and must not decrease, s')
        state = self.starts(paths, rng, start)
        states = np.empty((paths, grid.size), dtype=np.intp)
        states[:, 0] = state
        spent = np.zeros((paths, grid.size - 1, self.size))
        everyone = np.arange(paths)
        for k, which, at, dt in segments(self._table, self.leaving, grid, state, rng):
            spent[everyone[which], k, at] += dt
            if isinstance(which, slice):
                states[:, k + 1] = at
        return states, spent

    def segments(
        self, edges: FloatArray, state: IntArray, rng: np.random.Generator,
    ) -> Iterator[tuple[int, IntArray | slice, IntArray, FloatArray]]:
        """Advance an ensemble from jump to jump; see `jump_paths.segments`."""
        return segments(self._table, self.leaving, edges, state, rng)
