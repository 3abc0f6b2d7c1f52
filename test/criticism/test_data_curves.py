"""Histograms, averages by throttle and bands behind the plots, against closed forms."""

import math

import numpy as np
from ou_monitor.criticism.curves import (
    _averages, _bins, _by_throttle, _curves, _density, bin_width, outline, seen_range, stray)
from ou_monitor.criticism.samples import Samples
import pytest


@pytest.mark.parametrize('n, spread', [(27, 1.0), (1000, 0.02)])
def test_bins_after_freedman_and_diaconis(n, spread):
    """2 IQR n^(-1/3): of even values the quartiles are half the range apart."""
    width = bin_width(np.linspace(5.0, 5.0 + spread, n))
    assert width == pytest.approx(spread / n ** (1.0 / 3.0))


@pytest.mark.parametrize('code', [0.0, 0.01, 0.1])
@pytest.mark.parametrize('middle', [5.0, -2.0])
def test_edges_hold_all_values_and_room_for_tails(code, middle):
    """A density integrates to 1; codes lie half-way between edges, as many in each bin."""
    y = np.round(np.random.default_rng(3).normal(middle, 0.2, 2000), 2)
    y = np.round(y / code) * code if code else y
    edges = _bins(y, code)
    width = np.diff(edges)
    assert width == pytest.approx(width[0])
    room = 0.15 * np.ptp(y)
    assert edges[0] <= y.min() - room + 1e-9 and edges[-1] >= y.max() + room - 1e-9
    assert edges[0] > y.min() - room - 1.01 * width[0] - code
    assert edges[-1] < y.max() + room + 2.01 * width[0] + code
    assert float(_density(y, edges) @ width) == pytest.approx(1.0)
    if code:
        many = width[0] / code
        assert many == pytest.approx(round(many)) and many >= 1.0 - 1e-9
        assert ((y.min() - edges[0]) / code) % 1.0 == pytest.approx(0.5)


def test_up_to_twelve_throttles_have_a_bin_each():
    """One bin a value up to twelve, ten bins of as many samples beyond; the end is within."""
    which, bins = _by_throttle(np.array([0.2, 0.5, 0.2, 0.9]))
    assert bins == 3 and which.tolist() == [0, 1, 0, 2]
    which, bins = _by_throttle(np.linspace(0.0, 1.0, 1000))
    assert bins == 10 and np.bincount(which).tolist() == [100] * 10


@pytest.mark.parametrize('levels, separate', [(2, True), (12, True), (13, False), (400, False)])
def test_a_line_joins_what_lies_between_only_where_levels_are_many(levels, separate):
    u = np.arange(2400) % levels / levels
    rng = np.random.default_rng(1)
    found = _curves(Samples(1e-3 * np.arange(u.size), 5.0 + rng.standard_normal(u.size), u))
    drawn = {labels[0]: kind for labels, _, _, kind in found}
    assert drawn['Mean voltage by throttle'][2] is separate
    assert not drawn['Spectrum'][2]


def test_averages_need_five_samples():
    which = np.repeat([0, 1], [5, 4])
    means = _averages(np.arange(9.0), which, np.array([5.0, 4.0]))
    assert means[0] == 2.0 and math.isnan(means[1])


def test_the_outline_of_a_histogram_encloses_the_area_of_its_bars():
    """Up, along, down: the area below is that of the bars."""
    x, y = outline(np.array([0.0, 1.0, 3.0]), [2.0, 1.0])
    assert float(np.sum(np.diff(x) * 0.5 * (y[1:] + y[:-1]))) == pytest.approx(4.0)
    assert x[0] == 0.0 and x[-1] == 3.0 and y.max() == 2.0


def test_simulations_may_exceed_the_recorded_range_by_half_of_it():
    """Seen 14 to 16 V: 13 to 17 V may be simulated, and what is farther is said in volts."""
    seen = np.array([14.0, 15.0, 16.0])
    assert seen_range(seen) == (13.0, 17.0)
    assert stray(np.array([[13.0, 17.0], [15.0, 15.5]]), seen) == 0.0
    assert stray(np.array([[15.0, 17.3], [15.0, 15.5]]), seen) == pytest.approx(0.3)
    assert stray(np.array([12.5, 17.2]), seen) == pytest.approx(0.5)
    assert stray(np.array([np.nan, 15.0]), seen) == float('inf')
