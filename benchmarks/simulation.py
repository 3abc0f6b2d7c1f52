"""
Simulated samples per second against what users would write: one command (1 min).

    python benchmarks/simulation.py [--quick] [--json FILE] [--markdown FILE]

See README.md beside this file.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
import json
import math
import os
from pathlib import Path
import random
import subprocess
import sys
import time
from typing import Any

# Before NumPy is loaded: one thread for all.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ[_name] = '1'
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np  # noqa: E402
from ou_monitor.model.supply import SEGMENT, Simulation, SupplyModel  # noqa: E402
from ou_monitor.model.terms.ac_coupling import ACCoupling  # noqa: E402
from ou_monitor.model.terms.nonlinear_restoring import NonlinearRestoring  # noqa: E402
from ou_monitor.model.terms.ou import OU  # noqa: E402
from ou_monitor.model.terms.shocks import Jumps  # noqa: E402
from ou_monitor.model.terms.slow import FlickerNoise  # noqa: E402
from ou_monitor.model.terms.term import Term  # noqa: E402
from ou_monitor.simulation import PRESETS, PROFILES  # noqa: E402
from tables import put, table  # noqa: E402

ALPHA, SIGMA, RATE = 63.0, 0.632, 1000.0
VAR_INF = SIGMA**2 / (2.0 * ALPHA)
PATHS = 1000
SEED = 20260131
Draw = Callable[[int], Any]


@dataclass(frozen=True)
class Row:
    """One way to make samples."""

    name: str  # For the table.
    draw: Draw  # Makes n samples; returns them where they are of the plain OU, else None.
    share: float = 1.0  # Samples, as a share of those of the fastest.
    law: bool = False  # Whether the variance is compared with that of the plain OU.


def _supply(*more: Term) -> Draw:
    return _of(SupplyModel((OU(ALPHA, SIGMA, 5.0), *more)))


def _of(model: SupplyModel) -> Draw:
    profile = PROFILES['flight'][0]

    def draw(n: int) -> Any:
        run, drawn = Simulation(model, np.random.default_rng(SEED)), []
        for first in range(0, n, SEGMENT):
            t = np.arange(first, min(first + SEGMENT, n)) / RATE
            drawn.append(run.advance(t, profile(t) if model.needs_throttle else None))
        return np.concatenate(drawn) - model.ou.u0

    return draw


def _step() -> tuple[float, float]:
    phi = math.exp(-ALPHA / RATE)
    return phi, math.sqrt(VAR_INF * (1.0 - phi * phi))


def python_loop(n: int) -> Any:
    """Draw by a loop over Python floats."""
    phi, std = _step()
    gauss, x, out = random.Random(SEED).gauss, 0.0, []
    for _ in range(n):
        x = phi * x + gauss(0.0, std)
        out.append(x)
    return np.array(out)


def filtered(n: int) -> Any:
    """Draw by filtering white noise, all at once, as one who knows SciPy would."""
    from scipy.signal import lfilter
    phi, std = _step()
    return lfilter([std], [1.0, -phi], np.random.default_rng(SEED).standard_normal(n))


def normals(n: int) -> None:
    """Draw standard normal numbers and nothing else."""
    rng = np.random.default_rng(SEED)
    for first in range(0, n, SEGMENT):
        rng.standard_normal(min(SEGMENT, n - first))


def _numba() -> Row:
    from numba import njit

    @njit
    def loop(phi: float, std: float, rng: Any, n: int) -> Any:
        x, out = 0.0, np.empty(n)
        for k in range(n):
            x = phi * x + std * rng.standard_normal()
            out[k] = x
        return out

    loop(*_step(), np.random.default_rng(SEED), 10)
    return Row('Numba loop, plain OU', lambda n: loop(*_step(), np.random.default_rng(SEED), n),
               law=True)


def _sdeint() -> list[Row]:
    import sdeint

    def by(method: Callable[..., Any]) -> Draw:
        def draw(n: int) -> Any:
            found = method(lambda y, t: -ALPHA * y, lambda y, t: np.array([[SIGMA]]),
                           np.zeros(1), np.arange(n) / RATE)
            return found[:, 0]
        return draw

    np.random.seed(SEED)
    return [Row('sdeint.itoEuler', by(sdeint.itoEuler), 0.01, law=True),
            Row('sdeint.itoSRI2', by(sdeint.itoSRI2), 0.01, law=True)]


def _sdepy() -> list[Row]:
    import sdepy

    def draw(paths: int) -> Draw:
        def of(n: int) -> Any:
            process = sdepy.ornstein_uhlenbeck_process(
                paths=paths, x0=0.0, theta=0.0, k=ALPHA, sigma=SIGMA,
                rng=np.random.default_rng(SEED))
            found = np.asarray(process(np.arange(n // paths) / RATE))
            # From some relaxations on.
            return found[int(10.0 * RATE / ALPHA):] if paths > 1 else found
        return of

    return [Row('sdepy, one path', draw(1), 0.01, law=True),
            Row(f'sdepy, {PATHS} paths at once', draw(PATHS), law=True)]


def rows() -> list[Row]:
    """Return all ways, the random numbers first."""
    noisy = PRESETS['flight'].model
    out = [
        Row('numpy standard_normal alone', normals),
        Row('**ou_monitor: ou**', _supply(), law=True),
        Row('**ou_monitor: ou, sag, sigma(throttle), noise**', _of(noisy)),
        Row('**ou_monitor: flight_full, 7 terms**', _of(PRESETS['flight_full'].model)),
        Row('**ou_monitor: ou, jumps**', _supply(Jumps(5.0, 0.0, 0.05))),
        Row('**ou_monitor: ou, ac_coupling**', _supply(ACCoupling(10.0, 0.0))),
        Row('**ou_monitor: ou, flicker_noise**', _supply(FlickerNoise(5e-3, 0.1, 100.0))),
        Row('**ou_monitor: ou, nonlinear_restoring**', _supply(NonlinearRestoring(0.0, 2e3)),
            0.05),
        Row('scipy lfilter by hand, plain OU', filtered, law=True),
        Row('plain Python loop, plain OU', python_loop, 0.2, law=True)]
    for make in (lambda: [_numba()], _sdeint, _sdepy):
        try:
            out += make()
        except ImportError as error:
            print(f'left out: {error}', file=sys.stderr)
    return out


def speeds(samples: int, repeats: int) -> list[dict[str, Any]]:
    """Measure all in turn, `repeats` times; the fastest of each counts."""
    ways = rows()
    found = [{'name': way.name, 'ns': math.inf, 'n': int(samples * way.share),
              'ratio': None, 'se': None} for way in ways]
    for _ in range(repeats):
        for way, one in zip(ways, found):
            begin = time.thread_time()
            x = way.draw(one['n'])
            spent = time.thread_time() - begin
            one['ns'] = min(one['ns'], spent / one['n'] * 1e9)
            if way.law:
                one['ratio'] = float(np.mean(np.square(x))) / VAR_INF
                # Of a mean of squares over T seconds (Bartlett).
                one['se'] = math.sqrt(2.0 * RATE / (ALPHA * np.size(x)))
    return found


def memory(samples: int) -> dict[str, float]:
    """Simulate so many samples in a process of its own."""
    done = subprocess.run([sys.executable, __file__, '--memory', str(samples)], check=True,
                          stdout=subprocess.PIPE, text=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def _peak() -> float:
    """Return the peak RSS of this program, MB; that of its parent does not count (Linux)."""
    status = Path('/proc/self/status').read_text()
    return next(int(line.split()[1]) for line in status.splitlines()
                if line.startswith('VmHWM')) / 1024.0


def _one_run(samples: int) -> dict[str, float]:
    before = _peak()
    model = PRESETS['flight'].model
    run, profile = Simulation(model, np.random.default_rng(SEED)), PROFILES['flight'][0]
    begin = time.thread_time()
    for first in range(0, samples, SEGMENT):
        t = np.arange(first, min(first + SEGMENT, samples)) / 1e6
        run.advance(t, profile(t))
    return {'samples': samples, 'seconds': time.thread_time() - begin, 'before': before,
            'peak': _peak()}


def report(found: dict[str, Any]) -> str:
    """Return all tables as Markdown."""
    setting = ', '.join(f'{k} {v}' for k, v in found['environment'].items())
    normal = found['speeds'][0]['ns']
    cells = [[one['name'], f"{one['ns']:.3g}", f"{1e3 / one['ns']:.3g}",
              f"{one['ns'] / normal:.3g}",
              '' if one['ratio'] is None else f"{one['ratio']:.3f} ± {one['se']:.3f}"]
             for one in found['speeds']]
    parts = [f'<!-- {setting} -->\n', '### Samples per second, one thread, CPU time\n',
             table(['what', 'ns/sample', 'million samples/s', 'times standard_normal',
                    'variance over sigma²/(2 alpha)'], cells)]
    runs = [[f"{one['samples']:.0e}", f"{one['seconds']:.3g}", f"{one['before']:.0f}",
             f"{one['peak']:.0f}"] for one in found['memory']]
    parts += ['### Memory: the preset `flight` at 1 MHz, in pieces, throttle included\n',
              table(['samples', 'CPU s', 'RSS before, MB', 'peak RSS, MB'], runs)]
    return '\n'.join(parts)


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return 'not installed'


def main() -> int:
    """Parse arguments, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--quick', action='store_true', help='a tenth of the samples, once')
    parser.add_argument('--memory', type=int, help=argparse.SUPPRESS)
    parser.add_argument('--json', type=Path, help='write all numbers here')
    parser.add_argument('--markdown', type=Path,
                        help='write the tables here, between its marks if it has them')
    given = parser.parse_args()
    if given.memory is not None:
        print(json.dumps(_one_run(given.memory)))
        return 0
    # Not at the top: it brings along what the memory of a run would count.
    from estimator import environment
    about = environment()
    found: dict[str, Any] = {'environment': {
        name: about.get(name) or _version(name) for name in (
            'python', 'machine', 'commit', 'numpy', 'scipy', 'numba', 'sdeint', 'sdepy')}}
    found['speeds'] = speeds(200_000 if given.quick else 2_000_000, 1 if given.quick else 5)
    found['memory'] = [memory(n) for n in ((10**6, 10**7) if given.quick else (10**7, 10**8))]
    text = report(found)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + '\n')
    print(text)
    if given.markdown:
        put(given.markdown, text, 'benchmark')
    return 0


if __name__ == '__main__':
    sys.exit(main())
