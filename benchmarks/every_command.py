"""
Run every command on every recording of a folder: no traceback, one line of error (hours).

python benchmarks/every_command.py FOLDER [--quick] [--only NAME ...]

One process at a time.  `--quick` leaves out discover, compare, fleet and reproduce (minutes
instead of hours for 30 flights).  Each JSON of `analyze` is also searched for intervals that span
more than a factor of 10 either way.  The exit status is 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import json
import os
from pathlib import Path
import resource
import subprocess
import sys
import tempfile
from typing import Any

from common import ROOT
from ou_monitor.records import determined

ENDINGS = ('.csv', '.bbl', '.bfl', '.txt', '.bin', '.ulg', '.mcap')
# Timeout of one command, s: enough for `discover` of a long flight on a busy machine.
MOST = 3600.0


@dataclass(frozen=True)
class Run:
    """One command that was run."""

    command: str  # Words after 'ou-monitor', without paths of this machine.
    status: int
    seconds: float  # CPU time of it and its workers, s.
    fault: str  # What is wrong with it; empty if nothing is.
    out: str = ''  # Its standard output.


def run(*words: object, cwd: Path) -> Run:
    """Run one command in a process and judge how it ended."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    shown = ' '.join(Path(str(word)).name for word in words)
    try:
        done = subprocess.run(
            ['nice', sys.executable, '-m', 'ou_monitor.cli.main', *map(str, words)], cwd=cwd,
            capture_output=True, text=True, errors='replace', timeout=MOST, check=False,
            env={**os.environ, 'PYTHONPATH': str(ROOT)})
    except subprocess.TimeoutExpired:
        return Run(shown, -1, MOST, f'not done after {MOST:g} s')
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    # Progress may precede the one line of an error.
    lines = [line for line in done.stderr.splitlines() if line.startswith('ou-monitor')]
    fault = ''
    if 'Traceback' in done.stderr:
        fault = done.stderr.strip().splitlines()[-1]
    elif 'Warning' in done.stderr:
        fault = next(line for line in done.stderr.splitlines() if 'Warning' in line)
    elif done.returncode not in (0, 2):
        fault = f'status {done.returncode}'
    elif done.returncode == 2 and len(lines) != 1:
        fault = f'{len(lines)} lines for status 2'
    return Run(shown, done.returncode, seconds, fault, done.stdout)


def wide(data: Any, at: str = '') -> Iterator[str]:
    """Yield the paths of values in a JSON whose intervals are too wide."""
    if isinstance(data, dict):
        for key, value in data.items():
            ends = data.get(f'{key}_ci95')
            positive = key in ('alpha', 'tau', 'sigma', 'var_inf', 'ratio')
            if positive and value is not None and ends is not None and (
                    None in ends or not determined(value, *ends)):
                yield f'{at}/{key}'
            yield from wide(value, f'{at}/{key}')
    elif isinstance(data, list):
        for k, value in enumerate(data):
            yield from wide(value, f'{at}[{k}]')


def signals(listed: str) -> list[str]:
    """Return series other than voltages that `convert --list` lists: a gyro, a current."""
    names = [line.split()[0].lstrip('*') for line in listed.splitlines() if line.strip()]
    return [name for name in names if name.startswith(('gyro', 'IMU.Gyr', 'current', 'CURR'))][:1]


def runs_of(path: Path, folder: Path, quick: bool) -> Iterator[Run]:
    """Run each command on one recording; files go to `folder`."""
    result, model = folder / 'result.json', folder / 'model.yaml'
    for name in (result, model):
        name.unlink(missing_ok=True)
    files = ('--json', result, '--report', folder / 'report.html', '--force')
    listed = run('convert', path, '--list', cwd=folder)
    yield listed
    yield run('convert', path, folder / 'bag.mcap', '--force', cwd=folder)
    analysed = run('analyze', path, *files, cwd=folder)
    if result.exists():
        for place in wide(json.loads(result.read_text())):
            analysed = Run(analysed.command, analysed.status, analysed.seconds,
                           f'{place} is shown, and not known')
    yield analysed
    for name in signals(listed.out) or ['throttle']:
        yield run('coupling', path, '--signal', name, *files, cwd=folder)
    yield run('simulate', '--throttle', path, '--output', folder / 'made.mcap', '--force',
              cwd=folder)
    if quick:
        return
    yield run('compare', path, '--seeds', 20, *files, cwd=folder)
    yield run('discover', path, '--save-model', model, *files, cwd=folder)
    if model.exists():
        yield run('simulate', '--model', model, '--throttle', path, '--output',
                  folder / 'made.mcap', '--force', cwd=folder)
        yield run('compare', path, '--model', model, '--seeds', 20, *files, cwd=folder)


def recordings(folder: Path) -> list[Path]:
    """Return the recordings below a folder, by name."""
    return sorted(path for path in folder.rglob('*') if path.suffix.lower() in ENDINGS)


def main(argv: Sequence[str] | None = None) -> int:
    """Run all; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('folder', type=Path)
    parser.add_argument('--quick', action='store_true')
    parser.add_argument('--only', nargs='*', default=[])
    args = parser.parse_args(argv)
    done: list[Run] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def add(found: Run) -> None:
            done.append(found)
            print(f'{found.status:3d} {found.seconds:7.1f} s  {found.command[:60]:60s} '
                  f'{found.fault}', flush=True)
        for path in recordings(args.folder.resolve()):
            if not args.only or path.name in args.only:
                for found in runs_of(path, folder, args.quick):
                    add(found)
        if not args.quick and not args.only:
            add(run('fleet', args.folder.resolve(), '--output', folder / 'fleet', '--workers', 1,
                    cwd=folder))
            add(run('reproduce', '--json', '-', cwd=folder))
        add(run('design', '--risk', '1e-3', '--throttle', '0.6', '--json', '-', cwd=folder))
    bad = [found for found in done if found.fault]
    print(f'{len(done)} commands, {sum(r.status == 2 for r in done)} refused in one line, '
          f'{len(bad)} faults, {sum(r.seconds for r in done):.0f} s of CPU time')
    return int(bool(bad))


if __name__ == '__main__':
    sys.exit(main())
