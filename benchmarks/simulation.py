"""
Simulated samples per second, against other ways to draw an OU process (1 min).

All ways run in turn, `--repeats` times; the least CPU time of each counts. The package also makes
stamps and throttle for each piece, as `ou-monitor simulate` does. The ratio of the variance to the
OU process's own shows whether the distribution is right.
"""

from __future__ import annotations

from collections.abc import Callable
import math
import random
import sys
import time
from typing import Any

from common import arguments, deliver, environment, table
import numpy as np
from ou_monitor.model.supply import SEGMENT, Simulation, SupplyModel
from ou_monitor.model.terms.ou import NonlinearRestoring, OU
from ou_monitor.model.terms.term import Term
from ou_monitor.simulation import PRESETS, PROFILES
from scipy.signal import lfilter

ALPHA, SIGMA, RATE, SEED = 63.0, 0.632, 1000.0, 20260131
VAR_INF = SIGMA**2 / (2.0 * ALPHA)
PHI = math.exp(-ALPHA / RATE)
STEP = math.sqrt(VAR_INF * (1.0 - PHI * PHI))
Draw = Callable[[int], Any]


def ours(model: SupplyModel) -> Draw:
    """Return a function that draws samples of a model in pieces."""
    profile = PROFILES['flight'][0]

    def draw(n: int) -> np.ndarray:
        run, drawn = Simulation(model, np.random.default_rng(SEED)), []
        for first in range(0, n, SEGMENT):
            t = np.arange(first, min(first + SEGMENT, n)) / RATE
            drawn.append(run.advance(t, profile(t) if model.needs_throttle else None))
        return np.concatenate(drawn) - model.ou.u0
    return draw


def with_ou(*terms: Term) -> Draw:
    """Return a function that draws an OU process and more terms."""
    return ours(SupplyModel((OU(ALPHA, SIGMA, 5.0), *terms)))


def python_loop(n: int) -> np.ndarray:
    """Draw by a loop over Python floats."""
    gauss, x, out = random.Random(SEED).gauss, 0.0, []
    for _ in range(n):
        x = PHI * x + gauss(0.0, STEP)
        out.append(x)
    return np.array(out)


def filtered(n: int) -> np.ndarray:
    """Filter white noise, all samples at once."""
    return lfilter([STEP], [1.0, -PHI], np.random.default_rng(SEED).standard_normal(n))


def numba_loop() -> Draw:
    """Return a compiled loop."""
    from numba import njit

    @njit
    def loop(rng: Any, n: int) -> Any:
        x, out = 0.0, np.empty(n)
        for k in range(n):
            x = PHI * x + STEP * rng.standard_normal()
            out[k] = x
        return out
    loop(np.random.default_rng(SEED), 10)
    return lambda n: loop(np.random.default_rng(SEED), n)


def ways() -> dict[str, tuple[Draw, float, bool]]:
    """Return name, function, share of the samples, and whether it draws a plain OU."""
    found: dict[str, tuple[Draw, float, bool]] = {
        'numpy standard_normal alone':
            (lambda n: np.random.default_rng(SEED).standard_normal(n), 1.0, False),
        '**ou_monitor: ou**': (with_ou(), 1.0, True),
        '**ou_monitor: ou, sag, sigma(throttle), noise**':
            (ours(PRESETS['flight'].model), 1.0, False),
        '**ou_monitor: flight_full, 7 terms**':
            (ours(PRESETS['flight_full'].model), 1.0, False),
        '**ou_monitor: ou, nonlinear_restoring**':
            (with_ou(NonlinearRestoring(0.0, 2e3)), 0.05, False),
        'scipy lfilter by hand, plain OU': (filtered, 1.0, True),
        'plain Python loop, plain OU': (python_loop, 0.2, True)}
    try:
        found['Numba loop, plain OU'] = numba_loop(), 1.0, True
    except ImportError as error:
        print(f'left out: {error}', file=sys.stderr)
    return found


def speeds(samples: int, repeats: int) -> str:
    """Return the table of speeds."""
    drawn = ways()
    least, ratio = dict.fromkeys(drawn, math.inf), dict.fromkeys(drawn, '')
    for _ in range(repeats):
        for name, (draw, share, law) in drawn.items():
            n = int(samples * share)
            begin = time.thread_time()
            x = draw(n)
            least[name] = min(least[name], 1e9 * (time.thread_time() - begin) / n)
            if law:
                # Error of a mean of squares over T seconds (Bartlett).
                ratio[name] = (f'{np.mean(np.square(x)) / VAR_INF:.3f} ± '
                               f'{math.sqrt(2.0 * RATE / (ALPHA * n)):.3f}')
    first = next(iter(least.values()))
    return table(['way', 'ns/sample', 'million samples/s', 'times standard_normal',
                  'variance over sigma²/(2 alpha)'],
                 [[name, f'{ns:.3g}', f'{1e3 / ns:.3g}', f'{ns / first:.3g}', ratio[name]]
                  for name, ns in least.items()])


def main() -> int:
    """Measure and print the tables, or put them into the page."""
    parser = arguments(__doc__)
    parser.add_argument('--quick', action='store_true', help='a tenth of the samples, once')
    parser.add_argument('--repeats', type=int, default=5)
    given = parser.parse_args()
    text = (f'<!-- {environment("numba")} -->\n\n### Samples per second, one thread, CPU time\n\n'
            + speeds(*((200_000, 1) if given.quick else (2_000_000, given.repeats))))
    deliver(text, given.page, 'benchmark')
    return 0


if __name__ == '__main__':
    sys.exit(main())
