"""Whether simulations can be mistaken for a recording in level."""

import numpy as np
from ou_monitor.criticism.curves import seen_range, stray
import pytest


def test_half_the_range_is_room():
    """Seen 14 to 16 V: 13 to 17 V may be simulated, and what is farther is said in volts."""
    seen = np.array([14.0, 15.0, 16.0])
    assert seen_range(seen) == (13.0, 17.0)
    assert stray(np.array([[13.0, 17.0], [15.0, 15.5]]), seen) == 0.0
    assert stray(np.array([[15.0, 17.3], [15.0, 15.5]]), seen) == pytest.approx(0.3)
    assert stray(np.array([12.5, 17.2]), seen) == pytest.approx(0.5)
    assert stray(np.array([np.nan, 15.0]), seen) == float('inf')
