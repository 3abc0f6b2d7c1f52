"""
An hour of faults for the real `estimator`: reported dips, silence, memory (1 h).

Voltages at 1 kHz with dips, wrong stamps, values and types; publishers that come and go; changes
of parameters; and no CPU at times (`soak_source.py` has the schedule).

    .venv/bin/python benchmarks/soak.py [--minutes 60] [--seed 1] [--markdown doc/results/soak.md]

The node, the source and a busy loop are separate processes; this one listens over DDS, sets
parameters and stops the node in slices.  With a real-time priority (`chrt -r 1`) the node and the
busy loop keep it, and source and listener get the next higher one.  Ctrl-C ends the run with the
figures so far.

A dip that was not reported in time has one of three causes: its messages did not reach the node
(lost); the node counted it (`floor_dips`), but that message did not reach the listener (unheard,
known from sequence numbers); or the node missed it.  Times are those when the node sent its
messages, because a listener without CPU receives them late.
"""

from __future__ import annotations

import argparse
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
import json
import math
import multiprocessing
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any, NamedTuple

from common import deliver, ROOT, say, table
from live import memory_of, Probe, Process, Starved, values_of
import numpy as np
from scipy import stats
from soak_source import Event, events, NEVER_FALSE

NODE = '/soak/ou_estimator'
MODEL = """\
model:
- term: ou
  params: {alpha: 63.0, sigma: 0.2, u0: 5.0}
- term: measurement_noise
  params: {std: 0.002}
"""
COUNTERS = ('messages', 'messages_lost', 'foreign_messages', 'pushed', 'used', 'non_finite',
            'late', 'resets', 'floor_dips', 'samples_thinned', 'restarts', 'callback_errors')
Span = tuple[float, float]
# Times between readings of the memory and between reports of progress, and timeouts of a service,
# of the node's start, and of its end, s.
LOOK, PROGRESS, ANSWER, START, END = 2.0, 60.0, 20.0, 60.0, 20.0
# A dip is reported in time if within this time of its start, s, without pauses (times when this
# program had stopped the node, or when the node was ready but had no CPU).
IN_TIME = 1.0
# A dip with fewer low samples on the wire is shorter than 40 ms.
SAMPLES = 40
# The growth of memory is fitted after the warm-up, s (or a fifth of the time), to means of blocks.
WARM_UP, BLOCKS = 600.0, 20
# How long the node may report what came before a phase, s: the longest `stale_after` that is set,
# and one report.
LINGER = 2.3
# Minimum waiting time for a CPU, by the kernel, that counts as a pause of the node, s.
WAIT = 0.05
REAL_TIME = (os.SCHED_FIFO, os.SCHED_RR)


# -- received messages, and the figures computed from them


class State(NamedTuple):
    """One message of `~/state`."""

    at: float  # When it was sent, by the monotonic clock, s.
    level: str
    reason: str
    brownout: str
    # The node's counts so far: messages received, messages lost, dips to the floor.
    messages: int
    lost: int = 0
    dips: int = 0
    number: int = 0  # The publisher's sequence number.


class Said(NamedTuple):
    """One message of another output: when it was sent, s, its value, its sequence number."""

    at: float
    value: Any = None
    number: int = 0


@dataclass
class Heard:
    """Everything that was received and noted; times by the monotonic clock, s."""

    states: list[State] = field(default_factory=list)
    flags: list[Said] = field(default_factory=list)
    outputs: dict[str, list[Said]] = field(default_factory=dict)
    memory: list[tuple[float, float]] = field(default_factory=list)
    stops: list[Span] = field(default_factory=list)  # The node was stopped.
    withheld: list[Span] = field(default_factory=list)  # The node was ready but had no CPU.
    deaths: list[float] = field(default_factory=list)
    source: list[dict[str, Any]] = field(default_factory=list)  # Lines of the source's log.

    def pauses(self) -> list[Span]:
        """Return the union of stops and time without CPU, in order."""
        made: list[Span] = []
        for begin, end in sorted([*self.stops, *self.withheld]):
            if made and begin <= made[-1][1]:
                made[-1] = made[-1][0], max(end, made[-1][1])
            else:
                made.append((begin, end))
        return made

    def of(self, kind: str) -> list[dict[str, Any]]:
        """Return the source's lines of one kind."""
        return [line for line in self.source if line['kind'] == kind]


def overlap(begin: float, end: float, spans: Sequence[Span]) -> float:
    """Return how much of an interval lies in ordered spans, s."""
    first = max(bisect_right(spans, (begin, math.inf)) - 1, 0)
    total = 0.0
    for a, b in spans[first:]:
        if a >= end:
            break
        total += max(0.0, min(b, end) - max(a, begin))
    return total


def unheard(messages: Sequence[State] | Sequence[Said]) -> int:
    """Return the number of messages missing between the given ones."""
    return sum(max(b.number - a.number - 1, 0) for a, b in zip(messages, messages[1:]))


def low(state: State) -> bool:
    """Return whether a state is CRITICAL because of the floor."""
    return state.level == 'CRITICAL' and 'brownout.floor (' in state.reason


def delay(dip: Mapping[str, Any], heard: Heard, pauses: Sequence[Span]) -> float:
    """Return the time from a dip's start to state and flag, s, without pauses; inf: none."""
    begin = dip['begin']
    when = math.inf
    for state in heard.states[bisect_right(heard.states, (begin,)):]:
        # A later dip must not be taken for this one.
        if state.at - begin - overlap(begin, state.at, pauses) > IN_TIME:
            break
        if low(state):
            when = state.at
            break
    later = heard.flags[bisect_right(heard.flags, (begin,)):]
    when = max(when, next((said.at for said in later if said.value), math.inf))
    return when - begin - overlap(begin, when, pauses) if when < math.inf else when


def fate(dip: Mapping[str, Any], heard: Heard) -> str:
    """Return why a dip was not reported: 'lost', 'unheard' or 'missed'."""
    # From the last state before the dip to the first one a second after it.
    at = bisect_right(heard.states, (dip['begin'],))
    last = next((k for k in range(at, len(heard.states))
                 if heard.states[k].at > dip['end'] + IN_TIME), len(heard.states) - 1)
    states = heard.states[max(at - 1, 0):last + 1]
    before, after = states[0], states[-1]
    flags = heard.flags[max(bisect_left(heard.flags, (before.at,)) - 1, 0):
                        bisect_left(heard.flags, (after.at,)) + 2]
    if after.dips > before.dips:
        gone = unheard(flags if any(map(low, states[1:])) else states)
        return 'unheard' if gone else 'missed'
    sent = heard.of('sent')
    # Messages of the last 20 ms may wait for the next poll.
    due = float(np.diff(np.interp([before.at, after.at - 0.02], [line['at'] for line in sent],
                                  [line['count'] for line in sent]))[0])
    # From the messages sent, or the node's own count: received messages may be older ones.
    gone = max(due - (after.messages - before.messages), after.lost - before.lost)
    return 'lost' if gone > 0.5 * dip['samples'] else 'missed'


def dips_of(heard: Heard) -> dict[str, Any]:
    """Return how many dips were reported in time, and the others by their fate."""
    last = heard.states[-1].at if heard.states else -math.inf
    asked = [dip for dip in heard.of('dip') if not dip['unseen'] and dip['samples'] >= SAMPLES
             and dip['end'] + IN_TIME < last]
    pauses = heard.pauses()
    delays = [delay(dip, heard, pauses) for dip in asked]
    in_time = [one for one in delays if one <= IN_TIME]
    others: dict[str, list[dict[str, Any]]] = {'lost': [], 'unheard': [], 'missed': []}
    for dip, one in zip(asked, delays):
        if one > IN_TIME:
            others[fate(dip, heard)].append(dip)
    return {'asked': len(asked), 'in_time': len(in_time), **others,
            'median': float(np.median(in_time)) if in_time else math.nan,
            'longest': max(in_time, default=math.nan)}


def silence(said: Sequence[Said] | Sequence[State], pauses: Sequence[Span]) -> Span:
    """Return the longest gap between consecutive messages, s: with and without pauses."""
    gaps = [(a.at, b.at) for a, b in zip(said, said[1:]) if b.number == a.number + 1]
    return (max((b - a for a, b in gaps), default=math.nan),
            max((b - a - overlap(a, b, pauses) for a, b in gaps), default=math.nan))


def false_of(heard: Heard) -> tuple[int, list[tuple[float, str]]]:
    """Return the time in which the input was unusable, s, and each false `~/brownout` in it."""
    marks, pauses = heard.of('phase'), heard.pauses()
    spent, found = 0.0, []
    for now, then in zip(marks, marks[1:]):
        if now['name'] not in NEVER_FALSE:
            continue
        begin, end = now['at'] + LINGER, then['at']
        spent += max(end - begin, 0.0)
        begin += overlap(now['at'], begin, pauses)
        part = slice(bisect_right(heard.flags, (begin, True, math.inf)),
                     bisect_left(heard.flags, (end,)))
        found += [(said.at, now['name']) for said in heard.flags[part] if not said.value]
    return round(spent), found


def growth(memory: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """
    Return the slope of memory and its standard error, bytes/h, after the warm-up.

    It is fitted to means of blocks, because neighbouring values are not independent.
    """
    if len(memory) < 2 * BLOCKS:
        return math.nan, math.nan
    t, size = np.array(memory).T
    kept = t - t[0] > min(WARM_UP, 0.2 * (t[-1] - t[0]))
    means = [(np.mean(a), np.mean(b)) for a, b in zip(
        np.array_split(t[kept], BLOCKS), np.array_split(size[kept], BLOCKS))]
    fit = stats.linregress(*np.array(means).T)
    return 3600.0 * float(fit.slope), 3600.0 * float(fit.stderr)


def figures(heard: Heard, counters: Mapping[str, int], more: Mapping[str, Any]
            ) -> dict[str, Any]:
    """Return all figures; `more` has the answers of services and the exit."""
    spent, false = false_of(heard)
    pauses = heard.pauses()
    sizes = [size for _, size in heard.memory] or [math.nan]
    return {
        **more, 'deaths': len(heard.deaths),
        'silence': {name: silence(said, pauses) for name, said in (
            ('~/state', heard.states), *heard.outputs.items())},
        'dips': dips_of(heard), 'unheard': unheard(heard.states), 'unusable': spent,
        'false': len(false), 'false_in': sorted({name for _, name in false}),
        'memory': sizes[-1], 'most_memory': max(sizes), 'growth': growth(heard.memory),
        **{name: [function(b - a for a, b in spans or [(0.0, 0.0)]) for function in (sum, max)]
           for name, spans in (('stopped', heard.stops), ('withheld', heard.withheld))},
        'counters': dict(counters)}


def as_table(found: Mapping[str, Any]) -> str:
    """Return the figures as a Markdown table."""
    dips, (slope, error) = found['dips'], found['growth']
    return table(['what', 'found'], [
        ['seed, transport, length', f"{found['run']}, {found['minutes']:.1f} min"],
        ['deaths of the node', str(found['deaths'])],
        *([f'longest silence of `{name}` (without the pauses below)', f'{gap:.2f} s ({net:.2f} s)']
          for name, (gap, net) in found['silence'].items()),
        ['dips of 40 to 80 ms that the node must see', str(dips['asked'])],
        ['of these CRITICAL by the floor, and `~/brownout` true, within 1 s',
         str(dips['in_time'])],
        ['not reported: their messages did not reach the node', str(len(dips['lost']))],
        ['counted by the node (`floor_dips`), the message lost on its way to the listener',
         str(len(dips['unheard']))],
        ['**delivered, and missed**', str(len(dips['missed']))],
        ['from the begin of a dip to both, median, longest',
         f"{dips['median']:.2f} s, {dips['longest']:.2f} s"],
        ['`~/brownout` false while the input was unusable',
         f"{found['false']} times in {found['unusable']} s"],
        ['resident memory at the end, at most',
         f"{found['memory'] / 1e6:.1f} MB, {found['most_memory'] / 1e6:.1f} MB"],
        ['its slope after the warm-up', f'{slope / 1e6:+.2f} ± {error / 1e6:.2f} MB/h'],
        ['parameters set, refused as they must be, answered wrongly, not answered',
         f"{found['set']}, {found['refused']}, {found['wrong']}, {found['unanswered']}"],
        ['longest answer of the parameter service', f"{found['answer']:.2f} s"],
        *([words, '{:.0f} s, {:.2f} s'.format(*found[name])] for name, words in (
            ('stopped', 'pauses: the node stopped by SIGSTOP, in all, longest'),
            ('withheld', 'the node ready, but no CPU for it, by the kernel (above 0.05 s)'))),
        ['messages of `~/state` that the listener never got, by their numbers',
         str(found['unheard'])],
        *([f'`{name}`', str(value)] for name, value in found['counters'].items()),
        ['exit status after SIGINT, time', f"{found['status']}, {found['took']:.2f} s"]])


# -- the run


def set_priority(priority: int, pid: int = 0) -> None:
    """Set the priority of a process that is in a real-time class."""
    if os.sched_getscheduler(pid) in REAL_TIME:
        os.sched_setparam(pid, os.sched_param(priority))


def busy(core: int, priority: int) -> None:
    """Keep one core busy."""
    set_priority(priority)
    os.sched_setaffinity(0, {core})
    while True:
        pass


def steady(wall: float) -> float:
    """Return a time of the wall clock by the monotonic clock, s."""
    return wall + time.monotonic() - time.time()


class Soak:
    """One run: its processes, their messages, and the actions on them."""

    def __init__(self, seed: int, seconds: float, folder: Path, domain: int, dense: bool) -> None:
        self.heard = Heard(outputs={name: [] for name in ('/diagnostics', '~/brownout_risk')})
        self.counters: Counter[str] = Counter()
        self.found: Counter[str] = Counter(set=0, refused=0, wrong=0, unanswered=0)
        self.wrong: list[str] = []
        self.answer = 0.0
        self._newest: dict[str, str] = {}
        self._folder, self._domain = folder, domain
        self._log = folder / 'source.jsonl'
        fifo, model = folder / 'fifo', folder / 'model.yaml'
        os.mkfifo(fifo)
        model.write_text(MODEL)
        self._events = events(seed, seconds, str(fifo), str(model))
        self._priority = os.sched_getparam(0).sched_priority
        # Listener and source run before the node.
        set_priority(self._priority + 1)
        self._node = self._start_node()
        threading.Thread(target=self._watch_cpu, daemon=True).start()
        self._probe = Probe(domain)
        self._listen()
        self._source = subprocess.Popen(
            [sys.executable, ROOT / 'benchmarks/soak_source.py', str(seed), str(seconds),
             self._log, *(['dense'] if dense else [])],
            env={**os.environ, 'ROS_DOMAIN_ID': str(domain)})
        self._starved: tuple[float, Starved] | None = None
        self._busy: tuple[float, multiprocessing.Process] | None = None
        self._begin = time.monotonic()

    def _start_node(self) -> Process:
        node = Process('estimator', [
            '--ros-args', '-r', '__ns:=/soak', '-p', 'brownout.hold:=0.0', '-p',
            f"state_file:={self._folder / 'latch'}"], self._domain, self._folder)
        # Before the node starts threads, which inherit it.
        set_priority(self._priority, node.popen.pid)
        return node

    def _watch_cpu(self) -> None:
        """Record from the kernel when the node's main thread was ready but had no CPU."""
        last, waited = 0, 0.0
        while True:
            time.sleep(0.02)
            pid = self._node.popen.pid
            with suppress(OSError):
                # Time on the CPU, and time ready without CPU, since the thread started, ns.
                account = Path(f'/proc/{pid}/task/{pid}/schedstat').read_text()
                total, now = 1e-9 * int(account.split()[1]), time.monotonic()
                if pid == last and total - waited > WAIT:
                    self.heard.withheld.append((now - (total - waited), now))
                last, waited = pid, total

    def _listen(self) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from rcl_interfaces.srv import SetParameters
        from std_msgs.msg import Bool, Float64
        from std_srvs.srv import Trigger
        node = self._probe.node

        def state(message: Any, number: int, sent: float) -> None:
            values = self._newest = values_of(message.status[0])
            counts = [self.counters[name] + int(values[name]) for name in (
                'messages', 'messages_lost', 'floor_dips')]
            self.heard.states.append(State(
                steady(sent), values['brownout_level'], values['brownout_reason'],
                values['brownout'], *counts, number))

        self._probe.numbered(f'{NODE}/state', DiagnosticArray, state)
        for topic, kind, said in (
                (f'{NODE}/brownout', Bool, self.heard.flags),
                (f'{NODE}/brownout_risk', Float64, self.heard.outputs['~/brownout_risk']),
                ('/diagnostics', DiagnosticArray, self.heard.outputs['/diagnostics'])):
            self._probe.numbered(topic, kind, lambda message, number, sent, said=said: said.append(
                Said(steady(sent), getattr(message, 'data', None), number)))
        self._setter = node.create_client(SetParameters, f'{NODE}/set_parameters')
        self._clearer = node.create_client(Trigger, f'{NODE}/clear_brownout')

    def run(self) -> None:
        """Carry out the schedule until the source ends."""
        until = time.monotonic() + START
        while not self.heard.states:
            if time.monotonic() > until or self._node.popen.poll() is not None:
                raise SystemExit(f'the node did not start: {self._node.err}')
            time.sleep(0.02)
        # The source's clock starts with its first sample.
        while self._source.poll() is None and not self._read_source():
            time.sleep(0.01)
        start = self._read_source()[0]['at']
        looked = reported = -math.inf
        pending = list(self._events)
        while self._source.poll() is None:
            now = time.monotonic()
            if now - looked >= LOOK:
                looked = now
                self._look(now)
            if now - reported >= PROGRESS:
                reported = now
                say(f"{(now - start) / 60.0:5.1f} min: {self._newest.get('floor_dips')} dips "
                    f'counted by the node, {self.heard.memory[-1][1] / 1e6:.1f} MB')
            self._release(now - start)
            if pending and now - start >= pending[0].begin:
                self._do(pending.pop(0))
            time.sleep(0.02)

    def _read_source(self) -> list[dict[str, Any]]:
        if not self._log.exists():
            return []
        whole = self._log.read_text().rpartition('\n')[0]
        return [json.loads(line) for line in whole.splitlines()]

    def _look(self, now: float) -> None:
        """Record the node's memory; restart the node if it has died."""
        if self._node.popen.poll() is None:
            self.heard.memory.append((now, memory_of(self._node.popen.pid)))
            return
        self.heard.deaths.append(now)
        say(f'the node died: {self._node.err[-2000:]}')
        self.counters, self._newest = self._totals(), {}
        self._node = self._start_node()

    def _totals(self) -> Counter[str]:
        return Counter({name: self.counters[name] + int(self._newest.get(name, 0))
                        for name in COUNTERS})

    def _release(self, now: float) -> None:
        """Return the CPU to the node when an event is over (now: time of the schedule, s)."""
        if self._starved is not None and now > self._starved[0]:
            self._starved[1].stop()
            self.heard.stops += self._starved[1].stops
            self._starved = None
        if self._busy is not None and now > self._busy[0]:
            self._busy[1].kill()
            self._busy[1].join()
            self._pin(os.sched_getaffinity(0))
            self._busy = None

    def _pin(self, cores: set[int]) -> None:
        """Bind every thread of the node to cores."""
        for task in Path(f'/proc/{self._node.popen.pid}/task').iterdir():
            # A thread may end meanwhile.
            with suppress(OSError):
                os.sched_setaffinity(int(task.name), cores)

    def _do(self, event: Event) -> None:
        if event.kind in ('set', 'refused'):
            self._set(event)
        elif event.kind == 'clear':
            from std_srvs.srv import Trigger
            self._call(self._clearer, Trigger.Request())
        elif event.kind == 'slices':
            length, (stopped, running) = event.about
            self._starved = (event.begin + length,
                             Starved(self._node.popen.pid, stopped, running).start())
        else:
            core = min(os.sched_getaffinity(0))
            self._pin({core})
            process = multiprocessing.Process(
                target=busy, args=(core, self._priority), daemon=True)
            process.start()
            self._busy = event.begin + event.about[0], process

    def _call(self, client: Any, request: Any) -> Any:
        """Return the response of a service; None if there is none."""
        begin = time.monotonic()
        future = client.call_async(request)
        while not future.done():
            if time.monotonic() - begin > ANSWER:
                self.found['unanswered'] += 1
                client.remove_pending_request(future)
                return None
            time.sleep(0.005)
        self.answer = max(self.answer, time.monotonic() - begin)
        return future.result()

    def _set(self, event: Event) -> None:
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter
        answer = self._call(self._setter, SetParameters.Request(parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in event.about]))
        for (name, value), result in zip(event.about, answer.results if answer else ()):
            if result.successful is (event.kind == 'set'):
                self.found[event.kind] += 1
            else:
                self.found['wrong'] += 1
                self.wrong.append(f'{name} = {value!r}: {result.successful} {result.reason}')

    def close(self, run: str) -> dict[str, Any]:
        """End all processes; return the figures."""
        self._release(math.inf)
        minutes = (time.monotonic() - self._begin) / 60.0
        begin = time.monotonic()
        self._node.popen.send_signal(signal.SIGINT)
        try:
            status: Any = self._node.popen.wait(END)
        except subprocess.TimeoutExpired:
            status = f'none within {END:g} s'
            self._node.kill()
        took = time.monotonic() - begin
        self._source.send_signal(signal.SIGINT)
        self._source.wait()
        self._probe.close()
        self.heard.source = self._read_source()
        if 'Traceback' in self._node.err:
            say(self._node.err[-20000:])
        return figures(self.heard, self._totals(), {
            'run': run, 'minutes': minutes, 'answer': self.answer, 'status': status,
            'took': took, **self.found})


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--domain', type=int, default=91, help='ROS_DOMAIN_ID')
    parser.add_argument('--transport', default='DEFAULT', choices=('DEFAULT', 'UDPv4'),
                        help='of Fast DDS; DEFAULT: shared memory, and UDP beside it')
    parser.add_argument('--dense', action='store_true', help='dips as close as can be separated')
    parser.add_argument('--json', type=Path, help='file for all figures')
    parser.add_argument('--markdown', type=Path, help='page for the table')
    options = parser.parse_args()
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['FASTDDS_BUILTIN_TRANSPORTS'] = options.transport
    # A shell starts its background processes with SIGINT ignored.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as folder:
        os.environ['ROS_LOG_DIR'] = folder
        soak = Soak(options.seed, 60.0 * options.minutes, Path(folder), options.domain,
                    options.dense)
        try:
            soak.run()
        except KeyboardInterrupt:
            say('ended by a signal: the figures so far')
        finally:
            found = soak.close(f'seed {options.seed}, {options.transport}'
                               + (', dense' if options.dense else ''))
    print(as_table(found))
    for line in soak.wrong:
        print(f'answered wrongly: {line}')
    for kind in ('lost', 'unheard', 'missed'):
        for dip in found['dips'][kind]:
            print(f'{kind}: {dip}')
    if options.json:
        options.json.write_text(json.dumps(found, indent=1, default=str))
    if options.markdown:
        deliver(as_table(found).rstrip(), options.markdown, 'soak')


if __name__ == '__main__':
    main()
