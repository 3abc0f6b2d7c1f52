"""Histograms and the range of simulations, against closed forms."""


import numpy as np
from ou_monitor.criticism.curves import bin_width, outline, seen_range, stray
import pytest


@pytest.mark.parametrize('n, spread', [(27, 1.0), (1000, 0.02)])
def test_bins_after_freedman_and_diaconis(n, spread):
    """2 IQR n^(-1/3): of even values the quartiles are half the range apart."""
    width = bin_width(np.linspace(5.0, 5.0 + spread, n))
    assert width == pytest.approx(spread / n ** (1.0 / 3.0))


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
