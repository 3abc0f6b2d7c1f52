"""
The throttle that was known at a given stamp: the last value at or before it.

Limits first: a throttle is held for ever; whether it is too old to be believed
is for the caller to say (it knows what "now" is).
"""

from __future__ import annotations

import bisect
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

# Enough for 20 s of a 50 Hz stick, or 1 s of a 1 kHz one, before the block of
# voltage that it belongs to has arrived; 16 KiB.
KEEP = 1024

# Below this many stamps a bisection each is quicker than one conversion of
# the history to an array.
FEW = 16


def hold_last(stamps: FloatArray, values: FloatArray, at: npt.ArrayLike) -> FloatArray:
    """Return the last value at or before each stamp (stamps in s, at in s)."""
    asked = np.atleast_1d(np.asarray(at, dtype=np.float64))
    if stamps.size == 0:
        return np.full(asked.shape, np.nan)
    index = np.searchsorted(stamps, asked, side='right') - 1
    return np.where(index >= 0, values[np.maximum(index, 0)], np.nan)


class ThrottleHold:
    """
    Keeps the newest throttle values and tells which one held at a stamp.

    Parameters
    ----------
    keep : int
        Values kept; older ones are forgotten, and stamps before the oldest
        one kept give NaN.

    Raises
    ------
    ValueError
        When `keep` is below 1.

    """

    def __init__(self, keep: int = KEEP) -> None:
        """Start with nothing known."""
        if keep < 1:
            raise ValueError(f'keep must be at least 1 value, got {keep}')
        self._keep = keep
        self._stamps: list[float] = []
        self._values: list[float] = []

    def __len__(self) -> int:
        """Return the number of values kept."""
        return len(self._stamps)

    def push(self, stamp: float, value: float) -> None:
        """Add one value; stamps may come out of order (stamp in s, value 0..1)."""
        if not math.isfinite(stamp):
            return
        place = bisect.bisect_right(self._stamps, stamp)
        self._stamps.insert(place, float(stamp))
        self._values.insert(place, float(value))
        if len(self._stamps) > self._keep:
            del self._stamps[0], self._values[0]

    def at(self, stamps: npt.ArrayLike) -> FloatArray:
        """Return the throttle that held at each stamp (stamps in s)."""
        asked = np.atleast_1d(np.asarray(stamps, dtype=np.float64))
        if asked.size > FEW:
            return hold_last(np.array(self._stamps), np.array(self._values), asked)
        found = [bisect.bisect_right(self._stamps, stamp) - 1 for stamp in asked.tolist()]
        return np.array([self._values[k] if k >= 0 else np.nan for k in found], dtype=np.float64)

    def clear(self) -> None:
        """Forget everything, as after a clock that jumped back."""
        self._stamps.clear()
        self._values.clear()
