"""The exact likelihood against dense matrices and a Kalman filter."""

import math

from dense import kalman_log_likelihood, ou_covariance, restricted
from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.model.ou import simulate
from ou_monitor.online.estimator.irregular import _Likelihood, fit_exact, solve_tridiagonal
import pytest


def made(seed, n=120, noise=0.02, alpha=8.0, sigma=0.6, dt=0.02):
    """Return irregular stamps, voltages and regressors (level, ramp, wave)."""
    rng = np.random.default_rng(seed)
    t = 50.0 + np.cumsum(rng.exponential(dt, n) + 1e-5)
    y = simulate(t, alpha, sigma, rng, u0=5.0) + noise * rng.standard_normal(n)
    x = np.column_stack([np.ones(n), np.linspace(-0.5, 0.5, n), np.sin(np.arange(n) / 7.0)])
    return t, y, x


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10 ** 6), st.floats(-1.0, 5.0), st.floats(-6.0, 4.0),
       st.integers(1, 3))
def test_value_is_that_of_dense_matrices(seed, log_alpha, log_share, p):
    """
    Any parameters, any stamps, any regressors: value, scale, beta, its covariance.

    The dense matrix has condition up to 1e6 here, so 1e-8 is what doubles leave.
    """
    t, y, x = made(seed, n=60)
    x = x[:, :p]
    likelihood = _Likelihood(t, y, x)
    share = math.exp(log_share)
    value, scale, beta, cov = likelihood.solve(log_alpha, share)
    alpha = math.exp(log_alpha)
    dense = restricted(ou_covariance(t, alpha, 1.0, share * likelihood.step), y - y.mean(), x)
    assert -value == pytest.approx(dense[0], abs=1e-6)
    assert scale == pytest.approx(dense[1], rel=1e-7)
    assert beta == pytest.approx(dense[2], abs=1e-7)
    assert cov == pytest.approx(dense[3], rel=1e-6, abs=1e-12)


@pytest.mark.parametrize('seed', range(6))
@pytest.mark.parametrize('noise', [0.0, 0.02, 0.1])
def test_optimum_is_that_of_dense_matrices(seed, noise):
    """No step of a tenth of a standard error in any direction raises the dense likelihood."""
    t, y, x = made(seed, noise=noise)
    fit = fit_exact(t, y, x)

    def dense(alpha, share):
        return restricted(ou_covariance(t, alpha, 1.0, share), y, x)

    share = fit.noise_var / fit.sigma ** 2
    value, scale, beta, cov = dense(fit.alpha, share)
    assert fit.log_likelihood == pytest.approx(value, abs=1e-6)
    assert fit.sigma ** 2 == pytest.approx(scale, rel=1e-6)
    assert fit.beta == pytest.approx(beta, abs=1e-6)
    assert fit.beta_cov == pytest.approx(cov, rel=1e-5, abs=1e-12)
    step = 0.01 if fit.edge == 0 else 0.0
    for up in (-step, 0.0, step):
        for more in (0.98, 1.0, 1.02):
            assert dense(fit.alpha * math.exp(up), share * more)[0] <= value + 1e-7
    assert dense(fit.alpha, share + 1e-5)[0] <= value + 1e-7
    # The maximum is the global one of a coarse grid.
    for alpha in np.geomspace(1.0, 60.0, 9):
        for other in (0.0, 1e-4, 1e-3, 1e-2, 1e-1):
            assert dense(alpha, other)[0] <= value + 1e-7


def test_value_is_that_of_a_kalman_filter():
    """
    Integrate the level out of the Kalman filter's likelihood, numerically.

    Restricted likelihood is the integral over a flat prior of the level; the
    Gaussian integrand is summed exactly enough with 41 points over +-8 sd.
    """
    t, y, x = made(3)
    fit = fit_exact(t, y, x[:, :1])
    sd = math.sqrt(fit.beta_cov[0, 0])
    levels = fit.beta[0] + sd * np.linspace(-8.0, 8.0, 41)
    logs = np.array([kalman_log_likelihood(t, y, fit.alpha, fit.sigma, fit.noise_var, level)
                     for level in levels])
    total = math.log(np.exp(logs - logs.max()).sum() * (levels[1] - levels[0])) + logs.max()
    # The contrasts are of unit length but for log|X'X| = ln n.
    # (dense.restricted takes the flat prior without that factor.)
    assert fit.log_likelihood == pytest.approx(total, abs=1e-6)


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 100), st.floats(0.01, 100.0), st.floats(-1e3, 1e3), st.floats(0.1, 10.0))
def test_units_and_shifts(seed, scale, shift, slower):
    """
    Volts to other volts, another origin of time and another second.

    The search stops within 1e-4 of the maximum, of a width of 0.2 or more.
    """
    t, y, x = made(seed, n=80, noise=0.05)
    one = fit_exact(t, y, x[:, :1])
    two = fit_exact(slower * (t - 17.0), shift + scale * y, x[:, :1])
    if two.edge != one.edge:
        # A search that ends at the edge, and one that ends beside it.
        assert {one.edge, two.edge} in ({0, -1}, {0, 1})
        assert two.alpha * slower == pytest.approx(one.alpha, rel=0.2)
    assert two.log_likelihood == pytest.approx(
        one.log_likelihood - (t.size - 1) * math.log(scale),
        abs=1e-4 if two.edge == one.edge else 1e-2)
    assert two.beta[0] == pytest.approx(shift + scale * one.beta[0], abs=1e-2 * scale)
    if one.edge == two.edge == 0:
        assert two.alpha * slower == pytest.approx(one.alpha, rel=5e-3)
        assert two.sigma * math.sqrt(slower) == pytest.approx(scale * one.sigma, rel=5e-3)


def test_edges_are_told():
    """A random walk has no restoring force, white noise no correlation."""
    rng = np.random.default_rng(5)
    t = np.arange(400) * 0.01
    x = np.ones((400, 1))
    # Drift makes it certain: a line is no OU.
    walk = np.cumsum(rng.standard_normal(400)) + 0.5 * np.arange(400)
    assert fit_exact(t, walk, x).edge == -1
    # Signs that alternate are what a fast OU fits least badly.
    swing = rng.standard_normal(400) * 0.1 + (-1.0) ** np.arange(400)
    assert fit_exact(t, swing, x).edge == 1
    assert fit_exact(t, simulate(t, 30.0, 0.5, rng), x).edge == 0


@pytest.mark.parametrize('n', [1, 2, 3, 4, 7, 64, 101])
def test_tridiagonal_systems(n):
    """Of any size, against a dense solver."""
    rng = np.random.default_rng(n)
    off, right = rng.standard_normal(n - 1), rng.standard_normal((n, 3))
    diag = 1.0 + np.abs(np.append(off, 0.0)) + np.abs(np.append(0.0, off))
    dense = np.diag(diag) + np.diag(off, 1) + np.diag(off, -1)
    log_det, x = solve_tridiagonal(diag, off, right)
    assert log_det == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)
    np.testing.assert_allclose(x, np.linalg.solve(dense, right), rtol=1e-10)


@pytest.mark.parametrize('alpha, seed', [(8.0, 15), (40.0, 47), (8.0, 3), (0.05, 61)])
def test_the_truth_is_not_likelier_than_the_optimum(alpha, seed):
    """Under noise, too; in the first two a quasi-Newton search ended 28 and 2 nats lower."""
    t, y, x = made(seed, n=2000, noise=0.3, alpha=alpha)
    fit = fit_exact(t, y, x)
    likelihood = _Likelihood(t, y, x)
    at_truth = -likelihood.solve(math.log(alpha), (0.3 / 0.6) ** 2 / likelihood.step)[0]
    assert fit.log_likelihood > at_truth - 1e-6
