"""
Affine systems switched by a Markov chain (paper, 3.2 and 3.3).

du/dt = D u + d + speed (A_x u + a_x), x = x(clock t). Two scalings of the
paper, both with a small eps:

- averaging (eq. 1): clock 1/eps, speed 1; u^eps -> the averaged system.
- diffusion (eq. 3): clock 1/eps^2, speed 1/eps, for A, a of zero average;
  u^eps -> a diffusion (see `diffusion`).

D and d are not switched and not sped up. eps = 1 is the system as given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from ou_monitor.paper.theory.affine import AffineSystem, check_starts, check_times, flow
from ou_monitor.paper.theory.markov_chain import Generator
from ou_monitor.paper.theory.matrix_model import MatrixModel
from ou_monitor.records import FloatArray

Scaling = Literal['averaging', 'diffusion']


def clock_and_speed(eps: float, scaling: Scaling) -> tuple[float, float]:
    """Return the factors on the rates of the chain and on the switched velocity."""
    if not 0.0 < eps < np.inf:
        raise ValueError(f'eps must be positive and finite, got {eps}')
    if scaling == 'averaging':
        return 1.0 / eps, 1.0
    if scaling == 'diffusion':
        return 1.0 / eps**2, 1.0 / eps
    raise ValueError(f"scaling must be 'averaging' or 'diffusion', got {scaling!r}")


def _left_out() -> FloatArray:
    """Return an array without entries, which stands for zeros."""
    return np.empty(0)


@dataclass(frozen=True, eq=False)
class SwitchedSystem:
    """An affine system with a matrix and an offset for every state of the chain."""

    generator: Generator  # The chain, n states
    matrices: FloatArray  # A_x, 1/s; shape (n, d, d)
    # a_x, unit of u per second; zeros when left out; shape (n, d).
    offsets: FloatArray = field(default_factory=_left_out)
    # D, 1/s: not switched, not sped up; zeros when left out; shape (d, d).
    drift_matrix: FloatArray = field(default_factory=_left_out)
    drift_offset: FloatArray = field(default_factory=_left_out)  # d, likewise; shape (d,)

    def __post_init__(self) -> None:
        """Check the shapes and fill in the zeros."""
        n = self.generator.size
        matrices = np.asarray(self.matrices, dtype=np.float64)
        if matrices.ndim != 3 or matrices.shape[0] != n or \
                matrices.shape[1] != matrices.shape[2]:
            raise ValueError(
                f'matrices must have shape ({n}, d, d), one for each state of the chain, got '
                f'{matrices.shape}')
        d = matrices.shape[1]
        object.__setattr__(self, 'matrices', matrices)
        for name, shape in (
                ('offsets', (n, d)), ('drift_matrix', (d, d)), ('drift_offset', (d,))):
            value = getattr(self, name)
            array = np.asarray(value, dtype=np.float64) if len(value) else np.zeros(shape)
            if array.shape != shape:
                raise ValueError(f'{name} must have shape {shape}, got {array.shape}')
            object.__setattr__(self, name, array)
        for name in ('matrices', 'offsets', 'drift_matrix', 'drift_offset'):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f'{name} must be finite')

    @classmethod
    def of_models(cls, generator: Generator, models: Sequence[MatrixModel]) -> SwitchedSystem:
        """Return the matrix model of 3.1 with other coefficients in every state."""
        for state, model in enumerate(models):
            if not model.is_constant:
                raise ValueError(
                    f'the model of state {state} varies in time: between jumps coefficients '
                    'must be constant')
        return cls(generator, np.array([model.matrix() for model in models]),
                   np.array([model.offset() for model in models]))

    @classmethod
    def of_matrix_model(
        cls, generator: Generator, *, alpha: npt.ArrayLike, omega: npt.ArrayLike,
        beta: npt.ArrayLike, alpha_p: npt.ArrayLike, **choices: Any,
    ) -> SwitchedSystem:
        """Return the matrix model of 3.1 with switched coefficients."""
        columns = []
        for name, value in (
                ('alpha', alpha), ('omega', omega), ('beta', beta), ('alpha_p', alpha_p)):
            array = np.asarray(value, dtype=np.float64)
            if array.shape not in ((), (generator.size,)):
                raise ValueError(
                    f'{name} must be one number or have shape ({generator.size},), got '
                    f'{array.shape}')
            columns.append(np.broadcast_to(array, (generator.size,)).tolist())
        return cls.of_models(
            generator, [MatrixModel(*row, **choices) for row in zip(*columns, strict=True)])

    @property
    def dimension(self) -> int:
        """Return the number of components d of u."""
        return int(self.matrices.shape[1])

    def averaged(self) -> AffineSystem:
        """Return the averaged system du/dt = C_hat(u) = sum_x pi(x) C(u; x)."""
        pi = self.generator.stationary
        return AffineSystem(
            self.drift_matrix + np.tensordot(pi, self.matrices, 1),
            self.drift_offset + pi @ self.offsets)

    def balanced(self) -> SwitchedSystem:
        """
        Return the same system with the average moved to the unswitched part.

        At eps = 1 nothing changes; the switched part meets the balance
        condition, so the diffusion limit exists.
        """
        mean = self.averaged()
        pi = self.generator.stationary
        return replace(
            self, drift_matrix=mean.matrix, drift_offset=mean.offset,
            matrices=self.matrices - np.tensordot(pi, self.matrices, 1),
            offsets=self.offsets - pi @ self.offsets)

    def scaled(self, eps: float, scaling: Scaling) -> SwitchedSystem:
        """Return the system at eps with clock and speed built in, nothing left unswitched."""
        clock, speed = clock_and_speed(eps, scaling)
        return SwitchedSystem(
            self.generator.sped_up(clock), self.drift_matrix + speed * self.matrices,
            self.drift_offset + speed * self.offsets)

    def simulate(
        self, t: npt.ArrayLike, u0: npt.ArrayLike, rng: np.random.Generator, *,
        eps: float = 1.0, paths: int = 1, scaling: Scaling = 'averaging',
        start: int | None = None,
    ) -> FloatArray:
        """Draw paths, exact between the jumps and exact in the jumps (t in s)."""
        at_eps, times, d = self.scaled(eps, scaling), check_times(t), self.dimension
        state = at_eps.generator.starts(paths, rng, start)
        u = check_starts(u0, paths, d)
        found = np.empty((paths, times.size, d))
        found[:, 0] = u
        with np.errstate(over='ignore', invalid='ignore'):
            for k, which, at, dt in at_eps.generator.segments(times, state, rng):
                u[which] = flow(at_eps.matrices[at], at_eps.offsets[at], dt, u[which])
                if isinstance(which, slice):
                    if not np.isfinite(u).all():
                        raise ValueError(
                            f'unstable: a path overflows before t = {times[k + 1]:g} s')
                    found[:, k + 1] = u
        return found
