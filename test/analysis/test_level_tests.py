"""Tests of a level: their false alarms are as stated, and their power."""

import math

import numpy as np
from ou_monitor.analysis.level_tests import (
    adjusted, examine_level, holm, Shape, TestResult)
from ou_monitor.criticism.innovations import innovations
from ou_monitor.model.ou import simulate
from ou_monitor.records import Estimate, Flag, Recording, Status
import pytest
from scipy import stats
from scipy.signal import lfilter
from simulated_recordings import ALPHA, fitted

SIGMA = 0.3156
VAR_INF = SIGMA ** 2 / (2.0 * ALPHA)
T = np.arange(4000) / 1000.0


def truth(**changes):
    """Return an estimate that knows the parameters as well as 4 s tell them."""
    fields = {'alpha': ALPHA, 'sigma': SIGMA, 'var_inf': VAR_INF, 'u0': 5.0, 'noise_std': 0.0,
              'alpha_se': 0.09, 'sigma_se': 0.012, 'var_inf_se': 0.09, 'status': Status.OK,
              'rate': 1000.0}
    return Estimate(**{**fields, **changes})


def ou(seed, sigma=SIGMA, t=T):
    return simulate(t, ALPHA, sigma, np.random.default_rng(seed), u0=5.0)


def examined(voltage, estimate=None, t=T):
    """Return the tests of one level in two segments, adjusted alone."""
    half = t.size // 2
    parts = [(t[:half], voltage[:half]), (t[half:], voltage[half:])]
    return holm([examine_level(parts, estimate or truth())])[0]


def test_innovations_are_standard_and_independent():
    """Of an OU in white noise, and of one sampled unevenly."""
    # Variance 1 +- sqrt(2/n) and lag-1 correlation 0 +- 1/sqrt(n), n = 20000 and 5000; 4 standard
    # errors. Without the gain of the noise the correlation would be -0.2.
    rng = np.random.default_rng(1)
    t = np.arange(20000) / 1000.0
    noisy = simulate(t, ALPHA, SIGMA, rng) + rng.normal(0.0, 0.01, t.size)
    uneven = np.sort(rng.uniform(0.0, 20.0, 5000))
    for z in (innovations(t, noisy, ALPHA, VAR_INF, 1e-4),
              innovations(uneven, simulate(uneven, ALPHA, SIGMA, rng), ALPHA, VAR_INF, 0.0)):
        n = z.size
        assert np.mean(z ** 2) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / n))
        assert abs(np.mean(z[1:] * z[:-1])) < 4.0 / math.sqrt(n)


def test_false_alarms_of_a_whole_recording():
    """Of 200 levels of OU in noise, fitted, at most 7 have any test but 'correlated' reject."""
    # Holm keeps a level at 1 %: a binomial of 200 and 0.01 exceeds 7 with probability 1e-3.
    alarms = 0
    for seed in range(200):
        rng = np.random.default_rng(5000 + seed)
        voltage = ou(seed) + rng.normal(0.0, 0.003, T.size)
        estimate = fitted(Recording(T, voltage, np.full(T.size, 0.1)), 0, T.size)
        found = examined(voltage, estimate)
        alarms += any(test.rejects for test in found.tests if test.name != 'correlated')
    assert alarms <= 7


NAMES = ('mean_drift', 'variance_drift', 'gaussian', 'impulses', 'one_relaxation')


def test_p_values_are_not_too_small():
    """At most 15 % of 200 p-values of each test lie below 0.1."""
    # A binomial of 200 and 0.1 exceeds 30 with probability 1 %; five tests, fixed seeds.
    shapes = [examine_level([(T, ou(seed))], truth()) for seed in range(200)]
    for name in NAMES:
        p = np.array([shape[name].p_value for shape in shapes])
        assert np.isfinite(p).all() and (p < 0.1).sum() <= 30, name


def with_effect(name, rng):
    """Return an OU of 4 s with one thing wrong."""
    if name == 'mean_drift':
        # Half a standard deviation of the voltage, up and down: twice 0.25, which is of
        # consequence; blocks of 0.25 s know their means to 0.36.
        return ou(rng) + 2.0 * math.sqrt(VAR_INF) * np.linspace(-1.0, 1.0, T.size)
    if name == 'variance_drift':
        return ou(rng, SIGMA * np.where(T < 2.0, 0.8, 1.25))
    kicks = np.zeros(T.size)
    if name == 'impulses':
        # One in 200 samples of 6 standard deviations: excess kurtosis 6^4 / 200 and more.
        kicks[::200] = 6.0 * SIGMA * math.sqrt(1e-3)
    elif name == 'gaussian':
        # Exponential steps: skewness 2.
        kicks = SIGMA * math.sqrt(1e-3) * (np.random.default_rng(rng).exponential(size=T.size)
                                           - 1.0)
        return 5.0 + relaxing(kicks)
    elif name == 'one_relaxation':
        # A tone at a tenth of the rate, as strong as the steps.
        return ou(rng) + SIGMA * math.sqrt(1e-3) * np.sin(0.2 * math.pi * np.arange(T.size))
    return ou(rng) + relaxing(kicks)


def relaxing(kicks):
    """Return steps that relax with ALPHA."""
    return lfilter([1.0], [1.0, -math.exp(-ALPHA / 1000.0)], kicks)


@pytest.mark.parametrize('name', NAMES)
def test_each_effect_is_seen_in_ten_of_ten(name):
    """Each effect is seen in all of 10 recordings (0.6^10 = 6e-3 for a power of 60 %)."""
    assert all(examined(with_effect(name, seed))[name].rejects for seed in range(10))


def tailed(rng):
    """Return Student's t of 5 degrees: Layard's test stays calm, as Bartlett's would not."""
    return rng.standard_t(5, T.size)


def struck(rng):
    """Return noise with seven samples off by 65 standard deviations, scattered."""
    # With them in, the variances of blocks with and without one differ by a factor of ten.
    z = rng.standard_normal(T.size)
    z[rng.integers(0, T.size, 7)] += 65.0
    return z


@pytest.mark.parametrize('drawn', [tailed, struck])
def test_impulses_are_no_change_of_intensity(drawn):
    """At most 3 of 40 at 1 % (binomial: 7e-4)."""
    calm = 0
    for seed in range(40):
        z = drawn(np.random.default_rng(seed))
        found = examine_level([(T, 5.0 + 0.01 * z)], Estimate(status=Status.NO_RELAXATION))
        calm += found['variance_drift'].p_value > 0.01
        assert found['impulses'].p_value < 1e-6
    assert calm >= 37


def test_steps_of_the_adc_hide_the_shape():
    found = examined(np.round(ou(1), 2), truth(flags=(Flag.QUANTIZED,)))
    for name in ('gaussian', 'impulses'):
        assert math.isnan(found[name].p_value) and 'ADC' in found[name].why_not
    assert math.isfinite(found['mean_drift'].p_value)


@pytest.mark.parametrize('n', [0, 1, 2, 49])
def test_few_samples_are_not_tested(n):
    found = examine_level([(T[:n], ou(1)[:n])], truth())
    assert all(math.isnan(test.p_value) and test.why_not for test in found.tests)


def test_holm_is_that_of_the_textbook():
    """Sorted p-values times what is left, never falling; NaN takes no part."""
    def simulated(*p):
        return Shape(tuple(TestResult('gaussian', value, 1.0) for value in p), 100, 0.0, 0.0, 0,
                     (0.0, 0.0, 0.0))

    first, second = holm([simulated(0.01, math.nan, 0.03), simulated(0.02, 0.5)])
    assert [test.p_adjusted for test in first.tests] == pytest.approx(
        [0.04, math.nan, 0.06], nan_ok=True)
    assert [test.p_adjusted for test in second.tests] == pytest.approx([0.06, 0.5])
    assert adjusted([0.04, 0.01, 0.03, 0.005]) == pytest.approx((0.06, 0.03, 0.06, 0.02))
    assert adjusted([]) == () and adjusted([0.9, 0.8]) == (1.0, 1.0)


def test_rates_of_impulses_have_their_poisson_interval():
    """10 glitches of 12 sigma in 4 s: 2.5 1/s, with the exact interval of 10 counts."""
    voltage = ou(3)
    voltage[200::400] += 12.0 * SIGMA * math.sqrt(1e-3)
    rate, low, high = examined(voltage).impulse_rate
    # A glitch is two innovations, one up and one down.
    assert rate == pytest.approx(20.0 / 4.0, rel=0.01)
    assert low == pytest.approx(stats.chi2.ppf(0.025, 40) / 2.0 / 4.0, rel=0.01)
    assert high == pytest.approx(stats.chi2.ppf(0.975, 42) / 2.0 / 4.0, rel=0.01)
