"""From pushes to clean batches, and from fast sources to block means."""

import math

import numpy as np
from ou_monitor.online.estimator.window import Thinner
from ou_monitor.timeline.line import TimeLine


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


def test_blocks_do_not_reach_across_a_gap():
    """What is left before it is left out."""
    thinner = Thinner(1e4)
    t = np.concatenate([np.arange(105), 1000 + np.arange(100)]) * 1e-5
    kept = taken(thinner, t, np.r_[np.zeros(105), np.ones(100)])
    assert kept[0][1].tolist() == [0.0] * 10 + [1.0] * 10


def test_block_size_that_changes_restarts():
    """From 100 kHz to 1 MHz blocks of ten become blocks of a hundred."""
    thinner = Thinner(1e4)
    intake = TimeLine()
    kept = thinner.take(batches(np.arange(1000) * 1e-5, intake=intake)[0][0])
    assert not kept[1] and thinner.m == 10
    kept = thinner.take(batches(0.01 + np.arange(1000) * 1e-6, intake=intake)[0][0])
    assert kept[1] and thinner.m == 100
