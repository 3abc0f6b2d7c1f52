"""The exact likelihood against dense matrices and a Kalman filter."""

import math

from dense import ou_covariance, restricted
from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.model.ou import simulate
from ou_monitor.online.estimator.fit import maximise, noise_scale, StampLikelihood
import pytest


def made(seed, n=120, noise=0.02, alpha=8.0, sigma=0.6, dt=0.02):
    """Return irregular stamps, voltages and regressors (level, ramp, wave)."""
    rng = np.random.default_rng(seed)
    t = 50.0 + np.cumsum(rng.exponential(dt, n) + 1e-5)
    y = simulate(t, alpha, sigma, rng, u0=5.0) + noise * rng.standard_normal(n)
    x = np.column_stack([np.ones(n), np.linspace(-0.5, 0.5, n), np.sin(np.arange(n) / 7.0)])
    return t, y, x


def likelihood_of(t, y, x):
    return StampLikelihood(t, np.concatenate([x.T, [y]]))


def exact(t, y, x):
    return maximise(likelihood_of(t, y, x), x.shape[1])


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10 ** 6), st.floats(-1.0, 5.0), st.floats(-6.0, 4.0),
       st.integers(1, 3))
def test_value_is_that_of_dense_matrices(seed, log_alpha, log_share, p):
    # The dense matrix has condition up to 1e6 here, so 1e-8 is what doubles leave.
    t, y, x = made(seed, n=60)
    x = x[:, :p]
    likelihood = likelihood_of(t, y, x)
    alpha, share = math.exp(log_alpha), math.exp(log_share)
    at = likelihood.at(log_alpha + math.log(likelihood.step), noise_scale(share), p)
    dense = restricted(ou_covariance(t, alpha, 1.0, share * likelihood.step), y, x)
    assert -at.value == pytest.approx(dense[0], abs=1e-6)
    assert at.scale == pytest.approx(dense[1], rel=1e-7)
    assert np.linalg.solve(at.gram[:p, :p], at.gram[:p, -1]) == pytest.approx(dense[2], abs=1e-7)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10 ** 6), st.floats(-6.0, 1.5), st.floats(0.01, 8.0), st.integers(1, 3))
def test_slopes_are_those_of_differences(seed, log_a, z, p):
    """Central differences of 1e-5: 1e-10 of the third derivative, and rounding of 1e-8 or so."""
    t, y, x = made(seed, n=60)
    likelihood, h = likelihood_of(t, y, x), 1e-5
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


@pytest.mark.parametrize('alpha, seed', [(8.0, 15), (40.0, 47), (8.0, 3), (0.05, 61)])
def test_the_truth_is_not_likelier_than_the_optimum(alpha, seed):
    """Under noise, too; in the first two a quasi-Newton search ended 28 and 2 nats lower."""
    t, y, x = made(seed, n=2000, noise=0.3, alpha=alpha)
    fit = exact(t, y, x)
    likelihood = likelihood_of(t, y, x)
    a = alpha * likelihood.step
    z = noise_scale((0.3 / 0.6) ** 2 / likelihood.step)
    at_truth = -likelihood.at(math.log(a), z, 3).value
    # Half a nat, which no data can tell: noise of 3 times the OU hides which of two maxima it is.
    assert fit.log_likelihood > at_truth - 0.5
