"""
What `discover` makes of hidden effects, of none, and of real recordings: one command, five parts.

    python benchmarks/discover.py blind [--each 10] [--lines FILE] [--table FILE]
    python benchmarks/discover.py limits [--runs 40] [--lines FILE] [--figure FILE]
    python benchmarks/discover.py nulls [--each 40] [--elsewhere FILE] [--lines FILE]
    python benchmarks/discover.py flights [--table FILE] [NAME...]
    python benchmarks/discover.py injected [--table FILE] [--effects NAME...] [NAME...]

See README.md beside this file.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
import datetime
import math
import os
from pathlib import Path
from statistics import mean, median
import sys
import time
from typing import Any

# Before NumPy is loaded: one thread for each recording, as several run at once.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ[_name] = '1'
_ROOT = Path(__file__).resolve().parent.parent
# What is tested, and what counts as right.
sys.path[:0] = [str(_ROOT), *(str(_ROOT / 'test' / name) for name in ('support', 'hidden'))]

from discover_injected import examine, HIDDEN, injected_table  # noqa: E402
from discover_limits import CAUSES, DURATIONS, figure, limits_table, Point, Search  # noqa: E402
from discover_nulls import nulls_of, nulls_table  # noqa: E402
import discover_runs as runs  # noqa: E402
from discover_tables import heat_map, report  # noqa: E402
from hidden_effects import causes, KINDS, pairs, unknowns, variants  # noqa: E402
from injected import EFFECTS  # noqa: E402
import numpy as np  # noqa: E402
from tables import put, table  # noqa: E402

SEED = 20260131


def say(text: str) -> None:
    """Tell progress."""
    print(text, file=sys.stderr, flush=True)


def plan(given: argparse.Namespace) -> list[runs.Task]:
    """
    Return the recordings of a blind run, shuffled.

    Effects of one kind come equally often, so that each has its row; pairs are
    drawn.  A part of a run is a fair sample of the whole.

    """
    rng = np.random.default_rng([given.seed, 0])
    every = {'single': causes(), 'variant': variants(), 'unknown': unknowns()}
    drawn: list[tuple[str, str, int]] = []
    for kind, effects in every.items():
        drawn += [(kind, effect, k) for effect in effects for k in range(given.each)]
    possible = pairs()
    for k in range(given.pairs):
        drawn.append(('pair', '+'.join(possible[rng.integers(len(possible))]), k))
    drawn += [('none', '', k) for k in range(given.none)]
    drawn = [one for one in drawn if one[0] in given.kinds and (
        not given.effects or any(part in given.effects for part in _parts(one[1])))]
    rng.shuffle(drawn)
    return [runs.Task(kind, effect, given.seed, int(number), given.duration, given.rate,
                      given.strength) for kind, effect, number in drawn]


def _parts(effect: str) -> set[str]:
    """Return all by which an effect may be asked for: itself, its cause, those of a pair."""
    return {effect, effect.partition('/')[0], *effect.split('+')}


def work(next_task: Any, total: int, given: argparse.Namespace, results: runs.Results) -> None:
    """Run what is not done yet, telling how far it has come."""
    begin, done = time.monotonic(), 0
    for task, result in runs.run(next_task, given.jobs, given.limit):
        results.add(task, result)
        done += 1
        names = ' + '.join(result['named']) or 'nothing'
        spent = '' if result['seconds'] is None else f", {result['seconds']:.1f} s"
        left = (time.monotonic() - begin) / done * (total - done) / 60.0
        said = result['failure'] or f"{result['verdict']}, {names}"
        say(f'{done}/{total} {task.kind} {task.effect} x{task.strength:g}: {said}{spent}; '
            f'about {left:.0f} min left')


def blind(given: argparse.Namespace) -> int:
    """Run the blind part; write its tables."""
    tasks = plan(given)
    results = runs.Results(given.lines, _about())
    left = [task for task in tasks if task.key not in results.by_key]
    if len(left) < len(tasks):
        say(f'{len(tasks) - len(left)} of {len(tasks)} recordings are in {given.lines}')
    if left and not given.no_run:
        runs.warm_up()
        queue = iter(left)
        work(lambda under_way: next(queue, None), len(left), given, results)
    lines = results.of(tasks)
    if not lines:
        say('no recording was run')
        return 1
    setting = _setting(given, lines, f'{len(lines)} of {len(tasks)} recordings of '
                       f'{given.duration:g} s at {given.rate:g} Hz, strength {given.strength:g}, '
                       'which the generator varies by 30 % either way')
    text = report(lines, setting)
    print(text)
    _write(given, text, heat_map(lines, f'Hidden and named, seed {given.seed}'))
    return 0


def limits(given: argparse.Namespace) -> int:
    """Run the detection limits; write their figure."""
    points = [Point(cause, duration, given.rate, given.seed)
              for duration in given.durations for cause in given.causes]
    results = runs.Results(given.lines, _about())
    search = Search(points, given.runs, results)
    missing = sum(max(given.runs - len(lines), 0) for _, lines in search.state())
    if missing and not given.no_run:
        runs.warm_up()
        work(search.next_task, missing, given, results)
    lines = [line for _, found in search.state() for line in found]
    if not lines:
        say('no recording was run')
        return 1
    setting = _setting(given, lines, f'{len(lines)} recordings at {given.rate:g} Hz')
    text = f'{setting}\n\n{limits_table(search)}'
    print(text)
    _write(given, text, figure(
        search, f'Strength at which a cause is reported, seed {given.seed}'))
    return 0


def flights(given: argparse.Namespace) -> int:
    """Run the recordings of real runs; write their table."""
    folder = os.environ.get('OU_MONITOR_REALDATA')
    if folder is None:
        raise ValueError('OU_MONITOR_REALDATA is not set: it names the folder of the recordings')
    rows, agreed, spent = [], [], []
    for name, found in runs.examine_recorded(Path(folder), given.names, not given.whole):
        whole = found[0]
        extended, count = whole['extended'], Counter(one['name'] for one in whole['causes'])
        names = ', '.join(one if many == 1 else f'{one} x{many}' for one, many in count.items())
        alike = runs.agreement(*found[1:]) if len(found) == 3 else float('nan')
        gain = '-' if extended['gain'] is None else (
            f'{extended["gain"]:.2f} \u00b1 {extended["gain_se"]:.2f}')
        falls = ', '.join('-' if extended['crossing_rate'][key] is None else (
            f'{extended["crossing_rate"][key]:.3g}') for key in (
                'observed', 'baseline', 'extended'))
        rows.append([name, whole['verdict'].replace('_', ' '), names or '-', gain, falls,
                     'yes' if whole['refused'] else 'no',
                     '-' if math.isnan(alike) else f'{alike:.2f}', f'{whole["cpu_s"]:.1f}'])
        say(' | '.join(rows[-1]))
        spent.append(whole['cpu_s'])
        agreed += [] if math.isnan(alike) else [alike]
    if not rows:
        say('no recording was run')
        return 1
    head = ['recording', 'verdict', 'causes', 'gain, nats',
            'falls a minute: seen, plain OU, extended', 'refused', 'halves agree', 'CPU s']
    text = table(head, rows) + (
        f'\nCPU time: {median(spent):.1f} s at the median, {max(spent):.1f} s at most.'
        + (f' Halves name the same causes (Jaccard): {mean(agreed):.2f} in the mean of '
           f'{len(agreed)} recordings.\n' if agreed else '\n'))
    print(text)
    if given.table:
        put(given.table, text, 'runs')
    return 0


def nulls(given: argparse.Namespace) -> int:
    """Run recordings with nothing hidden; write their table."""
    lines = []
    for line in nulls_of(given.each, given.seed, given.elsewhere, given.generators, given.lines,
                         not given.no_run):
        lines.append(line)
        said = ', '.join(line['false']) or 'nothing false'
        say(f'{line["generator"]} {line["number"]}: {line["rate"]:g} Hz, {line["duration"]:g} s, '
            f'{line["verdict"]}, {said}')
    if not lines:
        say('no recording was run')
        return 1
    text = nulls_table(lines).strip()
    print(text)
    if given.table:
        put(given.table, text, 'nulls')
    return 0


def injected(given: argparse.Namespace) -> int:
    """Hide effects in the recordings of real runs; write their table."""
    folder = os.environ.get('OU_MONITOR_REALDATA')
    if folder is None:
        raise ValueError('OU_MONITOR_REALDATA is not set: it names the folder of the recordings')
    results = examine(Path(folder), given.names, given.effects, given.seed, say)
    if not results:
        say('no recording was run')
        return 1
    text = injected_table(results)
    print(text)
    if given.table:
        put(given.table, text, 'injected')
    return 0


def _write(given: argparse.Namespace, text: str, svg: str) -> None:
    """Write table and drawing where they are asked for; the table shows the drawing."""
    if given.figure:
        given.figure.write_text(svg)
    if given.table:
        if given.figure:
            place = os.path.relpath(given.figure, given.table.parent)
            text += f'\n![{given.part}: the drawing]({Path(place).as_posix()})\n'
        put(given.table, text, given.part)


def _about() -> dict[str, str]:
    return {'sources': runs.sources(),
            'date': datetime.datetime.now(datetime.timezone.utc).date().isoformat()}


def _setting(given: argparse.Namespace, lines: Sequence[dict[str, Any]], what: str) -> str:
    """Return what the numbers depend on: a sentence, and the machine in a comment."""
    # Not at the top: it turns the compiled code off for what is loaded after it.
    from estimator import environment
    about = environment()
    machine = ', '.join(f'{name} {about[name]}' for name in (
        'python', 'machine', 'numpy', 'scipy', 'numba', 'commit'))
    made = sorted({line['sources'] for line in lines})
    dates = sorted({line['date'] for line in lines})
    if len(made) > 1:
        say(f'these results were made by {len(made)} states of the sources: {", ".join(made)}')
    return (f'<!-- {machine}; {given.jobs} at once, limit {given.limit:g} s -->\n'
            f'Seed {given.seed}, {" to ".join(sorted({dates[0], dates[-1]}))}, sources '
            f'{", ".join(made)}: {what}.')


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not above zero')
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f'{text} is below zero')
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parts = parser.add_subparsers(dest='part', required=True)
    for name, text, action in (('blind', 'hidden effects, drawn blind', blind),
                               ('limits', 'strength against duration', limits)):
        part = parts.add_parser(name, help=text, description=text)
        part.set_defaults(action=action)
        part.add_argument('--seed', type=_count, default=SEED, help='of all that is drawn')
        part.add_argument('--rate', type=_positive, default=1000.0, help='Hz')
        part.add_argument('--jobs', type=_count, default=2, help='recordings at once')
        part.add_argument('--limit', type=_positive, default=60.0,
                          help='s for one recording; more is a failure')
        part.add_argument('--lines', type=Path, help='JSON lines: results, added one by one; '
                          'what is in it is not run again')
        part.add_argument('--no-run', action='store_true', help='only what is in --lines')
        part.add_argument('--table', type=Path,
                          help=f'write the tables here, between its marks "<!-- {name} begins '
                          f'-->" and "<!-- {name} ends -->" if it has them')
        part.add_argument('--figure', type=Path, help='write the drawing here, SVG')
    part = parts.choices['blind']
    part.add_argument('--each', type=_count, default=10, help='recordings of each effect')
    part.add_argument('--pairs', type=_count, help='recordings with two (default: 10 x each)')
    part.add_argument('--none', type=_count, help='recordings with none (default: 10 x each)')
    part.add_argument('--kinds', nargs='+', choices=KINDS, default=list(KINDS))
    part.add_argument('--effects', nargs='+', metavar='NAME',
                      help='only these effects, causes or parts of a pair; none is left out')
    part.add_argument('--strength', type=_positive, default=1.0, help='1: moderate')
    part.add_argument('--duration', type=_positive, default=60.0, help='s')
    part = parts.add_parser('nulls', help='recordings with nothing hidden',
                            description='recordings with nothing hidden: false alarms')
    part.set_defaults(action=nulls)
    part.add_argument('--seed', type=_count, default=SEED, help='of all that is drawn')
    part.add_argument('--each', type=_count, default=40, help='recordings of each generator')
    part.add_argument('--elsewhere', type=Path, metavar='FILE',
                      help="a generator of another hand: make('null', seed, T=duration) returns "
                      'stamps, throttle and voltage at 1 kHz, its noise following throttle')
    part.add_argument('--generators', nargs='+', help='only these: plain, flown, elsewhere')
    part.add_argument('--lines', type=Path, help='JSON lines: results, added one by one; what is '
                      'in it is not run again')
    part.add_argument('--no-run', action='store_true', help='only what is in --lines')
    part.add_argument('--table', type=Path, help='write the table here, between its marks')
    part = parts.add_parser('flights', help='recordings of real runs',
                            description='recordings of real runs, whole and in halves')
    part.set_defaults(action=flights)
    part.add_argument('names', nargs='*', help='recordings (default all)')
    part.add_argument('--whole', action='store_true', help='no halves')
    part.add_argument('--table', type=Path, help='write the table here, between its marks')
    part = parts.add_parser('injected', help='effects hidden in recordings of real runs',
                            description='effects hidden in recordings of real runs')
    part.set_defaults(action=injected)
    part.add_argument('names', nargs='*', help='recordings (default all)')
    part.add_argument('--effects', nargs='+', choices=EFFECTS, default=list(HIDDEN))
    part.add_argument('--seed', type=_count, default=1, help='of all that is drawn')
    part.add_argument('--table', type=Path, help='write the table here, between its marks')
    part = parts.choices['limits']
    part.add_argument('--causes', nargs='+', choices=causes(), default=list(CAUSES))
    part.add_argument('--durations', nargs='+', type=_positive, default=list(DURATIONS))
    part.add_argument('--runs', type=_count, default=40,
                      help='recordings of each cause and duration')
    return parser


def main() -> int:
    """Parse arguments, measure, write."""
    parser = _parser()
    given = parser.parse_args()
    if given.part in ('blind', 'limits') and given.jobs < 1:
        parser.error('--jobs needs 1 or more')
    if given.part == 'blind':
        given.pairs = 10 * given.each if given.pairs is None else given.pairs
        given.none = 10 * given.each if given.none is None else given.none
        known = {part for effect in (*causes(), *variants(), *unknowns())
                 for part in _parts(effect)}
        wrong = set(given.effects or []) - known
        if wrong:
            parser.error(f'--effects: {", ".join(sorted(wrong))} is not an effect')
    try:
        status: int = given.action(given)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    return status


if __name__ == '__main__':
    sys.exit(main())
