"""
The voltage of load levels without what the jitter of the stick makes of it.

Within a level throttle is meant to stand still; where it does not, the supply sags with it, and
that is neither noise nor a line of the supply.  The fit has throttle as a regressor; for tests,
spectra and transients the sag within each level is taken out here, by least squares over its
stretches.  Limits: at once and in proportion; slow drifts that go along with throttle go too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from ou_monitor.analyze.levels import half_width, LoadLevel
from ou_monitor.records import FloatArray, Recording


def without_jitter(recording: Recording, levels: Sequence[LoadLevel]) -> FloatArray:
    """Return the voltage with the sag of movements within the levels taken out."""
    voltage = recording.voltage.copy()
    reach = 2.0 * half_width(recording.t, recording.throttle)
    for level in levels:
        if not np.isfinite(level.throttle):
            continue
        throttle, sagged = (np.concatenate([
            x[s.start:s.stop] - x[s.start:s.stop].mean() for s in level.segments] or [np.zeros(0)])
            for x in (recording.throttle, recording.voltage))
        moved = float(throttle @ throttle)
        if not moved > 0.0:
            continue
        others = [abs(other.throttle - level.throttle) for other in levels if other is not level]
        away = recording.throttle - level.throttle
        near = np.abs(away) <= min([reach, *(0.5 * x for x in others)])
        voltage[near] -= float(throttle @ sagged) / moved * away[near]
    return voltage
