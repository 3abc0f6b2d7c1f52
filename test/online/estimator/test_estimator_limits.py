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
    """Too few to tell the rate from, some of them older than the window."""
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


def batches(t, y=None, window=1.0, intake=None, u=None):
    intake = intake or TimeLine()
    t = np.asarray(t, dtype=float)
    intake.put(t, np.zeros(t.size) if y is None else np.asarray(y, dtype=float), u)
    return intake.flush(window), intake


def taken(thinner, t, y=None, u=None, window=1e9):
    """Return what a thinner keeps of clean samples."""
    got, _ = batches(t, y, window)
    assert len(got) == 1
    return thinner.take(got[0])


def test_throttle_does_not_leak_into_the_next_batch():
    intake = TimeLine()
    got, _ = batches([0.0, 0.1], intake=intake, u=0.7)
    assert got[0].columns[2].tolist() == [0.7, 0.7]
    intake.put(np.array([0.2]), np.zeros(1), 0.1)
    intake.put(np.array([0.3]), np.zeros(1), None)
    u = intake.flush(1.0)[0].columns[2]
    assert u[0] == 0.1 and math.isnan(u[1])
    got, _ = batches([0.4], intake=intake)
    assert np.isnan(got[0].columns[2]).all()


def test_any_array_of_doubles_is_copied():
    """Strided, reversed, read-only, unaligned, repeated and empty ones."""
    plain = np.arange(1.0, 5.0)
    records = np.zeros(4, dtype=[('pad', 'i1'), ('y', 'f8')])
    records['y'] = plain
    fixed = plain.copy()
    fixed.setflags(write=False)
    for y in (np.repeat(plain, 3)[::3], plain[::-1].copy()[::-1], fixed, records['y']):
        intake = TimeLine()
        intake.put(np.empty(0), np.empty(0), np.empty(0))
        intake.put(0.1 * plain, y, y)
        intake.put(0.1 * plain + 1.0, np.broadcast_to(2.0, 4), np.broadcast_to(0.5, 4))
        batch = intake.flush(2.0)[0]
        assert batch.y.tolist() == [1.0, 2.0, 3.0, 4.0, 2.0, 2.0, 2.0, 2.0]
        assert batch.columns[2].tolist() == [1.0, 2.0, 3.0, 4.0, 0.5, 0.5, 0.5, 0.5]


def test_blocks_do_not_reach_across_a_gap():
    thinner = BlockAverager(1e4)
    t = np.concatenate([np.arange(105), 1000 + np.arange(100)]) * 1e-5
    kept = taken(thinner, t, np.r_[np.zeros(105), np.ones(100)])
    assert kept[0][1].tolist() == [0.0] * 10 + [1.0] * 10


def test_block_size_that_changes_restarts():
    """From 100 kHz to 1 MHz blocks of ten become blocks of a hundred."""
    thinner = BlockAverager(1e4)
    intake = TimeLine()
    kept = thinner.take(batches(np.arange(1000) * 1e-5, intake=intake)[0][0])
    assert not kept[1] and thinner.m == 10
    kept = thinner.take(batches(0.01 + np.arange(1000) * 1e-6, intake=intake)[0][0])
    assert kept[1] and thinner.m == 100
