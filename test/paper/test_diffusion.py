"""The diffusion limit: integrals of correlations, and exact moments of the switched system."""

from chains import moments_of_switched, THREE, vector_system
from convergence import cycle
import numpy as np
from ou_monitor.paper.theory import (
    CORRECT_FACTOR, Generator, PRINTED_FACTOR, SwitchedSystem, switching_drift,
    switching_intensity)
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

SYSTEM = vector_system()


def test_intensity_and_drift_are_integrals_of_correlations():
    """B = int Cov(C(x_0), C(x_t)) over all lags; b = int_0^inf E A(x_t) C(x_0), at a u."""
    u = np.array([0.4, -1.1])
    velocity = SYSTEM.matrices @ u + SYSTEM.offsets
    pi = THREE.stationary

    def intensity(t):
        one = velocity.T @ (pi[:, None] * expm(THREE.q * t)) @ velocity
        return one + one.T

    def drift(t):
        return np.einsum('xy,yij,xj->i', pi[:, None] * expm(THREE.q * t), SYSTEM.matrices,
                         velocity)

    assert switching_intensity(SYSTEM, u) == pytest.approx(
        quad_vec(intensity, 0.0, 30.0, epsabs=1e-11)[0], rel=1e-8)
    b = quad_vec(drift, 0.0, 30.0, epsabs=1e-11)[0]
    correction = switching_drift(SYSTEM)
    assert correction.matrix @ u + correction.offset == pytest.approx(b, rel=1e-8)
    assert switching_intensity(SYSTEM, u, PRINTED_FACTOR) == pytest.approx(
        switching_intensity(SYSTEM, u) / 2.0, rel=1e-12)


@pytest.mark.parametrize('matrices, offsets, message', [
    ([[[1.0]], [[1.0]]], [[0.0], [0.0]], r'a coefficient of \+1 1/s for component 0'),
    ([[[0.0]], [[0.0]]], [[1.0], [-0.5]], r'component 0 is \+0.25 per second at u = 0'),
])
def test_without_balance_the_limit_is_refused(matrices, offsets, message):
    system = SwitchedSystem(Generator.telegraph(1.0, 1.0), matrices, offsets)
    with pytest.raises(ValueError, match=message + '.*move the average'):
        switching_intensity(system, [0.0])


def test_the_order_of_the_jumps_matters_to_the_drift():
    """In a rotating chain A_y A_x and A_x A_y differ: only one of them is the limit."""
    chain = cycle([1.0, 1.0, 1.0])
    turn = np.array([[[0.0, 1.0], [0.0, 0.0]], [[0.0, 0.0], [1.0, 0.0]], [[0.0, -1.0],
                    [-1.0, 0.0]]])
    system = SwitchedSystem(chain, turn)
    b = switching_drift(system).matrix
    weight = chain.stationary[:, None] * chain.potential
    swapped = np.einsum('xy,xij,yjk->ik', weight, turn, turn)
    mean, _ = moments_of_switched(system, 1.0, [1.0, 0.5], 0.01, 'diffusion')
    assert np.abs(mean - expm(b) @ [1.0, 0.5]).max() < 0.02
    assert np.abs(mean - expm(swapped) @ [1.0, 0.5]).max() > 0.2


def test_exact_moments_tend_to_those_of_the_limit():
    """Multiplicative, not reversible: mean and covariance after 1 s, with order 1 in eps."""
    # The second moments of the limit follow from its drift and its intensity; with the printed
    # factor the covariance keeps an error of 30 % and more.
    u0 = np.array([0.5, 1.0])

    def of_limit(factor):
        drift = switching_drift(SYSTEM)
        matrix, one = SYSTEM.drift_matrix + drift.matrix, np.eye(2)
        column = (SYSTEM.drift_offset + drift.offset)[:, None]
        change = np.zeros((7, 7))
        change[1:3, :1], change[1:3, 1:3] = column, matrix
        change[3:, 1:3] = np.kron(column, one) + np.kron(one, column)
        change[3:, 3:] = np.kron(matrix, one) + np.kron(one, matrix)
        # The intensity is a polynomial in u: constant, square and mixed parts by differences.
        parts = {k: switching_intensity(SYSTEM, k, factor).ravel() for k in (
            (0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 1.0))}
        constant, right, left, up, down, both = parts.values()
        change[3:, 0] += constant
        change[3:, 1] += 0.5 * (right - left)
        change[3:, 2] += 0.5 * (up - down)
        change[3:, 3] += 0.5 * (right + left) - constant
        change[3:, 6] += 0.5 * (up + down) - constant
        change[3:, 4] += both - right - up + constant
        found = expm(change) @ np.concatenate([[1.0], u0, np.outer(u0, u0).ravel()])
        return found[1:3], found[3:].reshape(2, 2) - np.outer(found[1:3], found[1:3])

    mean, covariance = of_limit(CORRECT_FACTOR)
    errors = []
    for eps in (0.01, 0.005, 0.0025):
        there = moments_of_switched(SYSTEM, 1.0, u0, eps, 'diffusion')
        errors.append([np.abs(there[0] - mean).max(), np.abs(there[1] - covariance).max()])
    assert np.all(np.abs(np.diff(np.log2(errors), axis=0) + 1.0) < 0.2)
    assert np.max(errors[-1]) < 5e-3
    assert np.abs(of_limit(PRINTED_FACTOR)[1] - covariance).max() > 0.3 * np.abs(covariance).max()
