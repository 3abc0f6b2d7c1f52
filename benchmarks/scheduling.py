"""
How late a process of 10 ms each 100 ms is beside busy loops, by scheduling (2 min, root).

python benchmarks/scheduling.py [--seconds 10]

It stands for the estimator: ten reports a second.  Two busy loops a core run in the session of
the process, or in one of their own, which Linux's autogroup schedules as systemd does a unit.
Needs root for a negative nice and for a real-time priority.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import multiprocessing
from multiprocessing.connection import Connection
import os
import sys
import time

import numpy as np

# Time between two works, and the CPU time of one, s.
PERIOD, WORK = 0.1, 0.01
SETTINGS: dict[str, Callable[[], object]] = {
    'nothing': lambda: None, 'nice -10': lambda: os.nice(-10),
    'real time (rr, 1)': lambda: os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))}


def busy(own: bool) -> None:
    """Compute for ever."""
    if own:
        os.setsid()
    while True:
        pass


def work(setting: str, seconds: float, out: Connection) -> None:
    """Send how long after its time each work was done, s."""
    SETTINGS[setting]()
    late = []
    begin = time.monotonic()
    for k in range(round(seconds / PERIOD)):
        due = begin + k * PERIOD
        time.sleep(max(due - time.monotonic(), 0.0))
        spent = time.thread_time()
        while time.thread_time() - spent < WORK:
            pass
        late.append(time.monotonic() - due - WORK)
    out.send(late)


def measured(setting: str, own: bool, seconds: float) -> list[float]:
    """Return the delays of one setting, s."""
    context = multiprocessing.get_context('fork')
    loops = [context.Process(target=busy, args=(own,), daemon=True)
             for _ in range(2 * (os.cpu_count() or 1))]
    inside, outside = context.Pipe()
    worker = context.Process(target=work, args=(setting, seconds, outside))
    for one in [*loops, worker]:
        one.start()
    late: list[float] = inside.recv()
    worker.join()
    for one in loops:
        one.kill()
        one.join()
    return late


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seconds', type=float, default=10.0)
    args = parser.parse_args()
    print('| scheduling | busy loops in | late by, median | 99 % | longest |')
    print('|---|---|---:|---:|---:|')
    for own in (False, True):
        for setting in SETTINGS:
            late = 1e3 * np.array(measured(setting, own, args.seconds))
            middle, most = np.percentile(late, [50, 99])
            print(f'| {setting} | {"their own" if own else "its"} session | {middle:.1f} ms '
                  f'| {most:.0f} ms | {late.max():.0f} ms |', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
