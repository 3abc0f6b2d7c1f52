"""
Exact moments of switched systems and of their diffusion limits, and paths of the limits.

What the orders of convergence are measured with; see README.md beside this file.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.paper.theory.affine import check_starts, check_state, check_times, flow
from ou_monitor.paper.theory.diffusion import LinearDiffusion
from ou_monitor.paper.theory.switched_system import Scaling, SwitchedSystem
from ou_monitor.records import FloatArray
from scipy.linalg import expm


def moments_of_switched(system: SwitchedSystem, t: npt.ArrayLike, u0: npt.ArrayLike, *,
                        eps: float = 1.0, scaling: Scaling = 'averaging'
                        ) -> tuple[FloatArray, FloatArray]:
    """
    Return exact mean and covariance, without simulation (t in s).

    E[1_x], E[u 1_x] and E[u u' 1_x] together obey a linear equation, solved by the matrix
    exponential.  The chain starts in its stationary law.
    """
    times = check_times(t)
    at_eps = system.scaled(eps, scaling)
    n, d = at_eps.offsets.shape
    first = check_state(u0, d)
    joint = np.concatenate([[1.0], first, np.outer(first, first).ravel()])
    size = joint.size
    change = np.asarray(np.kron(at_eps.generator.q.T, np.eye(size)), dtype=np.float64)
    for x in range(n):
        block = slice(x * size, (x + 1) * size)
        change[block, block] += _moment_matrix(at_eps.matrices[x], at_eps.offsets[x])
    state = np.outer(at_eps.generator.stationary, joint).ravel()
    return _mean_and_covariance(
        _propagate(change, times, state).reshape(times.size, n, size).sum(axis=1), d)


def moments_of_diffusion(limit: LinearDiffusion, t: npt.ArrayLike, u0: npt.ArrayLike
                         ) -> tuple[FloatArray, FloatArray]:
    """Return exact mean and covariance by the matrix exponential (t in s)."""
    d = limit.offset.size
    first = check_state(u0, d)
    change = _moment_matrix(limit.matrix, limit.offset)
    for g, h in zip(limit.noise_matrices, limit.noise_offsets, strict=True):
        column = h[:, None]
        change[1 + d:, 0] += np.outer(h, h).ravel()
        change[1 + d:, 1:1 + d] += np.kron(g, column) + np.kron(column, g)
        change[1 + d:, 1 + d:] += np.kron(g, g)
    start = np.concatenate([[1.0], first, np.outer(first, first).ravel()])
    return _mean_and_covariance(_propagate(change, check_times(t), start), d)


def paths_of_diffusion(limit: LinearDiffusion, t: npt.ArrayLike, u0: npt.ArrayLike,
                       rng: np.random.Generator, *, paths: int = 1,
                       max_step: float | None = None) -> FloatArray:
    """
    Draw paths of the diffusion (t in s, max_step in s).

    Additive noise: exact in law at any spacing.  Multiplicative noise: the scheme of Ninomiya &
    Victoir (Appl. Math. Finance 15 (2008) 107), which follows the exact flows of the vector
    fields; weak order 2 in the step.
    """
    times, d = check_times(t), limit.offset.size
    if paths < 1:
        raise ValueError(f'paths must be 1 or more, got {paths}')
    u = check_starts(u0, paths, d)
    if max_step is not None and not max_step > 0.0:
        raise ValueError(f'max_step must be positive, got {max_step} s')
    found = np.empty((paths, times.size, d))
    found[:, 0] = u
    with np.errstate(over='ignore', invalid='ignore'):
        for k, dt in enumerate(np.diff(times).tolist()):
            u = _advance(limit, u, dt, rng, max_step)
            if not np.isfinite(u).all():
                raise ValueError(f'unstable: a path overflows before t = {times[k + 1]:g} s')
            found[:, k + 1] = u
    return found


def _advance(limit: LinearDiffusion, u: FloatArray, dt: float, rng: np.random.Generator,
             max_step: float | None) -> FloatArray:
    """Advance by dt: one exact step, or steps no longer than `max_step`."""
    if not limit.noise_matrices.any():
        return _exact_step(limit, u, dt, rng)
    if max_step is None:
        # A tenth of the shortest time scale.
        max_step = 0.1 / float(np.linalg.norm(limit.matrix, 2) + sum(
            np.linalg.norm(g, 2) ** 2 for g in limit.noise_matrices))
    parts = max(1, math.ceil(dt / max_step))
    for _ in range(parts):
        kicks = rng.standard_normal((len(limit.noise_matrices), len(u)))
        u = _weak_step(limit, u, dt / parts, kicks, rng.random(len(u)) < 0.5)
    return u


def _exact_step(limit: LinearDiffusion, u: FloatArray, dt: float, rng: np.random.Generator
                ) -> FloatArray:
    """Advance an Ornstein-Uhlenbeck process by dt, exact in law."""
    moved = flow(limit.matrix, limit.offset, np.full(len(u), dt), u)
    value, vector = np.linalg.eigh(
        step_covariance(limit.matrix, limit.noise_offsets.T @ limit.noise_offsets, dt))
    root = vector * np.sqrt(np.maximum(value, 0.0))
    return np.asarray(moved + rng.standard_normal(u.shape) @ root.T)


def _weak_step(limit: LinearDiffusion, u: FloatArray, h: float, kicks: FloatArray,
               forward: npt.NDArray[np.bool_]) -> FloatArray:
    """Advance by one step of Ninomiya & Victoir, for standard normal kicks."""
    g, q = limit.noise_matrices, limit.noise_offsets
    # Drift in the sense of Stratonovich, half a step before and after the noise.
    matrix = limit.matrix - 0.5 * np.einsum('kij,kjl->il', g, g)
    offset = limit.offset - 0.5 * np.einsum('kij,kj->i', g, q)
    half = np.full(len(u), 0.5 * h)
    u = flow(matrix, offset, half, u)
    kicks = math.sqrt(h) * kicks
    for chosen, order in ((forward, range(len(g))), (~forward, range(len(g))[::-1])):
        part = u[chosen]
        for k in order:
            part = flow(g[k], q[k], kicks[k, chosen], part)
        u[chosen] = part
    return flow(matrix, offset, half, u)


def step_covariance(matrix: FloatArray, intensity: FloatArray, dt: float) -> FloatArray:
    """
    Return integral_0^dt exp(M s) B exp(M' s) ds (dt in s).

    Van Loan (IEEE Trans. Autom. Control 23 (1978) 395) over a step short enough for its block
    exponential, doubled up to dt.
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


def _mean_and_covariance(found: FloatArray, d: int) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance from rows of 1, E u and E u u'."""
    mean = found[:, 1:1 + d]
    second = found[:, 1 + d:].reshape(-1, d, d)
    return mean, second - mean[:, :, None] * mean[:, None, :]


def _moment_matrix(matrix: FloatArray, offset: FloatArray) -> FloatArray:
    """Return the linear equation of (1, u, u u') under du/dt = A u + a (matrix in 1/s)."""
    d = offset.size
    one = np.eye(d)
    column = offset[:, None]
    full = np.zeros((1 + d + d * d, 1 + d + d * d))
    full[1:1 + d, 0] = offset
    full[1:1 + d, 1:1 + d] = matrix
    full[1 + d:, 1:1 + d] = np.kron(column, one) + np.kron(one, column)
    full[1 + d:, 1 + d:] = np.kron(matrix, one) + np.kron(one, matrix)
    return full


def _propagate(change: FloatArray, times: FloatArray, state: FloatArray) -> FloatArray:
    """Solve dy/dt = M y from time to time by the matrix exponential (M in 1/s, times in s)."""
    found = np.empty((times.size, state.size))
    found[0] = state
    steps: dict[float, FloatArray] = {}
    for k, dt in enumerate(np.diff(times).tolist()):
        # Equal steps of a grid differ in the last digits; they are one step.
        key = float(f'{dt:.12e}')
        if key not in steps:
            steps[key] = expm(change * dt)
        found[k + 1] = steps[key] @ found[k]
    return found
