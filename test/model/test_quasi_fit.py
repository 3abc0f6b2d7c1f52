"""The quasi-likelihood from autocovariances: its gradient, its dense twin, its minimiser."""

import math

from dense import fisher
import numpy as np
from ou_monitor.model import arma
from ou_monitor.model.ou import simulate
import pytest
from scipy.linalg import toeplitz
from scipy.optimize import minimize

LAGS = 24


def variogram(y):
    """Return c0 and c_k = c0 - D_k / 2 over all pairs, as the sliding sums have them."""
    c0 = float(y.var())
    return c0, [c0 - float(np.mean((y[k:] - y[:-k]) ** 2)) / 2.0 for k in range(1, LAGS + 1)]


def made(seed, n, a=0.1, share=0.3):
    """Return OU plus white noise with sigma^2 D = 1."""
    rng = np.random.default_rng(seed)
    return simulate(np.arange(float(n)), a, 1.0, rng) + math.sqrt(share) * rng.standard_normal(n)


def arma_covariance(log_a, theta, n):
    """Return the covariance of an ARMA(1,1) of unit innovation variance."""
    phi = math.exp(-math.exp(log_a))
    column = np.empty(n)
    column[0] = (1.0 + theta ** 2 - 2.0 * phi * theta) / (1.0 - phi * phi)
    column[1:] = (phi * column[0] - theta) * phi ** np.arange(n - 1)
    return toeplitz(column)


@pytest.mark.parametrize('log_a, theta', [
    (-2.3, 0.3), (-5.0, 0.7), (-0.5, -0.25), (0.7, -0.2), (-2.3, 0.0), (-7.0, 0.95)])
def test_gradient(log_a, theta):
    """Central differences at steps of 1e-5 are good to 1e-9 of the curvature, some 1e3."""
    c0, c = variogram(made(1, 500))
    tilts = (0.7, -0.4)

    def value(x, y):
        return arma.objective(c0, c, 497.0, x, y, *tilts)[0]

    h, k = 1e-5, 1e-5 * (1.0 - theta)
    _, by_a, by_t = arma.objective(c0, c, 497.0, log_a, theta, *tilts)
    scale = 1.0 + abs(by_a) + abs(by_t)
    assert by_a == pytest.approx(
        (value(log_a + h, theta) - value(log_a - h, theta)) / (2 * h), abs=1e-6 * scale)
    assert by_t == pytest.approx(
        (value(log_a, theta + k) - value(log_a, theta - k)) / (2 * k), abs=2e-6 * scale)


def test_impossible_parameters_are_infinite():
    """A quadratic form that comes out negative cannot be a likelihood."""
    value, by_a, by_t = arma.objective(1.0, [2.0, 2.0], 10.0, -3.0, 0.0, 0.0, 0.0)
    assert (value, by_a, by_t) == (math.inf, 0.0, 0.0)


def test_determinant_is_that_of_dense_matrices():
    """
    With equal quadratic forms what is left of value is half log|K| + half log|X'K^-1X|.

    c0 = 1 and c = the model's own autocovariances make the form free * q; the
    ends have died out at n = 800 (a n = 40, theta^n = 0), and 1'K^-1 1 is
    n f(0) + O(1), so the difference between two parameters is met to O(1/(n a)).
    """
    n = 800
    ones = np.ones(n)
    left = []
    for log_a, theta in ((-2.3, 0.3), (-1.0, -0.2), (-3.0, 0.6), (-1.5, 0.0)):
        cov = arma_covariance(log_a, theta, n)
        c = cov[0, 1:200].tolist()
        value = arma.objective(cov[0, 0], c, n - 1.0, log_a, theta, 0.0, 0.0)[0]
        assert arma.innovation(cov[0, 0], c, log_a, theta) == pytest.approx(1.0, rel=1e-9)
        half = 0.5 * (np.linalg.slogdet(cov)[1]
                      + math.log(ones @ np.linalg.solve(cov, ones)))
        left.append((value - half, math.exp(log_a)))
    for value, a in left:
        assert value == pytest.approx(-0.5 * math.log(n), abs=1.5 / (n * a))


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('a, share, floor, slope', [
    (0.05, 0.3, 0.0, 0.0), (0.05, 0.0, 0.0, 0.0), (0.3, 1.0, 0.0, 0.0), (0.1, 0.0, -0.2, 0.05),
    (0.02, 5.0, 0.0, 0.0)])
def test_minimiser_is_scipys(seed, a, share, floor, slope):
    """Bounded search by scipy from several starts finds no lower value."""
    y = made(seed, 800, a, share)
    c0, c = variogram(y)
    start = math.log(0.4)
    log_a, theta, value, on_bound, steps = arma.minimise(
        c0, c, 799.0, start, 0.2, floor, slope, -20.0, 2.0, 0.0, 0.0)
    assert steps < arma.MAX_STEPS
    again, by_a, by_t = arma.objective(c0, c, 799.0, log_a, theta, 0.0, 0.0)
    assert value == again
    least = floor + slope * (log_a - start)
    assert theta >= least - 1e-12 and on_bound == (abs(theta - least) < 1e-12)

    def cost(p):
        # theta = bound + what is above it, below phi.
        low = floor + slope * (p[0] - start)
        phi = math.exp(-math.exp(p[0]))
        if not low < phi:
            return math.inf
        at = low + (phi - low) * (1.0 - 1e-9) * math.sin(p[1]) ** 2
        return arma.objective(c0, c, 799.0, p[0], at, 0.0, 0.0)[0]

    best = min(minimize(cost, (x, z), method='Nelder-Mead',
                        options={'xatol': 1e-7, 'fatol': 1e-10}).fun
               for x in (-4.0, -2.0) for z in (0.3, 1.0))
    # Values of some 1e3 are rounded to 1e-12; gradients, whose terms are as large, to 1e-11
    # or so: what is left of it is a 1e-10th of a step.
    assert value <= best + 1e-8
    if on_bound:
        assert by_t >= -1e-6
        assert by_a + slope * by_t == pytest.approx(0.0, abs=1e-8)
    else:
        assert (by_a, by_t) == pytest.approx((0.0, 0.0), abs=1e-8)


def test_information_is_that_of_dense_matrices():
    """Differences of 2n and n are free of the ends; steps of 1e-4 leave 1e-6."""
    at = np.array([math.log(0.3), 0.4])
    steps = (1e-4, 1e-4)
    per_sample = (fisher(lambda p: arma_covariance(*p, 240), at, steps)
                  - fisher(lambda p: arma_covariance(*p, 120), at, steps)) / 120
    expected = (per_sample[0, 0], per_sample[0, 1], per_sample[1, 1])
    assert arma.information(*at) == pytest.approx(expected, rel=1e-5)
