"""
Switched systems with any velocity C(u; x), not only affine (paper, 3.2).

Between jumps the velocity is integrated by the classical Runge-Kutta scheme;
the jumps are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from ou_monitor.paper.theory.affine import check_state, check_times
from ou_monitor.paper.theory.jump_paths import IntArray
from ou_monitor.paper.theory.switched_system import clock_and_speed, run_ensemble, Scaling
from ou_monitor.paper.theory.switching import Generator
from ou_monitor.records import FloatArray
from scipy.integrate import solve_ivp

Velocity = Callable[[FloatArray, IntArray], FloatArray]


@dataclass(frozen=True, eq=False)
class SwitchedVelocity:
    """
    du/dt = C(u; x) with x a Markov chain.

    Attributes
    ----------
    generator : Generator
        The chain, n states.
    velocity : callable
        ``velocity(u, states)`` returns C for the states (m,) of the chain at
        the u (m, d), shape (m, d), unit of u per second.
    dimension : int
        Number of components d of u.

    """

    generator: Generator
    velocity: Velocity
    dimension: int

    def _checked(self, u: FloatArray, states: IntArray) -> FloatArray:
        """Return the velocity, of the right shape and finite."""
        found = np.asarray(self.velocity(u, states), dtype=np.float64)
        if found.shape != u.shape:
            raise ValueError(f'velocity must return shape {u.shape}, got {found.shape}')
        if not np.isfinite(found).all():
            row = int(np.flatnonzero(~np.isfinite(found).all(axis=1))[0])
            raise ValueError(
                f'the velocity is not finite at u = {u[row].tolist()} in state '
                f'{int(states[row])}: the solution has grown out of its domain')
        return found

    def averaged_velocity(self, u: npt.ArrayLike) -> FloatArray:
        """Return C_hat(u) = sum_x pi(x) C(u; x)."""
        n = self.generator.size
        everywhere = np.tile(check_state(u, self.dimension), (n, 1))
        return self.generator.stationary @ self._checked(everywhere, np.arange(n))

    def solve_averaged(
        self, t: npt.ArrayLike, u0: npt.ArrayLike, *, rtol: float = 1e-9,
    ) -> FloatArray:
        """Return the solution u^0 of the averaged system (t in s)."""
        times, first = check_times(t), check_state(u0, self.dimension)
        if times[-1] == times[0]:
            return np.tile(first, (times.size, 1))
        once, where = np.unique(times, return_inverse=True)
        solved = solve_ivp(
            lambda _, u: self.averaged_velocity(u), (times[0], times[-1]), first,
            method='LSODA', t_eval=once, rtol=rtol,
            atol=1e-3 * rtol * max(1.0, float(np.abs(first).max())))
        if not solved.success:
            raise ValueError(f'the averaged system cannot be integrated: {solved.message}')
        return np.asarray(solved.y.T[where])

    def simulate(
        self, t: npt.ArrayLike, u0: npt.ArrayLike, rng: np.random.Generator, *,
        max_step: float, eps: float = 1.0, paths: int = 1, scaling: Scaling = 'averaging',
        start: int | None = None,
    ) -> FloatArray:
        """Draw paths (t in s, max_step in s)."""
        if not 0.0 < max_step < np.inf:
            raise ValueError(f'max_step must be positive and finite, got {max_step} s')
        clock, speed = clock_and_speed(eps, scaling)

        def move(states: IntArray, dt: FloatArray, u: FloatArray) -> FloatArray:
            path = speed * dt
            parts = max(1, int(np.ceil(path.max() / max_step)))
            h = (path / parts)[:, None]
            for _ in range(parts):
                k1 = self._checked(u, states)
                k2 = self._checked(u + 0.5 * h * k1, states)
                k3 = self._checked(u + 0.5 * h * k2, states)
                k4 = self._checked(u + h * k3, states)
                u = u + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            return u

        return run_ensemble(
            self.generator.sped_up(clock), move, t, u0, self.dimension, rng, paths, start)
