"""What the machine gives a soak, and withholds: priorities, a busy core, a listener stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import threading
import time

from soak_figures import Span

REAL_TIME = (os.SCHED_FIFO, os.SCHED_RR)


class Machine(threading.Thread):
    """
    What the machine itself withholds, looked at 50 times a second, by the monotonic clock, s.

    `node`: when the node's main thread was ready and had no CPU for more than WAIT s, by the
    kernel's account; `here`: when this process had none for PAUSE s.
    """

    WAIT, PAUSE = 0.05, 0.1

    def __init__(self, pid: Callable[[], int]) -> None:
        super().__init__(daemon=True)
        self._pid = pid
        self.node: list[Span] = []
        self.here: list[Span] = []

    def run(self) -> None:
        """Look until the process ends."""
        before, last, waited = time.monotonic(), 0, 0.0
        while True:
            time.sleep(0.02)
            now, pid = time.monotonic(), self._pid()
            if now - before > self.PAUSE:
                self.here.append((before, now))
            before = now
            with suppress(OSError):
                # ns on the CPU, ns ready without it, since the thread began.
                account = Path(f'/proc/{pid}/task/{pid}/schedstat').read_text()
                total = 1e-9 * int(account.split()[1])
                if pid == last and total - waited > self.WAIT:
                    self.node.append((now - (total - waited), now))
                last, waited = pid, total


def set_priority(priority: int, pid: int = 0) -> None:
    """Set the priority of a process that is in a real-time class."""
    if os.sched_getscheduler(pid) in REAL_TIME:
        os.sched_setparam(pid, os.sched_param(priority))


@contextmanager
def at_leisure() -> Iterator[None]:
    """Do without a real-time priority in this thread."""
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    if policy in REAL_TIME:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, priority)


def busy(core: int, priority: int) -> None:
    """Keep one core busy."""
    set_priority(priority)
    os.sched_setaffinity(0, {core})
    while True:
        pass
