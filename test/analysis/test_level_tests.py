"""Tests of levels, and of a common alpha: false alarms as stated, and power."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.level_result import fit_all
from ou_monitor.analysis.level_tests import (
    adjusted, alpha_constancy, examine_level, holm, Shape, sigma_change, SigmaChange, TestResult)
from ou_monitor.analysis.levels import LoadLevel
from ou_monitor.analysis.noise import remainder
from ou_monitor.criticism.innovations import innovations
from ou_monitor.model.ou import simulate
from ou_monitor.records import Estimate, Flag, Recording, Status
import pytest
from scipy import stats
from scipy.signal import lfilter
from simulated_recordings import ALPHA, fitted, recording

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


THROTTLES = (0.1, 0.3, 0.5, 0.7)


def estimate(alpha, se):
    return Estimate(alpha=alpha, sigma=0.3, var_inf=7e-4, u0=5.0, alpha_se=se, sigma_se=0.01,
                    var_inf_se=se, status=Status.OK, rate=1000.0)


def drawn(rng, alphas, se):
    """Return estimates as sampling scatters them: the error follows the alpha found."""
    found = [alpha * math.exp(se * rng.standard_normal()) for alpha in alphas]
    return [estimate(value, se * math.sqrt(alpha / value)) for value, alpha in zip(found, alphas)]


def test_false_alarms_are_five_percent():
    """600 draws of four levels: 30 +- 5.3; within 4 of those."""
    rng = np.random.default_rng(1)
    alarms = sum(alpha_constancy(THROTTLES, drawn(rng, [ALPHA] * 4, 0.15)).verdict == 'differs'
                 for _ in range(600))
    assert 9 <= alarms <= 51


def test_the_detectable_ratio_is_detected_nine_times_in_ten():
    """ln(alpha) straight over throttle, by that ratio: 270 +- 5.2 of 300."""
    # Within 5 standard deviations, for the errors at a common alpha are themselves estimates.
    rng = np.random.default_rng(2)
    ratio = alpha_constancy(THROTTLES, [estimate(ALPHA, 0.1)] * 4).detectable_ratio
    steps = (np.array(THROTTLES) - 0.4) / 0.6
    alphas = ALPHA * np.exp(math.log(ratio) * steps)
    rejected = sum(alpha_constancy(THROTTLES, drawn(rng, alphas, 0.1)).verdict == 'differs'
                   for _ in range(300))
    assert abs(rejected - 270) <= 26


def test_the_numbers_are_those_of_the_textbook():
    """With errors that do not depend on alpha: chi^2, ratio and interval by hand."""
    logs = np.array([4.0, 4.1])
    found = alpha_constancy((0.2, 0.4), [estimate(math.exp(v), 0.1 * math.exp(-0.5 * (v - 4.05)))
                                         for v in logs])
    # Carried to the common alpha both errors are 0.1.
    assert found.statistic == pytest.approx(2.0 * (0.05 / 0.1) ** 2, rel=1e-6)
    assert found.p_value == pytest.approx(stats.chi2.sf(found.statistic, 1))
    assert found.ratio == pytest.approx(math.exp(0.1))
    assert found.ratio_high == pytest.approx(math.exp(0.1 + 1.96 * 0.1 * math.sqrt(2.0)), rel=1e-3)
    assert found.alpha == pytest.approx(math.exp(4.05))


def test_long_levels_decide_and_short_ones_do_not():
    """Errors of 3 %: constant; of 30 %: undecided; a factor of 3: differs."""
    assert alpha_constancy(THROTTLES, [estimate(ALPHA, 0.03)] * 4).verdict == 'constant'
    vague = alpha_constancy(THROTTLES, [estimate(ALPHA, 0.3)] * 4)
    assert vague.verdict == 'undetermined' and vague.detectable_ratio > 2.0
    assert 'cannot decide' in vague.sentence and f'{vague.detectable_ratio:.2f}' in vague.sentence
    differs = alpha_constancy((0.1, 0.5), [estimate(40.0, 0.1), estimate(120.0, 0.1)])
    assert differs.verdict == 'differs' and differs.ratio_low > 1.0
    assert 'assumes a constant alpha' in differs.sentence


@pytest.mark.parametrize('estimates', [
    [], [Estimate()] * 4, [estimate(63.0, 0.1), Estimate(), Estimate(), Estimate()]])
def test_less_than_two_levels_decide_nothing(estimates):
    found = alpha_constancy(THROTTLES, estimates)
    assert found.verdict == 'undetermined' and math.isnan(found.p_value)
    assert 'throttle held long enough has' in found.sentence


def test_fitted_levels_of_one_alpha_do_not_differ():
    """60 recordings of three levels, fitted: at most 9 alarms at 5 %."""
    # A binomial of 60 and 0.05 exceeds 9 with probability 1e-3; errors a third too small would
    # make it 20 %.
    alarms = 0
    for seed in range(60):
        simulated = recording(7000 + seed, ((0.1, 0.2), (0.3, 0.4), (0.6, 0.6)), seconds=2.0)
        fits = [fitted(simulated, 2000 * k, 2000 * k + 2000) for k in range(3)]
        alarms += alpha_constancy((0.1, 0.3, 0.6), fits).verdict == 'differs'
    assert alarms <= 9


def test_levels_that_one_ou_does_not_describe_are_withheld():
    """They have no say, and are named; with one left the test decides nothing."""
    four = [estimate(v, 0.05) for v in (ALPHA, ALPHA, ALPHA, 3.0 * ALPHA)]
    assert alpha_constancy(THROTTLES, four).verdict == 'differs'
    found = alpha_constancy(THROTTLES, four, [False, False, False, True])
    assert (found.verdict, found.levels, found.withheld) == ('constant', 3, (0.7,))
    assert found.sentence.endswith(
        'Withheld: 70 %, because a level shows more than one relaxation, or both '
        'lines and impulses.')
    alone = alpha_constancy(THROTTLES, four, [False, True, True, True])
    assert alone.verdict == 'undetermined'
    assert 'depends on load: only one throttle' in alone.sentence
    none = alpha_constancy(THROTTLES, four, [True] * 4)
    assert none.levels == 0 and math.isnan(none.alpha)
    assert 'no throttle held long enough has a usable fit and is described by' in none.sentence


def test_a_tone_is_not_taken_for_another_alpha():
    """Alpha 63 1/s at both levels, a tone of 3 mV rms at 180 Hz: never 'differs'."""
    # Sigma goes from 0.1 to 0.3, so the tone bends the alpha of the quiet level more.
    for seed in range(3):
        simulated = recording(seed, ((0.0, 0.1), (0.2, 0.3)), seconds=5.0)
        white = np.random.default_rng(seed).normal(0.0, 0.001, simulated.n)
        tone = 0.003 * math.sqrt(2.0) * np.sin(2.0 * math.pi * 180.0 * simulated.t)
        simulated = replace(simulated, voltage=simulated.voltage + white + tone)
        analysis = analyze(simulated)
        left = remainder(simulated)
        assert alpha_constancy([0.0, 0.2], [
            fit_all(simulated, left, [LoadLevel(level.throttle, level.segments)])
            for level in analysis.levels]).verdict == 'differs'
        assert analysis.alpha_test.verdict != 'differs'
        assert analysis.alpha_test.levels == 2


def test_a_sigma_that_may_have_changed_is_not_the_same():
    """Three cases: another sigma, the same within the factor that matters, and either."""
    assert [SigmaChange(math.sqrt(low * high), low, high).differs for low, high in (
        (1.1, 5.0), (0.2, 0.9), (0.8, 1.3), (0.812, 54.8), (0.3, 1.1))] == [
            True, True, False, None, None]


def test_scatter_between_levels_is_no_growth_of_sigma():
    """Levels with a scatter of 0.3 in ln sigma, known to 2 % each, beside a growth by 8."""
    # Of 400 drawings 8.5 % differ without growth (the scatter has 6 degrees of freedom) and 99 %
    # with it; the bounds are three standard deviations away.
    rng, u, found = np.random.default_rng(1), np.linspace(0.1, 0.8, 8), []
    for grows in (0.0, 3.0):
        for _ in range(200):
            levels = [replace(
                estimate(60.0, 0.1), throttle=x, sigma_se=0.02,
                sigma=math.exp(grows * x + 0.3 * z)) for x, z in zip(u, rng.standard_normal(8))]
            found.append(sigma_change(levels[0], levels[-1], levels[1:-1]).differs is True)
    assert np.mean(found[:200]) < 0.145 and np.mean(found[200:]) > 0.96
