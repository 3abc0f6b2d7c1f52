"""
Throughput of `ou-monitor fleet` against the number of workers (10 min).

    python benchmarks/fleet.py --workers 1 2 --recordings 64 --markdown doc/results/fleet.md

Recordings are simulated into a temporary folder.  Each round then analyses them with each number
of workers in turn, and in this process alone for comparison.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import logging
import os
from pathlib import Path
import resource
import statistics
import sys
import tempfile
import time

from common import deliver, table
import numpy as np
from ou_monitor.fleet.analysis import Options, work
from ou_monitor.fleet.workers import LocalWorkers, usable_cores
from ou_monitor.recordings.write import write_recording
from ou_monitor.records import Recording
from ou_monitor.simulation import PRESETS, read_profile, simulated


def make(folder: Path, count: int, seconds: float) -> list[str]:
    """Write recordings of the preset `flight`; return their paths."""
    preset = PRESETS['flight']
    paths = []
    for k in range(count):
        pieces = list(simulated(preset.model, read_profile(preset.throttle), duration=seconds,
                                rate=preset.rate, seed=k + 1))
        whole = Recording(*(np.concatenate([getattr(p, name) for p in pieces])
                            for name in ('t', 'voltage', 'throttle')), f'flight_{k}')
        path = folder / f'flight_{k}.mcap'
        write_recording(whole, path)
        paths.append(str(path))
    return paths


def cpu() -> float:
    """Return the CPU time of this process and of its children that have ended, s."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def alone(tasks: Sequence[tuple]) -> tuple[float, float, float]:
    """Return start, wall and CPU time of all tasks in this process, s."""
    used, start = cpu(), time.perf_counter()
    for task in tasks:
        assert not work(*task)['error']
    return 0.0, time.perf_counter() - start, cpu() - used


def on_workers(tasks: Sequence[tuple], count: int) -> tuple[float, float, float]:
    """Return the wall times of start and work, and the CPU time of both together, s."""
    used, start = cpu(), time.perf_counter()
    with LocalWorkers(count) as pool:
        # Each worker imports the package in its first task, which counts as start.
        for _, result, why in pool.each(work, [tasks[0]] * (2 * count)):
            assert not why and not result['error']
        middle = time.perf_counter()
        for _, result, why in pool.each(work, tasks):
            assert not why and not result['error']
        end = time.perf_counter()
    # The workers have ended, so their CPU time is known.
    return middle - start, end - middle, cpu() - used


def main() -> int:
    """Measure and print, or put the table into a Markdown file."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--workers', type=int, nargs='+', default=[1, 2])
    parser.add_argument('--recordings', type=int, default=64)
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--repeats', type=int, default=3)
    parser.add_argument('--markdown', type=Path)
    args = parser.parse_args()
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        paths = make(Path(folder), args.recordings, args.seconds)
        size = sum(os.path.getsize(path) for path in paths)
        tasks = [(path, Options()) for path in paths]
        # Imports and compiled code are loaded before the clock starts.
        work(*tasks[0])
        one: list[tuple[float, float, float]] = []
        times: dict[int, list[tuple[float, float, float]]] = {n: [] for n in args.workers}
        for _ in range(args.repeats):
            one.append(alone(tasks))
            for count in args.workers:
                times[count].append(on_workers(tasks, count))
    rows = []
    for name, found in (('none (this process)', one), *((str(n), t) for n, t in times.items())):
        start, wall, used = (statistics.median(column) for column in zip(*found))
        ratios = [b[1] / t[1] for b, t in zip(one, found)]
        rows.append([name, f'{start:.1f}', f'{wall:.1f}', f'{args.recordings / wall:.2f}',
                     f'{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})',
                     f'{used:.1f}'])
    text = (f'{args.recordings} recordings of {args.seconds:g} s at 1 kHz, {1e-6 * size:.0f} MB, '
            f'on {usable_cores()} cores (load before the run: {os.getloadavg()[0]:.1f}); '
            f'median of {args.repeats} rounds, in each of which all ways ran in turn; ratios '
            'within a round, with their range.\n\n' + table(
                ['workers', 'start s', 'work s', 'recordings a second', 'times as fast as none',
                 'CPU s, all processes'], rows))
    deliver(text, args.markdown, 'benchmark')
    return 0


if __name__ == '__main__':
    sys.exit(main())
