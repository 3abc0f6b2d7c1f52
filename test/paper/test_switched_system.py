"""Switched systems against exact moments, exact paths and the averaging theorem."""

import math

import numpy as np
from ou_monitor.paper.theory.affine import AffineSystem, flow
from ou_monitor.paper.theory.convergence import (
    averaging_convergence, AVERAGING_ORDER, fit_order, fluctuation_covariance)
from ou_monitor.paper.theory.matrix_model import MatrixModel
from ou_monitor.paper.theory.switched_system import SwitchedSystem
from ou_monitor.paper.theory.switched_velocity import SwitchedVelocity
from ou_monitor.paper.theory.switching import Generator
import pytest
from scipy.linalg import expm

CHAIN = Generator.cycle([3.0, 5.0, 4.0])
PAPER = SwitchedSystem.of_matrix_model(
    CHAIN, alpha=[1, 2, 6], omega=[3, 6, 9], beta=[1, 0, 2], alpha_p=[4, 5, 9])
U0 = np.array([1.0, 0.0, 1.0])


@pytest.mark.parametrize('matrix', [
    [[0.0, 1.0], [0.0, 0.0]],
    [[-63.0, 0.0], [3.0, -63.0]],
    [[0.0, 50.0], [-50.0, 0.0]],
    [[-1e4, 0.0], [1.0, -1.0]],
    [[2.0, 1.0], [1.0, 3.0]],
    [[0.0, 0.0], [0.0, 0.0]],
])
def test_flow_is_the_matrix_exponential(matrix):
    """Nilpotent, not diagonalisable, rotating, stiff, growing, nothing; also back in time."""
    a, b, u = np.array(matrix), np.array([0.3, -2.0]), np.array([1.0, -0.5])
    full = np.zeros((3, 3))
    full[:2, :2], full[:2, 2] = a, b
    tau = np.array([0.0, 1e-6, 1e-3, 0.1, 0.4])
    expected = np.array([(expm(full * t) @ np.append(u, 1.0))[:2] for t in tau])
    states = np.tile(u, (5, 1))
    assert flow(a, b, tau, states) == pytest.approx(expected, rel=1e-11, abs=1e-13)
    each = flow(np.tile(a, (5, 1, 1)), np.tile(b, (5, 1)), tau, states)
    assert each == pytest.approx(expected, rel=1e-11, abs=1e-13)
    if matrix[0][0] > -60.0:
        assert flow(a, b, -tau, each) == pytest.approx(states, rel=1e-9)


def test_averaging_the_matrix_model_averages_its_coefficients():
    """C is linear in them, so the average is the model of the averages, solution and all."""
    pi = CHAIN.stationary
    mean = MatrixModel(pi @ [1, 2, 6], pi @ [3, 6, 9], pi @ [1, 0, 2], pi @ [4, 5, 9])
    t = np.linspace(0.0, 1.0, 5)
    averaged = PAPER.averaged()
    assert averaged.matrix == pytest.approx(mean.matrix(), abs=1e-14)
    assert averaged.solve(t, U0) == pytest.approx(mean.solve(t, U0), rel=1e-11, abs=1e-13)


def test_the_average_holds_the_unswitched_drift():
    """Matrix and offset each: D + sum pi A and d + sum pi a."""
    system = SwitchedSystem(
        Generator.telegraph(1.0, 3.0), np.array([[[1.0]], [[5.0]]]), np.array([[2.0], [4.0]]),
        np.array([[-7.0]]), np.array([10.0]))
    assert system.averaged().matrix == pytest.approx(np.array([[-5.0]]))
    assert system.averaged().offset == pytest.approx([12.5])


def test_paths_are_exact_along_their_jumps():
    """Rates that commute: u = u0 exp(sum of A_x times the time in x), on the same draws."""
    rates = np.array([-1.0, 0.5, -3.0])
    system = SwitchedSystem(CHAIN, rates[:, None, None])
    t = np.array([0.0, 0.7, 0.7, 2.0])
    found = system.simulate(t, [2.0], np.random.default_rng(8), paths=300)[:, :, 0]
    _, spent = CHAIN.sample_many(t, 300, np.random.default_rng(8))
    exponent = np.cumsum(spent @ rates, axis=1)
    assert found[:, 1:] == pytest.approx(2.0 * np.exp(exponent), rel=1e-12)


def test_mean_is_that_of_feynman_and_kac():
    """E exp(integral of r(x)) = pi exp((Q + diag r) t) 1."""
    rates = np.array([-1.0, 0.5, -3.0])
    system = SwitchedSystem(CHAIN, rates[:, None, None])
    mean, covariance = system.moments([0.0, 0.9], [1.0])
    for power, found in ((1, mean[1, 0]), (2, covariance[1, 0, 0] + mean[1, 0] ** 2)):
        expected = CHAIN.stationary @ expm((CHAIN.q + np.diag(power * rates)) * 0.9)
        assert found == pytest.approx(expected.sum(), rel=1e-11)


@pytest.mark.parametrize('eps, scaling', [(0.5, 'averaging'), (0.7, 'diffusion')])
def test_simulation_has_the_exact_moments(eps, scaling):
    """Mean and covariance of 20 000 paths within five standard errors."""
    system = SwitchedSystem(
        CHAIN, np.array([[[-1, 1], [0, -2]], [[-1, 0], [2, -1]], [[-2, -1], [-1, 0]]]),
        np.array([[1, 0], [0, -1], [-1, 1]]), np.array([[-1, 0.5], [0, -1]]), np.array([0, 1]))
    t, paths = [0.0, 0.4, 1.2], 20_000
    found = system.simulate(
        t, [1.0, -1.0], np.random.default_rng(9), eps=eps, scaling=scaling, paths=paths)
    mean, covariance = system.moments(t, [1.0, -1.0], eps=eps, scaling=scaling)
    for k in (1, 2):
        rest = found[:, k] - mean[k]
        assert (np.abs(rest.mean(axis=0)) < 5.0 * rest.std(axis=0) / math.sqrt(paths)).all()
        products = rest[:, :, None] * rest[:, None, :]
        error = 5.0 * products.std(axis=0) / math.sqrt(paths)
        assert (np.abs(products.mean(axis=0) - covariance[k]) < error).all()


def test_the_start_of_the_chain_is_respected():
    """Before the first jump u follows the state asked for: most paths, over a short time."""
    system = SwitchedSystem(CHAIN, np.zeros((3, 1, 1)), np.array([[1.0], [10.0], [100.0]]))
    for start, speed in enumerate((1.0, 10.0, 100.0)):
        u = system.simulate([0.0, 1e-3], [0.0], np.random.default_rng(1), paths=50, start=start)
        assert np.median(u[:, 1, 0]) == pytest.approx(speed * 1e-3, rel=1e-12)


def test_averaging_has_order_one_half():
    """
    First part, the order: rms of the largest error over [0, 1] goes as sqrt(eps).

    The fitted slope has a standard error below 0.012 from 1000 paths at four
    eps over a factor 16; what is beyond sqrt(eps) moves it by less than 0.02
    (the exact root mean square at the end shows it). Order 0 or 1 is forty
    errors away.
    """
    t, eps = np.linspace(0.0, 1.0, 26), np.array([0.08, 0.04, 0.02, 0.005])
    largest, final = averaging_convergence(
        PAPER, t, U0, eps, np.random.default_rng(10), 1000)
    assert largest.order_error < 0.012
    # On the same draws: the largest distance of each path, then the mean square.
    rest = PAPER.simulate(t, U0, np.random.default_rng(10), eps=0.08, paths=1000) \
        - PAPER.averaged().solve(t, U0)
    worst = np.linalg.norm(rest, axis=2).max(axis=1)
    assert largest.error[0] == pytest.approx(math.sqrt(np.mean(worst**2)), rel=1e-12)
    for found in (largest, final):
        assert abs(found.order - AVERAGING_ORDER) < 4.0 * found.order_error + 0.02
    limit = PAPER.averaged().solve(t, U0)[-1]
    exact = []
    for value in eps.tolist():
        mean, covariance = PAPER.moments([0.0, 1.0], U0, eps=value)
        exact.append(math.sqrt(np.trace(covariance[1]) + np.sum((mean[1] - limit) ** 2)))
    assert abs(fit_order(eps, exact).order - AVERAGING_ORDER) < 0.02
    # The measured errors are those that the moments say.
    assert (np.abs(final.error - exact) < 4.5 * final.standard_error).all()


def test_averaging_has_the_constant_of_the_central_limit_theorem():
    """
    Second part, the constant: Cov(u^eps) / eps -> S with the factor 2 in B.

    Exact moments, so the distance falls by the ratio of the eps themselves;
    with half the intensity it would stay at one half.
    """
    t = np.array([0.0, 0.3, 1.0])
    limit = fluctuation_covariance(PAPER, t, U0)
    distance = [
        np.abs(PAPER.moments(t, U0, eps=eps)[1] / eps - limit)[1:].max() / np.abs(limit).max()
        for eps in (1e-2, 1e-3)]
    assert distance[1] < 1e-3
    assert distance[0] / distance[1] == pytest.approx(10.0, rel=0.1)


def test_the_mean_converges_with_order_one():
    """The bias of the average is eps, smaller than the spread: exact moments."""
    t, eps = np.linspace(0.0, 1.0, 6), [0.01, 0.005, 0.0025]
    limit = PAPER.averaged().solve(t, U0)
    errors = [np.abs(PAPER.moments(t, U0, eps=value)[0] - limit).max() for value in eps]
    assert fit_order(eps, errors).order == pytest.approx(1.0, abs=0.02)


def test_fit_of_the_order_is_weighted():
    eps = np.array([0.1, 0.01, 0.001])
    fit = fit_order(eps, 3.0 * eps**0.5 * np.array([1.0, 1.0, 2.0]),
                    [1e-4, 1e-4, 1e3])
    assert fit.order == pytest.approx(0.5, abs=1e-6)
    with pytest.raises(ValueError, match='two or more different'):
        fit_order([0.1, 0.1], [1.0, 1.0])
    with pytest.raises(ValueError, match='error must be positive'):
        fit_order([0.1, 0.2], [1.0, 0.0])


def test_balanced_changes_nothing_at_eps_one():
    """Same moments; and the switched part averages to zero."""
    balanced = PAPER.balanced()
    pi = CHAIN.stationary
    assert np.tensordot(pi, balanced.matrices, 1) == pytest.approx(0.0, abs=1e-14)
    for found, expected in zip(
            balanced.moments([0.0, 0.5], U0), PAPER.moments([0.0, 0.5], U0), strict=True):
        assert found == pytest.approx(expected, rel=1e-11, abs=1e-13)


@pytest.mark.parametrize('eps, scaling', [(0.1, 'averaging'), (0.5, 'diffusion')])
def test_any_velocity_may_be_switched(eps, scaling):
    """Affine velocities through the general way give the same paths on the same draws."""
    def velocity(u, states):
        return np.einsum('mij,mj->mi', PAPER.matrices[states], u) + PAPER.offsets[states]

    general = SwitchedVelocity(CHAIN, velocity, 3)
    t = [0.0, 0.2, 0.6]
    ours = general.simulate(
        t, U0, np.random.default_rng(11), max_step=2e-3, eps=eps, paths=50, scaling=scaling)
    exact = PAPER.simulate(
        t, U0, np.random.default_rng(11), eps=eps, paths=50, scaling=scaling)
    assert ours == pytest.approx(exact, rel=1e-8, abs=1e-9)
    assert general.solve_averaged(t, U0) == pytest.approx(
        PAPER.averaged().solve(t, U0), abs=1e-7)


def test_a_nonlinear_velocity_averages():
    """du/dt = -k(x) u^3 tends to u0 / sqrt(1 + 2 mean(k) u0^2 t)."""
    k = np.array([1.0, 4.0, 2.0])
    system = SwitchedVelocity(CHAIN, lambda u, x: -k[x][:, None] * u**3, 1)
    expected = 1.5 / math.sqrt(1.0 + 2.0 * (CHAIN.stationary @ k) * 1.5**2)
    assert system.solve_averaged([0.0, 1.0], [1.5])[1, 0] == pytest.approx(expected, rel=1e-7)
    rms = []
    for eps in (0.04, 0.01):
        u = system.simulate([0.0, 1.0], [1.5], np.random.default_rng(12), max_step=0.05,
                            eps=eps, paths=2000)[:, 1, 0]
        rms.append(math.sqrt(np.mean((u - expected) ** 2)))
    # The ratio of two rms of 2000 paths has a relative error of 2.2 %.
    assert rms[0] / rms[1] == pytest.approx(2.0, rel=5 * 0.022)


def test_an_exploding_velocity_is_refused():
    system = SwitchedVelocity(CHAIN, lambda u, x: u**2, 1)
    with np.errstate(all='ignore'), pytest.raises(ValueError, match='grown out of its domain'):
        system.simulate([0.0, 50.0], [1.0], np.random.default_rng(0), max_step=0.05)


def test_paths_that_overflow_are_refused():
    """One line instead of infinities."""
    system = SwitchedSystem(CHAIN, np.full((3, 1, 1), 9.0))
    with pytest.raises(ValueError, match='unstable: a path overflows before t = 100 s'):
        system.simulate([0.0, 1.0, 100.0], [1.0], np.random.default_rng(0))


def test_an_unstable_average_has_no_equilibrium():
    """The eigenvalue is named; a stable one gives the rest point."""
    with pytest.raises(ValueError, match=r'no equilibrium, the matrix has the eigenvalue \+0'):
        PAPER.averaged().equilibrium()
    printed = SwitchedSystem.of_matrix_model(
        CHAIN, alpha=1, omega=-1, beta=1, alpha_p=[1, 2, 3], power_sign='printed')
    rate = CHAIN.stationary @ [1, 2, 3]
    with pytest.raises(ValueError, match=rf'eigenvalue \+{rate:.6g} 1/s'):
        printed.averaged().require_stable('equilibrium')
    stable = AffineSystem(np.array([[-2.0, 1.0], [0.0, -4.0]]), np.array([1.0, 8.0]))
    assert stable.equilibrium() == pytest.approx([1.5, 2.0])
    with pytest.raises(ValueError, match=r'overflows; the largest eigenvalue .* \+900'):
        AffineSystem(np.array([[900.0]]), np.array([0.0])).solve([0.0, 1.0], [1.0])


@pytest.mark.parametrize('call, message', [
    (lambda: SwitchedSystem(CHAIN, np.zeros((2, 1, 1))), r'shape \(3, d, d\)'),
    (lambda: SwitchedSystem(CHAIN, np.zeros((3, 2, 2)), np.zeros((3, 1))), 'offsets must have'),
    (lambda: SwitchedSystem(CHAIN, np.full((3, 1, 1), np.nan)), 'matrices must be finite'),
    (lambda: PAPER.simulate([0.0], U0, np.random.default_rng(0), eps=0.0), 'eps must be'),
    (lambda: PAPER.simulate([0.0], U0, np.random.default_rng(0), scaling='fast'), 'scaling'),
    (lambda: PAPER.simulate([0.0], [1.0], np.random.default_rng(0)), 'u0 must have shape'),
    (lambda: PAPER.moments([0.0], [1.0]), r'u0 must have shape \(3,\)'),
    (lambda: SwitchedSystem.of_matrix_model(
        CHAIN, alpha=[1, 2], omega=0, beta=0, alpha_p=1), r'alpha must be one number or'),
    (lambda: SwitchedSystem.of_models(
        CHAIN, [MatrixModel(lambda t: t, 0, 0, 1)] * 3), 'state 0 varies in time'),
    (lambda: averaging_convergence(
        PAPER, [0.0, 1.0], U0, [0.1, 0.2], np.random.default_rng(0), 1), 'paths must be 2'),
    (lambda: SwitchedVelocity(CHAIN, lambda u, x: u, 3).simulate(
        [0.0], U0, np.random.default_rng(0), max_step=0.0), 'max_step must be positive'),
    (lambda: SwitchedVelocity(CHAIN, lambda u, x: u[:, 0], 3).averaged_velocity(U0),
     'velocity must return shape'),
])
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
