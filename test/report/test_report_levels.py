"""Dots and bars of plots: what is not known is not drawn."""

import re

import numpy as np
from ou_monitor.report.svg import Plot


def test_dots_and_bars_leave_out_what_is_not_known():
    """What is NaN is not drawn, and the rest stands where the axes put it."""
    plot = Plot('t', 'x', 'y').limits((0.0, 4.0), (0.0, 1.0))
    x, y = np.arange(5.0), np.array([0.0, 1.0, np.nan, 0.5, 0.5])
    svg = plot.bars(x, y - 0.1, y + 0.1, '', 0).markers(x, y, '', 7).svg()
    centres = [float(cy) for cy in re.findall('cy="([^"]+)"', svg)]
    assert len(centres) == 4 and centres[0] > centres[2] > centres[1]
    assert 'nan' not in svg
