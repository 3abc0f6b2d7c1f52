"""The map from source time to simulated time."""

import math
import random

from ou_monitor.nodes.clocks import PAIRS, SimClockMap
import pytest


@pytest.mark.parametrize('rate', [0.25, 1.0, 4.0, 100.0])
def test_maps_at_the_rate_of_the_replay(rate):
    """A source time between and after pairs lands on the line, at unix-sized numbers."""
    mapped = SimClockMap()
    for k in range(200):
        assert not mapped.add(1.7e9 + 0.01 * k, 1.6e9 + 0.01 * rate * k)
    # Floats hold unix seconds to 2.4e-7 s; some tens of roundings are summed.
    found = mapped(1.7e9 + 1.99) - mapped(1.7e9 + 0.99)
    assert found == pytest.approx(rate, rel=1e-4)
    assert mapped(1.7e9 + 1.503) == pytest.approx(1.6e9 + 1.503 * rate, abs=3e-6 * max(rate, 1))
    assert mapped(1.7e9 + 2.1) == pytest.approx(1.6e9 + 2.1 * rate, abs=2e-5 * max(rate, 1))


def test_nothing_is_known_before_two_pairs():
    """One pair gives a time but no rate."""
    mapped = SimClockMap()
    assert not mapped.ready and math.isnan(mapped(5.0))
    mapped.add(1.0, 10.0)
    assert not mapped.ready and math.isnan(mapped(5.0))
    mapped.add(2.0, 12.0)
    assert mapped.ready and mapped(5.0) == pytest.approx(18.0)


def test_a_clock_that_stops_is_not_run_on():
    """For 1 s, or five of its intervals, the line is continued; then nothing is known."""
    quick, slow = SimClockMap(), SimClockMap()
    for k in range(10):
        quick.add(0.01 * k, 0.02 * k)
        slow.add(1.0 * k, 2.0 * k)
    assert quick(0.09 + 0.99) == pytest.approx(2.16) and math.isnan(quick(0.09 + 1.01))
    assert slow(13.9) == pytest.approx(27.8) and math.isnan(slow(14.1))
    # It goes on where it stopped: a step, for the line had run on.
    assert quick.add(5.0, 0.2) and not quick.ready


def test_jitter_of_single_ticks_is_averaged():
    """The standard deviation at the end of a fitted line of n points is s 2 / sqrt(n)."""
    rng = random.Random(1)
    mapped, jitter, errors = SimClockMap(), 0.001, []
    for k in range(1000):
        mapped.add(0.01 * k, 0.04 * k + rng.gauss(0.0, jitter))
        if k >= PAIRS:
            errors.append(mapped(0.01 * k) - 0.04 * k)
    rms = math.sqrt(sum(e * e for e in errors) / len(errors))
    # 950 errors in runs of 50: 19 independent ones, so 16 % of rms; 3 times that.
    assert rms == pytest.approx(2.0 * jitter / math.sqrt(PAIRS), rel=0.5)


@pytest.mark.parametrize('clock', [3.0, 40.0])
def test_a_step_voids_what_was_known(clock):
    """A clock that goes back (next pass) or leaps ahead (seek) starts a new line."""
    mapped = SimClockMap()
    for k in range(100):
        mapped.add(0.01 * k, 10.0 + 0.01 * k)
    assert mapped.add(1.0, clock)
    assert not mapped.ready
    assert not mapped.add(1.01, clock + 0.01)
    assert mapped(1.02) == pytest.approx(clock + 0.02)


def test_a_late_tick_is_not_a_step():
    """A tick 50 ms late at rate 100 is 5 s off, and still the same clock."""
    mapped = SimClockMap()
    for k in range(100):
        assert not mapped.add(0.01 * k, k)
    assert not mapped.add(1.05, 100.0)


def test_a_repeated_tick_is_no_pair():
    """Two pairs at one source time give no rate."""
    mapped = SimClockMap()
    mapped.add(1.0, 10.0)
    assert not mapped.add(1.0, 10.0)
    assert not mapped.ready
