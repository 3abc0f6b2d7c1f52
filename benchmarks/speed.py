"""
Throughput and latency, in a process of its own (one line of JSON on stdout).

All blocks are made before the clock starts.  CPU time of this thread, the best
of several repeats: the machine may be shared.  The limits it is held against,
np.dot and np.copyto, are measured in the same loop over the same blocks
("same") and again over one block that stays in the cache ("hot").
"""

from __future__ import annotations

from collections.abc import Callable
import json
import os
import sys
import time
from typing import Any

BLOCKS = (1, 10, 100, 1000, 10000)
STEPS = {'1 kHz': 1e-3, '1 MHz': 1e-6}
REPEATS = 7
# Samples pushed in each repeat; 12 MB in three columns, so that the blocks come
# from the cache, as blocks that have just arrived do.
SAMPLES = {1: 60_000, 10: 300_000}
MOST = 500_000
# Windows for the latency, s, and the samples pushed before each estimate.
WINDOWS = (2.0, 20.0, 200.0)
BETWEEN = 100
# The rate at which estimates are asked for in the sustained run, Hz.
FITS = 20.0


def best(work: Callable[[], None], repeats: int = REPEATS) -> float:
    """Return the least CPU time of this thread, s."""
    times = []
    for _ in range(repeats):
        begin = time.thread_time_ns()
        work()
        times.append(time.thread_time_ns() - begin)
    return 1e-9 * min(times)


def main(quick: bool) -> None:
    """Measure; print JSON."""
    sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    import numpy as np
    from ou_monitor.online.estimator.estimator import SlidingEstimator
    import windows as simulated

    scale = 10 if quick else 1
    rng = np.random.default_rng(5)

    def supply(n: int, dt: float) -> tuple[Any, Any, Any]:
        t = 1000.0 + np.arange(n) * dt
        y = simulated.with_noise(5e-3)(simulated.simulate(rng, 1, n, dt)[0], rng)
        moving = np.repeat(0.3 + 0.4 * rng.random(n // round(0.1 / dt) + 1), round(0.1 / dt))[:n]
        return t, y, moving

    def throughput(dt: float, block: int) -> dict[str, float]:
        n = SAMPLES.get(block, MOST) // scale // block * block
        t, y, moving = supply(n, dt)
        still = np.full(n, simulated.LOW)
        cuts = [slice(i, i + block) for i in range(0, n, block)]
        ts, ys = [t[c] for c in cuts], [y[c] for c in cuts]
        rows: dict[str, float] = {}
        pairs = list(zip(ts, ys))

        def bare() -> None:
            put = SlidingEstimator(2.0).push
            for a, b in pairs:
                put(a, b)
        rows['push_bare'] = n / best(bare)
        for name, u in (('push', still), ('push_moving', moving)):
            pushes = list(zip(ts, ys, [u[c] for c in cuts]))

            def push() -> None:
                put = SlidingEstimator(2.0).push
                for a, b, c in pushes:
                    put(a, b, c)
            rows[name] = n / best(push)
            if name == 'push':
                every = max(1, round(1.0 / (FITS * dt * block)))

                def sustained() -> None:
                    estimator = SlidingEstimator(2.0)
                    for i, (a, b, c) in enumerate(pushes):
                        estimator.push(a, b, c)
                        if i % every == 0:
                            estimator.estimate()
                if block * dt <= 1.0 / FITS:
                    rows['sustained'] = n / best(sustained, 2)

        if block == 1:
            numbers = list(zip(t.tolist(), y.tolist(), still.tolist()))

            def scalars() -> None:
                put = SlidingEstimator(2.0).push
                for a, b, c in numbers:
                    put(a, b, c)
            rows['push_scalar'] = n / best(scalars)

        def dots() -> None:
            dot = np.dot
            for b in ys:
                dot(b, b)

        def copies() -> None:
            copy, out = np.copyto, np.empty(block)
            for b in ys:
                copy(out, b)

        hot = [ys[0]] * len(ys)

        def hot_dots() -> None:
            dot = np.dot
            for b in hot:
                dot(b, b)

        def hot_copies() -> None:
            copy, out = np.copyto, np.empty(block)
            for b in hot:
                copy(out, b)

        for name, work in (('dot', dots), ('copy', copies), ('hot_dot', hot_dots),
                           ('hot_copy', hot_copies)):
            rows[name] = n / best(work)
        return rows

    def latency(window: float, moves: bool) -> dict[str, float]:
        dt, rounds = 1e-3, 400 // scale
        filled = round(1.1 * window / dt)
        n = filled + rounds * BETWEEN
        t, y, moving = supply(n, dt)
        u = moving if moves else np.full(n, simulated.LOW)
        estimator = SlidingEstimator(window)
        estimator.push(t[:filled], y[:filled], u[:filled])
        begin = time.thread_time_ns()
        estimator.estimate()
        first = time.thread_time_ns() - begin
        cpu, wall = [], []
        for i in range(filled, n, BETWEEN):
            estimator.push(t[i:i + BETWEEN], y[i:i + BETWEEN], u[i:i + BETWEEN])
            wall_begin, begin = time.perf_counter_ns(), time.thread_time_ns()
            estimator.estimate()
            cpu.append(time.thread_time_ns() - begin)
            wall.append(time.perf_counter_ns() - wall_begin)
        # The first ones after the window has filled carry its one-off costs.
        low, high = np.percentile(cpu[2:], [50, 99]) * 1e-3
        return {'first_us': first * 1e-3, 'p50_us': float(low), 'p99_us': float(high),
                'wall_p50_us': float(np.percentile(wall[2:], 50)) * 1e-3,
                'wall_p99_us': float(np.percentile(wall[2:], 99)) * 1e-3}

    out: dict[str, Any] = {'throughput': {}, 'latency': {}}
    for name, dt in STEPS.items():
        out['throughput'][name] = {str(b): throughput(dt, b) for b in BLOCKS}
        print(f'  throughput at {name} done', file=sys.stderr, flush=True)
    for window in WINDOWS:
        out['latency'][f'{window:g}'] = {
            'still': latency(window, False), 'moving': latency(window, True)}
    print('  latency done', file=sys.stderr, flush=True)
    print(json.dumps(out))


if __name__ == '__main__':
    main('--quick' in sys.argv[1:])
