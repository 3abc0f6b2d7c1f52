"""Notches on recorded gyros: what they take away, and that they cost a quiet craft nothing."""

import os

import numpy as np
import pytest

pytestmark = pytest.mark.skipif('OU_MONITOR_REALDATA' not in os.environ,
                                reason='OU_MONITOR_REALDATA names the recordings')


def ratios(name, seconds, cutoff):
    """Return the cells of one row of the table as numbers, all axes; NaN for a dash."""
    import gyros
    from notch import measure
    (row,) = measure(gyros.read(name, seconds), (cutoff,))
    return [float(cell.split(' ')[0]) if cell != '-' else np.nan for cell in row[4:]]


def test_a_loud_craft():
    """Half and a third of the noise are left, on what was not learned from."""
    pytest.importorskip('orangebox')
    *_, throttle, nothing, _, rpm, _ = ratios('bf3s', np.inf, 80.0)
    assert throttle < 0.5 and nothing < 0.6 and rpm < 0.42


def test_a_quiet_craft():
    """It may not cost more than 2 %."""
    pytest.importorskip('orangebox')
    *_, throttle, nothing, _, _, _ = ratios('nazgul', 40.0, 80.0)
    assert throttle <= 1.02 and nothing <= 1.02
