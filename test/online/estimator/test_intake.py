"""From pushes to clean batches, and from fast sources to block means."""

import copy
import math

import numpy as np
from ou_monitor.online.estimator.window import Thinner
from ou_monitor.timeline.line import BATCH, TimeLine
import pytest

DT = 1e-3


def batches(t, y=None, window=1.0, intake=None, u=None):
    """Return the batches of one push, and the intake."""
    intake = intake or TimeLine()
    t = np.asarray(t, dtype=float)
    assert intake.put(t, np.zeros(t.size) if y is None else np.asarray(y, dtype=float), u)
    return intake.work_off(window), intake


def taken(thinner, t, y=None, u=None, window=1e9):
    """Return what a thinner keeps of clean samples."""
    got, _ = batches(t, y, window)
    assert len(got) == 1
    return thinner.take(got[0])


def test_room_is_limited():
    """A full buffer refuses, and has not changed."""
    intake = TimeLine()
    assert intake.put(np.zeros(BATCH - 1), np.zeros(BATCH - 1), None)
    assert not intake.put(np.zeros(2), np.zeros(2), None)
    assert intake.waiting == BATCH - 1
    assert intake.put_one(0.0, 0.0, None) and not intake.put_one(0.0, 0.0, None)
    # Overhead per call vanishes, and a megabyte stays in the cache.
    assert 8192 <= BATCH <= 65536


def test_throttle_does_not_leak_into_the_next_batch():
    intake = TimeLine()
    got, _ = batches([0.0, 0.1], intake=intake, u=0.7)
    assert got[0].u.tolist() == [0.7, 0.7]
    intake.put(np.array([0.2]), np.zeros(1), 0.1)
    intake.put(np.array([0.3]), np.zeros(1), None)
    u = intake.work_off(1.0)[0].u
    assert u[0] == 0.1 and math.isnan(u[1])
    got, _ = batches([0.4], intake=intake)
    assert got[0].u is None or np.isnan(got[0].u).all()


def test_any_array_of_doubles_is_copied():
    """Strided, reversed, read-only, unaligned, repeated and empty ones."""
    plain = np.arange(1.0, 5.0)
    records = np.zeros(4, dtype=[('pad', 'i1'), ('y', 'f8')])
    records['y'] = plain
    fixed = plain.copy()
    fixed.setflags(write=False)
    for y in (np.repeat(plain, 3)[::3], plain[::-1].copy()[::-1], fixed, records['y']):
        intake = TimeLine()
        assert intake.put(np.empty(0), np.empty(0), np.empty(0))
        assert intake.put(0.1 * plain, y, y)
        assert intake.put(0.1 * plain + 1.0, np.broadcast_to(2.0, 4), np.broadcast_to(0.5, 4))
        batch = intake.work_off(2.0)[0]
        assert batch.y.tolist() == [1.0, 2.0, 3.0, 4.0, 2.0, 2.0, 2.0, 2.0]
        assert batch.u.tolist() == [1.0, 2.0, 3.0, 4.0, 0.5, 0.5, 0.5, 0.5]


def test_a_copy_has_buffers_of_its_own():
    """Both go on from what had been pushed, apart."""
    intake = TimeLine()
    intake.put(np.array([0.1]), np.array([1.0]), None)
    other = copy.deepcopy(intake)
    intake.put(np.array([0.2]), np.array([2.0]), None)
    other.put(np.array([0.3]), np.array([3.0]), 0.5)
    assert intake.work_off(1.0)[0].y.tolist() == [1.0, 2.0]
    batch = other.work_off(1.0)[0]
    assert batch.y.tolist() == [1.0, 3.0] and batch.t.tolist() == [0.1, 0.3]
    assert math.isnan(batch.u[0]) and batch.u[1] == 0.5


@pytest.mark.parametrize('t, parts, resets, late', [
    ([0.0, 0.1, 0.2], [[0.0, 0.1, 0.2]], 0, 0),
    ([0.0, 0.2, 0.1, 0.2], [[0.0, 0.1, 0.2]], 0, 1),
    ([0.0, 0.1, 9.0, 9.1], [[0.0, 0.1], [9.0, 9.1]], 1, 0),
    ([5.0, 5.1, 0.0, 0.1], [[5.0, 5.1], [0.0, 0.1]], 1, 0),
    ([0.0, 9.0, 0.1, 0.2], [[0.0], [9.0], [0.1, 0.2]], 2, 0),
    ([0.0, 1.0, 2.0, 3.0], [[0.0, 1.0, 2.0, 3.0]], 0, 0)])
def test_order_jumps_and_repeats(t, parts, resets, late):
    """With a window of 1 s: steps back or pauses beyond it start anew."""
    got, intake = batches(t)
    assert [b.t.tolist() for b in got] == parts
    assert [b.restart for b in got] == [False] + [True] * (len(parts) - 1)
    c = intake.counters
    assert (c.resets, c.late, c.used) == (resets, late, len(t) - late)
    for b in got:
        assert (np.diff(b.t) > 0.0).all()


def test_late_for_an_earlier_batch():
    """All of them are dropped, not the first alone."""
    _, intake = batches([0.0, 0.1, 0.2, 0.3])
    got, _ = batches([0.05, 0.15, 0.25, 0.3], intake=intake)
    assert got == [] and intake.counters.late == 4 and intake.newest == 0.3
    got, _ = batches([0.4, 0.15, 0.25, 0.5], intake=intake)
    assert [b.t.tolist() for b in got] == [[0.4, 0.5]] and intake.counters.late == 6


def test_rate_needs_eight_samples():
    """Until then samples wait; then all come at once."""
    thinner = Thinner(1e4)
    t = np.arange(12) * DT
    kept = taken(thinner, t[:7])
    assert kept[0].size == 0 and thinner.waiting(-1.0).size == 7
    kept = taken(thinner, t[7:8])
    assert kept[0].tolist() == t[:8].tolist() and thinner.waiting(-1.0).size == 0
    assert thinner.m == 1 and thinner.step == pytest.approx(DT)


@pytest.mark.parametrize('rate, m', [(1e3, 1), (1.4e4, 1), (2e4, 2), (1e5, 10), (1e6, 100)])
def test_blocks_are_means_of_stamps_and_volts(rate, m):
    """Whatever does not fill a block waits for the next push."""
    thinner = Thinner(1e4)
    t = np.arange(1050) / rate
    y = np.sin(np.arange(1050.0))
    parts = [taken(thinner, t[a:b], y[a:b]) for a, b in ((0, 333), (333, 334), (334, 1050))]
    assert thinner.m == m
    whole = 1050 // m
    for row, values in ((0, t), (1, y)):
        got = np.concatenate([np.atleast_1d(p[row]) for p in parts])
        assert got == pytest.approx(values[:whole * m].reshape(whole, m).mean(axis=1), abs=1e-12)
    breaks = [p[3].tolist() for p in parts]
    assert breaks[0] == [0] and breaks[1:] == [[], []]


def test_blocks_do_not_reach_across_a_gap():
    """What is left before it is left out."""
    thinner = Thinner(1e4)
    t = np.concatenate([np.arange(105), 1000 + np.arange(100)]) * 1e-5
    kept = taken(thinner, t, np.r_[np.zeros(105), np.ones(100)])
    assert kept[1].tolist() == [0.0] * 10 + [1.0] * 10
    assert kept[3].tolist() == [0, 10]


@pytest.mark.parametrize('factor, broken', [(0.4, True), (0.6, False), (1.4, False), (1.6, True)])
def test_uneven_steps_break_runs(factor, broken):
    """A step off by more than half is not one step."""
    thinner = Thinner(1e4)
    t = np.arange(100) * DT
    t[60:] += (factor - 1.0) * DT
    assert taken(thinner, t)[3].tolist() == ([0, 60] if broken else [0])


def test_a_gap_between_pushes_breaks_runs():
    thinner = Thinner(1e4)
    intake = TimeLine()
    for begin, expected in ((0.0, [0]), (0.1, []), (0.3, [0])):
        got, _ = batches(begin + np.arange(100) * DT, intake=intake)
        assert thinner.take(got[0])[3].tolist() == expected


@pytest.mark.parametrize('factor, learnt', [(1.2, False), (1.45, False), (1.7, True), (3.0, True)])
def test_a_new_rate_is_learnt_when_steps_are_off(factor, learnt):
    """Steps within half of the usual are jitter; beyond, the median of a batch counts."""
    thinner = Thinner(1e4)
    intake = TimeLine()
    thinner.take(batches(np.arange(100) * DT, intake=intake)[0][0])
    thinner.take(batches(0.1 + np.arange(100) * DT * factor, intake=intake)[0][0])
    assert thinner.step == pytest.approx(factor * DT if learnt else DT)


@pytest.mark.parametrize('factor, learnt', [(1.2, False), (1.45, True)])
def test_a_slightly_other_rate_is_the_same(factor, learnt):
    """A gap makes the rate looked at; below 1.3 times the usual step it is kept."""
    thinner = Thinner(1e4)
    intake = TimeLine()
    thinner.take(batches(np.arange(100) * DT, intake=intake)[0][0])
    thinner.take(batches(0.2 + np.arange(300) * DT * factor, intake=intake)[0][0])
    assert thinner.step == pytest.approx(factor * DT if learnt else DT)


def test_a_lone_gap_does_not_change_the_rate():
    thinner = Thinner(1e4)
    intake = TimeLine()
    thinner.take(batches(np.arange(100) * DT, intake=intake)[0][0])
    thinner.take(batches([0.5], intake=intake)[0][0])
    thinner.take(batches([0.9], intake=intake)[0][0])
    assert thinner.step == pytest.approx(DT)


def test_block_size_that_changes_restarts():
    """From 100 kHz to 1 MHz blocks of ten become blocks of a hundred."""
    thinner = Thinner(1e4)
    intake = TimeLine()
    kept = thinner.take(batches(np.arange(1000) * 1e-5, intake=intake)[0][0])
    assert not kept[4] and thinner.m == 10
    kept = thinner.take(batches(0.01 + np.arange(1000) * 1e-6, intake=intake)[0][0])
    assert kept[4] and thinner.m == 100
