"""
Sending on schedule: reading ahead, waiting for an instant, and statistics of the error.

`time.sleep` wakes late by about 0.06 ms on Linux; the last stretch is spun.
The schedule is absolute, so a late message does not delay those after it.
Unpacking one chunk of a bag takes longer than the spacing of its messages, so
it is done in a thread of its own, up to a bounded number of messages ahead.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
import math
import sys
import threading
import time
from typing import Generic, TypeVar

# Length of the spin before an instant, s: about the usual lateness of sleep, so that a 1 kHz bag
# costs a tenth of a core.
SPIN = 0.0001
# Maximum single sleep, s: limits the delay in noticing a signal.
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
        """Take one event: its due time and its actual time, s."""
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


Item = TypeVar('Item')

# Maximum messages held: about 20 s at 10 kHz, some 50 MB.
AHEAD = 200_000
# Maximum time the reading thread may keep the interpreter from the sending one, s; Python's 5 ms
# would show in the spacing.
SWITCH = 0.0002


class Prefetch(Generic[Item]):
    """Iterate over a source that a thread reads ahead, up to `ahead` items; errors pass on."""

    def __init__(self, source: Iterable[Item], ahead: int = AHEAD) -> None:
        self._source = source
        self._ahead = ahead
        self._items: deque[Item] = deque()
        self._changed = threading.Condition()
        self._finished = self._closed = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._read, name='prefetch', daemon=True)
        sys.setswitchinterval(SWITCH)
        self._thread.start()

    def fill(self) -> None:
        """Wait until as much has been read as may be held, or all of it."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._finished or self._closed or len(self._items) >= self._ahead)

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _read(self) -> None:
        try:
            for item in self._source:
                # Appending to a deque needs no lock; the lock is only for waiting.
                self._items.append(item)
                if len(self._items) in (1, self._ahead):
                    with self._changed:
                        self._changed.notify_all()
                        self._changed.wait_for(
                            lambda: self._closed or len(self._items) < self._ahead)
                if self._closed:
                    break
        except BaseException as error:
            self._error = error
        finally:
            with self._changed:
                self._finished = True
                self._changed.notify_all()

    def __iter__(self) -> Iterator[Item]:
        """Yield the items in order."""
        while True:
            if not self._items:
                with self._changed:
                    self._changed.wait_for(lambda: self._items or self._finished)
                if not self._items:
                    break
            full = len(self._items) >= self._ahead
            item = self._items.popleft()
            if full:
                with self._changed:
                    self._changed.notify_all()
            yield item
        if self._error is not None:
            raise self._error
