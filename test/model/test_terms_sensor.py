"""Effects of sensor, ADC, logger and clock on the samples."""

import math

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import kstest
from term_examples import agrees, ALPHA, SIGMA, still, supply, term, U0

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
