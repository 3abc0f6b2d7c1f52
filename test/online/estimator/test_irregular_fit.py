"""The exact likelihood against dense matrices and a Kalman filter."""

import math

from dense import kalman_log_likelihood, ou_covariance, restricted
from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.model.ou import simulate
from ou_monitor.online.estimator import fit
from ou_monitor.online.estimator.fit import fit_exact, Likelihood, noise_scale, solve_tridiagonal
import pytest


def made(seed, n=120, noise=0.02, alpha=8.0, sigma=0.6, dt=0.02):
    """Return irregular stamps, voltages and regressors (level, ramp, wave)."""
    rng = np.random.default_rng(seed)
    t = 50.0 + np.cumsum(rng.exponential(dt, n) + 1e-5)
    y = simulate(t, alpha, sigma, rng, u0=5.0) + noise * rng.standard_normal(n)
    x = np.column_stack([np.ones(n), np.linspace(-0.5, 0.5, n), np.sin(np.arange(n) / 7.0)])
    return t, y, x


def exact(t, y, x):
    """Return the fit with all regressors."""
    return fit_exact(Likelihood(t, y, x), x.shape[1])


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
    likelihood = Likelihood(t, y, x)
    alpha, share = math.exp(log_alpha), math.exp(log_share)
    at = likelihood.at(log_alpha + math.log(likelihood.step), noise_scale(share), p)
    dense = restricted(ou_covariance(t, alpha, 1.0, share * likelihood.step), y - y.mean(), x)
    assert -at.value == pytest.approx(dense[0], abs=1e-6)
    assert at.scale == pytest.approx(dense[1], rel=1e-7)
    assert at.beta == pytest.approx(dense[2], abs=1e-7)
    assert at.cov == pytest.approx(dense[3], rel=1e-6, abs=1e-12)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10 ** 6), st.floats(-6.0, 1.5), st.floats(0.01, 8.0), st.integers(1, 3))
def test_slopes_are_those_of_differences(seed, log_a, z, p):
    """Central differences of 1e-5: 1e-10 of the third derivative, and rounding of 1e-8 or so."""
    t, y, x = made(seed, n=60)
    likelihood, h = Likelihood(t, y, x), 1e-5
    slopes = likelihood.at(log_a, z, p).slopes
    for slope, (up, more) in zip(slopes, ((h, 0.0), (0.0, h))):
        rise = likelihood.at(log_a + up, z + more, p).value - likelihood.at(
            log_a - up, z - more, p).value
        assert slope == pytest.approx(rise / (2.0 * h), rel=1e-4, abs=1e-4)


@pytest.mark.parametrize('seed', range(6))
@pytest.mark.parametrize('noise', [0.0, 0.02, 0.1])
def test_optimum_is_that_of_dense_matrices(seed, noise):
    """No step of a tenth of a standard error in any direction raises the dense likelihood."""
    t, y, x = made(seed, noise=noise)
    fit = exact(t, y, x)

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
            assert dense(fit.alpha * math.exp(up), share * more)[0] <= value + 2e-5
    assert dense(fit.alpha, share + 1e-5)[0] <= value + 2e-5
    # The maximum is the global one of a coarse grid.
    for alpha in np.geomspace(1.0, 60.0, 9):
        for other in (0.0, 1e-4, 1e-3, 1e-2, 1e-1):
            assert dense(alpha, other)[0] <= value + 2e-5


def test_value_is_that_of_a_kalman_filter():
    """
    Integrate the level out of the Kalman filter's likelihood, numerically.

    Restricted likelihood is the integral over a flat prior of the level; the
    Gaussian integrand is summed exactly enough with 41 points over +-8 sd.
    """
    t, y, x = made(3)
    fit = exact(t, y, x[:, :1])
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
    one = exact(t, y, x[:, :1])
    two = exact(slower * (t - 17.0), shift + scale * y, x[:, :1])
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
    assert exact(t, walk, x).edge == -1
    # Signs that alternate are what a fast OU fits least badly.
    swing = rng.standard_normal(400) * 0.1 + (-1.0) ** np.arange(400)
    assert exact(t, swing, x).edge == 1
    assert exact(t, simulate(t, 30.0, 0.5, rng), x).edge == 0


def damaged(rng, how):
    """Return stamps of 2 s at 1 kHz: a share of them lost, or all jittered."""
    t = np.arange(2000) * 1e-3
    return t[rng.random(t.size) > how[1]] if how[0] == 'lost' else t + rng.uniform(
        -how[1] * 1e-3, how[1] * 1e-3, t.size)


@pytest.mark.parametrize('how', [('lost', 0.2), ('lost', 0.3), ('jitter', 0.3)])
@pytest.mark.parametrize('noise', [0.0, 4e-3])
def test_an_estimate_takes_a_handful_of_evaluations(how, noise, monkeypatch):
    """Each evaluation solves one system; searching by differences took 120 to 160 of them."""
    rng = np.random.default_rng(7)
    solved = []
    solve = fit.solve_tridiagonal
    monkeypatch.setattr(fit, 'solve_tridiagonal', lambda *args: (
        solved.append(1), solve(*args))[1])
    counts = []
    for _ in range(12):
        t = damaged(rng, how)
        y = 15.0 + simulate(t, 60.0, 0.3, rng) + noise * rng.standard_normal(t.size)
        solved.clear()
        estimator = SlidingEstimator(2.1)
        estimator.push(t, y)
        assert estimator.estimate().usable
        counts.append(len(solved))
    assert 0 < np.median(counts) <= 8 and max(counts) <= 20


@pytest.mark.parametrize('n', [1, 2, 3, 4, 7, 64, 101])
def test_tridiagonal_systems(n):
    """Of any size, against a dense solver."""
    rng = np.random.default_rng(n)
    off, right = rng.standard_normal(n - 1), rng.standard_normal((n, 3))
    diag = 1.0 + np.abs(np.append(off, 0.0)) + np.abs(np.append(0.0, off))
    dense = np.diag(diag) + np.diag(off, 1) + np.diag(off, -1)
    log_det, x, own, beside = solve_tridiagonal(diag, off, right.T)
    assert log_det == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)
    inverse = np.linalg.inv(dense)
    np.testing.assert_allclose(x.T, np.linalg.solve(dense, right), rtol=1e-10)
    np.testing.assert_allclose(own, inverse.diagonal(), rtol=1e-10)
    np.testing.assert_allclose(beside, inverse.diagonal(1), rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize('alpha, seed', [(8.0, 15), (40.0, 47), (8.0, 3), (0.05, 61)])
def test_the_truth_is_not_likelier_than_the_optimum(alpha, seed):
    """Under noise, too; in the first two a quasi-Newton search ended 28 and 2 nats lower."""
    t, y, x = made(seed, n=2000, noise=0.3, alpha=alpha)
    fit = exact(t, y, x)
    likelihood = Likelihood(t, y, x)
    a = alpha * likelihood.step
    z = noise_scale((0.3 / 0.6) ** 2 / likelihood.step)
    at_truth = -likelihood.at(math.log(a), z, 3).value
    # Half a nat, which no data can tell: noise of 3 times the OU hides which of two maxima it is.
    assert fit.log_likelihood > at_truth - 0.5
