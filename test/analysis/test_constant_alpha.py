"""The test of a common alpha at all loads: false alarms, power, and undecided cases."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.level_result import fit_all
from ou_monitor.analysis.level_tests import alpha_constancy, sigma_change, SigmaChange
from ou_monitor.analysis.levels import LoadLevel
from ou_monitor.analysis.supply import remainder
from ou_monitor.records import Estimate, Status
import pytest
from scipy import stats
from simulated_recordings import ALPHA, fitted, recording

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
