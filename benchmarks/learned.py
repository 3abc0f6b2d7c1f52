"""
Law `kalman` on recorded gyros, given the noise but not the signal (4 min).

    OU_MONITOR_REALDATA=FOLDER python benchmarks/learned.py --page doc/results/learned.md

The truth is a gyro axis after a zero-phase low-pass at 30 Hz (or an eighth of the rate, if less),
in stretches of 20 s from 8 s on.  Supply noise (an OU of 63 1/s with 0.09 of the truth's
deviation) and white noise of 0.01 rad/s (or a tenth of the truth's deviation, if less) are added.
In each stretch, the mean square error from the 200th sample on is divided by the error of the best
of 15 fixed cutoffs from 2 to 110 Hz (0.44 of the rate) in hindsight.

The constants of `learned_wiener` and `low_pass_span` were chosen on bf3s, roma and jd, and for the
first second on gecko; nazgul and erle were not used for this.
"""

from __future__ import annotations

from collections.abc import Iterator
import math
import sys

from common import arguments, deliver, say, table
import gyros
import numpy as np
from ou_monitor import AdaptiveLowPass
from scipy import signal

SEED, ALPHA, SPREAD, WHITE = 20261122, 63.0, 0.05, 0.01
SIGMA = SPREAD * math.sqrt(2.0 * ALPHA)
SECONDS, FIRST = 20.0, 8.0
MODES = {'lowpass': 'signal', 'derivative': 'D term'}


def stretches(gyro: gyros.Gyro, most: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield stamps and truth (rad/s) of some stretches of each axis."""
    rate = 1.0 / float(np.median(np.diff(gyro.t)))
    t = np.arange(gyro.t[0], gyro.t[-1], 1.0 / rate)
    sos = signal.butter(4, min(30.0, rate / 8.0), fs=rate, output='sos')
    begins = np.arange(FIRST, gyro.t[-1] - 0.6 * SECONDS, SECONDS)
    if begins.size > most:
        begins = begins[np.linspace(0, begins.size - 1, most).round().astype(int)]
    for axis in gyro.signal.T:
        truth = signal.sosfiltfilt(sos, np.radians(np.interp(t, gyro.t, axis)))
        for begin in begins:
            part = (t >= begin) & (t < begin + SECONDS)
            yield t[part], truth[part]


def ratio(t: np.ndarray, truth: np.ndarray, mode: str, rng: np.random.Generator) -> float:
    """Return the mean square error relative to the best fixed cutoff's."""
    rate = (t.size - 1) / float(t[-1] - t[0])
    white = min(WHITE, 0.1 * float(truth.std()))
    coupling = 0.09 * float(truth.std()) / SPREAD
    keep = math.exp(-ALPHA / rate)
    x = (truth + white * rng.standard_normal(t.size) + coupling * signal.lfilter(
        [SPREAD * math.sqrt(1.0 - keep * keep)], [1.0, -keep], rng.standard_normal(t.size)))
    target = truth if mode == 'lowpass' else np.gradient(truth, 1.0 / rate)
    top = min(110.0, 0.44 * rate)

    def error(sigma: float, **options: object) -> float:
        out = AdaptiveLowPass(mode=mode, **options).filter(t, x, sigma)
        return float(np.mean((out - target)[200:]**2))
    best = min(error(math.nan, law='threshold', fmin=0.5 * f, fmax=f + 1e-3, fallback=f)
               for f in np.geomspace(2.0, top, 15))
    return error(SIGMA, law='kalman', fmin=1.0, fmax=top, alpha=ALPHA, coupling=coupling,
                 n0=white**2 / rate) / best


def measure(gyro: gyros.Gyro, most: int) -> list[list[str]]:
    """Return a row for each mode: geometric mean and worst of all stretches."""
    rows = []
    for mode, name in MODES.items():
        rng = np.random.default_rng(SEED)
        found = np.array([ratio(t, truth, mode, rng) for t, truth in stretches(gyro, most)])
        rows.append([gyro.name, name, str(found.size), f'{np.exp(np.mean(np.log(found))):.2f}',
                     f'{found.max():.2f}'])
    return rows


def main() -> int:
    """Measure and print the table, or put it into the page."""
    parser = arguments(__doc__, names=True)
    parser.add_argument('--stretches', type=int, default=4, help='most of an axis')
    options = parser.parse_args()
    rows = []
    for name, *_ in (*gyros.FLIGHTS, *gyros.SLOW):
        gyro = gyros.read(name) if name in (options.names or [name]) else None
        if gyro is not None:
            rows += measure(gyro, options.stretches)
            say(*rows[-2:])
    text = table(['gyro', '', 'stretches', 'mean', 'worst'], rows)
    deliver(text, options.page, 'learned')
    return 0


if __name__ == '__main__':
    sys.exit(main())
