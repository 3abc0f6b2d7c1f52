"""From a fit to published values: each limit from both sides, and when they are unknown."""

from dataclasses import replace
import math

from hypothesis import given, strategies as st
import numpy as np
from ou_monitor.analysis.analyze import analyze, as_data
from ou_monitor.analysis.level_tests import alpha_constancy, sigma_change
from ou_monitor.online.estimator.fit import FitEnd, WindowFit
from ou_monitor.online.estimator.quality import input_flags, judge, log_errors, Quality
from ou_monitor.records import (
    Counters, Estimate, Flag, LARGEST_FACTOR, LARGEST_LOG_SE, Recording, Status)
from ou_monitor.report.analysis_document import analysis_document
from ou_monitor.report.terminal import terminal
import pytest
from simulated_windows import estimate


NAN = math.nan
FIT = WindowFit(FitEnd.FOUND, 63.0, 0.632, 25e-6, 5.0, (0.016, 0.001, 0.016),
                np.array([5.0]), np.empty(0), np.empty((0, 0)), False, 2000, 0.063, 1.5)
BASE = {'t': 2.0, 'voltage': 5.0, 'throttle': NAN, 'n': 2000, 'duration': 2.0, 'rate': 1000.0,
        'counters': Counters()}
CLEAN = Quality(0.0, 1, False, 0.02)


def judged(fit=FIT, base=BASE, quality=CLEAN, throttle_std=NAN, smoothness=NAN, **changes):
    return judge(replace(fit, **changes), base, quality, throttle_std, smoothness)


def test_bias_is_taken_off_alpha_and_variance():
    e = judged()
    assert e.alpha == pytest.approx(63.0 - 1.5 / 2.0)
    assert (e.sigma, e.noise_std) == (0.632, pytest.approx(5e-3))
    assert e.var_inf == pytest.approx(0.632 ** 2 / (2.0 * e.alpha))
    assert e.u0_se == pytest.approx(math.sqrt(2.0 * e.var_inf / (e.alpha * 2.0)))
    assert (e.status, e.flags) == (Status.OK, ())


def test_errors_widen_in_short_windows():
    """By 1 + 1.5/x + 70/x^2 at x = 10 (1.85) and 126; the one of sigma does not."""
    for alpha, wider in ((5.0, 1.85), (63.0, 1.0 + 1.5 / 126.0 + 70.0 / 126.0 ** 2)):
        errors = log_errors(replace(FIT, alpha=alpha), 2.0)
        assert errors[0] == errors[2] == pytest.approx(math.sqrt(0.016) * wider, rel=1e-3)
        assert errors[1] == pytest.approx(math.sqrt(0.001), rel=1e-6)


@pytest.mark.parametrize('score, share', [(0.0, 0.68), (0.75, 0.806), (3.0, 1.0)])
def test_error_of_sigma_beside_no_noise(score, share):
    """A normal cut in half has 0.68 of the variance; the zone ends within 0.75 errors."""
    got = log_errors(replace(FIT, noise_score=score), 2.0)[1]
    assert got ** 2 / 0.001 == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize('found, status', [
    (0.4, Status.UNBOUND), (0.6, Status.TOO_SHORT), (6.2, Status.TOO_SHORT),
    (6.7, Status.SHORT_WINDOW)])
def test_too_few_relaxations(found, status):
    """ln(alpha) known to sqrt(2/x) (1 + 1.5/x + 70/x^2), x fitted; 1.5 fewer are published."""
    e = judged(alpha=(found + 1.5) / 2.0, log_var=(2.0 / (found + 1.5), 1e-6, 1e-6))
    assert e.status is status
    assert math.isnan(e.alpha) == (status is not Status.SHORT_WINDOW) and e.sigma == 0.632


@pytest.mark.parametrize('found, status', [(24.9, Status.SHORT_WINDOW), (25.3, Status.OK)])
def test_enough_relaxations_are_needed(found, status):
    """With a standard error of nearly nothing; published ones are 1.5 fewer than fitted."""
    e = judged(alpha=(found + 1.5) / 2.0, log_var=(1e-6, 1e-6, 1e-6))
    assert e.status is status
    assert e.alpha * 2.0 == pytest.approx(found)


def test_one_standard_error_is_granted():
    for se, status in ((0.3, Status.OK), (0.45, Status.SHORT_WINDOW)):
        assert judged(alpha=41.5 / 2.0, log_var=(se ** 2, 1e-3, se ** 2)).status is status


@pytest.mark.parametrize('alpha, se, buried', [
    (63.0, 0.49, False), (63.0, 0.51, True), (5.0, 0.95, False), (5.0, 1.0, True)])
def test_a_relaxation_below_half_a_nat_is_buried(alpha, se, buried):
    """Half a nat; in short windows (8.5 relaxations: 0.485) twice what the length makes."""
    assert (judged(alpha=alpha, log_var=(se ** 2, 0.1, se ** 2)).status is Status.BURIED) == buried


def test_no_relaxation_keeps_what_is_known():
    e = judged(outcome=FitEnd.UNCORRELATED, alpha=NAN, sigma=NAN)
    assert e.status is Status.NO_RELAXATION
    assert (e.u0, e.noise_std) == (5.0, pytest.approx(5e-3))
    assert math.isnan(e.alpha) and math.isnan(e.sigma)
    assert judged(outcome=FitEnd.UNBOUND, alpha=0.1).status is Status.UNBOUND


@pytest.mark.parametrize('smoothness, n, told', [
    (0.04, 10 ** 6, False), (0.06, 10 ** 6, True), (0.10, 2000, False), (0.12, 2000, True),
    (NAN, 2000, False)])
def test_a_low_pass_is_told_by_its_own_error(smoothness, n, told):
    """Above 0.05, and above five standard errors (0.112 for 2000 samples)."""
    assert (Flag.LOWPASS_UPSTREAM in judged(smoothness=smoothness, n=n).flags) == told


@pytest.mark.parametrize('std, told', [(0.0, True), (0.0045, True), (0.0055, False), (NAN, False)])
def test_jitter_of_a_stick_excites_nothing(std, told):
    """Half a percent of full scale is jitter of a stick."""
    assert (Flag.NO_EXCITATION in input_flags(Counters(), CLEAN, std)) == told


NAMES = ('alpha', 'sigma', 'var_inf')
# Standard errors of a logarithm, as an ill-conditioned fit may have them.
ERRORS = st.one_of(st.just(NAN), st.floats(min_value=0.0))
POSITIVE = st.floats(min_value=1e-300, max_value=1e300)


def nearly_white(seed: int) -> Recording:
    """Return samples at uneven times, almost uncorrelated: the fit says next to nothing."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(40, 300))
    phi = rng.uniform(0.0, 0.15)
    w = rng.standard_normal(n + 1)
    v = np.round((5.0 + 0.03 * (w[1:] + phi * w[:-1])) / 1.6e-3) * 1.6e-3
    return Recording(np.arange(n) / 100.0 + rng.uniform(-0.003, 0.003, n), v, np.full(n, 0.5))


@pytest.mark.parametrize('seed', [3, 74, 122])
def test_a_nearly_white_rail_is_analysed(seed):
    """Relative errors of 8e4 to 3e5: no traceback, and no sigma in the text or the JSON."""
    analysis = analyze(nearly_white(seed))
    (level,) = as_data(analysis)['levels']
    assert math.isnan(level['sigma']) and np.isnan(level['sigma_ci95']).all()
    assert 'sigma =' not in terminal(analysis_document(analysis))


@given(value=POSITIVE, error=ERRORS)
def test_an_estimate_holds_what_is_known(value, error):
    e = Estimate(alpha=value, sigma=value, var_inf=value, u0=5.0, alpha_se=error, sigma_se=error,
                 var_inf_se=error, u0_se=0.01, status=Status.OK, rate=math.inf)
    # NaN: the error was not given.
    known = not error > LARGEST_LOG_SE
    assert e.usable == known and (e.status is Status.OK) == known
    for name in NAMES:
        low, high = e.interval(name)
        assert math.isfinite(getattr(e, name)) == known
        if known and not math.isnan(error):
            edge = LARGEST_FACTOR * (1.0 + 1e-12)
            assert value / edge <= low <= value <= high <= value * edge
        else:
            assert math.isnan(low) and math.isnan(high)


@given(z=st.floats(allow_nan=True, allow_infinity=True))
def test_an_interval_of_any_width(z):
    low, high = Estimate(alpha=3.0, alpha_se=0.5).interval('alpha', z=z)
    assert math.isnan(z) or z < 0.0 or (0.0 <= low <= 3.0 <= high)


@given(log_var=st.tuples(*3 * [st.floats()]), score=st.floats(min_value=0.0), alpha=POSITIVE,
       duration=st.floats(min_value=1e-9, max_value=1e9))
def test_any_information_is_judged(log_var, score, alpha, duration):
    """Singular, negative, infinite: what is usable is known to a factor of 10."""
    e = judged(base={**BASE, 'duration': duration}, alpha=alpha, noise_score=score,
               log_var=log_var)
    for name in NAMES:
        if math.isfinite(getattr(e, name)):
            assert getattr(e, name + '_se') <= LARGEST_LOG_SE


def test_both_sides_of_the_limit():
    """ln(10) / 1.96 = 1.175 is still known; what is wrong is said."""
    for factor, status in ((1.0 - 1e-9, Status.OK), (1.0 + 1e-9, Status.TOO_SHORT)):
        e = Estimate(alpha=3.0, sigma=1.0, var_inf=1.0, u0=5.0, alpha_se=factor * LARGEST_LOG_SE,
                     sigma_se=0.1, var_inf_se=0.3, status=Status.OK, rate=100.0)
        assert e.status is status and (e.sigma, e.var_inf) == (1.0, 1.0)
    assert Estimate(alpha=300.0, alpha_se=2.0, status=Status.OK,
                    rate=100.0).status is Status.NO_RELAXATION
    assert math.log(10.0) / 1.96 == pytest.approx(LARGEST_LOG_SE, rel=1e-4)


def test_a_ratio_follows_the_same_rule():
    """Of levels that are known and differ the ratio may not be: 30, 95 % 2.3 to 390."""
    levels = [Estimate(status=Status.OK, u0=5.0, rate=1e9, alpha=x, sigma=x, var_inf=1.0,
                       alpha_se=0.4, sigma_se=1.1, var_inf_se=0.4)
              for x in (1.0, math.sqrt(30.0), 30.0)]
    change = sigma_change(replace(levels[0], sigma=1e-5), levels[2])
    assert math.isnan(change.ratio) and change.differs and change.ratio_low > 1e4
    test = alpha_constancy([0.0, 0.5, 1.0], levels)
    assert test.ratio_high == pytest.approx(390.0, rel=0.01)
    assert test.verdict == 'differs' and math.isnan(test.ratio)
    assert 'factor that is not determined' in test.sentence


@pytest.mark.parametrize('seed', [3, 122])
def test_the_estimator_publishes_nothing_of_it(seed):
    recording = nearly_white(seed)
    e = estimate(recording.t, recording.voltage, window=10.0)
    assert e.status in (Status.BURIED, Status.NO_RELAXATION)
    assert all(math.isnan(getattr(e, name)) for name in NAMES)
