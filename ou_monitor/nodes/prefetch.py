"""
Reading ahead of the schedule.

Unpacking one chunk of a bag takes longer than the spacing of its messages, so
it is done in a thread of its own, up to a bounded number of messages ahead.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
import sys
import threading
from typing import Generic, TypeVar

Item = TypeVar('Item')

# Messages held at most: about 20 s at 10 kHz, some 50 MB.
AHEAD = 200_000
# Longest time, s, for which the reading thread may keep the interpreter from the sending one;
# Python's 5 ms would be seen in the spacing.
SWITCH = 0.0002


class Prefetch(Generic[Item]):
    """
    Iterate over a source that a thread reads ahead.

    Parameters
    ----------
    source : iterable
        Read in the thread; what it raises is raised where the iteration
        reaches that point.
    ahead : int
        Items held at most.

    """

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
