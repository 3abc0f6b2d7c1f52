"""Plots by throttle: few levels are separate points, with the range of simulations."""

import re
from xml.etree import ElementTree

import numpy as np
from ou_monitor.criticism.curves import compare_curves
from ou_monitor.criticism.samples import Samples
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.report.discovery_document import _plot
from ou_monitor.report.svg import Plot
import pytest


def by_throttle(throttle):
    """Return the pictures by throttle of a rail that sags by 0.5 V at full throttle."""
    t = np.arange(throttle.size) / 100.0
    model = SupplyModel((OU(60.0, 0.3, 5.0),))
    rng = np.random.default_rng(3)
    v = model.simulate(t, rng, throttle) - 0.5 * throttle
    drawn = compare_curves(Samples(t, v, throttle), [model, model], rng, draws=5)
    return v, drawn[-2:]


@pytest.mark.parametrize('levels', [[0.0, 0.8], [0.1, 0.3, 0.7], [0.0, 0.2, 0.21, 1.0]])
def test_each_of_few_levels_is_a_point(levels):
    """One point a level, at its throttle, with the mean of its samples; a bar each model."""
    throttle = np.repeat(levels, 100)
    v, (mean, spread) = by_throttle(throttle)
    assert mean.points and spread.points
    assert mean.x == pytest.approx(100.0 * np.array(levels))
    assert mean.data == pytest.approx([v[throttle == level].mean() for level in levels])
    for picture in (mean, spread):
        svg = _plot(picture, 0, 'plain').svg()
        ElementTree.fromstring(svg)
        # One more is in the legend.
        assert len(re.findall('<circle', svg)) == len(levels) + 1
        bars = max(re.findall(r'<path class="line thick s0" d="([^"]+)"', svg), key=len)
        assert bars.count('V') == len(levels)


def test_one_level_of_rare_samples_does_not_hide_the_other():
    """90 % of the samples at rest: both levels are shown."""
    _, (mean, _) = by_throttle(np.repeat([0.0, 0.8], [360, 40]))
    assert mean.x == pytest.approx([0.0, 80.0]) and np.isfinite(mean.data).all()


def test_many_levels_are_a_line_of_bins():
    """Throttle that takes all values: ten bins of as many samples each."""
    _, (mean, _) = by_throttle(np.random.default_rng(1).random(400))
    assert not mean.points and mean.x.size == 10
    assert 'circle' not in _plot(mean, 0, 'plain').svg()


def test_dots_and_bars_leave_out_what_is_not_known():
    """What is NaN is not drawn, and the rest stands where the axes put it."""
    plot = Plot('t', 'x', 'y').limits((0.0, 4.0), (0.0, 1.0))
    x, y = np.arange(5.0), np.array([0.0, 1.0, np.nan, 0.5, 0.5])
    svg = plot.bars(x, y - 0.1, y + 0.1, '', 0).markers(x, y, '', 7).svg()
    centres = [float(cy) for cy in re.findall('cy="([^"]+)"', svg)]
    assert len(centres) == 4 and centres[0] > centres[2] > centres[1]
    assert 'nan' not in svg
