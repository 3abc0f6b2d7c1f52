"""Segments of one level: pooled when they agree, doubted when they do not."""

import math

from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.level_result import disagreement, fit_segment, pool
from ou_monitor.online.estimator.estimator import SlidingEstimator
from ou_monitor.records import Estimate, Status
import pytest
from simulated_recordings import ALPHA, recording


def one(alpha=63.0, se=0.1, duration=1.0, **changes):
    """Return a usable estimate."""
    values = {'alpha': alpha, 'sigma': 0.3, 'var_inf': 0.3 ** 2 / (2.0 * alpha),
              'alpha_se': se, 'sigma_se': 0.05, 'var_inf_se': 0.1, 'u0': 5.0, 'u0_se': 0.01,
              'status': Status.OK, 'n': 1000, 'duration': duration, 'rate': 1000.0}
    return Estimate(**{**values, **changes})


def test_a_segment_gets_the_estimator_that_flies():
    """All samples of the segment enter, and nothing else."""
    simulated = recording(1)
    e = fit_segment(simulated, 1000, 4000)
    node = SlidingEstimator(window=10.0)
    node.push(simulated.t[1000:4000], simulated.voltage[1000:4000], simulated.throttle[1000:4000])
    other = node.estimate()
    # Two windows cut the same samples into other slots: equal to rounding.
    for name in ('alpha', 'sigma', 'var_inf', 'u0', 'alpha_se', 'duration', 'rate'):
        assert getattr(e, name) == pytest.approx(getattr(other, name), rel=1e-9)
    assert (e.status, e.flags, e.n) == (other.status, other.flags, 3000)


def test_equal_segments_shrink_the_error_by_the_root_of_their_number():
    """The mean of equal logs, with se over sqrt(4)."""
    pooled, scatter = pool([one()] * 4)
    assert scatter == 1.0
    assert pooled.alpha == pytest.approx(63.0)
    assert pooled.alpha_se == pytest.approx(0.05)
    assert (pooled.n, pooled.duration) == (4000, 4.0)


def test_weights_are_the_durations():
    """Logs are averaged with weights 1 : 3."""
    pooled, _ = pool([one(60.0), one(70.0, duration=3.0)])
    assert math.log(pooled.alpha) == pytest.approx(0.25 * math.log(60) + 0.75 * math.log(70))


def test_pooling_does_not_favour_what_came_out_high():
    """
    Forty 1 s segments give back alpha within 4 standard errors of the truth.

    se(ln alpha) of 40 s is sqrt(2 / (63 * 40)) = 2.8 %.  Weights by each
    segment's own standard error would add about se^2 = 3 % a segment, which
    this alone cannot see; the weights are pinned by the test above.
    """
    simulated = recording(3, levels=((0.1, 0.3),), seconds=40.0)
    pooled, scatter = pool([fit_segment(simulated, k, k + 1000) for k in range(0, 40000, 1000)])
    assert abs(math.log(pooled.alpha / ALPHA)) < 4.0 * math.sqrt(2.0 / (ALPHA * 40.0))
    # The noise being unknown costs 8 %, the short segments 4 %.
    assert pooled.alpha_se == pytest.approx(1.12 * math.sqrt(2.0 / (ALPHA * 40.0)), rel=0.15)
    # sqrt(chi2 / 39): 1 +- 0.11.
    assert scatter < 1.5


def test_segments_that_differ_widen_the_interval():
    """Two alphas 10 standard errors apart are not one process."""
    pooled, scatter = pool([one(40.0, se=0.1), one(40.0 * math.exp(1.0), se=0.1)])
    # chi2 = 2 (0.5 / 0.1)^2 with one degree of freedom; Var_inf differs alike.
    assert scatter == pytest.approx(math.sqrt(50.0))
    assert pooled.alpha_se == pytest.approx(scatter * 0.1 / math.sqrt(2.0))


def test_most_segments_denying_relaxation_decide():
    """One lucky segment in four does not speak for the level."""
    denied = Estimate(status=Status.NO_RELAXATION, n=1000, duration=1.0, rate=1000.0)
    pooled, _ = pool([one(), denied, denied, denied])
    assert pooled.status is Status.NO_RELAXATION and math.isnan(pooled.alpha)


def test_a_segment_that_knows_nothing_has_no_say():
    """An alpha without information is left out, however long the segment."""
    vague = one(alpha=5000.0, se=9.0, duration=1.0)
    pooled, _ = pool([one(), one(), vague])
    assert pooled.alpha == pytest.approx(63.0)
    pooled, _ = pool([one(), vague, vague])
    assert pooled.status is Status.NO_RELAXATION


def test_one_segment_is_left_as_it_is():
    """Nothing is pooled, nothing doubted."""
    e = one(se=3.0)
    assert pool([e]) == (e, 1.0)


def test_nothing_to_pool_is_a_callers_bug():
    """No estimates: ValueError."""
    with pytest.raises(ValueError, match='no estimates'):
        pool([])


def test_segments_of_one_process_disagree_as_often_as_stated():
    """
    150 levels of three stays of 1 s, fitted: p < 5 % in at most 18, p < 1 % in at most 7.

    Binomials of 150 with 0.05 and 0.01 go beyond with probability 1e-4; the widening factor alone
    exceeds 1.5 in every fifth.  Stays of alpha 63 and 250 1/s do disagree.
    """
    p_values = []
    for seed in range(150):
        simulated = recording(9000 + seed, levels=((0.1, 0.3),), seconds=3.0)
        p_values.append(disagreement([fit_segment(simulated, k, k + 1000)
                                      for k in (0, 1000, 2000)]))
    assert sum(p < 0.05 for p in p_values) <= 18 and sum(p < 0.01 for p in p_values) <= 7
    assert disagreement([one(63.0), one(250.0)]) < 1e-6
    assert math.isnan(disagreement([one()])) and disagreement([one(), one()]) == 1.0


def test_not_one_process_is_said_of_what_differs_only():
    """Two stays of one level: with equal sigma rarely a word, with twice the sigma always."""
    said = 0
    for seed in range(30):
        simulated = recording(seed, ((0.1, 0.3), (0.4, 0.5), (0.1, 0.3)), seconds=2.0)
        said += any('not one process' in note for level in analyze_levels(simulated)
                    for note in level.notes)
    # A binomial of 30 and 0.01 exceeds 2 with probability 3e-3; without a test it was said of
    # every third.
    assert said <= 2
    simulated = recording(1, ((0.1, 0.3), (0.4, 0.5), (0.1, 0.6)), seconds=2.0)
    first, second = analyze_levels(simulated)
    assert any('not one process' in note for note in first.notes) and first.scatter_p < 0.01
    assert not second.notes and math.isnan(second.scatter_p)


def analyze_levels(simulated):
    """Return the levels of an analysis."""
    return analyze(simulated, brownout_voltage=math.nan).levels
