"""
One hidden effect after the other, each in a process of its own with a time limit.

And recordings of real runs, whole and in halves, where `OU_MONITOR_REALDATA` names their folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from hashlib import sha256
import json
import multiprocessing
from multiprocessing.connection import Connection, wait
from pathlib import Path
import resource
import signal
import sys
import time
from typing import Any

from blind_scores import hide, outcome
from hidden_effects import Hidden
from ou_monitor import discover
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import Recording
from real_flights import BENCHES, FLIGHTS

_ROOT = Path(__file__).resolve().parent.parent
TIME_LIMIT = 'time limit'
# What one result must say to be the result of a task.
_KEY = ('kind', 'effect', 'seed', 'number', 'duration', 'rate', 'strength')
# Beyond its limit a child is killed by its own alarm; after this, s, by its parent.
_GRACE = 5.0


@dataclass(frozen=True)
class Task:
    """
    One recording to be made and looked at.

    Attributes
    ----------
    kind, effect : str
        What `draw` is asked for: for a pair two names joined by '+', for none ''.
    seed, number : int
        Of the run, and which of this effect; they seed all that is drawn.
    duration, rate, strength : float
        As `draw` takes them: s, Hz, 1 for moderate.

    """

    kind: str
    effect: str
    seed: int
    number: int
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
    """
    Draw the recording of a task and discover it.

    Parameters
    ----------
    task : Task
        What to do.

    Returns
    -------
    dict
        The outcome, the gain and its error (nats per sample), time and memory of
        `discover` alone.

    """
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
    Run tasks side by side until there are none.

    Parameters
    ----------
    next_task : callable
        Given those under way, returns one more, or None where there is none now.
    jobs : int
        Processes at once.
    limit : float
        Time for one recording, s; more is a failure.

    Yields
    ------
    tuple of Task and dict
        As they end; the dict as `examine` returns it.

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
    """
    Discover recordings of real runs.

    Yields
    ------
    tuple of str and list of dict
        Name, and for the whole, and for its halves if they are asked for: JSON of the finding,
        and `cpu_s` beside it.

    """
    for name, file, options in (*FLIGHTS, *BENCHES):
        if (names and name not in names) or not (folder / file).exists():
            continue
        flight = int(options[options.index('--flight') + 1]) if '--flight' in options else None
        whole = read_recording(folder / file, flight=flight)
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
    Return the results in a JSON-lines file.

    Parameters
    ----------
    path : Path or None
        The file; one that is not there has none.

    Returns
    -------
    list of dict
        In order; the last line may be cut off by an interruption, and is left out.

    Raises
    ------
    ValueError
        When another line is no result; says which.

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
    """
    The results of a run: in memory, and in a JSON-lines file that can be resumed.

    Parameters
    ----------
    path : Path or None
        The file; None keeps nothing.
    about : dict
        Added to each new line, such as the commit.

    """

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
