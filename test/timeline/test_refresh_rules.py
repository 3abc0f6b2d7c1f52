"""Rules of the recognition of repeats, each at its edge."""

import math

import numpy as np
from ou_monitor.timeline.line import Batch, reading_places, refresh_period, Repeats
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
    # 7 to 13 where 10 is meant; 6 and 14 are one and two periods.
    ([7, 13, 10, 10] * 30, 10.0), ([6, 14] * 60, 20 / 3), ([6, 15] * 60, 1.0),
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


@pytest.mark.parametrize('seed', range(4))
def test_repeats_are_dropped_where_the_source_was_read(seed):
    """In pieces of any size, with the same value twice: each refresh but the first."""
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
        batch = repeats.drop(Batch.of(
            np.stack((t, y, u, -u))[:, start:stop], restart=False))
        if batch is not None:
            found.append(np.stack((batch.t, batch.y, batch.u, batch.i)))
            assert np.diff(batch.t).min(initial=math.inf) >= batch.shortest
        start = stop
    t_, y_, u_, i_ = np.concatenate(found, axis=1)
    at = np.arange(1, t_.size + 1) * period
    # The last ones may still be waiting for half a period after them.
    assert reads - 5 <= t_.size < reads
    np.testing.assert_array_equal(t_, t[at])
    np.testing.assert_array_equal(y_, y[at])
    np.testing.assert_array_equal(u_, u[at])
    np.testing.assert_array_equal(i_, -u[at])


def test_a_series_is_thinned_to_its_readings():
    """The period with it; what does not repeat stays as it is, and so does one sample."""
    rng = np.random.default_rng(5)
    y = np.repeat(rng.standard_normal(100), 4)
    places, period = reading_places(y)
    assert period == 4.0 and places.size >= 98
    np.testing.assert_array_equal(places, 4 + 4 * np.arange(places.size))
    for plain in (rng.standard_normal(400), y[:1]):
        places, period = reading_places(plain)
        assert period == 1.0 and places.size == plain.size
    one = Batch.of(np.array([[1.0], [5.0], [math.nan], [math.nan]]), restart=False)
    assert one.u is one.i is None and one.t.tolist() == [1.0]
