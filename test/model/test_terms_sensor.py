"""Effects of instrument, sensor, ADC, logger and clock on the samples."""

import math

import numpy as np
from ou_monitor.criticism.samples import Samples
import pytest
from scipy.special import ndtr
from scipy.stats import kstest
from term_examples import agrees, ALPHA, clusters, has_covariance, SIGMA, still, supply, term, U0

N = 200_000
T = np.arange(N) / 1000.0
# Of a variance from N independent normals: 0.32 %, so that 2 % is seen.
VAR_ERROR = math.sqrt(2.0 / N)


def drawn(*terms, t=T, seed=1, **ou):
    """Return samples of the ou with the terms."""
    return supply(*terms, **ou).simulate(t, np.random.default_rng(seed))


def is_white(noise):
    """Check lags 1, 2 and 7 against 1/sqrt(n)."""
    for lag in (1, 2, 7):
        rho = np.mean(noise[lag:] * noise[:-lag]) / noise.var()
        assert abs(rho) < 4.0 / math.sqrt(noise.size)


def test_measurement_noise_is_white_and_normal():
    noise = drawn(term('measurement_noise', std=0.02)) - drawn()
    agrees(noise.var(), 4e-4, 4e-4 * VAR_ERROR, 0.02)
    is_white(noise)
    assert kstest(noise[::10] / 0.02, 'norm').pvalue > 1e-4
    assert abs(np.corrcoef(noise, drawn())[0, 1]) < 4.0 / math.sqrt(N)


@pytest.mark.parametrize('std', [0.05, 0.5])
def test_readings_are_whole_steps(std):
    """Whole steps from 0 V, within half a step; errors of step^2/12 where noise covers steps."""
    # The square of a uniform error has the standard deviation step^2 / sqrt(180).
    step = 0.0317
    raw = drawn(term('measurement_noise', std=std))
    coded = drawn(term('measurement_noise', std=std), term('quantization', step=step))
    codes = coded / step
    assert np.abs(codes - np.rint(codes)).max() < 1e-9
    error = coded - raw
    assert np.abs(error).max() <= 0.5 * step * (1.0 + 1e-9)
    agrees(np.mean(error ** 2), step ** 2 / 12.0, step ** 2 / math.sqrt(180.0 * N), 0.02)
    assert abs(error.mean()) < 4.0 * step / math.sqrt(12.0 * N)


def test_samples_beyond_a_rail_read_the_rail():
    raw = drawn(t=T[:20_000] * 200.0)
    clipped = drawn(term('saturation', low=4.95, high=5.02), t=T[:20_000] * 200.0)
    np.testing.assert_array_equal(clipped, np.minimum(np.maximum(raw, 4.95), 5.02))
    std = SIGMA / math.sqrt(2.0 * ALPHA)
    for share, truth in ((np.mean(clipped == 4.95), ndtr(-0.05 / std)),
                         (np.mean(clipped == 5.02), ndtr(-0.02 / std))):
        agrees(share, truth, math.sqrt(truth * (1.0 - truth) / 20_000), 0.15)


def test_noise_comes_before_clipping_and_clipping_before_codes():
    noise = term('measurement_noise', std=0.05)
    rail = term('saturation', low=4.93, high=5.06)
    code = term('quantization', step=0.02)
    hold = term('held_samples', rate=250.0)
    expected = 0.02 * np.rint(np.clip(drawn(noise), 4.93, 5.06) / 0.02)
    expected = np.repeat(expected[::4], 4)
    for terms in ((noise, rail, code, hold), (hold, code, rail, noise)):
        np.testing.assert_allclose(drawn(*terms), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize('start', [0.0, 12.345, 1.7e9])
@pytest.mark.parametrize('rate', [1000, 500, 250, 400, 270, 999, 1])
def test_a_value_holds_until_the_source_has_the_next(rate, start):
    # At 1 kHz, sample k is in turn k rate // 1000; it shows the first sample of its turn.
    k = np.arange(20_000)
    fresh = np.diff(k * rate // 1000, prepend=-1) > 0
    first = np.maximum.accumulate(np.where(fresh, k, 0))
    raw = drawn(t=start + T[:20_000])
    held = drawn(term('held_samples', rate=float(rate)), t=start + T[:20_000])
    np.testing.assert_array_equal(held, raw[first])
    assert fresh.mean() == pytest.approx(rate / 1000, rel=0.02)


def test_glitches_hit_their_share_and_no_other_sample():
    error = drawn(term('glitches', probability=0.04, std=0.3)) - drawn()
    bad = error != 0.0
    agrees(bad.mean(), 0.04, math.sqrt(0.04 * 0.96 / N), 0.07)
    sizes = error[bad]
    agrees(sizes.var(), 0.09, 0.09 * math.sqrt(2.0 / sizes.size), 0.1)
    assert kstest(sizes / 0.3, 'norm').pvalue > 1e-4
    is_white(error)
    # Isolated: as many neighbours as chance has it, 0.0016 of all.
    agrees(np.mean(bad[1:] & bad[:-1]), 0.0016, math.sqrt(0.0016 * 1.1 / N), 0.4)


def clock_errors(std, t, seed=1):
    """Return how far from their stamps samples are taken, s, off a ramp of 1 V/s."""
    ramp = still(term('drift', rate=1.0, curvature=0.0), term('clock_jitter', std=std))
    return ramp.simulate(t, np.random.default_rng(seed)) - (t - t[0])


def test_clock_errors_are_normal_and_independent():
    """Normal of the stated deviation, independent; the first sample is on its stamp."""
    error = clock_errors(5e-5, T)
    assert error[0] == 0.0
    # Seen through a double of up to 200 s: 3e-14.
    agrees(error.var(), 2.5e-9, 2.5e-9 * VAR_ERROR, 0.02)
    is_white(error)
    assert kstest(error[1::10] / 5e-5, 'norm').pvalue > 1e-4


def test_clock_errors_never_swap_samples():
    """Cut at 0.45 of the step; a large error puts the normal share at the bounds."""
    error = clock_errors(1e-3, T)
    assert np.diff(T + error).min() >= 0.1e-3 - 1e-12
    assert np.abs(error).max() <= 0.45e-3 + 1e-12
    share = 2.0 * ndtr(-0.45)
    agrees(np.mean(np.abs(error[1:]) > 0.45e-3 - 1e-12), share,
           math.sqrt(share * (1.0 - share) / N), 0.02)
    uneven = np.cumsum(np.random.default_rng(5).exponential(1e-3, 20_000))
    assert np.diff(uneven + clock_errors(1e-3, uneven)).min() >= -1e-12


def test_samples_are_taken_at_the_wrong_time():
    # A stamp in the data is k dt, the sample of k dt + error. Innovations over the true steps have
    # variance 1 and no memory, over the stated ones they are wider.
    jitter = term('clock_jitter', std=2.5e-4)
    x = drawn(jitter) - U0
    at = T + clock_errors(2.5e-4, T)
    phi = np.exp(-ALPHA * np.diff(at))
    var = SIGMA ** 2 / (2.0 * ALPHA)
    z = (x[1:] - phi * x[:-1]) / np.sqrt(var * (1.0 - phi ** 2))
    agrees(z.var(), 1.0, VAR_ERROR, 0.02)
    is_white(z)
    # With the stamps alone, the squares of innovations do not follow the true steps.
    follow = np.corrcoef(z ** 2, np.diff(at))[0, 1]
    raw = (x[1:] - math.exp(-ALPHA * 1e-3) * x[:-1]) ** 2
    assert abs(follow) < 4.0 / math.sqrt(N) < np.corrcoef(raw, np.diff(at))[0, 1]


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
