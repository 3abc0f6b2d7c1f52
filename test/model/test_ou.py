"""The exact discretisation and the path generator against independent calculations."""

import math

import numpy as np
from ou_monitor.model.ou import simulate, stationary_variance, transition
import pytest
from scipy.linalg import solve_continuous_lyapunov


def test_stationary_variance_solves_the_lyapunov_equation():
    alpha, sigma = 63.0, 0.632
    lyapunov = solve_continuous_lyapunov(np.array([[-alpha]]), -np.array([[sigma**2]]))
    assert stationary_variance(alpha, sigma) == pytest.approx(lyapunov[0, 0], rel=1e-12)


def test_two_half_steps_are_one_step():
    phi, q = transition(63.0, 0.632, [0.004, 0.002])
    assert phi[1] ** 2 == pytest.approx(phi[0], rel=1e-14)
    assert q[1] * (1.0 + phi[1] ** 2) == pytest.approx(q[0], rel=1e-13)


def test_transition_at_a_tiny_step_keeps_its_digits():
    """For alpha dt -> 0 the innovation variance is sigma^2 dt (1 - alpha dt)."""
    _, q = transition(63.0, 0.632, 1e-12)
    assert float(q) == pytest.approx(0.632**2 * 1e-12 * (1.0 - 63e-12), rel=1e-12)


@pytest.mark.parametrize('regular', [True, False])
def test_paths_have_the_exact_covariance(regular):
    """Cov(x_j, x_k) = Var_inf exp(-alpha |t_j - t_k|), over 10 000 paths."""
    # The standard error of a sample covariance is at most Var_inf sqrt(2 / paths); five of them, 7
    # %, bound the largest of 36 entries.
    rng = np.random.default_rng(11)
    t = np.arange(8) * 0.005 if regular else np.array(
        [0.0, 0.001, 0.004, 0.0041, 0.02, 0.03, 0.031, 0.09])
    paths = np.array([simulate(t, 63.0, 0.632, rng) for _ in range(10_000)])
    var_inf = 0.632**2 / 126.0
    expected = var_inf * np.exp(-63.0 * np.abs(t[:, None] - t[None, :]))
    error = np.abs(paths.T @ paths / len(paths) - expected)
    assert error.max() < 5.0 * var_inf * math.sqrt(2.0 / len(paths))


def test_start_and_level_are_respected():
    rng = np.random.default_rng(0)
    t = np.arange(5) * 0.01
    path = simulate(t, 63.0, 0.0, rng, u0=5.0, start=-0.368)
    assert path == pytest.approx(5.0 - 0.368 * np.exp(-63.0 * t), rel=1e-12)


def test_sigma_may_change_along_the_path():
    """Zero noise after the third stamp leaves pure decay."""
    rng = np.random.default_rng(5)
    t = np.arange(6) * 0.01
    path = simulate(t, 63.0, np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]), rng)
    assert path[3:] == pytest.approx(path[2] * np.exp(-63.0 * (t[3:] - t[2])), rel=1e-12)


@pytest.mark.parametrize('alpha, sigma, dt, word', [
    (0.0, 1.0, 0.1, 'alpha'), (-1.0, 1.0, 0.1, 'alpha'), (math.nan, 1.0, 0.1, 'alpha'),
    (1.0, -1.0, 0.1, 'sigma'), (1.0, 1.0, -0.1, 'steps'), (1.0, 1.0, math.nan, 'steps')])
def test_bad_parameters_are_named(alpha, sigma, dt, word):
    with pytest.raises(ValueError, match=word):
        transition(alpha, sigma, dt)


def test_no_stamps_give_an_empty_path():
    assert simulate([], 63.0, 1.0, np.random.default_rng(0)).shape == (0,)
