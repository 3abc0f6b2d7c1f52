"""Types of process: each is named by its test."""

from dataclasses import replace
import math

from ou_monitor.analysis.level_result import classify, detectable_kurtosis, ProcessType
from ou_monitor.analysis.level_tests import EFFECT, examine_level, Shape, TestResult
from ou_monitor.records import Estimate, Status
import pytest
from scipy import stats

USABLE = Estimate(alpha=63.0, sigma=0.3, var_inf=7e-4, u0=5.0, alpha_se=0.1, sigma_se=0.1,
                  var_inf_se=0.1, noise_std=0.0, status=Status.OK, n=10000, duration=10.0,
                  rate=1000.0)
WHITE = Estimate(status=Status.NO_RELAXATION, rate=1000.0)


def shape(*rejecting, n=10000, undone=()):
    """Return tests of which those named reject, or could not be done."""
    tests = []
    for name in EFFECT:
        p = 1e-9 if name in rejecting else 0.5
        tests.append(TestResult(name, why_not='Steps of the ADC hide it.') if name in undone
                     else TestResult(name, p, 2.0, min(1.0, 10.0 * p)))
    return Shape(tuple(tests), n, 0.1, 2.0, 7, (0.7, 0.3, 1.4))


@pytest.mark.parametrize('estimate, tests, kind', [
    (USABLE, shape('correlated'), ProcessType.DIFFUSION),
    (USABLE, shape('correlated', 'impulses', 'gaussian'), ProcessType.IMPULSES),
    (USABLE, shape('correlated', 'gaussian'), ProcessType.NOT_GAUSSIAN),
    (USABLE, shape('correlated', 'one_relaxation'), ProcessType.STATIONARY),
    (USABLE, shape('correlated', 'mean_drift', 'impulses'), ProcessType.QUASI_STATIONARY),
    (USABLE, shape('correlated', 'variance_drift'), ProcessType.QUASI_STATIONARY),
    (USABLE, shape('correlated', undone=('impulses', 'gaussian')), ProcessType.UNDETERMINED),
    (USABLE, shape('correlated', n=300), ProcessType.UNDETERMINED),
    (USABLE, shape(), ProcessType.GAUSSIAN),
    (replace(USABLE, alpha=2000.0), shape('correlated'), ProcessType.GAUSSIAN),
    (replace(USABLE, noise_std=0.03), shape('correlated'), ProcessType.GAUSSIAN),
    (replace(USABLE, noise_std=0.02), shape('correlated'), ProcessType.DIFFUSION),
    (WHITE, shape(), ProcessType.GAUSSIAN),
    (WHITE, shape('correlated'), ProcessType.STATIONARY),
    (WHITE, examine_level([], WHITE), ProcessType.UNDETERMINED),
    (Estimate(status=Status.CONSTANT), shape(), ProcessType.CONSTANT),
    (Estimate(status=Status.TOO_SHORT), shape('correlated'), ProcessType.UNDETERMINED),
])
def test_each_kind_has_its_reason(estimate, tests, kind):
    """The first rule that applies decides, and says why."""
    found = classify(estimate, tests)
    assert found.kind is kind
    assert found.sentence.endswith('.') and not found.sentence.endswith('..')


def test_a_changing_level_keeps_its_process_type():
    assert classify(USABLE, shape('correlated', 'mean_drift')).within is ProcessType.DIFFUSION
    assert classify(USABLE, shape('mean_drift', 'impulses')).within is ProcessType.IMPULSES


def test_lines_that_carry_most_of_the_variance_are_no_relaxation():
    assert classify(USABLE, shape('correlated'), 0.6).kind is ProcessType.STATIONARY
    assert classify(USABLE, shape('correlated'), 0.4).kind is ProcessType.DIFFUSION


def test_a_rejection_without_consequence_does_not_count():
    """An effect of 0.01 with p = 1e-9 is none."""
    small = replace(shape('correlated'), tests=tuple(
        replace(test, p_adjusted=1e-9, effect=0.01) if test.name == 'variance_drift' else test
        for test in shape('correlated').tests))
    assert classify(USABLE, small).kind is ProcessType.DIFFUSION


def test_visible_kurtosis_is_what_the_test_sees():
    assert detectable_kurtosis(0) == math.inf
    n = next(n for n in range(50, 2000) if detectable_kurtosis(n) < 1.0)
    assert n == pytest.approx(24.0 * (stats.norm.isf(0.005) + stats.norm.isf(0.1)) ** 2, abs=2)
