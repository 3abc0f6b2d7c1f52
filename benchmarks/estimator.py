"""
The sliding-window estimator against what users would pick: one command.

    python benchmarks/estimator.py [--windows 500] [--quick] [--json FILE]
        [--accuracy doc/estimation_accuracy.md] [--speed doc/estimation_cost.md]

See README.md beside this file.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
import platform
import subprocess
import sys
from typing import Any

# Before NumPy is loaded: one thread for all, so that CPU times compare; and
# accuracy on the NumPy path, which the compiled one equals to 1e-9.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ[_name] = '1'
_ASKED = os.environ.get('OU_MONITOR_COMPILED', '1')
os.environ['OU_MONITOR_COMPILED'] = '0'
_HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(_HERE.parent))

import accuracy  # noqa: E402
import data  # noqa: E402
import tables  # noqa: E402

SEED = 20260131
_PACKAGES = ('numpy', 'scipy', 'numba', 'statsmodels', 'celerite2', 'pymle-diffusion', 'pandas')


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


def speed(quick: bool, compiled: bool) -> dict[str, Any]:
    """Measure speed in a fresh process, with or without compiled code."""
    command = [sys.executable, str(_HERE / 'speed.py'), *(['--quick'] if quick else [])]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env={
        **os.environ, 'OU_MONITOR_COMPILED': '1' if compiled else '0'})
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def measure(windows: int, slow: int, quick: bool, parts: str) -> dict[str, Any]:
    """Run the parts asked for; a letter each."""
    out: dict[str, Any] = {'environment': environment(), 'windows': windows, 'slow': slow}
    if 'a' in parts:
        accuracy.say(f'accuracy, {windows} windows ({slow} for the slow methods)')
        out['accuracy'] = accuracy.compare(SEED, windows, slow)
    if 'w' in parts:
        accuracy.say('short windows')
        out['small'] = accuracy.small(SEED + 1, windows)
    if 't' in parts:
        accuracy.say('throttle steps')
        out['load'] = accuracy.load(SEED + 2, windows)
    if 's' in parts:
        accuracy.say('speed, NumPy')
        out['speed'] = {'NumPy': speed(quick, compiled=False)}
        if _ASKED != '0':
            accuracy.say('speed, compiled')
            found = speed(quick, compiled=True)
            if found['compiled']:
                out['speed']['Numba'] = found
            else:
                accuracy.say('  no compiled path here')
    return out


def accuracy_report(results: dict[str, Any]) -> str:
    """Return the tables of accuracy as Markdown; empty when no such part was run."""
    parts = []
    if 'accuracy' in results:
        parts += [f'### Accuracy: {data.WINDOW:g} s windows at 1 kHz\n',
                  tables.accuracy(results['accuracy']['tables']),
                  '### RMSE beside the full likelihood\n',
                  tables.ratios(results['accuracy']['ratios'])]
    if 'small' in results:
        parts += [f'### Short and long windows ({accuracy.SMALL_SENSOR})\n',
                  tables.small(results['small'])]
    if 'load' in results:
        parts += [f'### Throttle steps, sag 0.3 V ({accuracy.SMALL_SENSOR})\n',
                  tables.load(results['load'])]
    note = f'; {results["windows"]} windows, {results["slow"]} for the slow methods'
    return _with_setting(results, note, parts)


def speed_report(results: dict[str, Any]) -> str:
    """Return the tables of speed as Markdown; empty when that part was not run."""
    parts = []
    for name, found in results.get('speed', {}).items():
        parts += [f'### Throughput, {name}\n', tables.throughput(found['throughput']),
                  f'### Latency of `estimate()` after pushes of 100 at 1 kHz, {name}\n',
                  tables.latency(found['latency'])]
    return _with_setting(results, '', parts)


def _with_setting(results: dict[str, Any], note: str, parts: list[str]) -> str:
    setting = ', '.join(f'{k} {v}' for k, v in results['environment'].items())
    return '\n'.join([f'<!-- {setting}{note} -->\n', *parts]) if parts else ''


def put_tables(path: Path, name: str, text: str) -> None:
    """Write the tables of that name, between its marks where the file has them."""
    if path.exists():
        old = path.read_text()
        head, mark, rest = old.partition(f'<!-- {name} begins -->')
        _, end, tail = rest.partition(f'<!-- {name} ends -->')
        if mark and end:
            text = f'{head}{mark}\n{text}\n{end}{tail}'
    path.write_text(text)


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
            put_tables(path, name, text)
        elif text:
            print(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
