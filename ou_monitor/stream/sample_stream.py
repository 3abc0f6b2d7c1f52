"""
Messages -> samples in order, throttle beside each, ready for the monitor.

The nodes hand over messages, and when they were sent.  Limits first: what has
been handed to the monitor stays; throttle that arrives after that, with a
stamp before it, counts for later samples only.
"""

from __future__ import annotations

from collections import deque
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
# Throttle values kept until a voltage follows them: 20 s of a 50 Hz stick, or 1 s of a 1 kHz one.
KEEP = 1024


class SampleStream:
    """
    Collects samples between two reports.

    Throttle is paired by the rule of `ThrottleHold`, at each `flush`.

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
        self._throttle_block: BlockClock | None = None
        self._hold = ThrottleHold()
        self._t: list[float] = []
        self._v: list[float] = []
        # Of each voltage message since the last flush: stamp, and whether it carries that itself.
        self._ends: list[float] = []
        self._own: list[bool] = []
        # Throttle since then: stamp, value, whether it carries its stamp, voltage messages ahead.
        self._loads: deque[tuple[float, float, bool, int]] = deque(maxlen=KEEP)
        self._empty = True
        self._newest = self._newest_throttle = -math.inf
        self._last_throttle = math.nan
        self.messages = self.unplaced = 0

    def open_voltage(self, extractor: Extractor) -> None:
        """Set where the voltage is in its messages."""
        self._voltage = extractor
        rate = extractor.spec.sample_rate
        self._block = None if rate is None else BlockClock(rate)
        self._hold = ThrottleHold(rate)

    def open_throttle(self, extractor: Extractor) -> None:
        """Set where the throttle is in its messages."""
        self._throttle = extractor
        rate = extractor.spec.sample_rate
        self._throttle_block = None if rate is None else BlockClock(rate)

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
        self._newest = max(self._newest, stamps[-1])
        self._ends.append(stamps[-1])
        self._own.append(found.stamp is not None)
        self._t += stamps
        self._v += values
        return found.missing < len(values) or len(values) > 1 and any(map(math.isfinite, values))

    def take_throttle(self, message: object, source_time: Callable[[], float]) -> bool:
        """Take one throttle message; return whether it held a throttle."""
        if self._throttle is None:
            raise ValueError('take_throttle before open_throttle')
        found = self._throttle.extract(message)
        if not found.values.size:
            return False
        end = source_time() if found.stamp is None else found.stamp
        values = found.values.tolist()
        stamps = [end]
        if self._throttle_block is not None and math.isfinite(end):
            stamps = self._throttle_block.stamps(end, len(values)).tolist()
        if stamps[0] < self._newest_throttle - BACK:
            self.flush()
            self._hold.restart(self._last_throttle)
        if math.isfinite(stamps[-1]):
            self._newest_throttle = stamps[-1]
        drop = self._throttle.spec.nan == 'drop'
        for stamp, value in zip(stamps, values[-len(stamps):], strict=True):
            if math.isfinite(value) or not drop:
                self._loads.append((stamp, value, found.stamp is not None, len(self._ends)))
                self._last_throttle = value
        return math.isfinite(self._last_throttle)

    def lose_throttle(self) -> None:
        """Take the throttle for unknown from here on: its source has fallen silent."""
        self._last_throttle = math.nan
        self._loads.append((math.nan, math.nan, False, len(self._ends)))

    def flush(self) -> None:
        """Hand the samples collected to the monitor."""
        if not self._t:
            return
        t = np.array(self._t)
        stamps, values, own, before = np.array(self._loads, dtype=np.float64).reshape(-1, 4).T
        self._hold.take(stamps, values, own > 0.0, np.array(self._ends), np.array(self._own),
                        before.astype(np.int64))
        self._monitor.push(t, np.array(self._v), self._hold.at(t))
        self._hold.forget_before(self._newest - BACK)
        self._t, self._v, self._ends, self._own = [], [], [], []
        self._loads.clear()
        self._empty = False

    def reset(self, reason: str) -> None:
        """Clear the window: what came before belongs to another time line."""
        self.flush()
        if not self._empty:
            self._monitor.reset(reason)
            self._empty = True
        self._newest = -math.inf
        self._hold.restart(self._last_throttle)
        if self._block is not None:
            self._block.reset()
