"""Load levels: found, given, split at pauses, without transients."""

import numpy as np
from ou_monitor.analysis.levels import find_levels, half_width, SETTLE
import pytest
from scipy.signal import lfilter

RATE = 200.0


def profile(*parts):
    """Return stamps and throttle for (throttle, seconds) parts."""
    throttle = np.concatenate([np.full(int(s * RATE), u) for u, s in parts])
    return np.arange(throttle.size) / RATE, throttle


def test_the_papers_levels_are_separated():
    """0, 5, 10 and 40 % with the jitter of a stick are four levels."""
    t, throttle = profile((0.0, 3), (0.05, 2), (0.10, 4), (0.40, 3), (0.05, 2))
    jitter = np.random.default_rng(1).uniform(-0.005, 0.005, t.size)
    levels = find_levels(t, throttle + jitter)
    assert [round(level.throttle, 2) for level in levels] == [0.0, 0.05, 0.10, 0.40]
    assert [len(level.segments) for level in levels] == [1, 2, 1, 1]


def test_every_sample_of_a_level_is_at_its_throttle():
    """Also in a profile that wanders, segments hold only their level and do not overlap."""
    rng = np.random.default_rng(2)
    t = np.arange(8000) / RATE
    throttle = np.clip(0.3 + np.cumsum(rng.normal(0.0, 0.004, t.size)), 0.0, 1.0)
    levels_of = np.zeros(t.size, dtype=int)
    levels = find_levels(t, throttle)
    assert levels
    for level in levels:
        for s in level.segments:
            levels_of[s.start:s.stop] += 1
            # A stay ends two half widths away from the middle.
            assert np.ptp(throttle[s.start:s.stop]) <= 4.0 * half_width(t, throttle) + 1e-6
    assert levels_of.max() == 1


def test_settling_is_left_out_after_a_step_only():
    """A step costs SETTLE seconds; jitter across the edge of a level costs nothing."""
    t, throttle = profile((0.1, 2), (0.4, 2))
    low, high = find_levels(t, throttle)
    assert low.segments[0].start == 0
    assert t[high.segments[0].start] == pytest.approx(2.0 + SETTLE, abs=1.5 / RATE)
    t, throttle = profile((0.1, 2), (0.13, 0.05), (0.1, 2))
    (level,) = find_levels(t, throttle, (0.1,))
    assert level.settling == 0.0
    assert [(s.start, s.stop) for s in level.segments] == [(0, t.size)]


def stick(t, spread, seed, relaxation=0.3):
    """Return the jitter of a hand: an OU of that standard deviation."""
    phi = np.exp(-1.0 / (RATE * relaxation))
    steps = np.random.default_rng(seed).normal(0.0, spread * np.sqrt(1.0 - phi ** 2), t.size)
    steps[0] /= np.sqrt(1.0 - phi ** 2)
    return lfilter([1.0], [1.0, -phi], steps)


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('spread', [0.005, 0.01, 0.015, 0.02])
def test_a_nervous_stick_breaks_no_level(spread, seed):
    """Three levels, each nearly whole; what lies at the sides of a level is no level."""
    t, throttle = profile((0.0, 5), (0.3, 15), (0.6, 5), (0.3, 10))
    levels = find_levels(t, throttle + stick(t, spread, seed))
    assert len(levels) == 3
    for level, middle, long, stays in zip(levels, (0.0, 0.3, 0.6), (5, 25, 5), (1, 2, 1)):
        # The median of a stay: its error is that of some 5 s / (2 * 0.3 s) values, times 1.25.
        assert abs(level.throttle - middle) < 4.0 * 1.25 * spread / np.sqrt(5.0 / 0.6)
        assert len(level.segments) <= stays + 2
        assert sum(t[s.stop - 1] - t[s.start] for s in level.segments) > 0.9 * long


def test_a_ramp_between_stays_makes_no_level():
    """Five seconds from each level to the next, at 4 and 8 % a second."""
    t = np.arange(int(32 * RATE)) / RATE
    throttle = np.interp(t, [0, 8, 13, 16, 21, 24, 29, 32], [0, 0, 0.2, 0.2, 0.4, 0.4, 0.8, 0.8])
    levels = find_levels(t, throttle)
    assert [round(level.throttle, 2) for level in levels] == [0.0, 0.2, 0.4, 0.8]
    # Asked for, the passage is there.
    (passed,) = find_levels(t, throttle, (0.6,))
    assert len(passed.segments) == 1


def test_a_slow_drift_of_throttle_within_a_level_does_not_split_it():
    t, throttle = profile((0.2, 20), (0.5, 20))
    assert len(find_levels(t, throttle + 0.002 * t)) == 2


def test_a_pause_breaks_a_segment():
    """Samples on both sides of a gap are not one segment."""
    t, throttle = profile((0.1, 4))
    t[400:] += 1.0
    (level,) = find_levels(t, throttle)
    assert [(s.start, s.stop) for s in level.segments] == [(0, 400), (400, 800)]


def test_given_levels_share_the_samples_between_them():
    """Levels given closer than the half width split at the middle."""
    t, throttle = profile((0.10, 2), (0.12, 2))
    low, high = find_levels(t, throttle, (0.12, 0.10))
    assert (low.throttle, high.throttle) == (0.10, 0.12)
    assert low.segments[0].stop == high.segments[0].start == int(2 * RATE)


def test_a_throttle_that_never_rests_is_one_level():
    """A ramp through 4 % in less than MIN_TIME has no level; everything stays in one."""
    t = np.arange(1000) / RATE
    (level,) = find_levels(t, np.linspace(0.0, 1.0, t.size))
    assert np.isnan(level.throttle)
    assert [(s.start, s.stop) for s in level.segments] == [(0, t.size)]


def test_unknown_throttle_belongs_to_no_level():
    t, throttle = profile((0.1, 2))
    throttle[:100] = np.nan
    (level,) = find_levels(t, throttle)
    # What came before the first is unknown, so it may have been a step.
    assert t[level.segments[0].start] == pytest.approx(t[99] + SETTLE, abs=1.5 / RATE)


@pytest.mark.parametrize('given, word', [((0.1, 1.2), '1.2'), ((0.1, 0.1), 'twice'),
                                         ((float('nan'),), 'nan'), ((-0.1,), '-0.1')])
def test_bad_levels_are_refused(given, word):
    t, throttle = profile((0.1, 2))
    with pytest.raises(ValueError, match=word):
        find_levels(t, throttle, given)


@pytest.mark.parametrize('parts, given, found', [
    # A few seconds of full throttle are a level of a long flight.
    ([(0.1, 150), (0.9, 4), (0.4, 146)], None, [0.1, 0.4, 0.9]),
    # Where no stay is longer than 0.4 s, the stays are the levels.
    ([(0.1, 0.4), (0.3, 0.4), (0.6, 0.4)] * 5, None, [0.1, 0.3, 0.6]),
    # Passages of 0.35 s at 30 % between stays of 2 s are no level, unless asked for, or longer.
    ([(0.1, 2), (0.3, 0.35), (0.6, 2), (0.3, 0.35)] * 3, None, [0.1, 0.6]),
    ([(0.1, 2), (0.3, 0.35), (0.6, 2), (0.3, 0.35)] * 3, (0.1, 0.3, 0.6), [0.1, 0.3, 0.6]),
    ([(0.1, 2), (0.3, 0.35), (0.6, 2), (0.3, 0.35)] * 3 + [(0.3, 0.8)], None, [0.1, 0.3, 0.6]),
    ([(0.1, 0)], None, [])])
def test_stays_that_are_levels(parts, given, found):
    assert [level.throttle for level in find_levels(*profile(*parts), given)] == found
