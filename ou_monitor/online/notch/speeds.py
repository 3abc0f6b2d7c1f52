"""Motor speeds as they come: in Hz of the shaft, and until when they can be believed."""

from __future__ import annotations

from collections.abc import Sequence
import math

NAN = math.nan
# A speed that has changed so often, and then not for so many mean times between changes (and
# never less than s), has stopped coming: no motor in flight holds its speed to the last digit.
_CHANGES, _FROZEN, _LEAST = 20, 50.0, 1.0


class MotorSpeeds:
    """
    Newest speeds of the motors.

    Parameters
    ----------
    per_unit : float
        Hz for one of what comes.
    stale_after : float
        s.

    """

    def __init__(self, per_unit: float, stale_after: float) -> None:
        self._per_unit, self._stale_after = per_unit, stale_after
        self._speeds: list[float] = []
        self._heard = self._changed = self._first = -math.inf
        self._changes = 0

    def configure(self, per_unit: float, stale_after: float) -> None:
        """Change the unit, and the age that is too old, s."""
        if per_unit != self._per_unit:
            self._speeds = []
        self._per_unit, self._stale_after = per_unit, stale_after

    def take(self, t: float, values: Sequence[float]) -> None:
        """Take what came at t, s; nothing that is a number: nothing came."""
        speeds = [abs(one) * self._per_unit if math.isfinite(one) else NAN for one in values]
        if all(one != one for one in speeds):
            return
        if self._first == -math.inf or t < self._heard:
            self._first, self._changes = t, 0
            self._changed = t
        elif any(one != other for one, other in zip(speeds, self._speeds)
                 if one == one or other == other):
            self._changes += 1
            self._changed = t
        self._speeds, self._heard = speeds, t

    def now(self, t: float, most: int) -> list[float]:
        """Return the speeds of at most so many groups of motors, Hz; empty: not known."""
        if not most or not t - self._heard <= self._stale_after:
            return []
        if self._changes >= _CHANGES:
            usual = (self._changed - self._first) / self._changes
            if t - self._changed > max(_FROZEN * usual, _LEAST):
                return []
        if len(self._speeds) <= most:
            return self._speeds
        # Places of motors that are not there stay 0.
        known = sorted(one for one in self._speeds if one > 0.0)
        if len(known) <= most:
            return known
        # Neighbours in speed share a notch.
        edges = [round(k * len(known) / most) for k in range(most + 1)]
        return [sum(known[a:b]) / (b - a) for a, b in zip(edges, edges[1:])]
