"""The mean regressed on the load: generalised least squares by dense matrices."""

import math

import numpy as np
from ou_monitor.model import arma
from ou_monitor.online.estimator.fit import independent, Moments
from ou_monitor.online.estimator.quality import load_at, slope_at
from ou_monitor.online.estimator.window import Resolution
import pytest
from scipy.linalg import toeplitz

N, A, SHARE = 1200, 0.08, 0.3
DT = 1e-3


def made(seed, slope=0.0):
    """Return voltage, throttle, the load columns, the covariance, and the sums."""
    rng = np.random.default_rng(seed)
    t = np.arange(N) * DT
    cov = toeplitz(0.5 / A * np.exp(-A * np.arange(N))) + SHARE * np.eye(N)
    u = 0.2 + 0.3 * (np.floor(t / 0.07) % 3)
    resolution = Resolution(5.0)
    probe = Resolution(5.0)
    start = np.array([0], dtype=np.int64)
    probe.add(t, t, u, start)
    load = probe.series.load(0, N)
    x = np.stack([u, u * u, load[1], load[2]])
    y = (np.linalg.cholesky(cov) @ rng.standard_normal(N)
         + np.array([-30.0, -10.0, 15.0, -8.0]) @ x + slope * np.arange(N) / N)
    resolution.add(t, y, u, start)
    return y, x, cov, resolution.sums.total()


@pytest.mark.parametrize('trend', [False, True])
@pytest.mark.parametrize('seed', range(3))
def test_regression_is_that_of_dense_matrices(seed, trend):
    """
    Coefficients of the mean, and their errors.

    The ends, 1/(n a) = 1 % of the data, move a coefficient by up to some
    sqrt(2 %) of its error, and its error by 1 or 2 %.
    """
    y, x, cov, sums = made(seed, slope=3.0 if trend else 0.0)
    moments = Moments(sums, trend)
    theta = arma.theta_at(A, 1, SHARE)
    found = moments.regress(math.log(A), theta)
    rows = [np.ones(N), *x, *([np.arange(N) / N] if trend else [])]
    design = np.column_stack(rows)
    solved = np.linalg.solve(cov, np.column_stack([design, y]))
    beta_cov = np.linalg.inv(design.T @ solved[:, :-1])
    beta = (beta_cov @ design.T @ solved[:, -1])[1:]
    sd = np.sqrt(beta_cov.diagonal()[1:])
    got = found.beta
    q = arma.innovation_variance(A, theta, 1)
    got_cov = found.cov * q / N
    if not trend:
        assert got[4:] == pytest.approx(np.zeros(got[4:].size))
        got, got_cov = got[:4], got_cov[:4, :4]
    assert (np.abs(got - beta) < 0.4 * sd).all()
    assert np.sqrt(got_cov.diagonal()) == pytest.approx(sd, rel=0.08)


def test_tilt_is_the_gradient_of_the_determinant():
    """Half log|X'K^-1X| of the regressors, by central differences."""
    _, _, _, sums = made(1)
    moments = Moments(sums, False)
    theta = 0.3
    inner = []
    for shift_a, shift_t in ((0.02, 0.0), (-0.02, 0.0), (0.0, 0.01), (0.0, -0.01)):
        cov = moments.regress(math.log(A) + shift_a, theta + shift_t).cov
        inner.append(-0.5 * np.linalg.slogdet(cov[:4, :4])[1])
    tilt = moments.regress(math.log(A), theta).tilt
    assert tilt == pytest.approx(((inner[0] - inner[1]) / 0.04, (inner[2] - inner[3]) / 0.02),
                                 rel=1e-3, abs=1e-3)


def test_residual_is_the_variogram_of_what_is_left():
    """Autocovariances of y - b x, by the samples."""
    y, x, _, sums = made(2)
    moments = Moments(sums, False)
    beta = moments.regress(math.log(A), 0.3).beta
    c0, c = moments.residual(beta)
    rest = y - beta[:4] @ x
    assert c0 == pytest.approx(rest.var(), rel=1e-8)
    for k in (1, 7, 24):
        spread = np.mean((rest[k:] - rest[:-k]) ** 2)
        assert c[k - 1] == pytest.approx(rest.var() - 0.5 * spread, rel=1e-7, abs=1e-9)


def test_what_the_window_does_not_show_is_left_out():
    """Columns that are constant, or combinations of others."""
    rng = np.random.default_rng(3)
    one, two = rng.standard_normal((2, 500))
    cov = np.cov(np.stack([one, 2.0 * one, np.full(500, 0.3), two]))
    basis = independent(cov)
    assert basis.shape == (4, 2) and not basis[2].any()
    assert basis.T @ cov @ basis == pytest.approx(np.diag((basis.T @ cov @ basis).diagonal()))
    assert independent(np.zeros((4, 4))).shape == (4, 0)
    # A throttle that moves by 1e-3 is seen, one that moves by 1e-7 is rounding.
    for size, columns in ((1e-3, 1), (1e-7, 0)):
        assert independent(np.array([[size ** 2]])).shape == (1, columns)
    # Directions that vary by 1 % of the others are seen, by 0.1 % are not.
    for size, columns in ((1e-2, 2), (1e-3, 1)):
        cov = np.cov(np.stack([one, one + size * two]))
        assert independent(cov).shape == (2, columns)


def test_steady_load():
    """Both lags have settled; the slope is the derivative of level over throttle."""
    beta = np.array([-0.2, -0.8, -0.1, 0.05])
    levels = [load_at(u) @ beta for u in (0.4 - 1e-6, 0.4 + 1e-6)]
    assert slope_at(0.4, beta) == pytest.approx((levels[1] - levels[0]) / 2e-6, rel=1e-6)
