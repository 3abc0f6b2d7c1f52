"""
The voltage floor: a threshold on the samples that needs no model.

The median of the last `brownout.floor_time` seconds decides, so that a lone
bad sample does not; every sample is looked at, also those between two reports.
Limits: a bad value that a logger repeats for more than half of that time counts.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.online.settings import MonitorSettings

# Samples that decide when fewer lie within the time: the median of three outvotes one.
_FEWEST = 3
# A whole batch older than the newest sample by more than this, s, belongs to another time line.
_BACK = 1.0


class FloorWatch:
    """
    Whether the voltage is at or below the floor.

    Parameters
    ----------
    settings : MonitorSettings
        `floor`, V (0: off), `brownout_floor_time`, s, and
        `stale_after`, s: three samples further apart than twice this are not
        judged together.

    """

    def __init__(self, settings: MonitorSettings) -> None:
        self.settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget the samples: what follows is another time line."""
        self._t = np.empty(0)
        self._v = np.empty(0)
        self._low = self._was_low = False

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike) -> None:
        """Look at samples (t in s, voltage in V)."""
        s = self.settings
        if s.floor <= 0.0:
            if self._t.size:
                self.reset()
            return
        stamps, volts = np.atleast_1d(np.asarray(t, float)), np.atleast_1d(
            np.asarray(voltage, float))
        if stamps.shape != volts.shape:
            raise ValueError(f't {stamps.shape} and voltage {volts.shape} differ in shape')
        good = np.isfinite(stamps) & np.isfinite(volts)
        if not good.all():
            stamps, volts = stamps[good], volts[good]
        if not stamps.size:
            return
        newest = self._t[-1] if self._t.size else -math.inf
        if stamps.max() < newest - _BACK:
            self.reset()
            newest = -math.inf
        if stamps[0] <= newest or np.any(np.diff(stamps) <= 0.0):
            stamps, first = np.unique(stamps, return_index=True)
            volts = volts[first]
            volts, stamps = volts[stamps > newest], stamps[stamps > newest]
        if stamps.size:
            self._judge(stamps, volts)

    def _judge(self, t: npt.NDArray[np.float64], v: npt.NDArray[np.float64]) -> None:
        """Judge every new sample with those before it; `t` increases."""
        s = self.settings
        old = self._t.size
        t, v = np.concatenate([self._t, t]), np.concatenate([self._v, v])
        ends = np.arange(old, t.size)
        begin = np.searchsorted(t, t[ends] - s.brownout_floor_time, 'right')
        near = np.searchsorted(t, t[ends] - 2.0 * s.stale_after, 'left')
        begin = np.minimum(begin, np.maximum(ends - _FEWEST + 1, near))
        below = np.concatenate([[0], np.cumsum(v <= s.floor)])
        count = below[ends + 1] - below[begin]
        # The median is at or below the floor where more than half of the samples are.
        low = (count > 1) & (2 * count > ends + 1 - begin)
        self._low = bool(low[-1])
        self._was_low = self._was_low or bool(low.any())
        self._t, self._v = t[begin[-1]:], v[begin[-1]:]

    def take(self) -> bool:
        """Return whether the voltage is at or below the floor, or was since the last call."""
        low, self._was_low = self._low or self._was_low, False
        return low and self.settings.floor > 0.0
