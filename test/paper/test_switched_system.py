"""Switched systems against exact moments, exact paths and the averaging theorem."""

import math

from chains import CYCLE, moments_of_switched, PAPER
import numpy as np
from ou_monitor.paper.theory import flow, Generator, SwitchedSystem
import pytest
from scipy.linalg import expm

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


def test_the_average_holds_the_unswitched_drift():
    """Matrix and offset each: D + sum pi A and d + sum pi a."""
    system = SwitchedSystem(
        Generator.telegraph(1.0, 3.0), np.array([[[1.0]], [[5.0]]]), np.array([[2.0], [4.0]]),
        np.array([[-7.0]]), np.array([10.0]))
    assert system.averaged().matrix == pytest.approx(np.array([[-5.0]]))
    assert system.averaged().offset == pytest.approx([12.5])


@pytest.mark.parametrize('eps, scaling', [(0.5, 'averaging'), (0.7, 'diffusion')])
def test_simulation_has_the_exact_moments(eps, scaling):
    """Mean and covariance of 20 000 paths within five standard errors."""
    system = SwitchedSystem(
        CYCLE, np.array([[[-1, 1], [0, -2]], [[-1, 0], [2, -1]], [[-2, -1], [-1, 0]]]),
        np.array([[1, 0], [0, -1], [-1, 1]]), np.array([[-1, 0.5], [0, -1]]), np.array([0, 1]))
    t, paths = [0.0, 0.4, 1.2], 20_000
    found = system.simulate(
        t, [1.0, -1.0], np.random.default_rng(9), eps=eps, scaling=scaling, paths=paths)
    for k in (1, 2):
        mean, covariance = moments_of_switched(system, t[k], [1.0, -1.0], eps, scaling)
        rest = found[:, k] - mean
        assert (np.abs(rest.mean(axis=0)) < 5.0 * rest.std(axis=0) / math.sqrt(paths)).all()
        products = rest[:, :, None] * rest[:, None, :]
        error = 5.0 * products.std(axis=0) / math.sqrt(paths)
        assert (np.abs(products.mean(axis=0) - covariance) < error).all()


def test_paths_that_overflow_are_refused():
    system = SwitchedSystem(CYCLE, np.full((3, 1, 1), 9.0))
    with pytest.raises(ValueError, match='unstable: a path overflows before t = 100 s'):
        system.simulate([0.0, 1.0, 100.0], [1.0], np.random.default_rng(0))


@pytest.mark.parametrize('call, message', [
    (lambda: SwitchedSystem(CYCLE, np.zeros((2, 1, 1))), r'shape \(3, d, d\)'),
    (lambda: SwitchedSystem(CYCLE, np.zeros((3, 2, 2)), np.zeros((3, 1))), 'offsets must have'),
    (lambda: SwitchedSystem(CYCLE, np.full((3, 1, 1), np.nan)), 'matrices must be finite'),
    (lambda: PAPER.simulate([0.0], U0, np.random.default_rng(0), eps=0.0), 'eps must be'),
    (lambda: PAPER.simulate([0.0], U0, np.random.default_rng(0), scaling='fast'), 'scaling'),
    (lambda: PAPER.simulate([0.0], [1.0], np.random.default_rng(0)), 'u0 must have shape'),
    (lambda: SwitchedSystem.of_matrix_model(
        CYCLE, alpha=[1, 2], omega=0, beta=0, alpha_p=1), r'alpha must be one number or'),
])
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
