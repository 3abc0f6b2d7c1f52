"""
Save the JSON of commands on recorded runs; print what changed between two versions (10 min).

    python benchmarks/freeze.py keep BEFORE --root OTHER_CHECKOUT
    python benchmarks/freeze.py keep AFTER
    python benchmarks/freeze.py moved BEFORE AFTER

`keep` runs the commands of a checkout on the recordings of `RUNS` (in `OU_MONITOR_REALDATA`;
missing ones are left out with a message) and writes one JSON per run and command in about ten
minutes; existing files are not written again.  `--parts` adds slower parts: the examination
(`--exam FOLDER`, with `examine.py`), effects hidden in recorded runs, and risk and load on
recorded flights.  `moved` compares two such folders number by number.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import json
import math
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
# Name, file (in the checkout or below OU_MONITOR_REALDATA), options of the commands.
RUNS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ('flight', 'bags/flight', ()),
    ('transient', 'bags/transient', ()),
    ('gecko', 'bf_gecko_a.csv', ()),
    ('gecko_log', 'raw/ie_btfl_002.bbl', ()),
    ('nazgul', 'raw/bf_nazgul_4s.bbl', ('--flight', '1')),
    ('roma', 'raw/bf_roma_6s.bbl', ('--flight', '3')),
    ('cf_solo', 'cf_solo_large.csv', ()),
    ('erle', 'raw/ac_erle_althold2.BIN', ()),
    ('jd', 'raw/ac_jd_2004.bin', ()),
    ('micromouse', 'mm_bench_3.csv', ()),
    ('regbot_81', 'regbot_81.csv', ()),
    ('frc_ol_1', 'frc_ol_1.csv', ()),
    ('xt_pico', 'xt_pico_a.csv', ()),
)
COMMANDS = ('analyze', 'compare', 'coupling', 'discover')
# The signal for `coupling`; the command is left out for logs without a gyro.
SIGNALS = {'gecko_log': 'gyroADC[0]', 'nazgul': 'gyroADC[0]', 'roma': 'gyroADC[0]'}
BENCHMARKS = {'injected': ('discover.py', 'injected'), 'risk': ('risk_real.py',),
              'load': ('real_flights.py',)}
# Runs the node's monitor over a recording, 20 samples at a time; prints the last report.
MONITOR = """
import dataclasses, enum, json, math, sys
import numpy as np
from ou_monitor import MonitorSettings, SupplyMonitor, read_recording
rec = read_recording(sys.argv[1], **json.loads(sys.argv[2]))
monitor = SupplyMonitor(MonitorSettings(brownout_voltage=float(np.quantile(rec.voltage, .05))))
for k in range(0, rec.n, 20):
    part = slice(k, k + 20)
    monitor.push(rec.t[part], rec.voltage[part], rec.throttle[part])
    report = monitor.report(age=0.0)
load = report.load
print(json.dumps({
    'estimate': {name: str(value) if isinstance(value, enum.Enum) else value
                 for name, value in vars(report.estimate).items()
                 if isinstance(value, (int, float, enum.Enum))},
    'counters': vars(report.estimate.counters), 'risk': report.risk,
    'risk_basis': str(report.risk_basis), 'budget': report.budget, 'flag': str(report.flag),
    'load': {'known': load.known, 'level': load.level, 'resistance': load.resistance,
             'sag': [float(load.sag(u)) for u in (0.0, 0.5, 1.0)],
             'noise': [float(load.noise(u)) for u in (0.0, 0.5, 1.0)]}}))
"""
# Numbers whose relative difference is smaller are the same.
SAME = 1e-6
_NUMBER = re.compile(r'-?\d+(?:\.\d+)?(?:e[+-]?\d+)?')


def run(words: list[str], root: Path, **more: Any) -> subprocess.CompletedProcess[str]:
    """Run Python on the package of a checkout."""
    environment = {**os.environ, 'PYTHONPATH': str(root), 'OPENBLAS_NUM_THREADS': '1'}
    return subprocess.run([sys.executable, *words], cwd=root, env=environment, text=True,
                          capture_output=True, check=False, **more)


def keep(into: Path, root: Path, parts: list[str], names: list[str], exam: Path | None,
         python: str) -> None:
    """Write the output of a checkout's commands."""
    into.mkdir(parents=True, exist_ok=True)
    data = Path(os.environ.get('OU_MONITOR_REALDATA', '/nowhere'))
    for name, file, options in RUNS if 'commands' in parts else ():
        path = root / file if (root / file).exists() else data / file
        if names and name not in names:
            continue
        if not path.exists():
            print(f'{name}: {path} is not there, left out', file=sys.stderr)
            continue
        for command in COMMANDS:
            out = into / f'{name}.{command}.json'
            signal = ('--signal', SIGNALS[name]) if name in SIGNALS else ()
            if not out.exists() and (signal or command != 'coupling'):
                done = run(['-c', 'from ou_monitor.cli.main import main; raise SystemExit(main())',
                            command, str(path), *options, '--json', '-',
                            *(signal if command == 'coupling' else ())], root)
                out.write_text(done.stdout if done.returncode == 0 else json.dumps(
                    {'exit': done.returncode, 'stderr': done.stderr.strip().split('\n')[-1]}))
        out = into / f'{name}.monitor.json'
        if not out.exists():
            flight = {'flight': int(options[1])} if options else {}
            done = run(['-c', MONITOR, str(path), json.dumps(flight)], root)
            out.write_text(done.stdout or json.dumps({'stderr': done.stderr[-300:]}))
        print(f'{name}: kept', file=sys.stderr)
    for part in parts:
        if part in BENCHMARKS and not (into / f'{part}.txt').exists():
            done = run(['benchmarks/' + BENCHMARKS[part][0], *BENCHMARKS[part][1:]], root)
            (into / f'{part}.txt').write_text(done.stdout)
            print(f'{part}: exit {done.returncode}', file=sys.stderr)
    if 'exam' in parts and exam is not None and not (into / 'exam.jsonl').exists():
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(shutil.copytree(exam, Path(folder) / 'exam'))
            program = Path(folder) / 'ou-monitor'
            program.write_text(f'#!/bin/sh\nPYTHONPATH={root} exec {sys.executable} -c "from '
                               'ou_monitor.cli.main import main; raise SystemExit(main())" "$@"\n')
            program.chmod(0o755)
            done = subprocess.run(
                [python, 'examine.py', '--seeds', '1', '--cli', str(program), '--out',
                 str(into.resolve() / 'exam.jsonl')], cwd=copy, text=True, capture_output=True,
                check=False)
            (into / 'exam.txt').write_text(done.stdout)
            print(done.stdout, done.stderr[-300:], file=sys.stderr)


def leaves(value: Any, path: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the leaves of a JSON value with their paths."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f'{path}.{key}')
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from leaves(inner, f'{path}[{k}]')
    else:
        yield path, value


def contents(path: Path) -> dict[str, Any]:
    """Return the leaves of a kept file; for a page, each line with its numbers extracted."""
    if path.suffix == '.json':
        text = path.read_text()
        return dict(leaves(json.loads(text))) if text.strip() else {'': None}
    if path.suffix == '.jsonl':
        found = {}
        for line in path.read_text().splitlines():
            one = json.loads(line)
            found[f"{one['effect']}.{one['seed']}"] = ', '.join(
                sorted(cause['name'] for cause in one['result'].get('causes', []))
            ) + ': ' + str(one['result'].get('verdict'))
        return found
    found = {}
    for k, line in enumerate(path.read_text().splitlines()):
        label = line.strip(' |').split('|')[0].strip()
        for j, number in enumerate(_NUMBER.findall(line)):
            found[f'{k} {label}[{j}]'] = float(number)
    return found


def differ(before: Any, after: Any, share: float) -> bool:
    """Return whether two leaves differ."""
    if isinstance(before, (int, float)) and isinstance(after, (int, float)):
        if math.isnan(before) and math.isnan(after):
            return False
        return not math.isclose(before, after, rel_tol=share, abs_tol=1e-12)
    return bool(before != after)


def moved(before: Path, after: Path, share: float, most: int) -> int:
    """Print the changed leaves; return their number."""
    count = 0
    for file in sorted({path.name for path in (*before.iterdir(), *after.iterdir())}):
        if not ((before / file).exists() and (after / file).exists()):
            print(f'{file}: only in {before if (before / file).exists() else after}')
            continue
        old, new = contents(before / file), contents(after / file)
        changed = [key for key in {**old, **new}
                   if key not in old or key not in new or differ(old[key], new[key], share)]
        count += len(changed)
        if changed:
            print(f'{file}: {len(changed)} of {len(old)} moved')
        for key in changed[:most]:
            print(f'    {key}: {old.get(key, "(absent)")!r:.70} -> '
                  f'{new.get(key, "(absent)")!r:.70}')
    print(f'{count} moved')
    return count


def main() -> int:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split('\n')[0])
    verbs = parser.add_subparsers(dest='verb', required=True)
    one = verbs.add_parser('keep')
    one.add_argument('into', type=Path)
    one.add_argument('--root', type=Path, default=ROOT, help='checkout (default: this one)')
    one.add_argument('--parts', nargs='+', default=['commands'],
                     choices=['commands', 'exam', *BENCHMARKS])
    one.add_argument('--runs', nargs='+', default=[], help='names (default: all)')
    one.add_argument('--exam', type=Path, help='folder with examine.py')
    one.add_argument('--exam-python', default=sys.executable, help='Python with Numba, for it')
    two = verbs.add_parser('moved')
    two.add_argument('before', type=Path)
    two.add_argument('after', type=Path)
    two.add_argument('--share', type=float, default=SAME, help='that counts as the same')
    two.add_argument('--most', type=int, default=12, help='lines a file')
    args = parser.parse_args()
    if args.verb == 'keep':
        keep(args.into, args.root.resolve(), args.parts, args.runs, args.exam, args.exam_python)
        return 0
    return 1 if moved(args.before, args.after, args.share, args.most) else 0


if __name__ == '__main__':
    sys.exit(main())
