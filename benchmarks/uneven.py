"""
CPU of a report of the monitor on uneven samples, over that on even ones (all at 1 kHz) (1 min).

A rail (alpha 63 1/s, 56 mV) under moving throttle for 40 s, reported ten times a second, the
first 6 s not counted; this thread's CPU time, so that fits in the background are not in it.
"""

from __future__ import annotations

import time

from common import table
import numpy as np
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import MonitorSettings
import windows as simulated

SECONDS, COUNTED, REPORT = 40.0, 6.0, 0.1


def main() -> None:
    """Measure; print a table."""
    rng = np.random.default_rng(3)
    n = round(SECONDS / simulated.DT)
    t = np.arange(n) * simulated.DT
    u = np.clip(0.5 + 0.3 * np.sin(1.7 * t) + np.cumsum(0.005 * rng.standard_normal(n)), 0.0, 1.0)
    v = simulated.simulate(rng, 1, n, simulated.DT)[0] + simulated.SAG * u
    here = rng.random(n) > 0.25
    moved = t + np.clip(0.2 * rng.standard_normal(n), -0.45, 0.45) * simulated.DT
    whole = np.ones(n, dtype=bool)
    for at in rng.integers(0, n, 200):
        whole[at:at + 30] = False
    rows = []
    for window in (2.0, 'auto'):
        usual = None
        for name, stamps, kept in (('even', t, ...), ('25 % missing', t, here),
                                   ('stamps jittered by 0.2 ms', moved, ...),
                                   ('both', moved, here), ('200 gaps of 30 ms', t, whole)):
            cost = 1e3 * reports(window, stamps[kept], v[kept], u[kept])
            shown = np.percentile(cost, [50, 99])
            usual = shown if usual is None else usual
            rows.append([str(window), name, *(f'{x:.2f}' for x in (*shown, *shown / usual))])
    print(table(['window', 'samples', 'p50, ms', 'p99, ms', 'over even: p50', 'p99'], rows))


def reports(window: float | str, t: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the CPU time of each report, s."""
    monitor = SupplyMonitor(MonitorSettings(window=window, brownout_voltage=15.0), background=True)
    cost, begin = [], 0
    for end in np.searchsorted(t, np.arange(REPORT, SECONDS, REPORT)).tolist():
        monitor.push(t[begin:end], v[begin:end], u[begin:end])
        begin, start = end, time.thread_time()
        monitor.report(0.0)
        cost.append(time.thread_time() - start)
    return np.array(cost[round(COUNTED / REPORT):])


if __name__ == '__main__':
    main()
