"""
What a report costs with samples missing or stamps jittered, beside even samples.

    .venv/bin/python benchmarks/irregular_cost.py [--seconds 10]

CPU time of this thread in `SupplyMonitor.report`, 10 times a second, of an OU rail (40 1/s,
0.3 V/sqrt(s), 4 mV of noise) at 1 kHz with and without throttle at 50 Hz.  The cases take turns,
so a busy machine is equally busy for all: read the ratios.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import sys
import time

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from ou_monitor.model.ou import simulate  # noqa: E402
from ou_monitor.online.monitor import SupplyMonitor  # noqa: E402
from ou_monitor.online.settings import MonitorSettings  # noqa: E402
from tables import table  # noqa: E402

CASES = ('even', '20 % missing', '30 % missing', 'jitter of 30 % of a step')
# The window has filled, and the first fit is made, s.
WARM = 3.0


class Rail:
    """One monitor and its samples."""

    def __init__(self, case: str, throttle: bool, seconds: float) -> None:
        rng = np.random.default_rng(1)
        n = round(1000.0 * (WARM + seconds))
        t = np.arange(n) * 1e-3
        # A first-order walk of the stick, one value each 20 ms.
        stick = np.zeros(n // 20 + 1)
        for k in range(1, stick.size):
            stick[k] = 0.97 * stick[k - 1] + 0.05 * rng.standard_normal()
        u = np.clip(0.4 + stick, 0.0, 1.0)[np.arange(n) // 20] if throttle else np.full(n, np.nan)
        if 'jitter' in case:
            t = t + rng.uniform(-0.3e-3, 0.3e-3, n)
        y = (15.0 - np.nan_to_num(u) + simulate(t, 40.0, 0.3, rng)
             + 4e-3 * rng.standard_normal(n))
        keep = rng.random(n) >= (float(case[:2]) / 100.0 if 'missing' in case else 0.0)
        self.t, self.y, self.u = t[keep], y[keep], u[keep]
        self.monitor = SupplyMonitor(MonitorSettings(window=2.0, brownout_voltage=13.0))
        self.costs: list[float] = []

    def step(self, begin: float, end: float) -> None:
        """Push the samples between two times, s, and report."""
        part = slice(*np.searchsorted(self.t, (begin, end)).tolist())
        self.monitor.push(self.t[part], self.y[part], self.u[part])
        start = time.thread_time()
        _ = self.monitor.report(0.0).fields
        if end > WARM:
            self.costs.append(time.thread_time() - start)


def main() -> int:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seconds', type=float, default=10.0)
    seconds = parser.parse_args().seconds
    rows = []
    for throttle in (False, True):
        rails = [Rail(case, throttle, seconds) for case in CASES]
        for k in range(round(10.0 * (WARM + seconds))):
            for rail in rails:
                rail.step(0.1 * k, 0.1 * (k + 1))
        even = float(np.median(rails[0].costs))
        for case, rail in zip(CASES, rails):
            middle, high = np.percentile(rail.costs, (50, 99)).tolist()
            rows.append(['yes' if throttle else 'no', case, f'{1e3 * middle:.1f}',
                         f'{1e3 * high:.1f}', f'{middle / even:.1f}'])
    print(table(['throttle', 'samples', 'p50, ms', 'p99, ms', 'p50 over even'], rows))
    return 0


if __name__ == '__main__':
    sys.exit(main())
