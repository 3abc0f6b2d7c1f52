"""
Affine systems du/dt = A u + a: exact flow and solution.

Between two jumps a switched system is affine, its average is affine, and so
are the vector fields of its diffusion limit: all of them move along this flow.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from scipy.linalg import expm

# Beyond this many substeps of the series the matrix exponential is cheaper.
_MOST_SUBSTEPS = 32.0


def augmented(matrix: npt.ArrayLike, offset: npt.ArrayLike) -> FloatArray:
    """Return [[A, a], [0, 0]], whose exponential carries u and the constant 1 (matrix in 1/s)."""
    a = np.asarray(matrix, dtype=np.float64)
    d = a.shape[-1]
    full = np.zeros((*a.shape[:-2], d + 1, d + 1))
    full[..., :d, :d] = a
    full[..., :d, d] = offset
    return full


def flow(matrix: FloatArray, offset: FloatArray, tau: FloatArray, u: FloatArray) -> FloatArray:
    """
    Move m states along their affine systems, each for its own time.

    Taylor series of the exponential acting on the state, in substeps of norm
    at most 1, to the last digit; no eigenvectors, so a matrix that cannot be
    diagonalised is as good as any. Very long steps use the matrix exponential.

    matrix in 1/s, tau in s.
    """
    if not u.size:
        return u.copy()
    step = tau[:, None]
    norm = np.abs(matrix).sum(axis=-1).max(axis=-1)
    reach = float(np.max(np.abs(tau) * norm))
    if not reach <= _MOST_SUBSTEPS:
        power = expm(augmented(matrix, offset) * tau[:, None, None])
        return np.asarray((power[:, :-1, :-1] @ u[:, :, None])[..., 0] + power[:, :-1, -1])
    parts = max(1, math.ceil(reach))
    step = step / parts
    reach /= parts
    for _ in range(parts):
        term = step * (_times(matrix, u) + offset)
        u = u + term
        k, size = 1, reach
        while size > 1e-17:
            k += 1
            term = (step / k) * _times(matrix, term)
            u += term
            size *= reach / k
    return u


def _times(matrix: FloatArray, u: FloatArray) -> FloatArray:
    """Return A u for each of the m states."""
    if matrix.ndim == 2:
        return u @ matrix.T
    if u.shape[1] == 1:
        return matrix[:, :, 0] * u
    return np.asarray(np.einsum('mij,mj->mi', matrix, u))


@dataclass(frozen=True, eq=False)
class AffineSystem:
    """du/dt = A u + a."""

    matrix: FloatArray  # A, 1/s; shape (d, d)
    offset: FloatArray  # a, unit of u per second; shape (d,)

    def __post_init__(self) -> None:
        """Check the shapes."""
        matrix = np.asarray(self.matrix, dtype=np.float64)
        offset = np.asarray(self.offset, dtype=np.float64)
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
            raise ValueError(f'matrix must have shape (d, d), got {matrix.shape}')
        if offset.shape != matrix.shape[:1]:
            raise ValueError(
                f'offset must have shape ({matrix.shape[0]},) to fit the matrix, '
                f'got {offset.shape}')
        if not (np.isfinite(matrix).all() and np.isfinite(offset).all()):
            raise ValueError('matrix and offset must be finite')
        object.__setattr__(self, 'matrix', matrix)
        object.__setattr__(self, 'offset', offset)

    @property
    def growth_rate(self) -> float:
        """Return the largest real part of an eigenvalue of A, 1/s; >= 0 when nothing restores."""
        return float(np.linalg.eigvals(self.matrix).real.max())

    def solve(self, t: npt.ArrayLike, u0: npt.ArrayLike) -> FloatArray:
        """Return the exact solution by the matrix exponential (t in s)."""
        times = check_times(t)
        state = check_state(u0, self.offset.size)
        with np.errstate(all='ignore'):
            power = expm(augmented(self.matrix, self.offset)
                         * (times - times[0])[:, None, None])
            path = np.asarray(power[:, :-1, :-1] @ state + power[:, :-1, -1])
        if not np.isfinite(path).all():
            raise ValueError(
                f'unstable: the solution overflows; the largest eigenvalue of the matrix is '
                f'{self.growth_rate:+.6g} 1/s')
        return path


def check_times(t: npt.ArrayLike) -> FloatArray:
    """Return the times as an array (t in s)."""
    times = np.asarray(t, dtype=np.float64)
    if times.ndim != 1 or not times.size:
        raise ValueError(f't must have shape (k,) with k >= 1, got {times.shape}')
    if not np.isfinite(times).all() or (np.diff(times) < 0.0).any():
        raise ValueError('t must be finite and must not decrease, s')
    return times


def check_state(u0: npt.ArrayLike, d: int) -> FloatArray:
    """Return a first state as an array."""
    state = np.atleast_1d(np.asarray(u0, dtype=np.float64))
    if state.shape != (d,):
        raise ValueError(f'u0 must have shape ({d},), got {state.shape}')
    if not np.isfinite(state).all():
        raise ValueError('u0 must be finite')
    return state


def check_starts(u0: npt.ArrayLike, paths: int, d: int) -> FloatArray:
    """Return the first states of paths, shape (paths, d), of one for all or one for each."""
    first = np.atleast_1d(np.asarray(u0, dtype=np.float64))
    if first.shape not in ((d,), (paths, d)):
        raise ValueError(f'u0 must have shape ({d},) or ({paths}, {d}), got {first.shape}')
    return np.array(np.broadcast_to(first, (paths, d)))
