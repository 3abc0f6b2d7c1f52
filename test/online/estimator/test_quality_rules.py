"""Rules of the findings about raw samples, each at its edge."""

import math

import numpy as np
from ou_monitor.online.estimator.quality import (
    examine, lattice, Quality, refresh_period, refreshes, Repeats, whole)
import pytest


def series(gaps, sizes=(1.0, 2.0, 5.0)):
    """Return values that change after these gaps, by steps of several sizes, up and down."""
    steps = np.resize(sizes, len(gaps) + 1) * np.resize((1.0, -1.0, -1.0, 1.0), len(gaps) + 1)
    return np.repeat(np.concatenate(([0.0], np.cumsum(steps))), [1, *gaps, 1])


@pytest.mark.parametrize('period', [2, 3, 4, 7])
def test_a_period_needs_twenty_nats(period):
    """Against changes at random, of which a gap is a whole number of periods by chance."""
    gaps = np.arange(1, 2000)
    law = (1.0 - 1.0 / period) ** (gaps - 1) / period
    chance = law[gaps % period == 0].sum()
    divergence = 0.95 * math.log(0.95 / chance) + 0.05 * math.log(0.05 / (1.0 - chance))
    enough = math.ceil(20.0 / divergence)
    assert refresh_period(series([period] * enough)) == period
    assert refresh_period(series([period] * (enough - 1))) == 1.0


@pytest.mark.parametrize('gaps, period', [
    # Two neighbouring lengths, also with a refresh that gave the same value; one in twenty odd.
    ([3, 3, 4] * 20, 10 / 3), ([3, 4, 3, 7, 3, 3] * 10, 23 / 7), ([5] * 57 + [3] * 3, None),
    # 7 to 13 where 10 is meant, not 6 or 14.
    ([7, 13, 10, 10] * 30, 10.0), ([6, 14] * 60, 1.0),
    # One in two samples changes at least; 1.5 times the usual gap is no double one.
    ([2, 2] * 30, 2.0), ([1, 2, 2, 1, 1] * 30, 1.0)])
def test_periods_by_the_gaps(gaps, period):
    found = refresh_period(series(gaps))
    if period is None:
        # The odd ones are left out.
        period = (57 * 5 + (9 if abs(3 - 5) <= 1.75 else 0)) / 57
    assert found == pytest.approx(period)


@pytest.mark.parametrize('odd, kept', [(4, True), (5, False)])
def test_a_known_period_is_kept_while_eight_in_ten_gaps_are_regular(odd, kept):
    """3.5 of 10 samples off are regular, 4 are not; those do not count in the mean."""
    found = refresh_period(series([10] * (20 - odd) + [14] * odd), 10.0)
    assert (found == 10.0) is kept
    assert refresh_period(series([10] * 16 + [13] * 4), 10.0) == pytest.approx(10.6)
    assert refresh_period(series([2] * 15 + [5] * 5), 2.0) == pytest.approx(55 / 25)


@pytest.mark.parametrize('same, found', [(90, 5.0), (91, 1.0)])
def test_a_tenth_of_the_steps_has_another_size(same, found):
    """Sizes within a thousandth are one."""
    # Counted is what lies between two changes: the first step of all included.
    sizes = [1.0, 1.0005] * 46
    steps = np.array([*sizes[:same], *[2.0 + 0.01 * k for k in range(100 - same)]])
    steps = np.random.default_rng(1).permutation(steps) * np.resize((1.0, -1.0), 100)
    y = np.repeat(np.concatenate(([0.0], np.cumsum(steps))), 5)
    assert refresh_period(y) == found


def test_a_lattice_has_a_thousand_steps_at_most():
    """Each within 2 % of the step, and those within 0.1 % of the least are one."""
    assert lattice(0.01 * np.array([1.0, 2.0, 1000.0])) == pytest.approx(0.01)
    assert lattice(0.01 * np.array([1.0, 2.0, 1001.0])) == 0.0
    # 2 differs from twice the step of best fit by 1.7 and by 2.1 % of it.
    assert lattice(np.array([1.0, 2.0, 3.04])) == pytest.approx(14.12 / 14.0)
    assert lattice(np.array([1.0, 2.0, 3.05])) == 0.0
    assert lattice(np.array([1.0, 1.0005, 2.0, 3.0])) == pytest.approx(1.00005, abs=2e-5)
    assert lattice(np.array([1.0, 1.0015, 2.0])) == 0.0
    assert lattice(np.array([3.0]), 1) == 3.0 and lattice(np.array([3.0])) == 0.0


@pytest.mark.parametrize('changes, found', [(57, 0.5), (60, 0.0)])
def test_two_sizes_are_a_lattice_where_neighbours_are_equal(changes, found):
    """Below nine changes in ten."""
    rng = np.random.default_rng(2)
    steps = np.zeros(64)
    at = rng.choice(64, changes, replace=False)
    steps[at] = 0.5 * rng.choice([1.0, 2.0], changes) * rng.choice([-1.0, 1.0], changes)
    assert examine(np.concatenate(([0.0], np.cumsum(steps)))).step == found


@pytest.mark.parametrize('side', [1.0, -1.0])
@pytest.mark.parametrize('many, beside, found', [
    (10, 1, True), (9, 1, False), (12, 4, False), (13, 4, True)])
def test_an_end_holds_ten_samples_and_three_times_its_neighbour(side, many, beside, found):
    """Of 500 samples: a hundredth would be five."""
    rng = np.random.default_rng(3)
    y = np.concatenate((rng.uniform(0.0, 1.0, 500 - many - beside), np.full(beside, 1.5),
                        np.full(many, 2.0)))
    assert examine(side * rng.permutation(y)).saturated is found


def test_nothing_is_told_of_nothing():
    assert Quality() == Quality(0.0, 1.0, False, pytest.approx(math.nan, nan_ok=True))
    two = np.r_[np.zeros(40), np.ones(40), np.zeros(40)]
    assert math.isnan(examine(two).rms_increment)
    three = np.r_[two, np.ones(40)]
    assert examine(three).rms_increment == pytest.approx(math.sqrt(3.0 / 159.0))


@pytest.mark.parametrize('seed', range(4))
def test_repeats_are_dropped_where_the_source_was_read(seed):
    """In pieces of any size, with the same value twice: each refresh at its place."""
    rng = np.random.default_rng(seed)
    period, reads = (3, 4, 10, 2)[seed], 120
    values = rng.integers(0, 4, reads) / 8.0
    y = np.repeat(values, period)
    t = np.arange(y.size) * 1e-3
    repeats = Repeats()
    repeats.period = float(period)
    u = rng.random(y.size)
    found, start = [], 0
    while start < y.size:
        stop = min(y.size, start + int(rng.integers(1, 25)))
        batch = repeats.drop(whole(np.stack((t, y, u))[:, start:stop]))
        if batch is not None:
            found.append(np.stack((batch.t, batch.y, batch.u)))
            assert np.diff(batch.t).min(initial=math.inf) >= batch.shortest
        start = stop
    t_, y_, u_ = np.concatenate(found, axis=1)
    at = np.arange(t_.size) * period
    # The last ones may still be waiting for half a period after them.
    assert reads - 4 <= t_.size <= reads
    np.testing.assert_array_equal(t_, t[at])
    np.testing.assert_array_equal(y_, y[at])
    np.testing.assert_array_equal(u_, u[at])


def test_a_series_is_thinned_to_its_refreshes():
    """The period with it; what does not repeat stays as it is, and so does one sample."""
    rng = np.random.default_rng(5)
    y = np.repeat(rng.standard_normal(100), 4)
    t = np.arange(400) * 1e-3
    stamps, values, period = refreshes(t, y)
    assert period == 4.0
    np.testing.assert_array_equal(stamps, t[:stamps.size * 4:4])
    np.testing.assert_array_equal(values, y[:stamps.size * 4:4])
    assert stamps.size >= 99
    stamps, values, period = refreshes(t, rng.standard_normal(400))
    assert period == 1.0 and stamps is t
    assert refreshes(t[:1], y[:1])[2] == 1.0
    assert whole(np.empty((3, 0))) is None
    one = whole(np.array([[1.0], [5.0], [math.nan]]))
    assert one.u is None and one.t.tolist() == [1.0]
