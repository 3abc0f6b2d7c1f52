"""
Waiting until an instant, and keeping account of how well that went.

`time.sleep` wakes late by about 0.06 ms on Linux; the last stretch is spun.
The schedule is absolute, so a late message does not delay those after it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
import math
import time

# The last stretch before an instant that is spun, s: about the usual lateness of sleep, so that a
# 1 kHz bag costs a tenth of a core.
SPIN = 0.0001
# The longest single sleep, s: bounds how late a signal is noticed.
NAP = 0.05


def wait_until(instant: float, going: Callable[[], bool]) -> bool:
    """Wait until `time.monotonic()` reaches an instant (instant in s)."""
    while True:
        if not going():
            return False
        left = instant - time.monotonic()
        if left <= SPIN:
            break
        time.sleep(min(left - SPIN, NAP))
    while time.monotonic() < instant:
        pass
    return True


class SpacingError:
    """
    How far the spacing of events was from the intended one, in whole microseconds.

    A histogram, so that days of replay take no more memory than minutes.
    """

    def __init__(self) -> None:
        self._counts: Counter[int] = Counter()
        self._last: tuple[float, float] | None = None

    def restart(self) -> None:
        """Begin a new pass: the gap before it is not counted."""
        self._last = None

    def add(self, due: float, done: float) -> None:
        """Take one event: when it was due and when it was done, s."""
        if self._last is not None:
            error = (done - self._last[1]) - (due - self._last[0])
            self._counts[round(abs(error) * 1e6)] += 1
        self._last = (due, done)

    @property
    def n(self) -> int:
        """Return the number of spacings."""
        return self._counts.total()

    def quantile(self, share: float) -> float:
        """Return the error, s, that a share of the spacings did not exceed; NaN when empty."""
        rank, seen = math.ceil(share * self.n), 0
        for error, count in sorted(self._counts.items()):
            seen += count
            if seen >= rank:
                return error * 1e-6
        return math.nan

    def summary(self) -> dict[str, float]:
        """Return p50, p99 and max, s; empty when there was no spacing."""
        if not self.n:
            return {}
        return {'p50': self.quantile(0.5), 'p99': self.quantile(0.99), 'max': self.quantile(1.0)}
