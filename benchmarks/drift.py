"""
Rounding that a running estimator gathers: against a fit of the same window from nothing.

    .venv/bin/python benchmarks/drift.py [--samples 1e8] [--rate 1e6] [--json FILE]

The running estimator takes a supply in blocks of 1/40 of a window, with an
estimate after each.  At the end another one gets the last two windows only (two,
because the increments at the old edge reach back behind it).  Both then hold
the same samples, and should agree to some 1e-9, however long the first one ran.
"""

from __future__ import annotations

import argparse
from collections import deque
import json
import math
from pathlib import Path
import sys
import time

import numpy as np
from scipy.signal import lfilter

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

ALPHA, SIGMA, LEVEL, NOISE = 63.0, 0.632, 16.2, 5e-3
# Slots of a window, and windows that the second estimator gets.
SLOTS, HISTORY = 40, 2
NAMES = ('alpha', 'sigma', 'var_inf', 'u0', 'noise_std', 'alpha_se', 'sigma_se', 'var_inf_se')


class Supply:
    """
    An OU in white noise, block by block, with stamps and throttle.

    Parameters
    ----------
    rate : float
        Samples a second, Hz.
    throttle : bool
        Whether throttle steps every 0.3 s and the supply sags by 0.6 V a unit.

    """

    def __init__(self, rate: float, throttle: bool) -> None:
        self._rng = np.random.default_rng(1)
        self._rate, self._throttle = rate, throttle
        self._phi = math.exp(-ALPHA / rate)
        self._step = SIGMA * math.sqrt(-math.expm1(-2.0 * ALPHA / rate) / (2.0 * ALPHA))
        self._state = np.array([0.0])
        self._count = 0

    def block(self, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return stamps, s, voltages, V, and throttle (or None) of the next n samples."""
        rng = self._rng
        u, self._state = lfilter([1.0], [1.0, -self._phi], self._step * rng.standard_normal(n),
                                 zi=self._state)
        t = np.arange(self._count, self._count + n) / self._rate
        self._count += n
        y = LEVEL + u + NOISE * rng.standard_normal(n)
        if not self._throttle:
            return t, y, None
        load = 0.2 + 0.5 * (np.floor(t / 0.3) % 2)
        return t, y - 0.6 * load, load


def compare(samples: int, rate: float, window: float, throttle: bool, search: bool,
            progress: bool) -> dict[str, float]:
    """
    Return the relative differences of the two estimates, and what was run.

    Parameters
    ----------
    samples : int
        Samples the running estimator takes.
    rate : float
        Hz.
    window : float
        Length of the window, s.
    throttle : bool
        Whether throttle moves.
    search : bool
        Whether the second estimator starts each search for the maximum where
        the one before ended, as the running one does; if not, it fits once.
    progress : bool
        Whether to say on standard error how far it is.

    Returns
    -------
    dict
        Differences by name, `n` samples in the window, `seconds` it took.

    """
    from ou_monitor import SlidingEstimator
    supply = Supply(rate, throttle)
    running = SlidingEstimator(window)
    # One slot of the window a block: then the last window starts with a block, too.
    size = max(1, round(window / SLOTS * rate))
    kept: deque = deque(maxlen=HISTORY * SLOTS)
    done, told, started = 0, -1, time.monotonic()
    while done < samples:
        part = supply.block(min(size, samples - done))
        kept.append(part)
        running.push(*part)
        e = running.estimate()
        done += part[0].size
        share = 100 * done // samples
        if progress and share > told:
            told = share
            print(f'\r{rate:g} Hz{", throttle" if throttle else ""}: {share} %', end='',
                  file=sys.stderr, flush=True)
    if progress:
        print('\r' + 40 * ' ', end='\r', file=sys.stderr)
    fresh = SlidingEstimator(window)
    for part in kept:
        fresh.push(*part)
        if search:
            fresh.estimate()
    other = fresh.estimate()
    if other.n != e.n or other.duration != e.duration:
        raise ValueError(f'the windows differ: {e.n} and {other.n} samples')
    result = {name: abs(getattr(e, name) / getattr(other, name) - 1.0)
              if getattr(other, name) else abs(getattr(e, name)) for name in NAMES}
    return {**result, 'n': float(e.n), 'samples': float(done), 'rate': rate,
            'throttle': float(throttle), 'seconds': time.monotonic() - started}


def main() -> int:
    """Run both rates and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--samples', type=float, default=1e8, help='samples (default 1e8)')
    parser.add_argument('--rate', type=float, action='append',
                        help='Hz; may be given more than once (default 1e6 and, with a hundredth '
                        'of the samples, 1e4)')
    parser.add_argument('--window', type=float, default=2.0, help='s (default 2)')
    parser.add_argument('--cold', action='store_true',
                        help='let the second one fit once, without a start: shows how far the '
                        'search goes, not rounding')
    parser.add_argument('--json', type=Path, help='keep all numbers')
    options = parser.parse_args()
    runs = [(rate, options.samples) for rate in options.rate or ()] or [
        (1e6, options.samples), (1e4, options.samples / 100.0)]
    rows = []
    for rate, samples in runs:
        least = math.ceil(2.0 * options.window * rate)
        if not samples >= least:
            parser.error(f'at {rate:g} Hz at least {least} samples are needed: two windows')
        for throttle in (False, True):
            rows.append(compare(round(samples), rate, options.window, throttle,
                                not options.cold, sys.stderr.isatty()))
    print('| rate Hz | throttle | samples | in the window | ' + ' | '.join(NAMES) + ' | s |')
    print('|---:|---|---:|---:|' + '---:|' * len(NAMES) + '---:|')
    for row in rows:
        print(f"| {row['rate']:g} | {'steps' if row['throttle'] else 'none'} | "
              f"{row['samples']:.3g} | {row['n']:.0f} | "
              + ' | '.join(f'{row[name]:.1e}' for name in NAMES) + f" | {row['seconds']:.0f} |")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))
    return 0


if __name__ == '__main__':
    sys.exit(main())
