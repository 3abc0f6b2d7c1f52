"""
Law `kalman` told a wrong bandwidth, on recorded gyros, with and without its check.

    OU_MONITOR_REALDATA=FOLDER python benchmarks/told_wrong.py --page doc/filter.md

The truth is 20 s of a gyro's roll from 8 s on (a third of a shorter flight), below 30 Hz without
phase; to it come supply noise (an OU of 63 1/s, 0.09 of the truth's deviation) and white noise of
0.01 rad/s.  The mean square error is over that of the best of 15 fixed cutoffs in hindsight.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
import sys

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import gyros  # noqa: E402
import numpy as np  # noqa: E402
from ou_monitor import AdaptiveLowPass  # noqa: E402
from scipy import signal  # noqa: E402
from tables import put, table  # noqa: E402

SEED, ALPHA, SPREAD, WHITE = 20261122, 63.0, 0.05, 0.01
SIGMA = SPREAD * math.sqrt(2.0 * ALPHA)
NAMES = ('bf3s', 'nazgul', 'roma 3', 'gecko')
TOLD = (2.0, 8.0)


def measure(gyro: gyros.Gyro, mode: str) -> list[str]:
    """Return a row: unchecked and checked for each bandwidth that is told."""
    rng = np.random.default_rng(SEED)
    sos = signal.butter(4, 30.0, fs=gyro.rate, output='sos')
    seconds = min(20.0, gyro.t[-1] / 3.0)
    part = (gyro.t >= 8.0) & (gyro.t < 8.0 + seconds)
    truth = signal.sosfiltfilt(sos, np.radians(gyro.signal[:, 0]))[part]
    t = gyro.t[part]
    coupling = 0.09 * float(truth.std()) / SPREAD
    keep = math.exp(-ALPHA / gyro.rate)
    noise = coupling * signal.lfilter([SPREAD * math.sqrt(1.0 - keep * keep)], [1.0, -keep],
                                      rng.standard_normal(t.size))
    x = truth + noise + WHITE * rng.standard_normal(t.size)
    target = truth if mode == 'lowpass' else np.gradient(truth, 1.0 / gyro.rate)

    def error(low_pass: AdaptiveLowPass, sigma: float) -> float:
        return float(np.mean((low_pass.filter(t, x, sigma) - target)[200:]**2))
    cutoffs = np.geomspace(2.0, 110.0, 15)
    fixed = [error(AdaptiveLowPass(mode=mode, law='threshold', fmin=1.0, fmax=f + 1e-3,
                                   fallback=f), math.nan) for f in cutoffs]
    cells = [f'{error(_kalman(gyro, mode, coupling, told, truth, check), SIGMA) / min(fixed):.2f}'
             for told in TOLD for check in (False, True)]
    return [gyro.name, 'D term' if mode == 'derivative' else 'signal',
            f'{cutoffs[int(np.argmin(fixed))]:.0f}', *cells]


def _kalman(gyro: gyros.Gyro, mode: str, coupling: float, told: float, truth: np.ndarray,
            check: bool) -> AdaptiveLowPass:
    return AdaptiveLowPass(
        mode=mode, law='kalman', fmin=1.0, fmax=110.0, coupling=coupling, alpha=ALPHA,
        n0=WHITE**2 / gyro.rate, signal_bandwidth=told, signal_rms=float(truth.std()),
        signal_poles=2, signal_check=check)


def main() -> int:
    """Measure and print the table, or put it into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('flight', nargs='*', help='names (default all)')
    parser.add_argument('--page', type=Path, help='page whose table is replaced')
    options = parser.parse_args()
    if gyros.folder() is None:
        parser.error('OU_MONITOR_REALDATA is not set: it names the folder of the flights')
    rows = []
    for name in options.flight or NAMES:
        gyro = gyros.read(name)
        if gyro is not None:
            rows += [measure(gyro, mode) for mode in ('lowpass', 'derivative')]
            print(rows[-2:], file=sys.stderr)
    text = table(['gyro', '', 'best fixed, Hz', *(
        f'told {told:g} Hz{words}' for told in TOLD for words in ('', ', checked'))], rows)
    if options.page:
        put(options.page, text, 'told')
    else:
        print(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
