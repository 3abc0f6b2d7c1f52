"""The time line of samples that travel in blocks."""

import numpy as np
from ou_monitor.stream.samples import BlockClock, FOLLOW
import pytest

RATE = 10_000.0
N = 100
LENGTH = N / RATE


def run(ends, clock=None, n=N):
    """Return the stamps of all blocks, one after another."""
    clock = clock or BlockClock(RATE)
    return clock.stamps(np.array(ends), np.broadcast_to(n, len(ends)))


def test_jitter_of_stamps_does_not_reach_the_samples():
    """Arrival 0..8 ms late leaves an even spacing, within the lean of 8 ms over FOLLOW."""
    rng = np.random.default_rng(3)
    ends = LENGTH * np.arange(1, 3001) + rng.uniform(0.0, 8e-3, 3000)
    clock = BlockClock(RATE)
    t = run(ends, clock)
    step = np.diff(t) * RATE
    # The correction of one block is at most error * length / FOLLOW, spread
    # over the block: relative 8 ms / FOLLOW; rounding of t at 30 s adds 4e-11.
    assert np.abs(step - 1.0).max() < 8e-3 / FOLLOW * 1.01 + 1e-10
    assert clock.gaps == 0
    # It does lean on the stamps: the mean delay is 4 ms, reached within 3 FOLLOW.
    assert t[-1] - 3000 * LENGTH == pytest.approx(4e-3, abs=1e-3)


@pytest.mark.parametrize('drift', [1e-4, -1e-4])
def test_drift_is_followed(drift):
    """A clock wrong by 100 ppm is followed at a lag of drift * FOLLOW, not left behind."""
    blocks = round(100.0 / LENGTH)
    ends = LENGTH * (1.0 + drift) * np.arange(1, blocks + 1)
    clock = BlockClock(RATE)
    t = run(ends, clock)
    assert clock.gaps == 0
    # After 10 FOLLOW the lag is settled to exp(-10); unfollowed it would be 10 ms.
    assert ends[-1] - t[-1] == pytest.approx(drift * FOLLOW, rel=1e-2)
    settled = np.diff(t[-1000:]) * RATE - 1.0
    np.testing.assert_allclose(settled, drift, rtol=1e-2)


@pytest.mark.parametrize('gap', [0.255, 0.5, -0.3])
def test_a_gap_is_kept(gap):
    """Beyond max(2 blocks, 0.25 s) the time line restarts at the stamp."""
    ends = LENGTH * np.arange(1, 21)
    ends[10:] += gap
    clock = BlockClock(RATE)
    t = run(ends, clock).reshape(20, N)
    assert clock.gaps == 1
    assert t[10, 0] - t[9, -1] == pytest.approx(gap + 1 / RATE, abs=1e-9)
    np.testing.assert_allclose(t[:, -1], ends, rtol=0, atol=1e-9)


def test_two_long_blocks_are_not_a_gap():
    """With blocks of 200 ms a difference of 350 ms is jitter, 450 ms is not."""
    for late, gaps in ((0.35, 0), (0.45, 1)):
        clock = BlockClock(1000.0)
        run([0.2, 0.4 + late], clock, n=200)
        assert clock.gaps == gaps


def test_blocks_of_any_length():
    clock = BlockClock(1000.0)
    t = run([0.010, 0.010, 0.013], clock, n=[10, 0, 3])
    np.testing.assert_allclose(t, np.arange(1, 14) / 1000.0, rtol=0, atol=1e-12)


def test_a_clock_since_1970_is_as_accurate():
    """Adding up must not collect the rounding of large stamps: one of 2^-22 s remains."""
    ends = 1_704_067_200.0 + LENGTH * np.arange(1, 2001)
    t = run(ends)
    exact = np.arange(1, 2000 * N + 1) / RATE
    assert np.abs(t - 1_704_067_200.0 - exact).max() <= 1.02 * 2.0**-22


def test_a_reset_starts_a_new_time_line():
    clock = BlockClock(RATE)
    run([100.0], clock)
    clock.reset()
    assert run([1.0], clock)[-1] == 1.0
    assert clock.gaps == 0


@pytest.mark.parametrize('rate', [0.0, -1.0, float('nan'), float('inf')])
def test_wrong_rates_are_refused(rate):
    with pytest.raises(ValueError, match='Hz'):
        BlockClock(rate)


def test_wrong_stamps_are_refused():
    with pytest.raises(ValueError, match='finite'):
        run([float('nan')], n=1)
    with pytest.raises(ValueError, match='-1'):
        run([1.0], n=-1)


@pytest.mark.parametrize('lengths', [[100], [100, 100, 7, 0, 1, 250]])
def test_many_blocks_at_once_equal_single_ones(lengths):
    """The same bits as one by one, over gaps and batches, and the same gaps counted."""
    rng = np.random.default_rng(5)
    n = np.array(lengths * 12, dtype=np.int64)
    ends = 1.7e9 + np.cumsum(n) / RATE + rng.uniform(0.0, 8e-3, n.size)
    ends[30:] += 4.0
    ends[7:] += 1.0
    one, many = BlockClock(RATE), BlockClock(RATE)
    expected = np.concatenate([run([end], one, k) for end, k in zip(ends, n.tolist())])
    found = np.concatenate([many.stamps(ends[part], n[part])
                            for part in (slice(0, 5), slice(5, 5), slice(5, None))])
    np.testing.assert_array_equal(found.view(np.uint64), expected.view(np.uint64))
    assert one.gaps == many.gaps >= 1
