"""
Messages -> samples in order, throttle beside each, ready for the monitor.

No ROS here: the nodes hand over messages, and when they were sent.
"""

from __future__ import annotations

from collections.abc import Callable
import math

import numpy as np
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.stream.blocks import BlockClock
from ou_monitor.stream.extract import Extractor
from ou_monitor.stream.throttle import ThrottleHold

# A stamp that is older than the newest by more than this, s, is a clock or a bag that went back.
# One publisher's messages arrive in order; what several interleave is milliseconds.
BACK = 0.1
# Stamps of voltage and throttle further apart than this, s, come from two clocks (an autopilot's
# boot time and a wall clock differ by years).
APART = 5.0


class SampleStream:
    """
    Collects samples between two reports.

    Throttle is paired by stamp when both quantities carry stamps of one clock,
    else by arrival: the last value received.

    Parameters
    ----------
    monitor : SupplyMonitor
        Gets the samples at `flush`.

    Attributes
    ----------
    messages : int
        Voltage messages taken.
    unplaced : int
        Messages that could not be placed in time (`/clock` not there yet).

    """

    def __init__(self, monitor: SupplyMonitor) -> None:
        self._monitor = monitor
        self._voltage: Extractor | None = None
        self._throttle: Extractor | None = None
        self._block: BlockClock | None = None
        self._hold = ThrottleHold()
        self._t: list[float] = []
        self._v: list[float] = []
        self._u: list[float] = []
        self._empty = True
        self._newest = self._newest_throttle = -math.inf
        self._own_stamp = self._own_throttle_stamp = False
        self._last_throttle = math.nan
        self.messages = self.unplaced = 0

    def open_voltage(self, extractor: Extractor) -> None:
        """Set where the voltage is in its messages."""
        self._voltage = extractor
        rate = extractor.spec.sample_rate
        self._block = None if rate is None else BlockClock(rate)

    def open_throttle(self, extractor: Extractor) -> None:
        """Set where the throttle is in its messages."""
        self._throttle = extractor

    @property
    def throttle(self) -> float:
        """Newest throttle, 0..1; NaN when unknown."""
        return self._last_throttle

    def take_voltage(self, message: object, source_time: Callable[[], float]) -> bool:
        """Take one voltage message (source_time in s)."""
        if self._voltage is None:
            raise ValueError('take_voltage before open_voltage')
        self.messages += 1
        found = self._voltage.extract(message)
        end = source_time() if found.stamp is None else found.stamp
        if not math.isfinite(end):
            self.unplaced += 1
            return False
        # What the extractor dropped goes on as NaN: the monitor counts it.
        values = found.values.tolist()
        if self._block is None:
            values = values or [math.nan]
            stamps = [end]
        else:
            stamps = self._block.stamps(end, len(values)).tolist()
            if not stamps:
                return False
        if stamps[0] < self._newest - BACK:
            self.reset(f'stamps went back by {self._newest - stamps[0]:.3g} s')
        self._own_stamp = found.stamp is not None
        self._newest = max(self._newest, stamps[-1])
        self._t += stamps
        self._v += values
        self._u += [self._last_throttle] * len(stamps)
        return found.missing < len(values) or len(values) > 1 and any(map(math.isfinite, values))

    def take_throttle(self, message: object, source_time: Callable[[], float]) -> bool:
        """Take one throttle message; return whether it held a throttle."""
        if self._throttle is None:
            raise ValueError('take_throttle before open_throttle')
        found = self._throttle.extract(message)
        if not found.values.size:
            return False
        stamp = source_time() if found.stamp is None else found.stamp
        self._last_throttle = float(found.values[-1])
        self._own_throttle_stamp = found.stamp is not None
        if stamp < self._newest_throttle - BACK:
            self._hold.clear()
        if math.isfinite(stamp):
            self._newest_throttle = stamp
        self._hold.push(stamp, self._last_throttle)
        return math.isfinite(self._last_throttle)

    def lose_throttle(self) -> None:
        """Take the throttle for unknown from here on: its source has fallen silent."""
        self._last_throttle = math.nan
        self._hold.push(self._newest, math.nan)

    def flush(self) -> None:
        """Hand the samples collected to the monitor."""
        if not self._t:
            return
        t = np.array(self._t)
        one_clock = (self._own_stamp == self._own_throttle_stamp
                     and abs(self._newest - self._newest_throttle) <= APART)
        load = self._hold.at(t) if one_clock else np.array(self._u)
        self._monitor.push(t, np.array(self._v), load)
        self._t, self._v, self._u = [], [], []
        self._empty = False

    def reset(self, reason: str) -> None:
        """Clear the window: what came before belongs to another time line."""
        self.flush()
        if not self._empty:
            self._monitor.reset(reason)
            self._empty = True
        self._newest = -math.inf
        if self._block is not None:
            self._block.reset()
