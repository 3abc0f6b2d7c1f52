"""Real processes over DDS: start them, listen to them, stop them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import inspect
import itertools
import math
import os
from pathlib import Path
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
BAGS = ROOT / 'bags'
# Only failures should reach a deadline: work of 2 s takes 20 s if ten processes share two cores,
# and starting a process (imports, discovery) five times that.
DEADLINE = 120.0
# A process that is still running this long after a test, s, is killed.
_END = 10.0
# A service is called again after this time without an answer, s: ten starts on a busy machine.
_ASK_AGAIN = 20.0
_counter = itertools.count()


def new_domain() -> int:
    """Return a ROS domain that nobody on this machine uses, including other runs of tests."""
    # Parallel runs start at different domains and skip those in use: the first participant of a
    # domain has this port (DDSI-RTPS 9.6.1).
    for _ in range(200):
        domain = 10 + (37 * os.getpid() + next(_counter)) % 90
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
            try:
                first.bind(('', 7410 + 250 * domain))
            except OSError:
                continue
            return domain
    pytest.fail('every ROS domain from 10 to 99 is in use')


def queues(domain: int) -> list[Path]:
    """Return the paths of Fast DDS's queues of a domain in shared memory."""
    return [Path(f'/dev/shm/fastrtps_port{port}')
            for port in range(7400 + 250 * domain, 7650 + 250 * domain)]


def remove_queues(domain: int) -> None:
    """Remove the queues that killed programs left in a domain that only we used."""
    for port in queues(domain):
        for left in (port, port.with_name(port.name + '_el'),
                     port.with_name(f'sem.{port.name}_mutex')):
            left.unlink(missing_ok=True)


# `new_domain` never returns these; each is used once in a run.
_UNUSED = [*range(1, 10), 100, 101]


@contextmanager
def unused_domain() -> Iterator[int]:
    """Give a ROS domain in which no killed program has left a queue in shared memory."""
    # A node reuses such a queue with the size that its creator chose. Queues that the test's own
    # programs leave in the domain are removed.
    while _UNUSED:
        domain = _UNUSED.pop(0)
        if not any(port.exists() for port in queues(domain)):
            break
    else:
        pytest.fail('every ROS domain of 1 to 9, 100 and 101 is in use, or killed programs left '
                    'queues there')
    try:
        yield domain
    finally:
        remove_queues(domain)


def wait_until(predicate: Callable[[], Any], timeout: float = DEADLINE, what: str = '') -> Any:
    """Return the value of the predicate once it is true; fail after the timeout, s."""
    until = time.monotonic() + timeout
    while True:
        value = predicate()
        if value:
            return value
        if time.monotonic() > until:
            pytest.fail(f'not within {timeout:g} s: {what or predicate}')
        time.sleep(0.02)


class Process:
    """One executable, or any other module, of the package, with its output in files."""

    def __init__(self, name: str, arguments: list[str], domain: int, folder: Path,
                 reach: str = 'LOCALHOST') -> None:
        self.name = name
        self._out = folder / f'{name}_{next(_counter)}.out'
        self._err = self._out.with_suffix('.err')
        # The bootstrapper of the ROS wheels marks the environment of a process that it has set up.
        inherited = {key: value for key, value in os.environ.items()
                     if key != '_ROS_WHEELS_BOOTSTRAP_COMPLETE'}
        env = {**inherited, 'ROS_DOMAIN_ID': str(domain), 'PYTHONUNBUFFERED': '1',
               'ROS_AUTOMATIC_DISCOVERY_RANGE': reach, 'ROS_LOG_DIR': str(folder),
               'PYTHONPATH': os.pathsep.join(
                   [str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])])}
        with self._out.open('w') as out, self._err.open('w') as err:
            self.popen = subprocess.Popen(
                [sys.executable, '-m', *([] if '.' in name else ['ou_monitor.nodes']), name,
                 *arguments],
                stdout=out, stderr=err, env=env, cwd=folder)

    @property
    def out(self) -> str:
        return self._out.read_text()

    @property
    def err(self) -> str:
        return self._err.read_text()

    def wait(self, timeout: float = DEADLINE) -> int:
        try:
            return self.popen.wait(timeout)
        except subprocess.TimeoutExpired:
            pytest.fail(f'{self.name} did not end within {timeout:g} s:\n{self.err}')

    def stop(self, number: int = signal.SIGINT) -> int:
        """Send a signal; return the exit status."""
        self.popen.send_signal(number)
        return self.wait()

    def kill(self) -> None:
        if self.popen.poll() is None:
            self.popen.kill()
            self.popen.wait()

    def ask_to_end(self) -> None:
        """Send SIGINT, also to a stopped process."""
        if self.popen.poll() is None:
            self.popen.send_signal(signal.SIGINT)
            self.popen.send_signal(signal.SIGCONT)


class Starved:
    """
    A process that gets the CPU only in slices: it is stopped and continued in turn, s.

    Attributes
    ----------
    stops : list of tuple of float
        Times at which it was stopped and continued, by the monotonic clock, s.
    """

    def __init__(self, pid: int, stopped: float = 0.02, running: float = 0.01) -> None:
        self._pid, self._stopped, self._running = pid, stopped, running
        self._end = threading.Event()
        self.stops: list[tuple[float, float]] = []
        self._thread = threading.Thread(target=self._slice, daemon=True)

    def _slice(self) -> None:
        while not self._end.is_set():
            begin = time.monotonic()
            try:
                os.kill(self._pid, signal.SIGSTOP)
                time.sleep(self._stopped)
                os.kill(self._pid, signal.SIGCONT)
            except ProcessLookupError:
                return
            self.stops.append((begin, time.monotonic()))
            time.sleep(self._running)

    def start(self) -> Starved:
        self._thread.start()
        return self

    def stop(self) -> None:
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def longest(self) -> float:
        """Return the longest stop, s, including pauses of the machine itself."""
        return max(end - begin for begin, end in self.stops)


def memory_of(pid: int) -> float:
    """Return the resident memory of a process, bytes."""
    status = Path(f'/proc/{pid}/status').read_text()
    return 1024.0 * int(re.findall(r'VmRSS:\s+(\d+)', status)[0])


class Probe:
    """A node in this process that listens, publishes and sets parameters of other nodes."""

    def __init__(self, domain: int) -> None:
        import rclpy
        from rclpy.experimental.events_executor import EventsExecutor
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node('probe', context=self.context)
        self._executor = EventsExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}
        self._closing = False
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException
        try:
            while not self._closing:
                self._executor.spin_once(timeout_sec=0.1)
        except ExternalShutdownException:
            return

    def listen(self, topic: str, kind: Any, qos: Any = 100,
               sent: list[float] | None = None) -> list[Any]:
        """Return the list to which messages of a topic are added; their times, s, go to `sent`."""
        got: list[Any] = []
        if sent is None:
            self.node.create_subscription(kind, topic, got.append, qos)
            return got

        def take(message: Any, info: Any) -> None:
            sent.append(info['source_timestamp'] * 1e-9)
            got.append(message)

        self._subscribe(topic, kind, take, qos)
        return got

    def numbered(self, topic: str, kind: Any, take: Callable[[Any, int, float], None],
                 qos: Any = 100) -> None:
        """Call `take` with each message of a topic, its sequence number and sending time, s."""
        self._subscribe(topic, kind, lambda message, info: take(
            message, info['publication_sequence_number'], info['source_timestamp'] * 1e-9), qos)

    def _subscribe(self, topic: str, kind: Any, take: Callable[[Any, Any], None], qos: Any
                   ) -> None:
        # The EventsExecutor of rclpy 7.1 passes one tuple instead of two arguments.
        def call(*args: Any) -> None:
            take(*(args if len(args) == 2 else args[0]))
        call.__signature__ = inspect.signature(take)  # type: ignore[attr-defined]
        self.node.create_subscription(kind, topic, call, qos)

    def publisher(self, topic: str, kind: Any, qos: Any = 10) -> Any:
        return self.node.create_publisher(kind, topic, qos)

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Return the answer of a service."""
        # If a client has discovered a service before the service has discovered the client, the
        # middleware drops the answer after .1 s; so the call is repeated.
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, service)
        client = self._clients[service]
        wait_until(client.service_is_ready, what=f'service {service}')
        asked = [client.call_async(request)]
        again = time.monotonic() + _ASK_AGAIN

        def answered() -> Any:
            nonlocal again
            if time.monotonic() > again:
                asked.append(client.call_async(request))
                again = time.monotonic() + _ASK_AGAIN
            return next((future for future in asked if future.done()), None)
        return wait_until(answered, what=f'answer of {service}').result()

    def set_parameter(self, node: str, name: str, value: Any) -> Any:
        """Set a parameter as `ros2 param set` does; return successful, reason."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.call(SetParameters, f'{node}/set_parameters', request).results[0]

    def close(self) -> None:
        self._closing = True
        self._thread.join(5.0)
        self._executor.remove_node(self.node)
        self.node.destroy_node()
        self.context.try_shutdown()


class World:
    """One ROS domain with processes and probes."""

    def __init__(self, folder: Path) -> None:
        self.domain = new_domain()
        # Discovery range of its processes.
        self.reach = 'LOCALHOST'
        self.folder = folder
        self._processes: list[Process] = []
        self._probes: list[Probe] = []
        # The middleware of this process reads this at the first context.
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        os.environ['ROS_LOG_DIR'] = str(folder)

    def start(self, name: str, *arguments: str) -> Process:
        self._processes.append(Process(name, [str(a) for a in arguments], self.domain,
                                       self.folder, self.reach))
        return self._processes[-1]

    def probe(self) -> Probe:
        self._probes.append(Probe(self.domain))
        return self._probes[-1]

    def close(self) -> None:
        """Stop everything; a traceback in any process is a failure, whatever the test checked."""
        # A killed process leaves its queues in shared memory, in which later processes of the
        # domain may lose messages.
        for process in self._processes:
            process.ask_to_end()
        until = time.monotonic() + _END
        while (any(process.popen.poll() is None for process in self._processes)
               and time.monotonic() < until):
            time.sleep(0.02)
        for process in self._processes:
            process.kill()
        for probe in self._probes:
            probe.close()
        remove_queues(self.domain)
        for process in self._processes:
            assert 'Traceback' not in process.err, process.err


class Estimator:
    """An estimator in a namespace, with its outputs and a publisher of stamped messages."""

    def __init__(self, world: World, namespace: str, *arguments: str,
                 probe: Probe | None = None) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from std_msgs.msg import Bool
        self.namespace, self.probe = namespace, probe or world.probe()
        self.node = f'/{namespace}/ou_estimator'
        self.states = self.probe.listen(f'{self.node}/state', DiagnosticArray)
        self.flags = self.probe.listen(f'{self.node}/brownout', Bool)
        self.process = world.start(
            'estimator', '--ros-args', '-r', f'__ns:=/{namespace}', *arguments)
        self.output: Any = None
        # Stamp of the newest sample that `feed` has sent, s.
        self.t = 1000.0

    def connect(self, kind: Any) -> None:
        """Publish a type; wait until the estimator has subscribed and published."""
        self.output = self.probe.publisher(f'/{self.namespace}/voltage', kind, 1000)
        wait_until(lambda: self.output.get_subscription_count() and self.states, what='its input')

    def send(self, voltage: float, stamp: float, output: Any = None,
             current: float = math.nan) -> None:
        from sensor_msgs.msg import BatteryState
        message = BatteryState(voltage=voltage, current=current)
        message.header.stamp = to_stamp(stamp)
        (output or self.output).publish(message)

    def feed(self, voltages: list[float], dt: float = 0.001,
             currents: list[float] | None = None) -> None:
        """Send stamped samples, dt apart, slowly enough for best effort."""
        for k, voltage in enumerate(voltages):
            self.t += dt
            self.send(voltage, self.t, current=math.nan if currents is None else currents[k])
            if k % 20 == 19:
                time.sleep(0.002)

    @property
    def status(self) -> Any:
        return self.states[-1].status[0]

    def field(self, name: str) -> str:
        return values_of(self.status)[name]

    def count(self, name: str) -> int:
        """Return a counter of the newest state."""
        return int(self.field(name))


class LowPass:
    """An adaptive filter of an IMU, with its outputs, and publishers on its `inputs`."""

    node = '/ou_adaptive_filter'

    def __init__(self, world: World, inputs: dict[str, Any], *arguments: str) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from sensor_msgs.msg import Imu
        from std_msgs.msg import Float64
        self.probe = world.probe()
        self.output = self.probe.listen(f'{self.node}/output', Imu)
        self.cutoff, self.lag = (self.probe.listen(f'{self.node}/{name}', Float64)
                                 for name in ('cutoff', 'lag'))
        self._diagnostics = self.probe.listen('/diagnostics', DiagnosticArray)
        self.inputs = {topic: self.probe.publisher(f'/{topic}', kind, 1000)
                       for topic, kind in {'input': Imu, **inputs}.items()}
        self.process = world.start('adaptive_filter', '--ros-args', *arguments)
        wait_until(lambda: all(one.get_subscription_count() for one in self.inputs.values()),
                   what='subscriptions')
        # Both ends must know of each other before the first message.
        wait_until(lambda: self.probe.node.count_publishers(f'{self.node}/output'))
        time.sleep(0.3)

    @property
    def status(self) -> Any:
        return diagnosis(self._diagnostics, 'ou_adaptive_filter: adaptive low-pass')

    def set(self, name: str, value: Any) -> Any:
        return self.probe.set_parameter(self.node, name, value)


def refusal(make: Callable[[], Any], *arguments: object) -> str:
    """Return the error of `make` in this process with ROS arguments, which must fail."""
    from ou_monitor.errors import InputError
    import rclpy
    from rclpy.exceptions import ParameterException
    from rclpy.signals import SignalHandlerOptions
    rclpy.init(args=['--ros-args', *map(str, arguments)], domain_id=new_domain(),
               signal_handler_options=SignalHandlerOptions.NO)
    try:
        with pytest.raises((InputError, ParameterException)) as found:
            make()
        return str(found.value)
    finally:
        rclpy.shutdown()


def values_of(status: Any) -> dict[str, str]:
    """Return the key/value pairs of a DiagnosticStatus."""
    return {pair.key: pair.value for pair in status.values}


def to_stamp(t: float) -> Any:
    """Return a builtin_interfaces/Time of a time, s."""
    from builtin_interfaces.msg import Time
    whole, rest = divmod(round(t * 1e9), 10**9)
    return Time(sec=whole, nanosec=rest)


def seconds(stamp: Any) -> float:
    """Return a builtin_interfaces/Time in s."""
    return float(stamp.sec + stamp.nanosec * 1e-9)


def diagnosis(messages: list[Any], name: str) -> Any:
    """Return the newest status with a name from DiagnosticArrays, or None."""
    for message in reversed(messages):
        for status in message.status:
            if status.name == name:
                return status
    return None


def ou_path(n: int, dt: float, seed: int, alpha: float = 63.0, sigma: float = 0.3,
            u0: float = 5.0) -> list[float]:
    """Return n samples of an OU process, V, exactly discretised."""
    rng = random.Random(seed)
    phi = math.exp(-alpha * dt)
    step = sigma * math.sqrt((1.0 - phi * phi) / (2.0 * alpha))
    u, path = 0.0, []
    for _ in range(n):
        u = phi * u + step * rng.gauss(0.0, 1.0)
        path.append(u0 + u)
    return path
