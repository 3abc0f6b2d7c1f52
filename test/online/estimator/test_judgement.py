"""From a fit to published values: each limit from both sides."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.online.estimator.fit import FitEnd, WindowFit
from ou_monitor.online.estimator.quality import input_flags, judge, log_errors, Quality
from ou_monitor.records import Counters, Flag, Status
import pytest

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


def test_slow_rate_and_trend():
    assert Flag.SLOW_RATE not in judged(alpha_step=0.99).flags
    assert Flag.SLOW_RATE in judged(alpha_step=1.01).flags
    assert judged(trend=True).flags == (Flag.TREND,)


@pytest.mark.parametrize('std, told', [(0.0, True), (0.0045, True), (0.0055, False), (NAN, False)])
def test_jitter_of_a_stick_excites_nothing(std, told):
    """Half a percent of full scale is jitter of a stick."""
    assert (Flag.NO_EXCITATION in input_flags(Counters(), CLEAN, std)) == told


@pytest.mark.parametrize('quality, counters, flag', [
    (Quality(0.021, 1, False, 0.02), Counters(), Flag.QUANTIZED),
    (Quality(0.0, 2, False, 0.02), Counters(), Flag.HELD_SAMPLES),
    (Quality(0.0, 1, True, 0.02), Counters(), Flag.SATURATED),
    (CLEAN, Counters(late=1), Flag.IRREGULAR), (CLEAN, Counters(non_finite=1), Flag.IRREGULAR)])
def test_flags_follow_counters_and_quality(quality, counters, flag):
    assert input_flags(counters, quality, NAN) == [flag]
    assert input_flags(Counters(), Quality(0.019, 1, False, 0.02), NAN) == []
