"""
Mutation test of the suite: what it notices of random changes of the sources.

    python benchmarks/mutation.py [--number 150] [--seed N] [--jobs 2] [--table FILE]

See README.md beside this file. Needs pytest and coverage beside the package. What is done is kept
in the folder `--work`: stopped, it goes on from there with the same command.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
import json
import math
from pathlib import Path
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from mutants import draw, Mutant
from mutation_map import carry, file_of, Reach, reach
from mutation_runs import prepare, read_lines, stop, Tree

ROOT = Path(__file__).resolve().parent.parent
SEED = 20261122
FOLDERS = ('ou_monitor/online', 'ou_monitor/model/terms', 'ou_monitor/criticism',
           'ou_monitor/discovery')
# Not by default: real-time runs of ROS, whose timing two runs at once spoil; what builds the
# package or looks at the sources rather than at what they calculate.
TESTS = ('test/online', 'test/model', 'test/criticism', 'test/discovery', 'test/analysis',
         'test/coupling', 'test/simulation', 'test/stream', 'test/fleet', 'test/cli',
         'test/test_golden_runs.py')
STATUSES = ('killed', 'timeout', 'survived', 'not covered')


def say(text: str) -> None:
    """Tell how far it has come."""
    print(text, file=sys.stderr, flush=True)


def snapshot(work: Path) -> None:
    """Copy the project as it is now, once: edits to it do not disturb a run that goes on."""
    origin = work / 'origin'
    if origin.exists():
        say(f'goes on with the sources that were copied to {origin}; remove {work} for new ones')
        return
    listed = subprocess.run(['git', 'ls-files', '-co', '--exclude-standard', '-z'], cwd=ROOT,
                            check=True, capture_output=True, text=True).stdout.split('\0')
    part = work / 'origin.part'
    shutil.rmtree(part, ignore_errors=True)
    for name in filter(None, listed):
        if (ROOT / name).is_file():
            (part / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, part / name)
    about = subprocess.run(['git', 'describe', '--always', '--dirty'], cwd=ROOT,
                           capture_output=True, text=True).stdout.strip()
    (part / 'commit').write_text(about or 'unknown')
    part.rename(origin)


def files_of(origin: Path, tests: Sequence[str]) -> list[str]:
    """Return the files of tests in files and folders."""
    return sorted({path.relative_to(origin).as_posix() for name in tests for path in (
        (origin / name).rglob('test_*.py') if (origin / name).is_dir() else [origin / name])})


def collect(work: Path, files: Sequence[str], trees: queue.Queue[Tree], jobs: int,
            earlier: Path | None) -> Reach:
    """Return the map of the files of tests, running those that are not in it yet."""
    origin, folder = work / 'origin', work / 'reach'
    folder.mkdir(exist_ok=True)
    if earlier:
        say(f'map: {len(carry(earlier, work, files))} of {len(files)} files carried over')
    out = {name: folder / file_of(name) for name in files}
    left = [name for name in files if not out[name].exists()]

    def one(name: str) -> str:
        tree = trees.get()
        try:
            reach(tree, name, out[name])
        finally:
            trees.put(tree)
        return name
    for k, name in enumerate(_parallel(one, left, jobs)):
        say(f'map {k + 1}/{len(left)}: {name}')
    return Reach(out.values(), origin)


def _parallel(function: Any, arguments: Iterable[Any], jobs: int) -> Iterator[Any]:
    """Yield results as they come; on an interruption nothing more is begun."""
    waiting = iter(arguments)
    under_way: set[Future[Any]] = set()
    with ThreadPoolExecutor(jobs) as pool:
        while True:
            for argument in waiting:
                under_way.add(pool.submit(function, argument))
                if len(under_way) >= jobs:
                    break
            if not under_way:
                return
            try:
                done, under_way = wait(under_way, return_when=FIRST_COMPLETED)
            except KeyboardInterrupt:
                stop()
                raise
            for one in done:
                yield one.result()


def choose(mutant: Mutant, reached: Reach, budget: float) -> tuple[list[str], int]:
    """Return the tests to run within a budget, s, nearest and shortest first, and how many."""
    near, module = str(Path('test', *Path(mutant.path).parts[1:-1])), Path(mutant.path).stem
    # A file in no folder of test/ is about all of them.
    order = sorted(reached.tests(mutant), key=lambda name: (
        f'/test_{module}.py' not in name,
        not (name.startswith(near) or name.count('/') == 1), reached.seconds[name], name))
    chosen, spent = [], 0.0
    for name in order:
        if chosen and spent + reached.seconds[name] > budget:
            continue
        chosen.append(name)
        spent += reached.seconds[name]
    return chosen, len(order)


def wilson(k: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson 1927)."""
    z = 1.959963984540054
    middle, spread = k + z * z / 2, z * math.sqrt(k * (n - k) / n + z * z / 4)
    return (middle - spread) / (n + z * z), (middle + spread) / (n + z * z)


def report(done: Sequence[tuple[Mutant, dict[str, Any]]], origin: Path, seed: int) -> str:
    """Return the table and the list of survivors, Markdown."""
    def row(name: str, some: Sequence[tuple[Mutant, dict[str, Any]]]) -> str:
        counts = Counter(result['status'] for _, result in some)
        share = (counts['killed'] + counts['timeout']) / len(some)
        return (f'| {name} | {len(some)} | '
                + ' | '.join(str(counts[status]) for status in STATUSES)
                + f' | {100.0 * share:.0f} % |')
    kinds = sorted({one.kind for one, _ in done})
    folders = [name for name in FOLDERS if any(one.path.startswith(name) for one, _ in done)]
    lines = ['| | mutants | ' + ' | '.join(STATUSES) + ' | noticed |',
             '|---|' + '---:|' * (len(STATUSES) + 2)]
    lines += [row(f'`{name}`', [pair for pair in done if pair[0].path.startswith(name)])
              for name in folders]
    lines += [row(kind, [pair for pair in done if pair[0].kind == kind]) for kind in kinds]
    lines.append(row('all', done))
    noticed = sum(result['status'] in ('killed', 'timeout') for _, result in done)
    low, high = wilson(noticed, len(done))
    commit = (origin / 'commit').read_text()
    text = (f'{len(done)} mutants, seed {seed}, commit {commit}: {noticed} noticed, '
            f'{100.0 * noticed / len(done):.0f} % (95 % interval {100.0 * low:.0f} to '
            f'{100.0 * high:.0f} %).\n\n' + '\n'.join(lines) + '\n')
    for status in ('survived', 'not covered'):
        some = [pair for pair in done if pair[1]['status'] == status]
        text += f'\n### {status.capitalize()}: {len(some)}\n'
        for one, result in some:
            ran = f', {result["ran"]} of {result["reach"]} tests ran' if result['reach'] else ''
            diff = one.diff((origin / one.path).read_bytes())
            text += f'\n`{one.path}:{one.line}` ({one.kind}{ran})\n\n```diff\n{diff}\n```\n'
    return text


def mutate(given: argparse.Namespace) -> str:
    """Draw, run what is not done yet, and return the report."""
    work = given.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    snapshot(work)
    origin, trees = work / 'origin', queue.Queue[Tree]()
    files = files_of(origin, given.tests)
    prepare(origin, files)
    for k in range(given.jobs):
        trees.put(Tree(work, f'tree{k}', files))
    reached = collect(work, files, trees, given.jobs, given.map)
    if reached.failed:
        say(f'{len(reached.failed)} tests fail without a mutant and are left out: '
            + ', '.join(reached.failed))
    drawn = draw(origin, given.folders, given.seed, given.number)
    kept = work / 'results.jsonl'
    results = {line['key']: line for line in read_lines(kept)}
    left = [one for one in drawn if one.key not in results]

    def one(mutant: Mutant) -> dict[str, Any]:
        names, many = choose(mutant, reached, given.budget)
        result: dict[str, Any] = {'status': 'not covered', 'by': '', 'seconds': 0.0}
        if names:
            tree = trees.get()
            try:
                result = tree.try_mutant(mutant, names, reached.seconds)
            finally:
                trees.put(tree)
        return {'key': mutant.key, 'ran': len(names), 'reach': many, **result}
    begin = time.monotonic()
    for k, result in enumerate(_parallel(one, left, given.jobs), 1):
        results[result['key']] = result
        with kept.open('a') as file:
            file.write(json.dumps(result) + '\n')
        rest = (time.monotonic() - begin) / k * (len(left) - k) / 60.0
        say(f'{k}/{len(left)} {result["status"]} in {result["seconds"]:.0f} s: {result["key"]} '
            f'{result["by"]}; about {rest:.0f} min left')
    while not trees.empty():
        trees.get().close()
    return report([(one, results[one.key]) for one in drawn], origin, given.seed)


def main() -> int:
    """Parse arguments, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--number', type=int, default=150, help='of mutants')
    parser.add_argument('--seed', type=int, default=SEED)
    parser.add_argument('--jobs', type=int, default=2, help='mutants at once')
    parser.add_argument('--budget', type=float, default=25.0,
                        help='s of normal time for the tests of one mutant, nearest and '
                        'shortest first')
    parser.add_argument('--folders', nargs='+', default=list(FOLDERS), help='to be mutated')
    parser.add_argument('--tests', nargs='+', default=list(TESTS), help='files or folders')
    parser.add_argument('--work', type=Path,
                        default=Path(tempfile.gettempdir()) / 'ou_monitor_mutation',
                        help='folder of copies, map and results; remove it to begin anew')
    parser.add_argument('--map', type=Path, metavar='WORK', help='folder of an earlier run, '
                        'whose map is carried over to files of tests that are the same')
    parser.add_argument('--table', type=Path, help='write table and survivors here')
    given = parser.parse_args()
    if given.number < 1 or given.jobs < 1:
        parser.error('--number and --jobs need 1 or more')
    for name in (*given.folders, *given.tests):
        if not (ROOT / name).exists():
            parser.error(f'there is no {name}')
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        text = mutate(given)
    except KeyboardInterrupt:
        say(f'stopped; the same command goes on from what is in {given.work}')
        return 130
    if given.table:
        given.table.write_text(text)
    else:
        print(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
