"""
Causes named by `discover`: hidden effects, nothing hidden, recorded runs (5 min to hours).

    python benchmarks/discover.py blind [--each 10] [--lines FILE]
    python benchmarks/discover.py nulls [--each 40] [--lines FILE]
    python benchmarks/discover.py flights [NAME...]
    python benchmarks/discover.py injected [--effects NAME...] [NAME...]

`blind`: all but the name of an effect is drawn from the seed; the order is shuffled, so part of a
run is a fair sample.  `nulls`: a plain rail, or one with the effects of any flight under throttle
(sag, noise, ADC steps); each other name is a false alarm.  `flights`: recorded runs, whole and in
halves.  `injected`: effects hidden in pieces of recorded runs.  benchmarks/README.md defines which
answers are right.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
import json
import math
import multiprocessing
from pathlib import Path
import signal
from statistics import mean, median
import sys
import time
from typing import Any
import zlib

from common import arguments, BENCHES, deliver, environment, FLIGHTS, flights, HIRO, say, table
from blind_scores import from_data, hide, Outcome, outcome  # noqa: I100
from hidden_circuit import FINE_RATE, make_bench, UPDATE_RATE
from hidden_effects import causes, KINDS, pairs, unknowns, variants
from hidden_registry import EFFECTS as BASES
from injected import EFFECTS, noise_of
import numpy as np
from ou_monitor import discover
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery import decision
from ou_monitor.discovery.finding import Finding
from ou_monitor.discovery.fitting import Fitter
from ou_monitor.discovery.gain import guess
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.slow import SecondRelaxation
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import FloatArray, Recording
from scipy.stats import binomtest

SEED = 20260131
KNOWN = {**FLIGHTS, **BENCHES}
# All recordings: two more flights of one log, and other vehicles.
EVERY = {**KNOWN, 'roma 1': (FLIGHTS['roma'][0], 1), 'roma 2': (FLIGHTS['roma'][0], 2),
         'bf3s 1': (FLIGHTS['bf3s'][0], 1), 'hiro': HIRO, 'ar8': ('raw/bf_ar8_6s.BFL', None),
         'in_xr': ('raw/in_xr_141340.TXT', None), **{name: (f'{name}.csv', None) for name in (
             'cf_bl00', 'px_tg1', 'frc_ol_1', 'regbot_10', 'regbot_19', 'regbot_28', 'regbot_30',
             'regbot_62', 'regbot_81', 'as_f60', 'hebi_x', 'euc_1', 'js_11t_6s')}}


def interval(hits: int, of: int) -> str:
    """Return the 95 % interval of a share (Wilson, 1927), in percent."""
    found = binomtest(hits, of).proportion_ci(0.95, method='wilson')
    return f'{100.0 * found.low:.1f}..{100.0 * found.high:.1f} %'


def counted(names: Iterable[str]) -> str:
    """Return names with their counts."""
    return ', '.join(name if many == 1 else f'{name} {many}'
                     for name, many in Counter(names).most_common()) or '-'


def resumed(tasks: Sequence[tuple[Any, ...]], lines: Path | None,
            run: Callable[[list[tuple[Any, ...]]], Iterator[dict[str, Any]]]
            ) -> list[dict[str, Any]]:
    """Return the result of each task, read from a file of JSON lines, or run and added to it."""
    known: dict[str, dict[str, Any]] = {}
    if lines is not None and lines.exists():
        for line in lines.read_text().splitlines():
            result = json.loads(line)
            known[json.dumps(result['task'])] = result
    left = [task for task in tasks if json.dumps(task) not in known]
    for done, result in enumerate(run(left), 1):
        known[json.dumps(result['task'])] = result
        if lines is not None:
            with lines.open('a') as out:
                out.write(json.dumps(result) + '\n')
        say(f'{done}/{len(left)}', *result['task'], result['verdict'] or result['failure'],
            ' + '.join(result['named']) or 'nothing')
    return [known[json.dumps(task)] for task in tasks]


# -- hidden blind


def plan(given: argparse.Namespace) -> list[tuple[Any, ...]]:
    """Return kind, effect, seed and number of each recording, and duration, rate and strength."""
    rng = np.random.default_rng([given.seed, 0])
    drawn = [(kind, effect, k) for kind, effects in (
        ('single', causes()), ('variant', variants()), ('unknown', unknowns()))
        for effect in effects for k in range(given.each)]
    possible = pairs()
    drawn += [('pair', '+'.join(possible[rng.integers(len(possible))]), k)
              for k in range(10 * given.each)]
    drawn += [('none', '', k) for k in range(10 * given.each)]
    drawn = [one for one in drawn if one[0] in given.kinds and (not given.effects or {
        one[1], one[1].partition('/')[0], *one[1].split('+')} & set(given.effects))]
    rng.shuffle(drawn)
    return [(kind, effect, given.seed, int(number), given.duration, given.rate, given.strength)
            for kind, effect, number in drawn]


def examine(task: tuple[Any, ...], limit: float) -> dict[str, Any]:
    """Return the result of `discover` for a hidden effect, and its time, s."""
    def late(*_: object) -> None:
        raise TimeoutError(f'not done after {limit:g} s')
    *what, duration, rate, strength = task
    hidden = hide(*what, duration=duration, rate=rate, strength=strength)
    signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, limit)
    began = time.perf_counter()
    try:
        finding = discover(Recording(hidden.t, hidden.voltage, hidden.throttle, 'blind'))
        made, failure = outcome(hidden, finding.verdict.value, finding.causes), ''
    except Exception as error:
        # A failure counts as missed; the benchmark continues.
        made, failure = outcome(hidden), f'{type(error).__name__}: {error}'
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    return {'task': list(task), **made.as_data(), 'failure': failure,
            'seconds': time.perf_counter() - began}


# Kind, name of the count, and condition to be counted.
SHARES: tuple[tuple[str, str, Callable[[Outcome], bool]], ...] = (
    ('single', 'named right, alone', lambda o: o.alone),
    ('single', 'named right or in the reported set', lambda o: o.in_set),
    ('variant', 'named right, alone', lambda o: o.alone),
    ('variant', 'named right or in the reported set', lambda o: o.in_set),
    ('variant', 'family right', lambda o: o.family),
    ('pair', 'both named', lambda o: o.all_named),
    ('pair', 'both named and nothing else', lambda o: o.alone),
    ('pair', 'both in the reported set, nothing false', lambda o: o.in_set),
    ('none', 'false alarms', lambda o: o.alarm),
    ('unknown', 'left open', lambda o: o.left_open),
    ('unknown', 'left open, and no name that is wrong', lambda o: o.left_open and not o.misnamed))


def blind(given: argparse.Namespace) -> str:
    """Score effects hidden blind."""
    def run(tasks: list[tuple[Any, ...]]) -> Iterator[dict[str, Any]]:
        # A process for each recording, so that its memory is freed.
        with multiprocessing.get_context('fork').Pool(given.jobs, maxtasksperchild=1) as pool:
            yield from pool.imap_unordered(partial(examine, limit=given.limit), tasks)
    lines = resumed(plan(given), given.lines, run)
    outcomes = [from_data(line) for line in lines]
    rows = []
    for kind, what, counts in SHARES:
        hits = [counts(one) for one in outcomes if one.kind == kind]
        if hits:
            rows.append([f'{kind}: {what}', f'{sum(hits)} of {len(hits)}',
                         f'{100.0 * mean(hits):.1f} %', interval(sum(hits), len(hits))])
    spent = [line['seconds'] for line in lines]
    return (f'Seed {given.seed}, {len(lines)} recordings of {given.duration:g} s at '
            f'{given.rate:g} Hz, strength {given.strength:g}, which the generator varies by 30 % '
            f'either way; {environment()}. Time of a recording: {median(spent):.1f} s at the '
            f'median, {max(spent):.1f} s at most.\n\n'
            + table(['', 'recordings', 'share', '95 % interval'], rows))


# -- nothing hidden

# Terms that a base may have, each with a probability of one half.
BASE = ('load_sag', 'load_dependent_sigma', 'measurement_noise', 'quantization')
RATES, DURATIONS = (50, 100, 200, 500, 1000), (20.0, 60.0, 120.0)


def throttles(known: list[np.ndarray] = []) -> list[np.ndarray]:
    """Return throttle of the recorded flights at the rate of commands, read once."""
    for _, recording in flights() if not known else ():
        if np.isfinite(recording.throttle).any() and recording.n > 1000:
            t = recording.t - recording.t[0]
            at = np.arange(0.0, float(t[-1]), 1.0 / UPDATE_RATE)
            known.append(np.clip(np.interp(at, t, recording.throttle), 0.0, 1.0))
    return known


def examine_null(base: str, seed: int, number: int) -> dict[str, Any]:
    """Return the names from `discover` in a recording without an effect, and the false ones."""
    word = int.from_bytes(sha256(base.encode()).digest()[:8], 'big')
    rng = np.random.default_rng([seed, number, word])
    rate, duration = float(rng.choice(RATES)), float(rng.choice(DURATIONS))
    names: tuple[str, ...] = ()
    throttle = None
    if base == 'flown':
        flown = throttles()
        names = tuple(name for name in BASE if rng.random() < 0.5)
        throttle = flown[rng.integers(len(flown))]
    bench = make_bench(duration, rate, int(np.ceil(FINE_RATE / rate)), rng)
    if throttle is not None:
        again = np.concatenate((throttle, throttle[::-1]))
        begin = int(rng.integers(again.size))
        bench.commands = np.resize(np.roll(again, -begin), bench.commands.size)
        bench.__post_init__()
    truth: set[str] = set()
    for name in names:
        BASES[name].apply(bench, float(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))))
        truth.update(BASES[name].truth)
    began = time.process_time()
    finding = discover(Recording(*bench.run(), 'null'))
    named = [cause.name for cause in finding.causes]
    return {'task': [base, seed, number], 'verdict': finding.verdict.value, 'named': named,
            'false': sorted(set(named) - truth), 'cpu_s': time.process_time() - began}


def nulls(given: argparse.Namespace) -> str:
    """Count false names in recordings with nothing hidden."""
    tasks = [(base, given.seed, k) for k in range(given.each) for base in given.bases]
    lines = resumed(tasks, given.lines, lambda left: (examine_null(*task) for task in left))
    rows = []
    for base in (*given.bases, 'all'):
        of = [line for line in lines if base in (line['task'][0], 'all')]
        wrong = sum(bool(line['false']) for line in of)
        left = sum(line['verdict'] in ('partly_explained', 'unexplained') for line in of)
        rows.append([base, f'{wrong} of {len(of)}', interval(wrong, len(of)),
                     counted(one for line in of for one in line['false']), f'{left}',
                     f'{median(line["cpu_s"] for line in of):.1f}'])
    return table(['base', 'with a false name', '95 % interval', 'false names',
                  'something left', 'median CPU s'], rows)


def best_evidence(seed: int) -> float:
    """Return the evidence of the best cause, nats, in a simulated OU with nothing hidden."""
    rng = np.random.default_rng(seed)
    rate, n = 10.0 ** rng.uniform(2.0, 3.0), round(10.0 ** rng.uniform(3.5, 4.5))
    alpha, stick = rate * 10.0 ** rng.uniform(-2.0, -0.3), rng.uniform(0.6, 3.0)
    t = np.arange(n) / rate
    voltage, throttle = (SupplyModel((OU(a, std * math.sqrt(2.0 * a), 0.0),)).simulate(t, rng)
                         for a, std in ((alpha, 0.02), (stick, 1.0)))
    samples = Samples(t, voltage, 1.0 / (1.0 + np.exp(-throttle)) if seed % 2 else None)
    fitter, found = Fitter(samples), -np.inf
    plain = fit_composite(samples, [guess(samples)], samples.train)
    view, before = fitter.view(plain), fitter.evidence(plain)
    for kind in catalogue().values():
        if kind.NAME == 'ou' or kind.ROLE is Role.EXACT or (
                kind.NEEDS_THROTTLE and samples.throttle is None):
            continue
        start = fitter.best_start(plain, kind, view, -1e3)
        full = None if start is None else fitter.fit(start.terms, start)
        found = max(found, *(fitter.evidence(fit) - before for fit in (start, full) if fit), -1e3)
    return found


def evidence(given: argparse.Namespace) -> str:
    """Measure the evidence of the best cause where nothing is hidden."""
    # Kinds are compared before the threshold, so that its effect can be computed.
    decision.ACCEPT = -1e3
    found = np.array([best_evidence(given.seed + k) for k in range(given.each)])
    # With a slope of one nat per e-fold, as the share above -1 nat has it.
    scale = 1.0 - np.log(np.mean(found > -1.0))
    return table(['evidence above, nats', 'recordings', f'exp(-{scale:.1f} - x)'], [
        [f'{x:g}', f'{100.0 * np.mean(found > x):.1f} %', f'{100.0 * np.exp(-scale - x):.2g} %']
        for x in (-2.0, -1.0, 0.0, 1.0, 2.0, 4.0)])


# -- recorded runs


def part_of(recording: Recording, part: Any) -> Recording:
    """Return a part of a recording."""
    def of(x: Any) -> Any:
        return None if x is None else x[part]
    return replace(recording, t=recording.t[part], voltage=recording.voltage[part],
                   throttle=of(recording.throttle), current=of(recording.current))


def agreement(one: dict[str, Any], other: dict[str, Any]) -> float:
    """Return the share of causes that two findings have in common (Jaccard); NaN: no data."""
    if 'insufficient_data' in (one['verdict'], other['verdict']):
        return float('nan')
    first, second = ({cause['name'] for cause in found['causes']} for found in (one, other))
    return len(first & second) / len(first | second) if first | second else 1.0


def recorded_runs(given: argparse.Namespace) -> str:
    """Run `discover` on recorded runs, whole and in halves."""
    rows, agreed, spent = [], [], []
    for name, run in flights(given.names, EVERY):
        middle = run.t.size // 2
        began = time.process_time()
        finding = discover(run)
        spent.append(time.process_time() - began)
        whole = finding.as_data()
        alike = float('nan')
        if not given.whole:
            alike = agreement(*(discover(part_of(run, part)).as_data()
                                for part in (slice(0, middle), slice(middle, None))))
        extended = whole['extended']
        dips = [whole['extended']['crossing_rate'][key]
                for key in ('observed', 'baseline', 'extended')]
        left = len(whole['remaining'])
        rows.append([
            name + (', by current' if whole['load'] == 'current' else ''),
            ', '.join(one if many == 1 else f'{one} x{many}' for one, many in Counter(
                cause['name'] for cause in whole['causes']).items()) or '-',
            'explained' if whole['verdict'] == 'explained' else f'{left}'
            + (', refused' if finding.refused else ''),
            *('-' if extended[key] is None else f'{factor * extended[key]:.{digits}f}'
              for key, factor, digits in (('gain', 1.0, 2), ('errors_shrink', 100.0, 0))),
            ', '.join('-' if one is None else f'{one:.3g}' for one in dips),
            '-' if np.isnan(alike) else f'{alike:.2f}', f'{spent[-1]:.1f}'])
        say(' | '.join(rows[-1]))
        agreed += [] if np.isnan(alike) else [alike]
    text = table(['recording', 'causes', 'statistics left', 'gain, nats', 'errors shrink, %',
                  'dips a minute: seen, plain OU, extended', 'halves agree', 'CPU s'], rows)
    text += f'\nCPU time: {median(spent):.1f} s at the median, {max(spent):.1f} s at most.'
    return text + (f' Halves name the same causes (Jaccard): {mean(agreed):.2f} in the mean of '
                   f'{len(agreed)} recordings.\n' if agreed else '\n')


# -- hidden in recorded runs

# Part of each recording, s; a shorter one is used whole, as is jd (one sample per second).
PIECES = {'gecko': (30.0, 60.0), 'nazgul': (40.0, 80.0), 'roma': (40.0, 80.0),
          'bf3s': (0.0, 40.0), 'jd': (0.0, 400.0), 'cf_solo': (10.0, 50.0),
          'cf_pair': (10.0, 50.0), 'cf_takeoff': (0.0, 40.0), 'mm_bench_3': (0.0, 4.0),
          'mm_bench_5': (0.0, 4.0), 'xt_pico_a': (2.0, 6.0)}
# The other `EFFECTS` belong to the sensor and need no model to be detected.
HIDDEN = ('tone', 'slow', 'levels', 'glitches', 'jumps', 'held', 'regimes', 'tails', 'dropouts')
STRENGTHS = (1.0, 3.0)


@dataclass(frozen=True)
class Injected:
    """Names from `discover` in a piece with a hidden effect, and in the original piece."""

    effect: str
    strength: float
    clean: tuple[str, ...]  # Names in the original piece.
    named: tuple[str, ...]
    alternatives: tuple[str, ...]
    oracle: float  # Gain of an oracle, nats; see `oracle_gain`

    @property
    def outcome(self) -> str:
        """
        Return 'yes', 'no', or 'there' if the original piece already gets the name.

        An effect is named if a right name is in the set, and occurs in it more often than in the
        set of the original piece.
        """
        right = EFFECTS[self.effect][1]
        if any(self.named.count(name) > self.clean.count(name) for name in right) or (
                right & set(self.alternatives) - set(self.clean)):
            return 'yes'
        return 'there' if right & set(self.clean) & set(self.named) else 'no'

    @property
    def kept(self) -> tuple[int, int]:
        """Return how many causes of the original piece are still named, and how many it has."""
        return len(set(self.clean) & set(self.named)), len(set(self.clean))

    @property
    def false(self) -> set[str]:
        """Return the names that are neither right nor in the original piece."""
        return set(self.named) - set(self.clean) - EFFECTS[self.effect][1]


# Gain of an oracle, nats, from which an effect should be named.
TOLD = 300.0


def oracle_gain(clean: Finding, piece: Recording, hidden: Recording, effect: str) -> float:
    """Return what an oracle gains from an effect that the original piece's model lacks, nats."""
    samples = clean.samples
    assert samples is not None
    added = np.interp(samples.t - samples.t[0], piece.t - piece.t[0],
                      hidden.voltage - piece.voltage)
    ou, *others = clean.simulated.terms
    assert isinstance(ou, OU)
    laws = [term for term in others if term.ROLE is Role.LAW]
    rest = [term for term in others if term.ROLE is not Role.LAW]

    def fit(voltage: FloatArray, *terms: Term) -> float | None:
        found = Fitter(replace(samples, voltage=voltage)).fit([*terms, *laws], None)
        return None if found is None else float(found.density.sum())
    # A fit that fails has a parameter out of its range.
    after = fit(samples.voltage + added, ou, *rest)
    if effect == 'slow':
        # The path of a relaxation cannot be known: the oracle knows its law.  Either of the two
        # may be the first.
        slow = 1.0, float(np.std(added)) * math.sqrt(2.0)
        known = [fit(samples.voltage + added, ou, *rest, SecondRelaxation(*slow)),
                 fit(samples.voltage + added, OU(*slow, ou.u0), *rest,
                     SecondRelaxation(ou.alpha, ou.sigma))]
    else:
        # An oracle that knows what was added to the voltage loses nothing.
        known = [fit(samples.voltage, ou, *rest)]
    best = max((one for one in known if one is not None), default=None)
    return math.inf if after is None else 0.0 if best is None else best - after


def injected(given: argparse.Namespace) -> str:
    """Hide effects in pieces of recorded runs."""
    rows, every = [], []
    for name, whole in flights(given.names, {one: KNOWN[one] for one in KNOWN if one in PIECES}):
        at = whole.t - whole.t[0]
        part = (at >= PIECES[name][0]) & (at < PIECES[name][1])
        piece = Recording(whole.t[part], whole.voltage[part], whole.throttle[part])
        known = discover(piece)
        clean = tuple(cause.name for cause in known.causes)
        say(f'{name}:', ', '.join(clean) or 'nothing')
        mine = []
        for effect in given.effects:
            rng = np.random.default_rng([given.seed, zlib.crc32(f'{name} {effect}'.encode())])
            strength = float(rng.uniform(*STRENGTHS))
            hidden = EFFECTS[effect][0](piece, strength * noise_of(piece.voltage), rng)
            found = discover(hidden).causes
            mine.append(Injected(effect, strength, clean, tuple(one.name for one in found),
                                 tuple(other for one in found for other in one.alternatives),
                                 oracle_gain(known, piece, hidden, effect)))
            say(f'{name} {effect} x{strength:.1f}: {mine[-1].outcome};',
                ', '.join(mine[-1].named) or 'nothing')
        every += mine
        rows.append([name, *(f'{one.outcome} ({one.strength:.1f})' for one in mine),
                     '{} of {}'.format(*np.sum([one.kept for one in mine], axis=0)),
                     counted(cause for one in mine for cause in sorted(one.false))])
    tried = [one for one in every if one.outcome != 'there']
    named = Counter(one.effect for one in tried if one.outcome == 'yes')
    of = Counter(one.effect for one in tried)
    kept, had = np.sum([one.kept for one in every], axis=0)
    rows.append(['named', *(f'{named[effect]} of {of[effect]}' for effect in given.effects),
                 f'{kept} of {had}', str(sum(len(one.false) for one in every))])
    found, had = named.total() / max(len(tried), 1), max(had, 1)
    told = [one.outcome == 'yes' for one in tried if one.oracle >= TOLD]
    return table(['recording', *given.effects, 'own causes kept', 'named beside, times'], rows) + (
        f'\nNamed: {named.total()} of {len(tried)}, {100.0 * found:.0f} %; '
        f'own causes kept: {100.0 * kept / had:.0f} %. An oracle that knows the path of what was '
        f'added (of `slow`: its law) gains {TOLD:g} nats or more from {len(told)}, of which '
        f'{sum(told)} were named.\n')


def main() -> int:
    """Parse arguments, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parts = parser.add_subparsers(dest='part', required=True)

    def add(name: str, action: Callable[[argparse.Namespace], str], names: bool
            ) -> argparse.ArgumentParser:
        part = parts.add_parser(name, help=action.__doc__, parents=[arguments('', names, False)])
        part.set_defaults(action=action)
        return part
    part = add('blind', blind, False)
    part.add_argument('--each', type=int, default=10, help='recordings of each effect; ten times '
                      'as many with two effects, and with none')
    part.add_argument('--kinds', nargs='+', choices=KINDS, default=list(KINDS))
    part.add_argument('--effects', nargs='+', metavar='NAME', help='only these')
    part.add_argument('--duration', type=float, default=60.0, help='s')
    part.add_argument('--rate', type=float, default=1000.0, help='Hz')
    part.add_argument('--strength', type=float, default=1.0, help='1: moderate')
    part.add_argument('--jobs', type=int, default=2, help='recordings at once')
    part.add_argument('--limit', type=float, default=60.0, help='s for one recording')
    more = add('nulls', nulls, False)
    more.add_argument('--each', type=int, default=40, help='recordings of each base')
    more.add_argument('--bases', nargs='+', choices=('plain', 'flown'), default=['plain', 'flown'])
    null = add('evidence', evidence, False)
    null.add_argument('--each', type=int, default=240, help='recordings')
    for one in (part, more, null):
        one.add_argument('--seed', type=int, default=SEED)
    for one in (part, more):
        one.add_argument('--lines', type=Path,
                         help='JSON lines: results are added; those in it are not run again')
    part = add('flights', recorded_runs, True)
    part.add_argument('--whole', action='store_true', help='no halves')
    part = add('injected', injected, True)
    part.add_argument('--effects', nargs='+', choices=EFFECTS, default=list(HIDDEN))
    part.add_argument('--seed', type=int, default=1)
    given = parser.parse_args()
    deliver(given.action(given), given.page, {'flights': 'runs'}.get(given.part, given.part))
    return 0


if __name__ == '__main__':
    sys.exit(main())
