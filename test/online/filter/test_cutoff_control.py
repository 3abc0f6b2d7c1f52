"""From the wanted cutoff to the one in force, as time series."""

import math

import numpy as np
from ou_monitor.online.filter.cutoff import (
    Bound, CutoffControl, SampleInterval, time_constant)
from ou_monitor.online.settings import FilterSettings
import pytest

NAN = math.nan
DT = 0.01


def control(**options):
    """Return a control without smoothing, slew and dead band unless they are given."""
    return CutoffControl(FilterSettings(**{
        'smoothing': 0.0, 'slew': 0.0, 'dead_band': 0.0, **options}))


def line(made, wanted, error=NAN, interval=0.0):
    return [made.update(one, error, DT, interval) for one in wanted]


def test_starts_at_the_first_wanted_and_follows():
    assert line(control(), [100.0, 50.0, 50.0]) == [100.0, 50.0, 50.0]


def test_starts_at_the_fallback_when_nothing_is_known():
    made = control(fallback=60.0)
    assert line(made, [NAN, NAN]) == [60.0, 60.0] and made.bound is Bound.FALLBACK


def test_limits_saturate_and_say_which():
    made = control()
    assert line(made, [1.0]) == [20.0] and made.bound is Bound.LOWEST
    assert line(made, [1e6]) == [150.0] and made.bound is Bound.HIGHEST
    assert line(made, [70.0]) == [70.0] and made.bound is Bound.NONE


def test_the_lowest_cutoff_follows_from_the_lag():
    """45 degrees at 10 Hz with order 1: 10 Hz."""
    made = control(order=1, max_lag=45.0)
    assert line(made, [1.0]) == [pytest.approx(10.0)] and made.bound is Bound.LAG


def test_the_sample_rate_bounds_down_to_the_lowest():
    made = control()
    assert line(made, [100.0], interval=0.01) == [45.0] and made.bound is Bound.RATE
    assert line(made, [100.0], interval=0.05) == [20.0] and made.bound is Bound.LOWEST
    assert line(made, [100.0], interval=0.001) == [100.0]


def test_smoothing_is_exponential_in_the_logarithm():
    made = control(smoothing=0.2)
    line(made, [100.0])
    got = line(made, [25.0] * 40)
    t = DT * np.arange(1, 41)
    assert got == pytest.approx(list(25.0 * 4.0 ** np.exp(-t / 0.2)))
    assert made.bound is Bound.SMOOTHING
    assert line(made, [25.0] * 400)[-1] == 25.0 and made.bound is Bound.NONE


@pytest.mark.parametrize('error, expected', [
    (NAN, 0.2), (0.1, 0.2), (0.05, 0.1), (0.2, 0.4), (0.0, 0.05), (5.0, 0.8), (math.inf, 0.8)])
def test_a_certain_sigma_moves_the_cutoff_faster(error, expected):
    """Proportional to the error, within a factor of 4; not known: as given."""
    s = FilterSettings()
    assert time_constant(s, error) == pytest.approx(expected)
    made = CutoffControl(FilterSettings(slew=0.0, dead_band=0.0))
    line(made, [100.0])
    got = line(made, [50.0], error)[0]
    assert got == pytest.approx(50.0 * 2.0 ** math.exp(-DT / expected))


def test_slew_limits_octaves_per_second():
    """4 octaves/s: from 150 to 37.5 Hz takes half a second, on a straight line in log2."""
    made = control(slew=4.0)
    line(made, [150.0])
    got = line(made, [37.5] * 60)
    assert got[:50] == pytest.approx(list(150.0 * 2.0 ** (-0.04 * np.arange(1, 51))))
    assert got[50:] == pytest.approx([37.5] * 10)
    assert line(made, [150.0])[0] < 40.0 and made.bound is Bound.SLEW


def test_the_fallback_is_reached_within_the_slew_too():
    made = control(slew=4.0, fallback=75.0)
    line(made, [150.0])
    got = line(made, [NAN] * 30)
    assert got[0] == pytest.approx(150.0 * 2.0 ** -0.04)
    assert made.cutoff == 75.0 and made.bound is Bound.FALLBACK


def test_dead_band_holds_and_then_follows():
    made = control(dead_band=0.1)
    assert line(made, [100.0, 106.0, 94.0]) == [100.0] * 3
    assert made.bound is Bound.DEAD_BAND
    # The band lies around the cutoff that was taken last: 108 Hz, down to 100.8.
    assert line(made, [108.0, 102.0, 100.0]) == [108.0, 108.0, 100.0]


def test_after_the_fallback_the_dead_band_does_not_hold():
    """A sigma that has come back is followed, however near it is; then the band is there again."""
    made = control(dead_band=0.5, fallback=75.0)
    assert line(made, [100.0, NAN, 80.0, 85.0]) == [100.0, 75.0, 80.0, 80.0]


def test_configure_keeps_the_cutoff_within_the_new_limits():
    made = control()
    line(made, [100.0])
    made.configure(FilterSettings(fmax=60.0, fallback=50.0))
    assert made.cutoff == 60.0
    made.configure(FilterSettings(fmin=5.0, fmax=200.0))
    assert made.cutoff == 60.0


@pytest.mark.parametrize('intervals, mean', [
    # The mean of all up to 100; from then on each counts 1/100.
    ((1.0,) * 98 + (2.0,), 1.0 + 1.0 / 99.0),
    ((1.0,) * 99 + (2.0,), 1.01),
    ((1.0,) * 250 + (2.0,), 1.01),
    # Up to five means, or down to a fifth, it is an interval as others; beyond, it is odd.
    ((1.0,) * 9 + (5.0,), 1.4),
    ((1.0,) * 9 + (5.001,), 1.0),
    ((1.0,) * 9 + (0.2,), 0.92),
    # Four odd ones in a row are gaps (or repeats), five are a new rate.
    ((1.0,) * 9 + (6.0,) * 4, 1.0),
    ((1.0,) * 9 + (6.0,) * 5, 6.0),
    ((1.0,) * 200 + (0.1,) * 5, 0.1),
    # Gaps are left out if they are a third of all, and not if they are half.
    ((1.0, 1.0) * 5 + (6.0, 1.0, 1.0) * 50, 1.0),
    ((1.0, 1.0) * 5 + (6.0, 1.0) * 8 + (6.0,), 6.0),
    ((1.0, 1.0) * 5 + (6.0, 1.0) * 8, 1.0),
    # One that is not odd in between, and they are not in a row.
    ((1.0,) * 9 + (6.0,) * 4 + (1.0,) * 8 + (6.0,) * 4, 1.0),
])
def test_the_sample_interval_by_a_table(intervals, mean):
    """Means worked out by hand; odd is five times off, and five odd ones are a new rate."""
    interval = SampleInterval()
    for dt in intervals:
        got = interval.add(dt)
    assert got == interval.mean == pytest.approx(mean, rel=1e-12)
