"""
The sliding-window estimator against what users would pick: one command (10 min).

    python benchmarks/estimator.py [--windows 500] [--quick] [--json FILE]
        [--accuracy doc/results/estimator.md] [--speed doc/results/estimator.md]

See README.md beside this file.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import json
import os
from pathlib import Path
import platform
import subprocess
import sys
import time
from typing import Any

# Before NumPy is loaded: one thread for all, so that CPU times compare.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ[_name] = '1'
_HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(_HERE.parent))

import common  # noqa: E402
import methods  # noqa: E402
import numpy as np  # noqa: E402
from ou_monitor.online.estimator.estimator import SlidingEstimator  # noqa: E402
import tables  # noqa: E402
import windows as simulated  # noqa: E402
from windows import Array, Fit, Fits, NAMES, rmse_ratio, SENSORS, TRUTH  # noqa: E402

SEED = 20260131
_PACKAGES = ('numpy', 'scipy', 'numba', 'statsmodels', 'celerite2', 'pandas')
OURS = 'ou_monitor SlidingEstimator'
KALMAN = 'Kalman, restricted likelihood'
CORRECTED = 'the same, corrected by 2/T'
# alpha T of the small windows; they are seen with this sensor.
RELAXATIONS = (5, 8, 12, 25, 40, 126, 630)
SMALL_SENSOR = '5 mV noise'
# Name, time constant, dead time (s), and whether steps fall on the sampling grid.
RESPONSES: tuple[tuple[str, float, float, bool], ...] = (
    ('(a) at once', 0.0, 0.0, True),
    ('(b) through a 10 ms lag', 0.010, 0.0, True),
    ('(c) 10 ms lag, steps between samples', 0.010, 0.0, False),
    ('(d) through a 20 ms lag', 0.020, 0.0, True),
    ('(e) 10 ms lag after 5 ms dead time', 0.010, 0.005, True),
)


def environment() -> dict[str, str]:
    """Return what the numbers depend on."""
    from importlib import metadata
    out = {'python': platform.python_version(), 'machine': _processor()}
    for name in _PACKAGES:
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            out[name] = 'not installed'
    try:
        out['commit'] = subprocess.run(
            ['git', 'describe', '--always', '--dirty'], cwd=_HERE, check=True,
            capture_output=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        out['commit'] = 'unknown'
    return out


def _processor() -> str:
    info = Path('/proc/cpuinfo')
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith('model name'):
                return line.split(':', 1)[1].strip()
    return platform.processor() or platform.machine()


def say(text: str) -> None:
    """Tell progress."""
    print(text, file=sys.stderr, flush=True)


def ours(y: Array, dt: float, throttle: Array | None = None) -> Fit:
    """Return our estimate of one window, from nothing."""
    n = y.size
    window = n * dt
    estimator = SlidingEstimator(window)
    estimator.push(1000.0 * window + np.arange(n) * dt, y, throttle)
    e = estimator.estimate()
    return Fit(e.alpha, e.sigma, e.var_inf, (e.alpha_se, e.sigma_se, e.var_inf_se),
               e.status.name)


def run(method: Callable[..., Any], windows: Array, *columns: Array) -> Fits:
    """Fit each window; CPU time of this process, errors of a fit left out where they are extra."""
    out = Fits()
    for row, y in enumerate(windows):
        begin = time.process_time()
        fit = method(y, simulated.DT, *(c[row] for c in columns))
        out.seconds.append(time.process_time() - begin)
        if isinstance(fit, tuple):
            fit = fit[1]()
        out.fits.append(fit)
    return out


def correct(plain: Fits, duration: float) -> Fits:
    """Return fits less their small-sample bias."""
    return Fits([methods.kalman_corrected(f, duration) for f in plain.fits], plain.seconds)


def compare(seed: int, windows: int, slow: int) -> dict[str, Any]:
    """Compare all methods on 2 s windows at 1 kHz."""
    rng = np.random.default_rng(seed)
    paths = simulated.simulate(rng, windows, round(simulated.WINDOW / simulated.DT))
    tables: dict[str, Any] = {}
    ratios: dict[str, Any] = {}
    for sensor, see in SENSORS.items():
        seen = see(paths, rng)
        results = {OURS: run(ours, seen)}
        for name, package, method, is_slow in methods.PEERS:
            if not methods.installed(package):
                say(f'  {name}: {package} is not installed, left out')
                continue
            begin = time.monotonic()
            results[name] = run(method, seen[:slow] if is_slow else seen)
            say(f'  {sensor}: {name}: {time.monotonic() - begin:.1f} s')
            if name == KALMAN:
                results[CORRECTED] = correct(results[name], simulated.WINDOW)
        tables[sensor] = {name: fits.summary(TRUTH) for name, fits in results.items()}
        ratios[sensor] = _ratios(results)
    return {'tables': tables, 'ratios': ratios}


def _ratios(results: dict[str, Fits]) -> dict[str, Any]:
    own = results[OURS].relative(TRUTH)
    out: dict[str, Any] = {}
    for reference in (KALMAN, CORRECTED):
        other = results[reference].relative(TRUTH)
        out[reference] = {name: rmse_ratio(own[:, i], other[:, i], paired=True)
                          for i, name in enumerate(NAMES)}
    return out


def small(seed: int, windows: int) -> dict[str, Any]:
    """Shorten the window."""
    rng = np.random.default_rng(seed)
    out: dict[str, Any] = {}
    for relaxations in RELAXATIONS:
        n = round(relaxations / simulated.ALPHA / simulated.DT)
        seen = SENSORS[SMALL_SENSOR](simulated.simulate(rng, windows, n), rng)
        own = run(ours, seen)
        reference = correct(run(methods.kalman_fit, seen), n * simulated.DT)
        told = np.isfinite(own.relative(TRUTH)[:, 0])
        out[str(relaxations)] = {
            'samples': n, 'ours': own.summary(TRUTH, told),
            'kalman': reference.summary(TRUTH, told), 'kalman_all': reference.summary(TRUTH)}
        say(f'  alpha T = {relaxations} done')
    return out


def load(seed: int, windows: int) -> dict[str, Any]:
    """Step the throttle within the window."""
    rng = np.random.default_rng(seed)
    n = round(simulated.WINDOW / simulated.DT)
    still = SENSORS[SMALL_SENSOR](simulated.simulate(rng, windows, n), rng)
    throttle, times = simulated.throttle_steps(rng, windows, n)
    rest = run(ours, still, np.full_like(still, simulated.LOW))
    base = rest.relative(TRUTH)
    out: dict[str, Any] = {'no steps': {'summary': rest.summary(TRUTH), 'ratio': None}}

    def add(name: str, fits: Fits) -> None:
        errors = fits.relative(TRUTH)
        out[name] = {'summary': fits.summary(TRUTH),
                     'ratio': {p: rmse_ratio(errors[:, i], base[:, i], paired=True)
                               for i, p in enumerate(NAMES)}}

    add('throttle moves, supply does not sag', run(ours, still, throttle))
    for name, lag, delay, on_grid in RESPONSES:
        sag = simulated.sagging(throttle, times, lag, delay, on_grid)
        add(name, run(ours, still + sag, throttle))
        say(f'  {name} done')
    sag = simulated.sagging(throttle, times, RESPONSES[1][1])
    add('(b), throttle not given', run(ours, still + sag))
    return out


def speed(quick: bool) -> dict[str, Any]:
    """Measure speed in a fresh process."""
    command = [sys.executable, str(_HERE / 'speed.py'), *(['--quick'] if quick else [])]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def measure(windows: int, slow: int, quick: bool, parts: str) -> dict[str, Any]:
    """Run the parts asked for; a letter each."""
    out: dict[str, Any] = {'environment': environment(), 'windows': windows, 'slow': slow}
    if 'a' in parts:
        say(f'accuracy, {windows} windows ({slow} for the slow methods)')
        out['accuracy'] = compare(SEED, windows, slow)
    if 'w' in parts:
        say('short windows')
        out['small'] = small(SEED + 1, windows)
    if 't' in parts:
        say('throttle steps')
        out['load'] = load(SEED + 2, windows)
    if 's' in parts:
        say('speed')
        out['speed'] = speed(quick)
    return out


def accuracy_report(results: dict[str, Any]) -> str:
    """Return the tables of accuracy as Markdown; empty when no such part was run."""
    parts = []
    if 'accuracy' in results:
        parts += [f'### Accuracy: {simulated.WINDOW:g} s windows at 1 kHz\n',
                  tables.accuracy(results['accuracy']['tables']),
                  '### RMSE beside the full likelihood\n',
                  tables.ratios(results['accuracy']['ratios'])]
    if 'small' in results:
        parts += [f'### Short and long windows ({SMALL_SENSOR})\n',
                  tables.small(results['small'])]
    if 'load' in results:
        parts += [f'### Throttle steps, sag 0.3 V ({SMALL_SENSOR})\n',
                  tables.load(results['load'])]
    note = f'; {results["windows"]} windows, {results["slow"]} for the slow methods'
    return _with_setting(results, note, parts)


def speed_report(results: dict[str, Any]) -> str:
    """Return the tables of speed as Markdown; empty when that part was not run."""
    parts = []
    if 'speed' in results:
        found = results['speed']
        parts += ['### Throughput\n', tables.throughput(found['throughput']),
                  '### Latency of `estimate()` after pushes of 100 at 1 kHz\n',
                  tables.latency(found['latency'])]
    return _with_setting(results, '', parts)


def _with_setting(results: dict[str, Any], note: str, parts: list[str]) -> str:
    setting = ', '.join(f'{k} {v}' for k, v in results['environment'].items())
    return '\n'.join([f'<!-- {setting}{note} -->\n', *parts]) if parts else ''


def main() -> int:
    """Parse arguments, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--windows', type=int, default=500, help='windows per case')
    parser.add_argument('--slow-windows', type=int,
                        help='windows for methods of 0.2 s a fit and more (default: a fifth)')
    parser.add_argument('--quick', action='store_true',
                        help='20 windows and a tenth of the samples: does it run')
    parser.add_argument('--parts', default='awts',
                        help='a: accuracy, w: short windows, t: throttle steps, s: speed')
    parser.add_argument('--json', type=Path, help='write all numbers here')
    for name in ('accuracy', 'speed'):
        parser.add_argument(f'--{name}', type=Path,
                            help=f'write the tables of {name} here, between its marks '
                            f'"<!-- {name} begins -->" and "<!-- {name} ends -->" if it has them')
    given = parser.parse_args()
    windows = min(given.windows, 20) if given.quick else given.windows
    slow = given.slow_windows or max(windows // 5, min(windows, 5))
    if windows < 2 or slow < 2 or not set(given.parts) <= set('awts'):
        parser.error('--windows and --slow-windows need 2 or more; --parts is of a, w, t, s')
    results = measure(windows, min(slow, windows), given.quick, given.parts)
    if given.json:
        given.json.write_text(json.dumps(results, indent=1) + '\n')
    for name, text in (('accuracy', accuracy_report(results)), ('speed', speed_report(results))):
        path = getattr(given, name)
        if text and path:
            common.deliver(text, path, name)
        elif text:
            print(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
