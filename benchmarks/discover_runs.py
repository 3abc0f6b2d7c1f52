"""
What `discover.py` runs: hidden effects, each in a process of its own with a time limit; nothing.

And recordings of real runs, whole, in halves, and with effects hidden in them, where
`OU_MONITOR_REALDATA` names their folder.  Of recordings with nothing hidden, what every flight has
may be in the base: a sag, noise that follows throttle, white noise, steps of the ADC.  Each of
these that was put in is true, whatever is named beyond it is a false alarm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
import json
import multiprocessing
from multiprocessing.connection import Connection, wait
import os
from pathlib import Path
import resource
import signal
import sys
import time
from typing import Any
import zlib

from blind_scores import hide, outcome
from common import BENCHES, FLIGHTS, flights
from hidden_circuit import FINE_RATE, make_bench, UPDATE_RATE
from hidden_effects import Hidden
from hidden_registry import EFFECTS as BASES
from injected import EFFECTS, noise_of
import numpy as np
from ou_monitor import discover
from ou_monitor.records import Recording

KNOWN = {**FLIGHTS, **BENCHES}

_ROOT = Path(__file__).resolve().parent.parent
TIME_LIMIT = 'time limit'
# What one result must say to be the result of a task.
_KEY = ('kind', 'effect', 'seed', 'number', 'duration', 'rate', 'strength')
# Beyond its limit a child is killed by its own alarm; after this, s, by its parent.
_GRACE = 5.0


@dataclass(frozen=True)
class Task:
    """One recording to be made and looked at."""

    # What `draw` is asked for: for a pair two names joined by '+', for none ''.
    kind: str
    effect: str
    # Of the run, and which of this effect; they seed all that is drawn.
    seed: int
    number: int
    # As `draw` takes them: s, Hz, 1 for moderate.
    duration: float
    rate: float
    strength: float

    @property
    def key(self) -> tuple[Any, ...]:
        """Return what tells it from other tasks."""
        return tuple(getattr(self, name) for name in _KEY)

    def hidden(self) -> Hidden:
        """Return the recording."""
        return hide(self.kind, self.effect, self.seed, self.number, duration=self.duration,
                    rate=self.rate, strength=self.strength)


def key_of(line: dict[str, Any]) -> tuple[Any, ...]:
    """Return the key of the task that a result is of."""
    return tuple(line['task'][name] for name in _KEY)


def examine(task: Task) -> dict[str, Any]:
    """Return outcome, gain and its error (nats), time and memory of `discover` alone."""
    hidden = task.hidden()
    recording = Recording(hidden.t, hidden.voltage, hidden.throttle, 'blind')
    wall, cpu = time.perf_counter(), time.process_time()
    finding = discover(recording)
    seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu
    data = finding.as_data()
    left = data['remaining'][:1]
    return {**outcome(hidden, data['verdict'], finding.causes).as_data(), 'failure': '',
            'seconds': seconds, 'cpu_s': cpu_seconds, 'memory_mb': peak_memory(),
            'gain': data['extended']['gain'], 'gain_se': data['extended']['gain_se'],
            'left': [[one['statistic'], one['observed']] for one in left]}


def peak_memory() -> float:
    """Return the largest resident memory of this process so far, MB."""
    status = Path('/proc/self/status')
    if status.exists():
        # What the parent has had does not count here, unlike in getrusage.
        lines = status.read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith('VmHWM')) / 1024.0
    top = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return top / (1024.0**2 if sys.platform == 'darwin' else 1024.0)


def _child(task: Task, limit: float, out: Connection) -> None:
    # The default action ends the process, in compiled code as well.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        result = examine(task)
    except Exception as error:
        # A failure is a result; the benchmark goes on.
        result = {**_nothing(task), 'failure': f'{type(error).__name__}: {error}'}
    out.send(result)
    out.close()


def _nothing(task: Task) -> dict[str, Any]:
    """Return the result of a recording of which nothing came."""
    return {**outcome(task.hidden()).as_data(), 'seconds': None, 'cpu_s': None,
            'memory_mb': None, 'gain': None, 'gain_se': None, 'left': []}


def run(next_task: Callable[[list[Task]], Task | None], jobs: int, limit: float
        ) -> Iterator[tuple[Task, dict[str, Any]]]:
    """
    Run tasks side by side until there are none; yield each with its result, as they end.

    `next_task`, given those under way, returns one more, or None where there is none now; a
    recording that takes longer than `limit` (s) is a failure.
    """
    context = multiprocessing.get_context('fork')
    running: dict[Connection, tuple[Task, Any, float]] = {}
    try:
        while True:
            while len(running) < jobs:
                task = next_task([one for one, _, _ in running.values()])
                if task is None:
                    break
                near, far = context.Pipe(duplex=False)
                process = context.Process(target=_child, args=(task, limit, far))
                process.start()
                far.close()
                running[near] = task, process, time.monotonic() + limit + _GRACE
            if not running:
                return
            first = min(end for _, _, end in running.values())
            ready = wait(list(running), max(0.0, first - time.monotonic()))
            late = [one for one, (_, _, end) in running.items() if end <= time.monotonic()]
            for one in {*ready, *late}:
                task, process, _ = running.pop(one)
                yield task, _collect(one, task, process)
    finally:
        for _, process, _ in running.values():
            process.kill()
            process.join()


def _collect(pipe: Connection, task: Task, process: Any) -> dict[str, Any]:
    """Return what a child has sent, or why it has not."""
    try:
        result: dict[str, Any] | None = pipe.recv() if pipe.poll() else None
    except EOFError:
        result = None
    pipe.close()
    # The end of the pipe comes a little before that of the process.
    process.join(1.0)
    stuck = process.is_alive()
    if stuck:
        process.kill()
    process.join()
    if result is not None:
        return result
    code = process.exitcode
    timed = stuck or code == -signal.SIGALRM
    return {**_nothing(task), 'failure': TIME_LIMIT if timed else f'ended with status {code}'}


def examine_recorded(folder: Path, names: Iterable[str], halves: bool
                     ) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield names of real runs, and JSON of what is found in the whole and in its halves."""
    for name, whole in flights(names, KNOWN):
        middle = whole.t.size // 2
        found = []
        for part in (slice(None), slice(0, middle), slice(middle, None))[:3 if halves else 1]:
            began = time.process_time()
            data = discover(_part(whole, part)).as_data()
            found.append({**data, 'cpu_s': time.process_time() - began})
        yield name, found


def _part(recording: Recording, part: slice) -> Recording:
    """Return a part of a recording."""
    def of(x: Any) -> Any:
        return None if x is None else x[part]

    return replace(recording, t=recording.t[part], voltage=recording.voltage[part],
                   throttle=of(recording.throttle), current=of(recording.current))


def agreement(one: dict[str, Any], other: dict[str, Any]) -> float:
    """Return the share of the causes of either finding that both name (Jaccard); NaN for none."""
    if 'insufficient_data' in (one['verdict'], other['verdict']):
        return float('nan')
    first, second = ({cause['name'] for cause in found['causes']} for found in (one, other))
    return len(first & second) / len(first | second) if first | second else 1.0


def warm_up() -> None:
    """Load and compile what recordings need, so that the first child is not charged for it."""
    for cause in ('load_sag', 'tone', 'glitches', 'regime_switching'):
        examine(Task('single', cause, 0, 0, 4.0, 250.0, 2.0))


def sources() -> str:
    """Return a fingerprint of the program and of the generator."""
    digest = sha256()
    for folder in ('ou_monitor', 'test/hidden'):
        for path in sorted((_ROOT / folder).rglob('*.py')):
            digest.update(str(path.relative_to(_ROOT)).encode() + path.read_bytes())
    return digest.hexdigest()[:8]


def read_lines(path: Path | None) -> list[dict[str, Any]]:
    """
    Return the results in a JSON-lines file in order; a file that is not there has none.

    The last line may be cut off by an interruption and is left out; another one that is no result
    raises a ValueError.
    """
    if path is None or not path.exists():
        return []
    found = []
    lines = path.read_text().splitlines()
    for k, line in enumerate(lines):
        try:
            one = json.loads(line)
            key_of(one)
        except (ValueError, KeyError, TypeError) as error:
            if k == len(lines) - 1:
                break
            raise ValueError(f'{path}, line {k + 1} is no result of this benchmark; '
                             'give another file') from error
        found.append(one)
    return found


class Results:
    """The results of a run: in memory, and in a JSON-lines file that can be resumed."""

    def __init__(self, path: Path | None, about: dict[str, Any]) -> None:
        self._path, self._about = path, about
        self.by_key = {key_of(line): line for line in read_lines(path)}
        text = ''.join(json.dumps(line) + '\n' for line in self.by_key.values())
        if path is not None and path.exists() and path.read_text() != text:
            # Without a line that was cut off; never half written.
            new = path.with_name(path.name + '.new')
            new.write_text(text)
            new.replace(path)

    def add(self, task: Task, result: dict[str, Any]) -> None:
        """Keep a result, in the file at once."""
        line = {'task': {name: getattr(task, name) for name in _KEY}, **self._about, **result}
        self.by_key[task.key] = line
        if self._path is not None:
            with self._path.open('a') as file:
                file.write(json.dumps(line) + '\n')

    def of(self, tasks: Iterable[Task]) -> list[dict[str, Any]]:
        """Return the results that there are of these tasks."""
        return [self.by_key[task.key] for task in tasks if task.key in self.by_key]


Draw = Callable[[np.random.Generator, float, float], tuple[Recording, tuple[str, ...]]]

# What a base may have, each with a chance of one half.
BASE = ('load_sag', 'load_dependent_sigma', 'measurement_noise', 'quantization')
RATES, DURATIONS = (50, 100, 200, 500, 1000), (20.0, 60.0, 120.0)


@dataclass(frozen=True)
class Null:
    """One recording with nothing hidden."""

    # Its generator, and which of it.
    name: str
    number: int
    # Hz, s.
    rate: float
    duration: float
    truth: tuple[str, ...]  # What is in its base.
    recording: Recording


def plain(rng: np.random.Generator, rate: float, duration: float
          ) -> tuple[Recording, tuple[str, ...]]:
    """Draw a plain rail under made throttle."""
    return _run(rng, rate, duration, None, ())


def flown(rng: np.random.Generator, rate: float, duration: float
          ) -> tuple[Recording, tuple[str, ...]]:
    """Draw a base with what flights have under throttle, recorded where there is some."""
    throttle = _recorded()
    base = tuple(name for name in BASE if rng.random() < 0.5)
    return _run(rng, rate, duration, throttle[rng.integers(len(throttle))] if throttle else None,
                base)


def _recorded(known: list[np.ndarray] = []) -> list[np.ndarray]:
    """Return throttle of recorded flights at the rate of commands, read once."""
    folder = os.environ.get('OU_MONITOR_REALDATA')
    if folder is not None and not known:
        for _, recording in flights():
            if recording.throttle is not None and recording.n > 1000:
                t = recording.t - recording.t[0]
                at = np.arange(0.0, float(t[-1]), 1.0 / UPDATE_RATE)
                known.append(np.clip(np.interp(at, t, recording.throttle), 0.0, 1.0))
    return known


def _run(rng: np.random.Generator, rate: float, duration: float, throttle: np.ndarray | None,
         base: Iterable[str]) -> tuple[Recording, tuple[str, ...]]:
    bench = make_bench(duration, rate, int(np.ceil(FINE_RATE / rate)), rng)
    if throttle is not None:
        need = bench.commands.size
        again = np.concatenate((throttle, throttle[::-1]))
        begin = int(rng.integers(again.size))
        bench.commands = np.resize(np.roll(again, -begin), need)
        bench.__post_init__()
    truth: set[str] = set()
    for name in base:
        BASES[name].apply(bench, float(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))))
        truth.update(BASES[name].truth)
    t, voltage, held = bench.run()
    return Recording(t, voltage, held, 'null'), tuple(sorted(truth))


def draw(name: str, make: Draw, seed: int, number: int) -> Null:
    """Draw one recording; all of it comes from seed, generator and number."""
    word = int.from_bytes(sha256(name.encode()).digest()[:8], 'big')
    rng = np.random.default_rng([seed, number, word])
    rate, duration = float(rng.choice(RATES)), float(rng.choice(DURATIONS))
    recording, truth = make(rng, rate, duration)
    return Null(name, number, rate, duration, truth, recording)


def examine_null(null: Null) -> dict[str, Any]:
    """Discover a recording; return what was named, and what of it is false."""
    began = time.process_time()
    data = discover(null.recording).as_data()
    named = [cause['name'] for cause in data['causes']]
    false = sorted({name for name in named if name not in null.truth})
    return {'generator': null.name, 'number': null.number, 'rate': null.rate,
            'duration': null.duration, 'truth': null.truth, 'verdict': data['verdict'],
            'named': named, 'false': false, 'cpu_s': time.process_time() - began}


# Generators of recordings with nothing hidden.
NULLS: dict[str, Draw] = {'plain': plain, 'flown': flown}


def nulls_of(each: int, seed: int, chosen: Sequence[str], lines: Path | None, more: bool
             ) -> Iterator[dict[str, Any]]:
    """Yield the results of all recordings, those known already from their file first."""
    known: dict[tuple[Any, ...], dict[str, Any]] = {}
    if lines is not None and lines.exists():
        for text in lines.read_text().splitlines():
            line = json.loads(text)
            known[line['generator'], line['seed'], line['number']] = line
    for number in range(each):
        for name in chosen:
            line = known.get((name, seed, number))
            if line is None and more:
                null = draw(name, NULLS[name], seed, number)
                line = {**examine_null(null), 'seed': seed}
                if lines is not None:
                    with lines.open('a') as out:
                        out.write(json.dumps(line) + '\n')
            if line is not None:
                yield line


# Seconds of each recording; what is shorter is taken whole, and so is jd, of one sample a second.
PIECES = {'gecko': (30.0, 60.0), 'nazgul': (40.0, 80.0), 'roma': (40.0, 80.0),
          'bf3s': (0.0, 40.0), 'jd': (0.0, 400.0), 'cf_solo': (10.0, 50.0),
          'cf_pair': (10.0, 50.0), 'cf_takeoff': (0.0, 40.0), 'mm_bench_3': (0.0, 4.0),
          'mm_bench_5': (0.0, 4.0), 'xt_pico_a': (2.0, 6.0)}
# What is hidden; the others of `EFFECTS` are of the sensor, and there or not without a model.
HIDDEN = ('tone', 'slow', 'levels', 'glitches', 'jumps', 'held', 'regimes', 'tails', 'dropouts')
STRENGTHS = (1.0, 3.0)


def pieces(folder: Path, names: Sequence[str]) -> Iterator[tuple[str, Recording]]:
    """Yield the pieces of the recordings that are there."""
    for name, whole in flights(names, {k: v for k, v in KNOWN.items() if k in PIECES}):
        first, last = PIECES[name]
        at = whole.t - whole.t[0]
        part = (at >= first) & (at < last)
        yield name, Recording(whole.t[part], whole.voltage[part],
                              whole.throttle[part])


@dataclass(frozen=True)
class Injected:
    """What came of one."""

    # What was hidden where; no effect: the piece as it is.
    recording: str
    effect: str
    strength: float
    # Causes that were named, and those that did as well.
    named: tuple[str, ...]
    alternatives: tuple[str, ...]
    seconds: float  # CPU time.

    def outcome(self, clean: Injected) -> str:
        """
        Return what came of an effect: 'yes', 'no', or 'there' where nothing can be said.

        It is named where a name that is right for it is in the set and is not, or not as often,
        in that of the piece as it is.
        """
        right = EFFECTS[self.effect][1]
        if any(self.named.count(name) > clean.named.count(name) for name in right) or (
                right & set(self.alternatives) - set(clean.named)):
            return 'yes'
        return 'there' if right & set(clean.named) & set(self.named) else 'no'

    def stays(self, clean: Injected) -> tuple[int, int]:
        """Return how many causes of the piece as it is are still named, and how many it has."""
        return len(set(clean.named) & set(self.named)), len(set(clean.named))

    def false(self, clean: Injected) -> tuple[str, ...]:
        """Return what is named that neither was there nor is right."""
        return tuple(sorted(set(self.named) - set(clean.named) - EFFECTS[self.effect][1]))


def found_in(name: str, effect: str, strength: float, recording: Recording) -> Injected:
    """Return what `discover` makes of a recording."""
    began = time.process_time()
    causes = discover(recording).causes
    return Injected(name, effect, strength, tuple(cause.name for cause in causes),
                    tuple(other for cause in causes for other in cause.alternatives),
                    time.process_time() - began)


def examine_injected(folder: Path, names: Sequence[str], effects: Sequence[str], seed: int,
                     say: Callable[[str], None]) -> list[Injected]:
    """Hide each effect in each piece, and return what came of it, the piece as it is first."""
    results = []
    for name, piece in pieces(folder, names):
        clean = found_in(name, '', 0.0, piece)
        say(f'{name}: {", ".join(clean.named) or "nothing"}; {clean.seconds:.1f} s')
        results.append(clean)
        for effect in effects or HIDDEN:
            rng = np.random.default_rng([seed, zlib.crc32(f'{name} {effect}'.encode())])
            strength = float(rng.uniform(*STRENGTHS))
            hidden = EFFECTS[effect][0](piece, strength * noise_of(piece.voltage), rng)
            one = found_in(name, effect, strength, hidden)
            kept, had = one.stays(clean)
            say(f'{name} {effect} x{strength:.1f}: {one.outcome(clean)}; '
                f'{", ".join(one.named) or "nothing"}; kept {kept} of {had}; '
                f'{one.seconds:.1f} s')
            results.append(one)
    return results
