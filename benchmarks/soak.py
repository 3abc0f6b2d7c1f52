"""
An hour of chaos for the real `estimator` (1 h).

1 kHz with dips, wrong stamps, values and types, parameters, publishers that come and go, and a
CPU that is taken away.

    .venv/bin/python benchmarks/soak.py [--minutes 60] [--seed 1] [--markdown doc/results/soak.md]

The node, the source and a busy loop are processes of their own; this one listens over DDS, sets
parameters and stops the node in slices.  With a real-time priority (`chrt -r 1`) the node and the
busy loop keep it, and source and listener get the next higher one.  Ctrl-C ends it with the
figures so far.
"""

from __future__ import annotations

import argparse
from collections import Counter
from contextlib import suppress
import json
import multiprocessing
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test/support')]

from live import memory_of, Probe, Process, Starved, values_of  # noqa: E402
from soak_figures import as_table, figures, Heard, IN_TIME, Said, State  # noqa: E402
from soak_machine import at_leisure, busy, Machine, set_priority  # noqa: E402
from soak_schedule import Event, events  # noqa: E402
from tables import put  # noqa: E402

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
# s: between looks at the memory, and at what is reported of the progress; patience with a
# service, with the start of a node, and with its end.
LOOK, PROGRESS, ANSWER, START, END = 2.0, 60.0, 20.0, 60.0, 20.0


def steady(wall: float) -> float:
    """Return a time of the wall clock by the monotonic clock, s."""
    return wall + time.monotonic() - time.time()


class Soak:
    """One run: processes, what is heard of them, and what is done to them."""

    def __init__(self, seed: int, seconds: float, folder: Path, domain: int, dense: bool) -> None:
        self.heard = Heard(outputs={name: [] for name in ('/diagnostics', '~/brownout_risk')})
        self.counters: Counter[str] = Counter()
        self.found: Counter[str] = Counter(set=0, refused=0, wrong=0, unanswered=0)
        self.wrong: list[str] = []
        self.answer, self.run_by = 0.0, ''
        self._newest: dict[str, str] = {}
        self._folder, self._domain = folder, domain
        self._log = folder / 'source.jsonl'
        fifo, model = folder / 'fifo', folder / 'model.yaml'
        os.mkfifo(fifo)
        model.write_text(MODEL)
        self._events = events(seed, seconds, str(fifo), str(model))
        # Of the node; what hears it and what feeds it goes before it.
        self._priority = os.sched_getparam(0).sched_priority
        set_priority(self._priority + 1)
        self._node = self._start_node()
        self._machine = Machine(lambda: self._node.popen.pid)
        self._machine.start()
        self._probe = Probe(domain)
        self._listen()
        env = {**os.environ, 'ROS_DOMAIN_ID': str(domain),
               'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
        self._source = subprocess.Popen(
            [sys.executable, ROOT / 'benchmarks/soak_source.py', str(seed), str(seconds),
             self._log, *(['dense'] if dense else [])], env=env)
        self._starved: tuple[float, Starved] | None = None
        self._busy: tuple[float, multiprocessing.Process] | None = None
        self._begin = self._start = time.monotonic()
        self._told: set[tuple[str, float]] = set()

    def _start_node(self) -> Process:
        node = Process('estimator', [
            '--ros-args', '-r', '__ns:=/soak', '-p', 'brownout.hold:=0.0', '-p',
            f"state_file:={self._folder / 'latch'}"], self._domain, self._folder)
        # Before it has threads.
        set_priority(self._priority, node.popen.pid)
        return node

    def _listen(self) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from rcl_interfaces.srv import SetParameters
        from std_msgs.msg import Bool, Float64
        from std_srvs.srv import Trigger
        node = self._probe.node

        def state(message: Any, number: int, sent: float) -> None:
            values = self._newest = values_of(message.status[0])
            counts = [self.counters[name] + int(values[name]) for name in (
                'messages', 'messages_lost', 'foreign_messages', 'floor_dips')]
            self.heard.states.append(State(
                steady(sent), values['brownout_level'], values['brownout_reason'],
                values['brownout'], *counts, number, float(values['arrival_age'])))

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
        """Do what is scheduled until the source ends."""
        self._wait_for_start()
        # From the first sample on, as the source counts.
        while self._source.poll() is None and not self._lines('start'):
            time.sleep(0.01)
        start = self._start = self._lines('start')[0]['at']
        looked = told = -1e9
        pending = list(self._events)
        while self._source.poll() is None:
            now = time.monotonic()
            if now - looked >= LOOK:
                looked = now
                self._look(now)
            if now - told >= PROGRESS:
                told = now
                self._report(now - start)
            self._release(now - start)
            if pending and now - start >= pending[0].begin:
                self._do(pending.pop(0))
            time.sleep(0.02)

    def _wait_for_start(self) -> None:
        until = time.monotonic() + START
        while not self.heard.states:
            if time.monotonic() > until or self._node.popen.poll() is not None:
                raise SystemExit(f'the node did not start: {self._node.err}')
            time.sleep(0.02)

    def _lines(self, kind: str = '') -> list[dict[str, Any]]:
        """Return the lines of the source's log."""
        if not self._log.exists():
            return []
        whole = self._log.read_text().rpartition('\n')[0]
        lines = [json.loads(line) for line in whole.splitlines()]
        return [line for line in lines if not kind or line['kind'] == kind]

    def _look(self, now: float) -> None:
        """Look at the node's memory; start it anew where it is dead."""
        if self._node.popen.poll() is None:
            self.heard.memory.append((now, memory_of(self._node.popen.pid)))
            return
        self.heard.deaths.append(now)
        print(f'the node died: {self._node.err[-2000:]}', file=sys.stderr)
        self._count()
        self._node = self._start_node()

    def _count(self) -> None:
        for name in COUNTERS:
            self.counters[name] += int(self._newest.get(name, 0))
        self._newest = {}

    def _release(self, now: float) -> None:
        """End what takes the CPU when its time is over (now in s of the schedule)."""
        if self._starved is not None and now > self._starved[0]:
            self._starved[1].stop()
            self.heard.stops += self._starved[1].stops
            self._starved = None
        if self._busy is not None and now > self._busy[0]:
            self._end_busy()

    def _end_busy(self) -> None:
        if self._busy is not None:
            self._busy[1].kill()
            self._busy[1].join()
            self._pin(os.sched_getaffinity(0))
            self._busy = None

    def _pin(self, cores: set[int]) -> None:
        """Put every thread of the node on cores."""
        for task in Path(f'/proc/{self._node.popen.pid}/task').iterdir():
            # A thread may end meanwhile.
            with suppress(OSError):
                os.sched_setaffinity(int(task.name), cores)

    def _do(self, event: Event) -> None:
        if event.kind != 'set':
            self._note(event.kind)
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

    def _note(self, name: str, value: str = '') -> None:
        self.heard.done.append((time.monotonic(), name, value))

    def _call(self, client: Any, request: Any) -> Any:
        """Return the answer of a service; None when there is none."""
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
        if answer is None:
            return
        for (name, value), result in zip(event.about, answer.results):
            if result.successful:
                self._note(name, repr(value))
            if result.successful is (event.kind == 'set'):
                self.found[event.kind] += 1
            else:
                self.found['wrong'] += 1
                self.wrong.append(f'{name} = {value!r}: {result.successful} {result.reason}')

    def _report(self, now: float) -> None:
        # Sums take seconds at the end of an hour: not before the node.
        with at_leisure():
            found = self.figures(now, {'status': '-', 'took': 0.0})
        dips = found['dips']
        silent = ', '.join(f'{name} {net:.2f}' for name, (_, net, _) in found['silence'].items())
        print(f"{now / 60.0:5.1f} min: {dips['in_time']} of {dips['asked']} dips, longest "
              f"silence, s: {silent}, {found['memory'] / 1e6:.1f} MB, false {found['false']}",
              flush=True)
        self._explain(dips)

    def _explain(self, dips: dict[str, Any]) -> None:
        """Say of each dip that was not told what is known of it, once."""
        for what in ('lost', 'unheard', 'missed'):
            for dip in dips[what]:
                if (what, dip['begin']) not in self._told:
                    self._told.add((what, dip['begin']))
                    print(f"{what} at {dip['begin'] - self._start:.2f} s: {dip['why']}", *(
                        state for state in self.heard.states if what == 'missed'
                        and dip['begin'] - 0.3 < state.at < dip['end'] + IN_TIME),
                        sep='\n  ', flush=True)

    def figures(self, seconds: float, end: dict[str, Any]) -> dict[str, Any]:
        """Return the figures so far."""
        self.heard.source = self._lines()
        self.heard.withheld = list(self._machine.node)
        self.heard.deaf = list(self._machine.here)
        counters = {name: self.counters[name] + int(self._newest.get(name, 0))
                    for name in COUNTERS}
        return figures(self.heard, counters, {
            'run': self.run_by, 'minutes': seconds / 60.0,
            'answer': self.answer, **self.found, **end})

    def close(self) -> dict[str, Any]:
        """End all processes; return the figures."""
        self._release(float('inf'))
        length = time.monotonic() - self._begin
        begin = time.monotonic()
        self._node.popen.send_signal(signal.SIGINT)
        try:
            status: Any = self._node.popen.wait(END)
        except subprocess.TimeoutExpired:
            status = f'none within {END:g} s'
            self._node.kill()
        end = {'status': status, 'took': time.monotonic() - begin}
        self._source.send_signal(signal.SIGINT)
        self._source.wait()
        self._probe.close()
        found = self.figures(length, end)
        self._explain(found['dips'])
        for name, (_, net, at) in found['silence'].items():
            print(f'{name} was silent for {net:.2f} s at {at - self._start:.2f} s; done: '
                  f'{self.heard.lately(at, at + net)}')
        if 'Traceback' in self._node.err:
            print(self._node.err[-20000:], file=sys.stderr)
        return found


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--domain', type=int, default=91, help='ROS_DOMAIN_ID')
    parser.add_argument('--transport', default='DEFAULT', choices=('DEFAULT', 'UDPv4'),
                        help='of Fast DDS; DEFAULT: shared memory, and UDP beside it')
    parser.add_argument('--dense', action='store_true', help='dips as close as can be told apart')
    parser.add_argument('--json', type=Path, help='file for all figures')
    parser.add_argument('--markdown', type=Path, help='page for the table')
    options = parser.parse_args()
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['FASTDDS_BUILTIN_TRANSPORTS'] = options.transport
    # A shell has SIGINT ignored by what it starts in the background.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as folder:
        os.environ['ROS_LOG_DIR'] = folder
        soak = Soak(options.seed, 60.0 * options.minutes, Path(folder), options.domain,
                    options.dense)
        soak.run_by = f'seed {options.seed}, {options.transport}' + (
            ', dense' if options.dense else '')
        try:
            soak.run()
        except KeyboardInterrupt:
            print('ended by a signal: the figures so far', file=sys.stderr)
        finally:
            found = soak.close()
    text = as_table(found)
    print(text)
    for line in soak.wrong:
        print(f'answered wrongly: {line}')
    if options.json:
        options.json.write_text(json.dumps(found, indent=1, default=str))
    if options.markdown:
        put(options.markdown, text.rstrip(), 'soak')


if __name__ == '__main__':
    main()
