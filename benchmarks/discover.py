"""
What `discover` makes of hidden effects, of none, and of real recordings (hours).

    python benchmarks/discover.py blind [--each 10] [--lines FILE] [--table FILE]
    python benchmarks/discover.py nulls [--each 40] [--lines FILE]
    python benchmarks/discover.py flights [--table FILE] [NAME...]
    python benchmarks/discover.py injected [--table FILE] [--effects NAME...] [NAME...]

See README.md beside this file.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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

from blind_scores import from_data, Outcome  # noqa: E402
from common import deliver, number, recorded, table  # noqa: E402
import discover_runs as runs  # noqa: E402
from hidden_effects import causes, KINDS, pairs, unknowns, variants  # noqa: E402
from injected import EFFECTS  # noqa: E402
import numpy as np  # noqa: E402
from scipy.stats import binomtest  # noqa: E402

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
    deliver(text, given.table, 'blind')
    return 0


def flights(given: argparse.Namespace) -> int:
    """Run the recordings of real runs; write their table."""
    rows, agreed, spent = [], [], []
    for name, found in runs.examine_recorded(recorded(), given.names, not given.whole):
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
    deliver(text, given.table, 'runs')
    return 0


def nulls(given: argparse.Namespace) -> int:
    """Run recordings with nothing hidden; write their table."""
    lines = []
    for line in runs.nulls_of(given.each, given.seed, given.generators, given.lines,
                              not given.no_run):
        lines.append(line)
        said = ', '.join(line['false']) or 'nothing false'
        say(f'{line["generator"]} {line["number"]}: {line["rate"]:g} Hz, {line["duration"]:g} s, '
            f'{line["verdict"]}, {said}')
    if not lines:
        say('no recording was run')
        return 1
    text = nulls_table(lines).strip()
    deliver(text, given.table, 'nulls')
    return 0


def injected(given: argparse.Namespace) -> int:
    """Hide effects in the recordings of real runs; write their table."""
    results = runs.examine_injected(recorded(), given.names, given.effects, given.seed, say)
    if not results:
        say('no recording was run')
        return 1
    text = injected_table(results)
    deliver(text, given.table, 'injected')
    return 0


# What the tables say.

# Seconds that a recording may take, and MB.
SECONDS, MEMORY = 15.0, 1000.0
# Kind, what is counted, required share (negative: at most), and which recordings count.
_LEVELS: tuple[tuple[str, str, float, Callable[[Outcome], bool]], ...] = (
    ('single', 'named right, alone', 0.90, lambda o: o.alone),
    ('single', 'named right or in the reported set', 0.95, lambda o: o.in_set),
    ('none', 'false alarms', -0.05, lambda o: o.alarm),
    ('pair', 'both named', 0.80, lambda o: o.all_named),
    ('pair', 'both named and nothing else', 0.0, lambda o: o.alone),
    ('pair', 'both in the reported set, nothing false', 0.0, lambda o: o.in_set),
    ('variant', 'family right', 0.90, lambda o: o.family),
    ('variant', 'name right or in the reported set', 0.80, lambda o: o.in_set),
    ('variant', 'named right, alone', 0.0, lambda o: o.alone),
    ('unknown', 'unexplained or partly explained', 0.90, lambda o: o.left_open),
    ('unknown', 'the same, and no name that is wrong', 0.90,
     lambda o: o.left_open and not o.misnamed),
)


@dataclass(frozen=True)
class Level:
    """A share of recordings beside the one required."""

    # Kind of recordings, and what is counted.
    kind: str
    what: str
    required: float  # Share at least; negative: at most minus that; 0: not required.
    hits: int
    of: int

    @property
    def share(self) -> float:
        """Return the share measured."""
        return self.hits / self.of

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of Wilson (1927)."""
        found = binomtest(self.hits, self.of).proportion_ci(0.95, method='wilson')
        return float(found.low), float(found.high)

    @property
    def met(self) -> str:
        """Return whether the share reaches what is required, in a word."""
        if self.required == 0.0:
            return ''
        good = self.share <= -self.required if self.required < 0.0 else \
            self.share >= self.required
        return 'yes' if good else 'no'


def levels(lines: Sequence[dict[str, Any]]) -> list[Level]:
    """Return all shares of which there are recordings."""
    outcomes = [from_data(line) for line in lines]
    found = []
    for kind, what, required, counts in _LEVELS:
        hits = [counts(one) for one in outcomes if one.kind == kind]
        if hits:
            found.append(Level(kind, what, required, sum(hits), len(hits)))
    return found


def report(lines: Sequence[dict[str, Any]], setting: str) -> str:
    """Return all tables as Markdown, below one line with what the numbers depend on."""
    return '\n'.join([
        f'{setting}\n', '### Levels\n', _levels(levels(lines)),
        '### Time and memory of one recording\n', _cost(lines),
        '### Effect by effect\n', _effects([from_data(line) for line in lines])])


def _levels(found: Sequence[Level]) -> str:
    rows = []
    for one in found:
        low, high = one.interval
        required = '' if one.required == 0.0 else (
            f'{100 * abs(one.required):.0f} % at ' + ('least' if one.required > 0.0 else 'most'))
        rows.append([f'{one.kind}: {one.what}', required, f'{100 * one.share:.1f} %',
                     f'{100 * low:.1f}..{100 * high:.1f} %', f'{one.hits}/{one.of}', one.met])
    return table(['', 'required', 'measured', '95 % interval', 'recordings', 'met'], rows)


def _cost(lines: Sequence[dict[str, Any]]) -> str:
    rows = []
    for kind in ('single', 'variant', 'pair', 'none', 'unknown', 'all'):
        part = [line for line in lines if kind in (line['kind'], 'all')]
        if not part:
            continue
        done = [line for line in part if line['seconds'] is not None]
        late = sum(line['failure'] == runs.TIME_LIMIT for line in part)
        cells = ['-'] * 5
        if done:
            # A recording that was stopped took longer than all that were not.
            wall = np.array([*(line['seconds'] for line in done), *[np.inf] * late])
            cpu = [line['cpu_s'] for line in done]
            cells = [*(number(float(q), '.1f') for q in (
                *np.quantile(wall, [0.5, 0.9], method='higher'), wall.max())),
                number(float(np.median(cpu)), '.1f'),
                f"{max(line['memory_mb'] for line in done):.0f}"]
        slow = late + sum(line['seconds'] > SECONDS for line in done)
        rows.append([kind, str(len(part)), *cells[:4], str(slow), cells[4], str(late),
                     str(len(part) - len(done) - late)])
    return table(['kind', 'recordings', 'median s', '90 % s', 'max s', 'median CPU s',
                  f'over {SECONDS:g} s', 'max MB', 'stopped', 'failed'], rows) + (
        f'\nRequired: {SECONDS:g} s on two cores, {MEMORY:g} MB. A dash for a time is one of a '
        'recording that was stopped.\n')


def _effects(outcomes: Sequence[Outcome]) -> str:
    groups: dict[tuple[str, str], list[Outcome]] = {}
    for one in outcomes:
        effect = one.kind if one.kind in ('none', 'pair') else one.effect
        groups.setdefault((one.kind, effect), []).append(one)
    order = ('single', 'variant', 'pair', 'none', 'unknown')
    rows = []
    for (kind, effect), part in sorted(groups.items(), key=lambda item: (
            order.index(item[0][0]), item[0][1])):
        right = (lambda o: not o.alarm) if kind == 'none' else (
            lambda o: o.left_open and not o.misnamed) if kind == 'unknown' else (
            lambda o: o.in_set)
        wrong = Counter(_said(one) for one in part if not right(one))
        rows.append([
            effect if kind == 'single' else f'*{kind}*' if effect == kind else f'*{effect}*',
            str(len(part)), *([str(sum(o.alone for o in part)), str(sum(o.in_set for o in part)),
                               str(sum(o.family for o in part))]
                              if kind not in ('none', 'unknown') else ['', '', '']),
            str(sum(map(right, part))),
            '; '.join(f'{text} {count}' if count > 1 else text
                      for text, count in wrong.most_common(6))])
    return table(['effect', 'recordings', 'alone', 'in the set', 'family', 'right',
                  'what was said of the others'], rows)


def _said(one: Outcome) -> str:
    """Return what was reported, in few words."""
    if not one.verdict:
        return 'failed'
    names = ' + '.join(sorted(one.named)) or 'nothing'
    return names + ('' if one.verdict == 'explained' or not one.named else ' (partly)')


def nulls_table(lines: Sequence[dict[str, Any]]) -> str:
    """Return how many recordings had a false name, by generator."""
    rows = []
    for name in (*dict.fromkeys(line['generator'] for line in lines), 'all'):
        of = [line for line in lines if name in (line['generator'], 'all')]
        wrong = sum(bool(line['false']) for line in of)
        low, high = Level('', '', 0.0, wrong, len(of)).interval
        names = Counter(one for line in of for one in line['false'])
        left = sum(line['verdict'] in ('partly_explained', 'unexplained') for line in of)
        rows.append([name, f'{wrong} of {len(of)}', f'{100 * low:.1f}..{100 * high:.1f} %',
                     ', '.join(f'{one} {many}' if many > 1 else one
                               for one, many in names.items()) or '-', f'{left}',
                     f'{np.median([line["cpu_s"] for line in of]):.1f}'])
    return table(['base', 'with a false name', '95 % interval', 'false names',
                  'something left', 'median CPU s'], rows)


def injected_table(results: Sequence[runs.Injected]) -> str:
    """Return the table: a row a recording, a column an effect, and what became of its causes."""
    clean = {one.recording: one for one in results if not one.effect}
    effects = list(dict.fromkeys(one.effect for one in results if one.effect))
    rows, named, counted = [], Counter[str](), Counter[str]()
    kept, had, false = np.zeros(3, dtype=int)
    for name, bare in clean.items():
        mine = {one.effect: one for one in results if one.recording == name and one.effect}
        cells = []
        for effect in effects:
            if effect not in mine:
                cells.append('-')
                continue
            outcome = mine[effect].outcome(bare)
            named[effect] += outcome == 'yes'
            counted[effect] += outcome != 'there'
            cells.append(f'{outcome} ({mine[effect].strength:.1f})')
        stays = np.sum([one.stays(bare) for one in mine.values()], axis=0)
        wrong = [cause for one in mine.values() for cause in one.false(bare)]
        kept, had, false = kept + stays[0], had + stays[1], false + len(wrong)
        most = ', '.join(f'{cause} {many}' for cause, many in Counter(wrong).most_common())
        rows.append([name, *cells, f'{stays[0]} of {stays[1]}', most or '-'])
    rows.append(['named', *(f'{named[effect]} of {counted[effect]}' for effect in effects),
                 f'{kept} of {had}', str(false)])
    total, tried = sum(named.values()), sum(counted.values())
    return table(['recording', *effects, 'own causes kept', 'named beside, times'], rows) + (
        f'\nNamed: {total} of {tried}, {100.0 * total / max(tried, 1):.0f} %; '
        f'own causes kept: {100.0 * kept / max(had, 1):.0f} %.\n')


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

    def add(action: Callable[[argparse.Namespace], int], words: str) -> argparse.ArgumentParser:
        part = parts.add_parser(action.__name__, help=words, description=words)
        part.set_defaults(action=action)
        part.add_argument('--table', type=Path, help='write the tables here, between its marks')
        return part

    part = add(blind, 'hidden effects, drawn blind')
    _resumable(part, 10, 'effect')
    part.add_argument('--rate', type=_positive, default=1000.0, help='Hz')
    part.add_argument('--jobs', type=_count, default=2, help='recordings at once')
    part.add_argument('--limit', type=_positive, default=60.0,
                      help='s for one recording; more is a failure')
    part.add_argument('--pairs', type=_count, help='recordings with two (default: 10 x each)')
    part.add_argument('--none', type=_count, help='recordings with none (default: 10 x each)')
    part.add_argument('--kinds', nargs='+', choices=KINDS, default=list(KINDS))
    part.add_argument('--effects', nargs='+', metavar='NAME',
                      help='only these effects, causes or parts of a pair; none is left out')
    part.add_argument('--strength', type=_positive, default=1.0, help='1: moderate')
    part.add_argument('--duration', type=_positive, default=60.0, help='s')
    part = add(nulls, 'recordings with nothing hidden: false alarms')
    _resumable(part, 40, 'generator')
    part.add_argument('--generators', nargs='+', choices=runs.NULLS, default=list(runs.NULLS))
    part = add(flights, 'recordings of real runs, whole and in halves')
    part.add_argument('names', nargs='*', help='recordings (default all)')
    part.add_argument('--whole', action='store_true', help='no halves')
    part = add(injected, 'effects hidden in recordings of real runs')
    part.add_argument('names', nargs='*', help='recordings (default all)')
    part.add_argument('--effects', nargs='+', choices=EFFECTS, default=list(runs.HIDDEN))
    part.add_argument('--seed', type=_count, default=1, help='of all that is drawn')
    return parser


def _resumable(part: argparse.ArgumentParser, each: int, what: str) -> None:
    part.add_argument('--seed', type=_count, default=SEED, help='of all that is drawn')
    part.add_argument('--each', type=_count, default=each, help=f'recordings of each {what}')
    part.add_argument('--lines', type=Path, help='JSON lines: results, added one by one; what is '
                      'in it is not run again')
    part.add_argument('--no-run', action='store_true', help='only what is in --lines')


def main() -> int:
    """Parse arguments, measure, write."""
    parser = _parser()
    given = parser.parse_args()
    if given.part == 'blind' and given.jobs < 1:
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
