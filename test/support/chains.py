"""Markov chains and switched systems shared by several tests."""

from convergence import cycle
import numpy as np
from ou_monitor.paper.theory import Generator, SwitchedSystem
from scipy.linalg import expm

# Three states, not reversible, every entry switched, balanced, with a stable drift.
THREE = Generator(np.array([[-3.0, 2.0, 1.0], [0.5, -1.5, 1.0], [3.0, 0.2, -3.2]]))
CYCLE = cycle([3.0, 5.0, 4.0])
# The matrix model of the paper, all of its coefficients switched.
PAPER = SwitchedSystem.of_matrix_model(
    CYCLE, alpha=[1, 2, 6], omega=[3, 6, 9], beta=[1, 0, 2], alpha_p=[4, 5, 9])


def vector_system() -> SwitchedSystem:
    """Return a switched system of two components on `THREE`."""
    rng = np.random.default_rng(20)
    whole = SwitchedSystem(THREE, rng.standard_normal((3, 2, 2)), rng.standard_normal((3, 2)))
    matrix, offset = whole.switched_average()
    return SwitchedSystem(
        THREE, 0.7 * (whole.matrices - matrix), whole.offsets - offset,
        np.array([[-3.0, 1.0], [0.0, -2.0]]), np.array([0.5, 0.0]))


def moments_of_switched(system, t, u0, eps, scaling='averaging'):
    """Return exact mean and covariance at t, s, without simulation."""
    # E[1_x], E[u 1_x] and E[u u' 1_x] together obey a linear equation.
    at_eps = system.scaled(eps, scaling)
    n, d = at_eps.offsets.shape
    one = np.eye(d)
    joint = np.concatenate([[1.0], u0, np.outer(u0, u0).ravel()])
    change = np.kron(at_eps.generator.q.T, np.eye(joint.size))
    for x in range(n):
        matrix, column = at_eps.matrices[x], at_eps.offsets[x][:, None]
        part = np.zeros((joint.size, joint.size))
        part[1:1 + d, :1], part[1:1 + d, 1:1 + d] = column, matrix
        part[1 + d:, 1:1 + d] = np.kron(column, one) + np.kron(one, column)
        part[1 + d:, 1 + d:] = np.kron(matrix, one) + np.kron(one, matrix)
        block = slice(x * joint.size, (x + 1) * joint.size)
        change[block, block] += part
    state = expm(change * t) @ np.outer(at_eps.generator.stationary, joint).ravel()
    found = state.reshape(n, -1).sum(axis=0)
    mean = found[1:1 + d]
    return mean, found[1 + d:].reshape(d, d) - np.outer(mean, mean)
