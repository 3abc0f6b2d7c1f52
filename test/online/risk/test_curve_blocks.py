"""Blocks of samples: the estimate of sigma from squares of innovations, and its variance."""

import math

import numpy as np
from ou_monitor.online.risk.curve_filters import Squares
from ou_monitor.online.risk.curves import LearnedCurves, Pool
import pytest
from simulated_flights import fly, log_sigma, truth

THROTTLE = 0.4
COUNT = 3000


def draws(n, dt, noise, *, lost=0.0, **more):
    """Return ln(sigma) less the truth, and its variance, of many blocks of n samples."""
    rng = np.random.default_rng([1, n, round(1e6 * dt), round(1e3 * noise)])
    t, y = fly(rng, np.full(COUNT * n, THROTTLE), dt, noise=noise)
    estimate = truth(THROTTLE, noise_std=noise, sigma_se=0.0, **more)
    found = []
    for begin in range(0, t.size, n):
        kept = begin + np.flatnonzero(rng.random(n) >= lost)
        squares = Squares()
        step = (t[kept[-1]] - t[kept[0]]) / (kept.size - 1)
        squares.add(t[kept], y[kept], THROTTLE, step, estimate, not lost,
                    estimate.sigma)
        found.append(squares.take(estimate, THROTTLE))
    return np.array([(value - log_sigma(THROTTLE), variance)
                     for _, value, variance in filter(None, found)])


@pytest.mark.parametrize('n, dt, noise, lost', [
    (32, 1e-3, 0.0, 0.0), (32, 1e-2, 0.0, 0.0), (250, 1e-3, 0.01, 0.0), (2000, 1e-4, 0.01, 0.0),
    (80, 5e-3, 0.0, 0.3)])
def test_no_bias_and_the_right_variance(n, dt, noise, lost):
    """
    Mean and variance of ln(sigma) over 3000 blocks.

    The mean of m values of variance s^2 is known to s / sqrt(m); the expansion of the logarithm
    to first order leaves some tenth of the variance itself.
    """
    found = draws(n, dt, noise, lost=lost)
    assert len(found) > 0.95 * COUNT
    spread = np.std(found[:, 0])
    assert abs(np.mean(found[:, 0])) < 3.0 * spread / math.sqrt(COUNT) + 0.2 * spread ** 2
    # Variances of 3000 values are known to 3 sqrt(2 / 3000) = 8 %.
    assert spread ** 2 == pytest.approx(np.mean(found[:, 1]), rel=0.25)


def test_the_estimate_says_how_well_at_best():
    """Errors of alpha and noise, which only the estimate knows, count time for time."""
    rng = np.random.default_rng(2)
    t, y = fly(rng, np.full(250, THROTTLE))
    squares = Squares()
    estimate = truth(THROTTLE, sigma_se=0.1, duration=2.0)
    squares.add(t, y, THROTTLE, 1e-3, estimate, True, estimate.sigma)
    _, _, variance = squares.take(estimate, THROTTLE)
    assert variance == pytest.approx(0.1 ** 2 * 2.0 / 0.25)
    # At a throttle with half the sigma of the window an error of the noise counts four times.
    squares.add(t, y, THROTTLE, 1e-3, estimate, True, 0.5 * estimate.sigma)
    _, _, variance = squares.take(estimate, THROTTLE)
    assert variance == pytest.approx((4.0 * 0.1) ** 2 * 2.0 / 0.25)


def test_too_little_waits_or_is_dropped():
    """Ten samples give no logarithm; with more of the same they do; a new throttle drops them."""
    rng = np.random.default_rng(3)
    t, y = fly(rng, np.full(40, THROTTLE))
    estimate, squares = truth(THROTTLE), Squares()
    assert squares.take(estimate, THROTTLE) is None
    squares.add(t[:12], y[:12], THROTTLE, 1e-3, estimate, True, estimate.sigma)
    assert squares.take(estimate, THROTTLE) is None
    squares.add(t[12:], y[12:], THROTTLE, 1e-3, estimate, True, estimate.sigma)
    assert squares.take(estimate, THROTTLE) is not None
    squares.add(t[:5], y[:5], THROTTLE, 1e-3, estimate, True, estimate.sigma)
    assert squares.take(estimate, 0.9) is None


def test_means_are_weighted_by_samples():
    """Two blocks of 10 and 30 samples."""
    pool = Pool()
    pool.add(10, 0.0, 0.09, 0.01, 5.0, 0.2, 0.04)
    pool.add(30, 0.1, 0.39, 0.01, 4.0, 0.4, 0.0)
    assert (pool.n, pool.begin, pool.end) == (40, 0.0, 0.39)
    assert [pool.time, pool.voltage, pool.throttle, pool.apart] == pytest.approx(
        [0.4, 4.25, 0.35, 0.01])


@pytest.mark.parametrize('step, even', [(1.0, True), (1.45, True), (1.6, False), (2.0, False),
                                        (0.55, True), (0.45, False)])
def test_a_sample_that_was_lost_is_no_even_step(step, even, monkeypatch):
    """One step longer, or shorter, than half of the mean one, and squares are taken one by one."""
    seen = []
    monkeypatch.setattr(Squares, 'add', lambda self, *given: seen.append(given[5]))
    curves = LearnedCurves()
    n = 2000
    dt = np.full(n, 1e-3)
    dt[n // 2] *= step
    t = np.cumsum(dt)
    curves.update(t, np.full(n, 5.0), np.full(n, THROTTLE), truth(THROTTLE))
    assert seen and set(seen) == {even}
