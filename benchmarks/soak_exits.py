"""
How nodes end when SIGINT comes twice, as with Ctrl-C in a terminal that runs ros2 launch (4 min).

    .venv/bin/python benchmarks/soak_exits.py [--number 200] [--seed 1]

The first signal comes during the start or while the node works, the second 0 to 2 s later, half
of them within 40 ms.  Starts are timed from the first handler of the node: before it Python ends
the process with a traceback of its own.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
import random
import re
import signal
import sys
import tempfile
import time

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test/support')]

from live import new_domain, Process, wait_until  # noqa: E402

NODES = ('estimator', 'adaptive_filter')


def catches(process: Process, number: int) -> bool:
    """Return whether a process has a handler of a signal, or has ended."""
    if process.popen.poll() is not None:
        return True
    status = Path(f'/proc/{process.popen.pid}/status').read_text()
    return bool(int(re.findall(r'SigCgt:\s*(\w+)', status)[0], 16) >> (number - 1) & 1)


def end_twice(process: Process, delay: float | None, spacing: float) -> int:
    """
    Send SIGINT twice; return the exit status.

    The first `delay` s after the first handler of the node, None: when the node works; the second
    `spacing` s later.
    """
    # Python catches SIGINT from its own start on, SIGTERM only the node.
    wait_until(lambda: catches(process, signal.SIGTERM), what='a handler')
    if delay is None:
        wait_until(lambda: 'Waiting for a publisher' in process.err
                   or process.popen.poll() is not None, what='the node')
    else:
        time.sleep(delay)
    for pause in (0.0, spacing):
        until = time.monotonic() + pause
        while time.monotonic() < until and process.popen.poll() is None:
            time.sleep(0.0)
        process.popen.send_signal(signal.SIGINT)
    return process.wait()


def main() -> int:
    """Measure; the exit status is 1 where a node did not end with status 0 and without words."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--number', type=int, default=200)
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    found: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for k in range(options.number):
            process = Process(NODES[k % 2], [], new_domain(), Path(folder))
            delay = None if rng.random() < 0.5 else rng.uniform(0.0, 1.0)
            spacing = rng.uniform(0.0, 0.04) if rng.random() < 0.5 else rng.uniform(0.0, 2.0)
            status = end_twice(process, delay, spacing)
            clean = status == 0 and 'Traceback' not in process.err
            found['clean' if clean else f'status {status}'] += 1
            if not clean:
                print(f'{process.name}, delay {delay}, spacing {spacing:.4f} s: status {status}\n'
                      f'{process.err}')
    print(', '.join(f'{name}: {number}' for name, number in found.most_common()))
    return int(set(found) != {'clean'})


if __name__ == '__main__':
    sys.exit(main())
