"""Limits inside the estimator, each from both sides, and its block means."""

import math

import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.online.estimator.estimator import BlockAverager
from ou_monitor.records import Flag, Status
from ou_monitor.timeline import TimeLine
import pytest
from simulated_windows import ALPHA, LEVEL, paths, SIGMA, stamps


def test_repeats_of_a_fast_source_are_seen_before_it_is_thinned():
    """Each value twice at 20 kHz: nothing is cleared to drop them, half of all are held."""
    n = 10_000
    y = np.repeat(paths(np.random.default_rng(6), 1, n // 2, 1e-4)[0], 2)
    estimator = SlidingEstimator(1.0)
    estimator.push(stamps(n, 5e-5), y)
    e = estimator.estimate()
    assert e.counters.resets == 0 and Flag.HELD_SAMPLES in e.flags
    assert e.counters.held == pytest.approx(n / 2, abs=2) and e.n == pytest.approx(n / 2, abs=2)


@pytest.mark.parametrize('since, told', [(1600, False), (1000, True)])
def test_quality_is_that_of_the_newest_thousand(since, told):
    """A clipped stretch of 400 samples that began before them is past."""
    y = paths(np.random.default_rng(7), 1, 2000)[0]
    low = 2000 - since
    y[low:low + 400] = np.minimum(y[low:low + 400], LEVEL)
    y[low:low + 400] = np.where(y[low:low + 400] == LEVEL, y.max() + 0.01, y[low:low + 400])
    estimator = SlidingEstimator(2.1)
    estimator.push(stamps(2000), y)
    assert (Flag.SATURATED in estimator.estimate().flags) is told


@pytest.mark.parametrize('window, step, n', [(2.0, 1.0, 3), (0.5, 1.0, 1)])
def test_what_waits_for_the_rate_is_that_of_the_window(window, step, n):
    estimator = SlidingEstimator(window)
    for j in range(6):
        estimator.push(j * step, 5.0)
        e = estimator.estimate()
        assert e.status is Status.TOO_FEW_SAMPLES
        assert e.duration <= window and e.n == min(j + 1, n)


def test_trends_are_few_where_there_is_none_and_seen_where_there_is():
    """Measured: 5 % of random walks, 0.7 % of windows of six relaxations."""
    # The limits are those, plus three standard errors of 400 windows. A drift of 8 standard
    # deviations is seen in 92 of 100 windows of 25 relaxations, less three errors, and in 60 of
    # 100 of 13, give or take three errors of 300.
    rng = np.random.default_rng(9)
    walks = LEVEL + np.cumsum(0.01 * rng.standard_normal((400, 200)), axis=1)
    drift = 8.0 * SIGMA / math.sqrt(2.0 * ALPHA)

    def share(windows):
        told = 0
        for y in windows:
            estimator = SlidingEstimator(1.0)
            estimator.push(stamps(y.size), y)
            told += Flag.TREND in estimator.estimate().flags
        return told / len(windows)

    assert share(walks) <= 0.085
    assert share(paths(rng, 400, 100)) <= 0.02
    assert share(paths(rng, 100, 400) + drift * np.arange(400) / 400) >= 0.84
    assert share(paths(rng, 300, 200) + drift * np.arange(200) / 200) == pytest.approx(
        0.6, abs=0.086)


def taken(thinner, t, y, intake=None):
    """Return what a thinner keeps of clean samples."""
    intake = intake or TimeLine()
    intake.put(t, y, None)
    (got,) = intake.flush(1e9)
    return thinner.take(got)


def test_blocks_do_not_reach_across_a_gap():
    thinner = BlockAverager(1e4)
    t = np.concatenate([np.arange(105), 1000 + np.arange(100)]) * 1e-5
    kept = taken(thinner, t, np.r_[np.zeros(105), np.ones(100)])
    assert kept[0][1].tolist() == [0.0] * 10 + [1.0] * 10


def test_block_size_that_changes_restarts():
    """From 100 kHz to 1 MHz blocks of ten become blocks of a hundred."""
    thinner = BlockAverager(1e4)
    intake = TimeLine()
    for begin, step, m in ((0.0, 1e-5, 10), (0.01, 1e-6, 100)):
        kept = taken(thinner, begin + step * np.arange(1000), np.zeros(1000), intake)
        assert kept[1] == (m == 100) and thinner.m == m
