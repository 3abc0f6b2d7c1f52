"""The mean of a window against generalised least squares with the whole covariance."""

import math

import numpy as np
from ou_monitor.online.estimator.fit import fit_window, Moments
from ou_monitor.online.estimator.window import Resolution
import pytest
from scipy.linalg import solve_triangular, toeplitz

N, A, THETA = 1200, 0.08, 0.5


def covariance(n):
    """Return that of x_t = phi x_(t-1) + e_t - theta e_(t-1), innovations of variance 1."""
    phi = math.exp(-A)
    first = (1.0 - phi * THETA) * (phi - THETA) / (1.0 - phi * phi)
    row = first * phi ** np.arange(-1.0, n - 1.0)
    row[0] = (1.0 - 2.0 * phi * THETA + THETA * THETA) / (1.0 - phi * phi)
    return toeplitz(row)


@pytest.fixture(scope='module')
def window():
    """Return voltage, whitened voltage and regressors (1, load, time), and the sums."""
    rng = np.random.default_rng(8)
    L = np.linalg.cholesky(covariance(N))
    t = np.arange(N) * 1e-3
    u = 0.3 + 0.4 * (np.floor(t / 0.15) % 2)
    y = 5.0 + 0.02 * (L @ rng.standard_normal(N)) - 0.5 * u + 0.4 * t / t[-1]
    resolution = Resolution(2.0)
    resolution.add(t, y, u, np.array([0], dtype=np.int64))
    sums = resolution.sums.total()
    load = resolution.series.load(resolution.series.first, resolution.series.end)
    columns = np.column_stack([np.ones(N), u, u * u, load[1], load[2], np.arange(N) / N])
    solved = solve_triangular(L, np.column_stack([y, columns]), lower=True)
    return solved[:, 0], solved[:, 1:], sums


def test_regression_is_that_of_the_whole_covariance(window):
    """
    Load and time together: what they make of the voltage, and its error.

    Lags stand for the covariance up to what lies at the ends, a correlation time in the window:
    one in a hundred.  The square of a throttle of two values is no regressor of its own.
    """
    y, x, sums = window
    mean = Moments(sums, trend=True).regress(math.log(A), THETA)
    # The load variables of a step from 0.3 to 0.7, and the whole trend.
    for c in ([0.4, 0.4, 0.4, 0.4, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]):
        c = np.array(c)
        inverse = np.linalg.pinv(x.T @ x, rcond=1e-9)
        beta = inverse @ x.T @ y
        error = math.sqrt(float(c @ inverse[1:, 1:] @ c))
        mine = math.sqrt(float(c @ mean.cov @ c) / sums.n)
        assert mine == pytest.approx(error, rel=0.05)
        assert float(c @ mean.beta) == pytest.approx(float(c @ beta[1:]), abs=0.2 * 0.02 * error)


@pytest.mark.parametrize('trend', [False, True])
def test_the_score_of_a_trend_is_its_t_statistic(window, trend):
    """Over the load alone, whether or not the time is among the regressors."""
    y, x, sums = window
    moments = Moments(sums, trend)
    inverse = np.linalg.pinv(x.T @ x, rcond=1e-9)
    beta = inverse @ x.T @ y
    rest = y - x @ beta
    t = float(beta[-1]) / math.sqrt(float(rest @ rest) / N * inverse[-1, -1])
    assert moments.trend_score(moments.regress(math.log(A), THETA)) == pytest.approx(t, rel=0.04)
    assert t > 10.0


def test_white_noise_has_its_variance_and_no_more():
    """Of uncorrelated samples only mean and variance are known."""
    y = 5.0 + 0.1 * np.random.default_rng(1).standard_normal(500)
    resolution = Resolution(2.0)
    resolution.add(np.arange(500) * 1e-3, y, None, np.array([0], dtype=np.int64))
    fit = fit_window(resolution.sums.total(), 1)
    assert not fit.correlated and math.isnan(fit.a) and math.isnan(fit.trend_score)
    assert fit.variance == pytest.approx(float(y.var()), rel=1e-9)
    assert fit.level[0] == pytest.approx(float(y.mean() - y[0]), abs=1e-12)
