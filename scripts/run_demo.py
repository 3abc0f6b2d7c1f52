#!/usr/bin/env python3
"""
Drive the demo: start the nodes, replay a bag into them, show a live table, write a report.

Estimator, adaptive filter and replay (or, with --simulated, supply_simulator with the recorded
throttle) run as separate processes that communicate over DDS, as on a vehicle; this program only
listens.  Exit status: 0 when estimates and filtered samples arrived, 1 when they did not, 2 when
the demo could not start, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
from importlib import import_module
import math
import os
from pathlib import Path
import random
import signal
import socket
import subprocess
import sys
import time
from typing import Any

from ou_monitor.errors import InputError

ROOT = Path(__file__).resolve().parent.parent
START_TIMEOUT = 30.0
# A node that is still running this long after SIGINT is killed, s.
STOP_TIMEOUT = 5.0
# A recorded flight of a 4S quad, its limit (3.3 V per cell), and a model of its supply.
RECORDED, LIMIT, MODEL = 'bags/recorded/gecko', 13.2, 'models/gecko.yaml'
# With --simulated: seed, sampling rate in Hz, and how much larger sag is in the second half.
SEED, RATE, OLD = 1, 200.0, 1.6
HEADER = (f'{"t":>6} {"throttle":>8} {"level":>7} {"noise":>6} {"sag":>6} {"error":>6} '
          f'{"alpha":>7} {"risk":>7} {"cutoff":>7}  load, relaxation\n'
          f'{"s":>6} {"0..1":>8} {"V":>7} {"mV":>6} {"V":>6} {"V":>6} {"1/s":>7} '
          f'{"0..1":>7} {"Hz":>7}')


class DemoError(Exception):
    """The demo cannot continue; the text is the one-line message for the user."""


def unused_domain() -> int:
    """Return a DDS domain that no participant on this machine uses."""
    # Up to 101 the ports of a domain stay below Linux' ephemeral range (DDSI-RTPS 9.6.1.1).
    for domain in random.sample(range(1, 101), 100):
        try:
            for offset in (0, 10):
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                    probe.bind(('', 7400 + 250 * domain + offset))
        except OSError:
            continue
        return domain
    raise DemoError('all ROS domains from 1 to 100 are in use here: set ROS_DOMAIN_ID')


class Children:
    """The processes of the demo, each with a log; all are stopped when the `with` block ends."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Children:
        """Make the folder of the logs."""
        self._logs.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *error: object) -> None:
        """End all of them, newest first."""
        for name in reversed(list(self._running)):
            self.stop(name)

    def start(self, name: str, *arguments: str) -> None:
        """Start one executable of the package."""
        with self._log(name).open('wb') as log:
            # In a new session: Ctrl-C reaches only this program, which stops the others in order.
            self._running[name] = subprocess.Popen(
                [sys.executable, '-u', '-m', *([] if '.' in name else ['ou_monitor.nodes']), name,
                 *arguments],
                cwd=ROOT, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                start_new_session=True)

    def status(self, name: str) -> int | None:
        """Return the exit status; None while it runs."""
        return self._running[name].poll()

    def stop(self, name: str) -> None:
        """Stop one as Ctrl-C would."""
        process = self._running[name]
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(STOP_TIMEOUT)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def check(self, *names: str) -> None:
        """Raise when one of them has ended on its own."""
        for name in names:
            if self.status(name) is not None:
                raise DemoError(f'{name} ended with status {self.status(name)}: {self.last(name)}')

    def last(self, name: str) -> str:
        """Return the last line of its output and the path of its log."""
        lines = self._log(name).read_text(errors='replace').strip().splitlines()
        return f'{lines[-1] if lines else "no output"} (log: {self._log(name)})'

    def said(self, name: str) -> str:
        """Return all of its output."""
        return self._log(name).read_text(errors='replace').strip()

    def _log(self, name: str) -> Path:
        return self._logs / f'demo_{name}.log'


class Listener:
    """Receives what the nodes publish, and formats it as a line of the table."""

    def __init__(self, node: Any) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from std_msgs.msg import Float64
        self._node = node
        self._first = math.nan
        self.fields: dict[str, str] = {}
        self.cutoff = math.nan
        self.estimates = self.outputs = 0
        node.create_subscription(DiagnosticArray, '/ou_estimator/state', self._on_state, 10)
        node.create_subscription(Float64, '/ou_adaptive_filter/cutoff', self._on_cutoff, 10)

    def ready(self) -> bool:
        """Whether both nodes are running."""
        return all(self._node.count_publishers(topic) > 0
                   for topic in ('/ou_estimator/state', '/ou_adaptive_filter/cutoff'))

    def hear_filter(self, kind: str) -> None:
        """Listen to the filter's output, which has the type of its input."""
        from rclpy.qos import qos_profile_sensor_data
        package, _, name = kind.split('/')
        self._node.create_subscription(
            getattr(import_module(f'{package}.msg'), name), '/ou_adaptive_filter/output',
            self._on_output, qos_profile_sensor_data)

    def _on_state(self, message: Any) -> None:
        self.fields = {item.key: item.value for item in message.status[0].values}
        self.estimates += math.isfinite(self.number('load_level'))

    def _on_cutoff(self, message: Any) -> None:
        self.cutoff = message.data

    def _on_output(self, message: Any) -> None:
        self.outputs += 1

    def number(self, name: str) -> float:
        """Return one field of the newest state; NaN when it is not there."""
        return float(self.fields.get(name, 'nan'))

    def line(self) -> str:
        """Return the newest state as a line of the table, with '-' for unknown values."""
        if not math.isfinite(self._first):
            self._first = self.number('t')
        cells = [
            (self.number('t') - self._first, 6, '.1f'), (self.number('throttle'), 8, '.2f'),
            (self.number('load_level'), 7, '.3f'), (1e3 * self.number('load_noise'), 6, '.1f'),
            (self.number('sag'), 6, '.2f'), (self.number('sag_se'), 6, '.2f'),
            (self.number('alpha'), 7, '.1f'),
            (self.number('brownout_risk'), 7, '.2g'), (self.cutoff, 7, '.1f')]
        text = ' '.join(f'{value:{width}{form}}' if math.isfinite(value) else f'{"-":>{width}}'
                        for value, width, form in cells)
        return (f'{text}  {self.fields.get("load_status", "waiting")}, '
                f'{self.fields.get("status", "waiting")}'
                + (', CRITICAL' if self.fields.get('brownout_level') == 'CRITICAL' else ''))


class Table:
    """A line a second; on a terminal the newest line is refreshed in between."""

    def __init__(self) -> None:
        self._live = sys.stdout.isatty()
        self._next_line = self._next_refresh = 0.0
        print(HEADER, flush=True)

    def show(self, listener: Listener) -> None:
        """Show the newest state if a new line or a refresh is due."""
        now = time.monotonic()
        if now >= self._next_line:
            self._next_line = now + 1.0
            print(('\r\x1b[K' if self._live else '') + listener.line(), flush=True)
        elif self._live and now >= self._next_refresh:
            self._next_refresh = now + 0.2
            print(f'\r\x1b[K\x1b[2m{listener.line()}\x1b[0m', end='', flush=True)

    def close(self) -> None:
        """Leave the cursor on an empty line."""
        if self._live:
            print('\r\x1b[K', end='', flush=True)


def signal_of(bag: str) -> tuple[str, str]:
    """Return the topic to filter: an IMU, else the fastest scalar other than the throttle."""
    from ou_monitor.nodes.filter_channels import CHANNELS
    from ou_monitor.recordings.bag import BagReader
    reader = BagReader(bag)
    known = [(name, kind) for name, kind in reader.topics.items() if kind in CHANNELS]
    if not known:
        raise DemoError(f'{bag} has no topic that the filter takes ({", ".join(CHANNELS)})')
    return max(known, key=lambda topic: (
        topic[1].endswith('/Imu'), not topic[0].endswith('throttle'), reader.counts[topic[0]]))


def live_page(children: Children) -> str:
    """Start the live page; return the line with its address, empty if it cannot be served."""
    children.start('ou_monitor.cli.main', 'live', '--port', '0')
    deadline = time.monotonic() + START_TIMEOUT
    while children.status('ou_monitor.cli.main') is None and time.monotonic() < deadline:
        line = children.said('ou_monitor.cli.main')
        if 'http://' in line:
            return line
        time.sleep(0.05)
    return ''


def make_old(node: Any) -> None:
    """Age the simulated pack in flight."""
    from rclpy.parameter import Parameter
    from rclpy.parameter_client import AsyncParameterClient
    AsyncParameterClient(node, '/supply_simulator').set_parameters(
        [Parameter('scale_resistance', value=OLD)])
    print(f'The pack ages: its sag is now {OLD:g} times as large', flush=True)


def watch(bag: str, seconds: float, logs: Path, limit: float | None,
          simulated: bool = False) -> Listener:
    """Run the nodes, replay the bag or its simulation into them and show what they publish."""
    from ou_monitor.nodes.run import make_executor
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    topic, kind = signal_of(bag)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    executor = make_executor()
    node = rclpy.create_node('ou_demo')
    executor.add_node(node)
    try:
        with Children(logs) as children:
            children.start('estimator', *(() if limit is None else (
                '--ros-args', '-p', f'brownout.voltage:={float(limit)}')))
            children.start('adaptive_filter', '--ros-args', '-r', f'input:={topic}',
                           '-r', 'sigma:=/ou_estimator/sigma',
                           '-r', 'state:=/ou_estimator/state')
            listener = Listener(node)
            listener.hear_filter(kind)
            deadline = time.monotonic() + START_TIMEOUT
            while not listener.ready():
                Interrupt.spin(executor, 0.1)
                children.check('estimator', 'adaptive_filter')
                if time.monotonic() > deadline:
                    raise DemoError(f'the nodes did not appear within {START_TIMEOUT:.0f} s '
                                    f'(logs: {logs})')
            address = live_page(children)
            if address:
                print(address, flush=True)
            source = 'supply_simulator' if simulated else 'replay'
            children.start(source, *((
                '--ros-args', '-p', f'model_file:={ROOT / MODEL}', '-p', f'rate:={RATE}', '-p',
                f'seed:={SEED}', '-p', f'throttle.play:={Path(bag).resolve()}'
            ) if simulated else (bag,)))
            table = Table()
            end = time.monotonic() + seconds
            old = end - 0.5 * seconds if simulated else math.inf
            while children.status(source) is None and time.monotonic() < end:
                Interrupt.spin(executor, 0.05)
                children.check('estimator', 'adaptive_filter')
                table.show(listener)
                if time.monotonic() > old:
                    old = math.inf
                    make_old(node)
            table.close()
            if children.status(source):
                children.check(source)
        return listener
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def simulate(bag: str, report: Path) -> str:
    """Return a simulated recording of the demo's supply, with the same seed but no ageing."""
    path = report.with_suffix('.mcap')
    done = subprocess.run(
        [sys.executable, '-m', 'ou_monitor.cli.main', 'simulate', '--model', str(ROOT / MODEL),
         '--throttle', bag, '--rate', f'{RATE}', '--seed', f'{SEED}', '--capacity-left', '-1',
         '--output', str(path), '--force'],
        cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise DemoError(f'the simulation failed: {done.stderr.strip()[-300:]}')
    return str(path)


def write_report(bag: str, report: Path) -> None:
    """Analyze the same bag with the command line."""
    report.parent.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        [sys.executable, '-m', 'ou_monitor.cli.main', 'analyze', bag, '--report', str(report),
         '--force'],
        cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode or not report.is_file():
        last = done.stderr.strip().splitlines()[-1:] or ['no report was written']
        raise DemoError(f'the report failed: {last[0]}')


def options() -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(
        prog='scripts/demo', description='Estimator and adaptive filter as real ROS 2 '
        'processes, a bag replayed into them, a live table, and an HTML report.')
    parser.add_argument('--bag', default=RECORDED,
                        help=f'bag to replay ({RECORDED}, a recorded flight)')
    parser.add_argument('--simulated', action='store_true',
                        help=f'simulate {MODEL} under the throttle of the bag; in the second half '
                             f'sag is {OLD:g} times as large')
    parser.add_argument('--limit', type=float, metavar='V',
                        help=f"voltage of a brown-out ({LIMIT} for {RECORDED}, else the nodes' "
                             'own)')
    parser.add_argument('--seconds', type=float, default=60.0,
                        help='replay no more than that many seconds (60)')
    parser.add_argument('--report', type=Path, default=Path('out/demo_report.html'),
                        help='file of the report (out/demo_report.html)')
    return parser.parse_args()


class Interrupt:
    """Ends the demo on SIGINT and SIGTERM, but never inside the executor, which has to finish."""

    inside = came = False

    @classmethod
    def handle(cls, *_: object) -> None:
        """Raise KeyboardInterrupt, now or when the executor has returned."""
        cls.came = True
        if not cls.inside:
            raise KeyboardInterrupt

    @classmethod
    def spin(cls, executor: Any, timeout: float) -> None:
        """Spin once (timeout in s)."""
        cls.inside = True
        try:
            executor.spin_once(timeout_sec=timeout)
        finally:
            cls.inside = False
        if cls.came:
            raise KeyboardInterrupt


def main() -> int:
    """Run the demo; return the exit status."""
    chosen = options()
    # Set explicitly, because a shell may start its children with SIGINT ignored.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, Interrupt.handle)
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    try:
        if not Path(chosen.bag).exists():
            raise DemoError(f"there is no bag '{chosen.bag}'")
        if 'ROS_DOMAIN_ID' not in os.environ:
            os.environ['ROS_DOMAIN_ID'] = str(unused_domain())
        topic, _ = signal_of(chosen.bag)
        print(f"{f'Simulating {MODEL} under' if chosen.simulated else 'Replaying'} "
              f'{chosen.bag} over DDS (domain {os.environ["ROS_DOMAIN_ID"]}) into '
              f'estimator and adaptive_filter (which filters {topic})', flush=True)
        limit = LIMIT if chosen.limit is None and chosen.bag == RECORDED else chosen.limit
        heard = watch(chosen.bag, chosen.seconds, chosen.report.parent, limit, chosen.simulated)
        print(f'{heard.estimates} estimates and {heard.outputs} filtered samples arrived')
        if not (heard.estimates and heard.outputs):
            print(f'scripts/demo: nothing usable arrived; last status: {heard.line()}',
                  file=sys.stderr)
            return 1
        write_report(simulate(chosen.bag, chosen.report) if chosen.simulated else chosen.bag,
                     chosen.report)
    except (DemoError, InputError) as error:
        print(f'scripts/demo: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('\nscripts/demo: stopped', file=sys.stderr)
        return 130
    print(f'Report: {chosen.report.resolve()}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
