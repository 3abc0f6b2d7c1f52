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
from ou_monitor.paper.theory.affine import AffineSystem, check_state
from ou_monitor.paper.theory.switched_system import SwitchedSystem
from ou_monitor.records import FloatArray

# The average may miss zero by this share of the largest switched entry.
BALANCE_TOLERANCE = 1e-9
PRINTED_FACTOR = 1.0
CORRECT_FACTOR = 2.0


@dataclass(frozen=True, eq=False)
class LinearDiffusion:
    """du = (M u + m) dt + sum_k (G_k u + g_k) dW_k, in the sense of Ito."""

    matrix: FloatArray  # M, 1/s; shape (d, d)
    offset: FloatArray  # m, unit of u per second; shape (d,)
    noise_matrices: FloatArray  # G_k, 1/sqrt(s); shape (r, d, d)
    noise_offsets: FloatArray  # g_k, unit of u per sqrt(s); shape (r, d)

    def intensity(self, u: npt.ArrayLike) -> FloatArray:
        """Return B(u), shape (d, d): the rate at which the covariance grows at u."""
        fields = self.noise_matrices @ check_state(u, self.offset.size) + self.noise_offsets
        return np.asarray(fields.T @ fields)


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
