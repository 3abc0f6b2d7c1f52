"""
Diffusion approximation of a switched system (paper, 3.3).

Under the balance condition sum_x pi(x) C(u; x) = 0 the paths of
du/dt = C(u; x(t/eps^2)) / eps tend in law to the diffusion with generator
b phi' + B phi'' / 2, where for C(u; x) = A_x u + a_x

    b(u) = sum_xy pi(x) R0(x, y) A_y (A_x u + a_x),
    B(u) = 2 sum_xy pi(x) R0(x, y) sym[C(u; x) C(u; y)'].

Equation (6) of the paper lacks the 2, which (4) as printed needs: the variance
of the integral of C(x(t)) grows at the rate of twice the integral of its
autocovariance over positive lags (Korolyuk & Limnios, Stochastic Systems in
Merging Phase Space, 2005, give it with the 2). `factor=1` is the printed one.
Drift and noise of the limit are affine: with noise that does not depend on the
state it is an Ornstein-Uhlenbeck process.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.paper.theory.affine import (
    AffineSystem, check_starts, check_state, check_times, flow, mean_and_covariance,
    moment_matrix, propagate)
from ou_monitor.paper.theory.switched_system import SwitchedSystem
from ou_monitor.records import FloatArray
from scipy.linalg import expm

# The average may miss zero by this share of the largest switched entry.
BALANCE_TOLERANCE = 1e-9
PRINTED_FACTOR = 1.0
CORRECT_FACTOR = 2.0


@dataclass(frozen=True, eq=False)
class LinearDiffusion:
    """
    du = (M u + m) dt + sum_k (G_k u + g_k) dW_k, in the sense of Ito.

    Attributes
    ----------
    matrix : ndarray, shape (d, d)
        M, 1/s.
    offset : ndarray, shape (d,)
        m, unit of u per second.
    noise_matrices : ndarray, shape (r, d, d)
        G_k, 1/sqrt(s).
    noise_offsets : ndarray, shape (r, d)
        g_k, unit of u per sqrt(s).

    """

    matrix: FloatArray
    offset: FloatArray
    noise_matrices: FloatArray
    noise_offsets: FloatArray

    @property
    def is_additive(self) -> bool:
        """Tell whether the intensity is free of u: an Ornstein-Uhlenbeck process."""
        return not self.noise_matrices.any()

    def drift(self, u: npt.ArrayLike) -> FloatArray:
        """Return b(u) and the unswitched drift together, shape (d,)."""
        return self.matrix @ check_state(u, self.offset.size) + self.offset

    def intensity(self, u: npt.ArrayLike) -> FloatArray:
        """Return B(u), shape (d, d): the rate at which the covariance grows at u."""
        fields = self.noise_matrices @ check_state(u, self.offset.size) + self.noise_offsets
        return np.asarray(fields.T @ fields)

    def _moment_matrix(self) -> FloatArray:
        """Return the linear equation of (1, E u, E u u')."""
        d = self.offset.size
        full = moment_matrix(self.matrix, self.offset)
        for g, h in zip(self.noise_matrices, self.noise_offsets, strict=True):
            column = h[:, None]
            full[1 + d:, 0] += np.outer(h, h).ravel()
            full[1 + d:, 1:1 + d] += np.kron(g, column) + np.kron(column, g)
            full[1 + d:, 1 + d:] += np.kron(g, g)
        return full

    def moments(self, t: npt.ArrayLike, u0: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return exact mean and covariance by the matrix exponential (t in s)."""
        d = self.offset.size
        first = check_state(u0, d)
        found = propagate(
            self._moment_matrix(), check_times(t),
            np.concatenate([[1.0], first, np.outer(first, first).ravel()]))
        return mean_and_covariance(found, d)

    def simulate(
        self, t: npt.ArrayLike, u0: npt.ArrayLike, rng: np.random.Generator, *,
        paths: int = 1, max_step: float | None = None,
    ) -> FloatArray:
        """
        Draw paths of the diffusion.

        Additive noise: exact in law at any spacing. Multiplicative noise: the
        scheme of Ninomiya & Victoir (Appl. Math. Finance 15 (2008) 107), which
        follows the exact flows of the vector fields; weak order 2 in the step.

        t in s, max_step in s.
        """
        times, d = check_times(t), self.offset.size
        if paths < 1:
            raise ValueError(f'paths must be 1 or more, got {paths}')
        u = check_starts(u0, paths, d)
        if max_step is not None and not max_step > 0.0:
            raise ValueError(f'max_step must be positive, got {max_step} s')
        found = np.empty((paths, times.size, d))
        found[:, 0] = u
        with np.errstate(over='ignore', invalid='ignore'):
            for k, dt in enumerate(np.diff(times).tolist()):
                u = self._advance(u, dt, rng, max_step)
                if not np.isfinite(u).all():
                    raise ValueError(f'unstable: a path overflows before t = {times[k + 1]:g} s')
                found[:, k + 1] = u
        return found

    def _advance(
        self, u: FloatArray, dt: float, rng: np.random.Generator, max_step: float | None,
    ) -> FloatArray:
        """Advance by dt: one exact step, or steps no longer than `max_step`."""
        if self.is_additive:
            return self._exact_step(u, dt, rng)
        parts = max(1, math.ceil(dt / (max_step or self._default_step())))
        for _ in range(parts):
            kicks = rng.standard_normal((len(self.noise_matrices), len(u)))
            u = self._weak_step(u, dt / parts, kicks, rng.random(len(u)) < 0.5)
        return u

    def _default_step(self) -> float:
        """Return a tenth of the shortest time scale, s."""
        rate = np.linalg.norm(self.matrix, 2) + sum(
            np.linalg.norm(g, 2) ** 2 for g in self.noise_matrices)
        return float(0.1 / rate)

    def _exact_step(self, u: FloatArray, dt: float, rng: np.random.Generator) -> FloatArray:
        """Advance an Ornstein-Uhlenbeck process by dt, exact in law."""
        moved = flow(self.matrix, self.offset, np.full(len(u), dt), u)
        value, vector = np.linalg.eigh(
            step_covariance(self.matrix, self.noise_offsets.T @ self.noise_offsets, dt))
        root = vector * np.sqrt(np.maximum(value, 0.0))
        return np.asarray(moved + rng.standard_normal(u.shape) @ root.T)

    def _weak_step(
        self, u: FloatArray, h: float, kicks: FloatArray, forward: npt.NDArray[np.bool_],
    ) -> FloatArray:
        """Advance by one step of Ninomiya & Victoir, for standard normal kicks."""
        g, q = self.noise_matrices, self.noise_offsets
        # Drift in the sense of Stratonovich, half a step before and after the noise.
        matrix = self.matrix - 0.5 * np.einsum('kij,kjl->il', g, g)
        offset = self.offset - 0.5 * np.einsum('kij,kj->i', g, q)
        half = np.full(len(u), 0.5 * h)
        u = flow(matrix, offset, half, u)
        kicks = math.sqrt(h) * kicks
        for chosen, order in ((forward, range(len(g))), (~forward, range(len(g))[::-1])):
            part = u[chosen]
            for k in order:
                part = flow(g[k], q[k], kicks[k, chosen], part)
            u[chosen] = part
        return flow(matrix, offset, half, u)


def balance_defect(system: SwitchedSystem) -> tuple[FloatArray, FloatArray]:
    """Return the average of the switched part, which should be zero (result in 1/s)."""
    pi = system.generator.stationary
    return np.tensordot(pi, system.matrices, 1), pi @ system.offsets


def require_balance(system: SwitchedSystem) -> None:
    """Refuse a system that does not meet the balance condition."""
    matrix, offset = balance_defect(system)
    cure = '; SwitchedSystem.balanced() moves the average to the unswitched drift'
    worst = np.unravel_index(int(np.argmax(np.abs(matrix))), matrix.shape)
    if abs(matrix[worst]) > BALANCE_TOLERANCE * float(np.abs(system.matrices).max()):
        i, j = (int(k) for k in worst)
        raise ValueError(
            f'the balance condition does not hold: the averaged velocity of component {i} has '
            f'{matrix[worst]:+.6g} 1/s times component {j}, not 0{cure}')
    i = int(np.argmax(np.abs(offset)))
    if abs(offset[i]) > BALANCE_TOLERANCE * float(np.abs(system.offsets).max()):
        raise ValueError(
            f'the balance condition does not hold: the averaged velocity of component {i} is '
            f'{offset[i]:+.6g} per second at u = 0, not 0{cure}')


def switching_drift(system: SwitchedSystem) -> AffineSystem:
    """Return b(u), equation (5), of a balanced system."""
    require_balance(system)
    weight = system.generator.stationary[:, None] * system.generator.potential
    # A_y after A_x: the chain is in x first.
    after = np.tensordot(weight, system.matrices, 1)
    return AffineSystem(
        np.einsum('xij,xjk->ik', after, system.matrices),
        np.einsum('xij,xj->i', after, system.offsets))


def diffusion_limit(system: SwitchedSystem, factor: float = CORRECT_FACTOR) -> LinearDiffusion:
    """Return the limit diffusion of a balanced system."""
    if not 0.0 < factor < math.inf:
        raise ValueError(f'factor must be positive and finite, got {factor}')
    correction = switching_drift(system)
    half = system.generator.stationary[:, None] * system.generator.potential
    # Positive semidefinite: a spectral density of the chain at frequency 0.
    value, vector = np.linalg.eigh(0.5 * factor * (half + half.T))
    used = value > 1e-12 * value.max()
    root = vector[:, used] * np.sqrt(value[used])
    matrices = np.einsum('xk,xij->kij', root, system.matrices)
    offsets = root.T @ system.offsets
    felt = matrices.any(axis=(1, 2)) | offsets.any(axis=1)
    return LinearDiffusion(
        system.drift_matrix + correction.matrix, system.drift_offset + correction.offset,
        matrices[felt], offsets[felt])


def step_covariance(matrix: FloatArray, intensity: FloatArray, dt: float) -> FloatArray:
    """
    Return integral_0^dt exp(M s) B exp(M' s) ds.

    Van Loan (IEEE Trans. Autom. Control 23 (1978) 395) over a step short
    enough for its block exponential, doubled up to dt.

    dt in s.
    """
    d = len(matrix)
    reach = float(np.abs(matrix).sum(axis=1).max()) * dt
    doublings = max(0, math.ceil(math.log2(reach))) if reach > 0.0 else 0
    block = np.zeros((2 * d, 2 * d))
    block[:d, :d], block[:d, d:], block[d:, d:] = -matrix, intensity, matrix.T
    power = expm(block * (dt / 2**doublings))
    carry = power[d:, d:].T
    covariance = carry @ power[:d, d:]
    for _ in range(doublings):
        covariance = covariance + carry @ covariance @ carry.T
        carry = carry @ carry
    return np.asarray(0.5 * (covariance + covariance.T))
