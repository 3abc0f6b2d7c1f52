"""AC coupling: a first-order high-pass of everything that the rail does."""

import math

import numpy as np
from ou_monitor.criticism.samples import Samples
import pytest
from term_examples import agrees, ALPHA, clusters, has_covariance, SIGMA, still, supply, term

VAR = SIGMA ** 2 / (2.0 * ALPHA)


def covariance(alpha, rate, lag, var=VAR):
    """Return the autocovariance of a high-passed OU, V^2."""
    # The PSD ~ w^2 / ((w^2 + alpha^2) (w^2 + rate^2)) in partial fractions; for equal rates its
    # limit.
    if abs(alpha / rate - 1.0) < 1e-3:
        return 0.5 * var * (1.0 - alpha * lag) * math.exp(-alpha * lag)
    return var * alpha / (alpha ** 2 - rate ** 2) * (
        alpha * math.exp(-alpha * lag) - rate * math.exp(-rate * lag))


@pytest.mark.parametrize('corner', [0.5, 5.0, 10.026, 10.03, 100.0, 1000.0])
def test_the_covariance_is_exact_at_any_spacing(corner):
    # At steps of a relaxation or more the rail between samples is not a straight line: only the
    # exact bridge has this law. 10.027 Hz is alpha itself.
    rate = 2.0 * math.pi * corner
    offsets = np.array([0.0, 0.3, 1.3, 3.3]) / math.sqrt(ALPHA * rate)
    gap = 15.0 / min(ALPHA, rate)
    groups = clusters(supply(term('ac_coupling', corner=corner, offset=0.0)), offsets, gap,
                      90_000, 1)
    assert abs(groups.mean()) < 4.0 * math.sqrt(VAR / 90_000)
    has_covariance(groups, offsets, lambda lag: covariance(ALPHA, rate, lag))


@pytest.mark.parametrize('dt', [1e-4, 1e-2, 2e-2])
@pytest.mark.parametrize('corner', [10.026761414789407, 4.0])
def test_covariance_at_even_stamps(corner, dt):
    """Also in a run, where errors would add up; rate dt is 0.0025 to 1.3."""
    # Standard error of a sample covariance: (1/n) sum_j (c_j^2 + c_{j+k} c_{j-k}).
    rate = 2.0 * math.pi * corner
    n = 1_000_000 if dt < 1e-3 else 100_000
    x = supply(term('ac_coupling', corner=corner, offset=0.0)).simulate(
        np.arange(n) * dt, np.random.default_rng(2))
    span = math.ceil(12.0 / (rate * dt))
    c = np.array([covariance(ALPHA, rate, j * dt) for j in range(2 * span)])
    j = np.arange(-span + 1, span)
    for k in (0, max(1, int(0.005 / dt))):
        error = math.sqrt(np.sum(c[abs(j)] ** 2 + c[abs(j + k)] * c[abs(j - k)]) / n)
        agrees(np.mean(x[k:] * x[:n - k]), c[k], error,
               (0.05 if dt > 1e-3 else 0.15) if k == 0 else math.inf)


def test_first_sample_is_stationary():
    """Over 5000 starts the first sample has the variance of all others; so has the tenth."""
    model = supply(term('ac_coupling', corner=5.0, offset=0.0))
    rng = np.random.default_rng(3)
    first = np.array([model.simulate([0.0, 0.02], rng) for _ in range(5_000)])
    truth = covariance(ALPHA, 10.0 * math.pi, 0.0)
    for column in first.T:
        agrees(np.mean(column ** 2), truth, truth * math.sqrt(2.0 / 5_000), 0.125)
    agrees(np.mean(first[:, 0] * first[:, 1]), covariance(ALPHA, 10.0 * math.pi, 0.02),
           float((first[:, 0] * first[:, 1]).std()) / math.sqrt(5_000), math.inf)


@pytest.mark.parametrize('corner', [2.0, 10.027, 50.0])
def test_a_step_of_the_level_decays_at_the_corner(corner):
    # The level is taken as a straight line between samples: the step is a ramp of one sample,
    # whose answer at its end is (1 - exp(-rate dt)) / (rate dt).
    dt, k = 1e-4, 50
    rate = 2.0 * math.pi * corner
    throttle = np.where(np.arange(3000) < k, 0.1, 0.6)
    found = still(term('load_sag', linear=-1.0, square=0.0),
                  term('ac_coupling', corner=corner, offset=0.0)).simulate(
        np.arange(3000) * dt, np.random.default_rng(0), throttle)
    since = (np.arange(3000) - k) * dt
    ramp = -math.expm1(-rate * dt) / (rate * dt)
    np.testing.assert_allclose(
        found, np.where(since >= 0.0, 0.5 * ramp * np.exp(-rate * since), 0.0), rtol=0, atol=1e-12)


def test_noise_after_the_instrument_is_not_high_passed():
    t = np.arange(2000) / 1000.0
    ac = term('ac_coupling', corner=10.0, offset=0.0)
    noise = term('measurement_noise', std=0.05)
    together = supply(ac, noise).simulate(t, np.random.default_rng(5))
    alone = supply(ac).simulate(t, np.random.default_rng(5))
    own = still(noise).simulate(t, np.random.default_rng(5))
    np.testing.assert_allclose(together, alone + own, rtol=0, atol=1e-12)


def test_columns_of_the_mean_pass_as_levels_do():
    """A constant is gone from the start, a step decays, and sums of columns stay sums."""
    t = 0.01 * np.arange(200)
    coupling = term('ac_coupling', corner=2.0, offset=1.7)
    step = np.where(t >= 0.5, 1.0, 0.0)
    columns = np.column_stack([np.full(t.size, 3.0), step, 3.0 - 2.0 * step])
    shown = coupling.pass_through(columns, Samples(t, step, None).segment(ALPHA, SIGMA))
    assert np.abs(shown[:, 0]).max() < 1e-12
    rate = 4.0 * math.pi
    ramp = -math.expm1(-0.01 * rate) / (0.01 * rate)
    late = t >= 0.5 - 1e-9
    np.testing.assert_allclose(shown[late, 1], ramp * np.exp(-rate * (t[late] - 0.5)), atol=1e-12)
    np.testing.assert_allclose(shown[:, 2], -2.0 * shown[:, 1], atol=1e-12)
