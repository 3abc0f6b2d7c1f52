"""The linear equations of first and second moments, and their exact solution."""

from __future__ import annotations

import numpy as np
from ou_monitor.records import FloatArray
from scipy.linalg import expm


def moment_matrix(matrix: FloatArray, offset: FloatArray) -> FloatArray:
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


def propagate(change: FloatArray, times: FloatArray, state: FloatArray) -> FloatArray:
    """
    Solve dy/dt = M y from time to time by the matrix exponential.

    change in 1/s, times in s.
    """
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
