"""
Which throttle held when a sample of voltage was taken: one rule, for node and bench alike.

A throttle holds from its own stamp on, as long as its clock is the voltage's; where the clocks
differ it holds from the next voltage message on.  The clocks are compared at each throttle
message, with the newest voltage stamp that had arrived by then.

Limits first: a throttle holds for ever; whether it is too old to be believed is for the caller
to say, who knows what "now" is.  A sample that has been paired stays as it is: a throttle that
arrives later, with a stamp before that sample, changes only what is paired after it.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

BoolArray = npt.NDArray[np.bool_]

# Stamps of voltage and throttle further apart than this, s, come from two clocks (an autopilot's
# boot time and a wall clock differ by years).
APART = 5.0
# The same where only one of the two carries a stamp of its own, and the other is known by when it
# was sent or logged: transmission takes milliseconds, and unsynchronized clocks may differ by
# little.
APART_MIXED = 0.25
# Stamps within a block are computed, and may be a rounding short of a throttle that was meant to
# hold for that sample: this share of a step is allowed for.
SLACK = 0.1


class ThrottleHold:
    """
    Places throttle values on the time line of the voltage, and looks them up.

    Parameters
    ----------
    sample_rate : float, optional
        Rate of the samples within a block of voltage, Hz; None: no blocks.

    """

    def __init__(self, sample_rate: float | None = None) -> None:
        self._slack = 0.0 if sample_rate is None else SLACK / sample_rate
        self._places, self._values = np.empty(0), np.empty(0)
        self._newest, self._own = -math.inf, False

    def take(self, stamps: FloatArray, values: FloatArray, own: BoolArray,
             voltage_stamps: FloatArray, voltage_own: BoolArray,
             before: npt.NDArray[np.int64]) -> None:
        """
        Take the throttle values and the voltage messages that have arrived since the last call.

        Both in order of arrival: stamps in s (NaN: not known), `own` where a message carries its
        stamp, and `before` the number of these voltage messages ahead of each throttle value.
        At least one voltage message must have come, now or earlier.
        """
        newest = np.maximum.accumulate(np.concatenate([[self._newest], voltage_stamps]))
        owns = np.concatenate([[self._own], voltage_own])
        if stamps.size:
            after, after_own = newest[before], owns[before]
            compared = after
            if self._newest == -math.inf:
                # No voltage had come: the first one to come tells.
                early = before == 0
                compared = np.where(early, voltage_stamps[0], after)
                after_own = np.where(early, voltage_own[0], after_own)
            apart = np.where(own == after_own, APART, APART_MIXED)
            one_clock = np.abs(stamps - compared) <= apart
            # By arrival: behind the newest voltage, and behind each throttle before.
            least = self._places[-1] if self._places.size else -math.inf
            latest = np.maximum.accumulate(np.concatenate([[least], np.where(
                one_clock, stamps, np.nextafter(after + 2.0 * self._slack, math.inf))]))[1:]
            places = np.concatenate([self._places, np.where(one_clock, stamps, latest)])
            values = np.concatenate([self._values, values])
            order = np.argsort(places, kind='stable')
            self._places, self._values = places[order], values[order]
        self._newest, self._own = float(newest[-1]), bool(owns[-1])

    def at(self, t: FloatArray) -> FloatArray:
        """Return the throttle that held at each stamp, s; NaN where none was known."""
        asked = t + self._slack
        places, values = self._places, np.append(np.nan, self._values)
        if places.size < asked.size and (asked[1:] >= asked[:-1]).all():
            # Both in order, and throttles are few: from which sample on each one holds.
            first = np.searchsorted(asked, places, 'left')
            return np.repeat(values, np.diff(np.concatenate([[0], first, [asked.size]])))
        return values[np.searchsorted(places, asked, 'right')]

    def forget_before(self, t: float) -> None:
        """Let go of the values that no sample from `t` on, s, can be paired with."""
        past = max(int(np.searchsorted(self._places, t + self._slack, 'right')) - 1, 0)
        self._places, self._values = self._places[past:], self._values[past:]

    def restart(self, value: float = math.nan) -> None:
        """Begin a new time line of the voltage, in which `value` holds from the beginning."""
        self._places, self._values = np.array([-math.inf]), np.array([value])
        self._newest, self._own = -math.inf, False

    def __len__(self) -> int:
        """Return the number of values kept."""
        return int(self._places.size)
