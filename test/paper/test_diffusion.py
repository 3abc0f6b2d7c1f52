"""The diffusion limit: closed forms, exact moments on both sides, Monte Carlo, whole laws."""

import math

from chains import THREE, vector_system
from convergence import cycle
from moments_and_paths import (
    _weak_step, moments_of_diffusion, moments_of_switched, paths_of_diffusion, step_covariance)
import numpy as np
from ou_monitor.paper.theory.diffusion import (
    balance_defect, diffusion_limit, LinearDiffusion, PRINTED_FACTOR, switching_drift)
from ou_monitor.paper.theory.markov_chain import Generator
from ou_monitor.paper.theory.switched_system import SwitchedSystem
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.stats import kstest

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

    limit = diffusion_limit(SYSTEM)
    assert limit.intensity(u) == pytest.approx(
        quad_vec(intensity, 0.0, 30.0, epsabs=1e-11)[0], rel=1e-8)
    b = quad_vec(drift, 0.0, 30.0, epsabs=1e-11)[0]
    correction = switching_drift(SYSTEM)
    assert correction.matrix @ u + correction.offset == pytest.approx(b, rel=1e-8)
    assert limit.matrix @ u + limit.offset == pytest.approx(
        b + SYSTEM.drift_matrix @ u + SYSTEM.drift_offset, rel=1e-8)
    assert diffusion_limit(SYSTEM, PRINTED_FACTOR).intensity(u) == pytest.approx(
        limit.intensity(u) / 2.0, rel=1e-12)


@pytest.mark.parametrize('matrices, offsets, message', [
    ([[[1.0]], [[1.0]]], [[0.0], [0.0]], r'component 0 has \+1 1/s times component 0'),
    ([[[0.0]], [[0.0]]], [[1.0], [-0.5]], r'component 0 is \+0.25 per second at u = 0'),
])
def test_no_balance_no_limit(matrices, offsets, message):
    """Refused with the component and the amount; `balanced` is named and mends it."""
    system = SwitchedSystem(Generator.telegraph(1.0, 1.0), matrices, offsets)
    with pytest.raises(ValueError, match=message + r'.*balanced\(\)'):
        diffusion_limit(system)
    diffusion_limit(system.balanced())
    for defect in balance_defect(system.balanced()):
        assert defect == pytest.approx(0.0, abs=1e-15)


def test_the_order_of_the_jumps_matters_to_the_drift():
    """In a rotating chain A_y A_x and A_x A_y differ: only one of them is the limit."""
    chain = cycle([1.0, 1.0, 1.0])
    turn = np.array([[[0.0, 1.0], [0.0, 0.0]], [[0.0, 0.0], [1.0, 0.0]], [[0.0, -1.0],
                    [-1.0, 0.0]]])
    system = SwitchedSystem(chain, turn)
    b = switching_drift(system).matrix
    weight = chain.stationary[:, None] * chain.potential
    swapped = np.einsum('xy,xij,yjk->ik', weight, turn, turn)
    mean = moments_of_switched(system, [0.0, 1.0], [1.0, 0.5], eps=0.01, scaling='diffusion')[0][1]
    assert np.abs(mean - expm(b) @ [1.0, 0.5]).max() < 0.02
    assert np.abs(mean - expm(swapped) @ [1.0, 0.5]).max() > 0.2


@pytest.mark.parametrize('dt', [1e-6, 0.1, 3.0, 1e4])
def test_covariance_of_a_step_is_the_integral(dt):
    """Quadrature for the short, the Lyapunov equation for the long; stiff by 1e3."""
    m = np.array([[-1.0, 0.5, 0.0], [0.0, -1.0, 0.0], [3.0, 0.0, -1e3]])
    b = np.array([[1.0, 0.2, 0.0], [0.2, 0.5, 0.1], [0.0, 0.1, 2.0]])
    found = step_covariance(m, b, dt)
    lyapunov = solve_continuous_lyapunov(m, -b)
    carry = expm(m * dt)
    assert found == pytest.approx(lyapunov - carry @ lyapunov @ carry.T, rel=1e-6, abs=1e-13)
    if dt <= 0.1:
        integral = quad_vec(lambda s: expm(m * s) @ b @ expm(m.T * s), 0.0, dt,
                            epsabs=1e-12, epsrel=1e-9)[0]
        assert found == pytest.approx(integral, rel=1e-7, abs=1e-11)


def test_additive_paths_are_exact_at_any_spacing():
    """One step of 2 s: mean, covariance within 5 errors, each component Gaussian."""
    limit = LinearDiffusion(
        np.array([[-1.0, 0.5], [-0.5, -2.0]]), np.array([1.0, 0.0]), np.zeros((2, 2, 2)),
        np.array([[1.0, 0.3], [0.0, 0.5]]))
    n = 20_000
    u = paths_of_diffusion(
        limit, [0.0, 2.0], [3.0, -1.0], np.random.default_rng(25), paths=n)[:, 1]
    mean, covariance = moments_of_diffusion(limit, [0.0, 2.0], [3.0, -1.0])
    assert covariance[1] == pytest.approx(
        step_covariance(limit.matrix, limit.noise_offsets.T @ limit.noise_offsets, 2.0))
    spread = np.sqrt(np.diag(covariance[1]))
    assert (np.abs(u.mean(axis=0) - mean[1]) < 5.0 * spread / math.sqrt(n)).all()
    assert (np.abs(np.cov(u.T) - covariance[1]) <
            5.0 * np.outer(spread, spread) * math.sqrt(2.0 / n)).all()
    for k in range(2):
        assert kstest((u[:, k] - mean[1, k]) / spread[k], 'norm').pvalue > 1e-4


def test_the_scheme_has_weak_order_two():
    """
    The error of one step in mean and second moment goes as h^3, so order 2.

    No sampling: the kicks are the nodes of a Gauss-Hermite quadrature, both
    orders of the fields half the weight each. The two fields do not commute,
    and M does not commute with them. A scheme of order 1 leaves h^2.
    """
    limit = LinearDiffusion(
        np.array([[-2.0, 1.0], [-1.0, -2.0]]), np.array([0.3, 0.0]),
        np.array([[[0.0, 1.0], [0.0, 0.0]], [[0.2, 0.0], [1.2, 0.0]]]),
        np.array([[0.5, 0.0], [0.0, -0.4]]))
    node, weight = np.polynomial.hermite_e.hermegauss(24)
    kicks = np.stack(np.meshgrid(node, node)).reshape(2, -1)
    weights = np.outer(weight, weight).ravel() / weight.sum() ** 2
    start = np.tile([1.0, -0.5], (weights.size, 1))
    errors = []
    for h in (0.02, 0.01, 0.005):
        mean, covariance = moments_of_diffusion(limit, [0.0, h], start[0])
        second = covariance[1] + np.outer(mean[1], mean[1])
        found = np.zeros((3, 2))
        for forward in (True, False):
            u = _weak_step(limit, start, h, kicks, np.full(weights.size, forward))
            found[0] += 0.5 * weights @ u
            found[1:] += 0.5 * np.einsum('p,pi,pj->ij', weights, u, u)
        errors.append(np.abs(found - np.vstack([mean[1], second])).max())
    assert np.diff(np.log2(errors)) == pytest.approx(-3.0, abs=0.1)


def test_multiplicative_paths_have_the_moments():
    """Paths of many default steps: mean and covariance within five errors of 20 000 paths."""
    limit, n, t = diffusion_limit(SYSTEM), 20_000, [0.0, 0.5, 1.0]
    u = paths_of_diffusion(limit, t, [0.5, 1.0], np.random.default_rng(26), paths=n)
    mean, covariance = moments_of_diffusion(limit, t, [0.5, 1.0])
    for k in (1, 2):
        rest = u[:, k] - mean[k]
        assert (np.abs(rest.mean(axis=0)) < 5.0 * rest.std(axis=0) / math.sqrt(n)).all()
        products = rest[:, :, None] * rest[:, None, :]
        assert (np.abs(products.mean(axis=0) - covariance[k]) <
                5.0 * products.std(axis=0) / math.sqrt(n)).all()


def test_geometric_brownian_motion_is_exact():
    """Scalar multiplicative noise: the flows commute, so one step of any length is the law."""
    limit = LinearDiffusion(np.array([[0.3]]), np.zeros(1), np.array([[[0.8]]]), np.zeros((1, 1)))
    u = paths_of_diffusion(
        limit, [0.0, 2.0], [1.0], np.random.default_rng(27), paths=5000, max_step=10.0)[:, 1, 0]
    normal = (np.log(u) - (0.3 - 0.32) * 2.0) / (0.8 * math.sqrt(2.0))
    assert kstest(normal, 'norm').pvalue > 1e-4


@pytest.mark.parametrize('noise', [0.0, 0.1])
def test_paths_that_overflow_are_refused(noise):
    """One line instead of infinities, for additive and multiplicative noise."""
    limit = LinearDiffusion(
        np.array([[9.0]]), np.zeros(1), np.array([[[noise]]]), np.ones((1, 1)))
    with pytest.raises(ValueError, match='unstable: a path overflows before t = 100 s'):
        paths_of_diffusion(limit, [0.0, 1.0, 100.0], [1.0], np.random.default_rng(0))


@pytest.mark.parametrize('call, message', [
    (lambda: diffusion_limit(SYSTEM, 0.0), 'factor must be positive'),
    (lambda: paths_of_diffusion(
        diffusion_limit(SYSTEM), [0.0], [0.0, 0.0], np.random.default_rng(0), max_step=0.0),
     'max_step must be positive'),
    (lambda: paths_of_diffusion(diffusion_limit(SYSTEM), [0.0], [0.0], np.random.default_rng(0)),
     'u0 must have shape'),
    (lambda: moments_of_diffusion(diffusion_limit(SYSTEM), [1.0, 0.0], [0.0, 0.0]),
     'must not decrease'),
])
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
