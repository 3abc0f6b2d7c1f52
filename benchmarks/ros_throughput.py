"""
What the estimator node takes over DDS: 1 MHz in ADC blocks, 10 kHz as scalars.

    .venv/bin/python benchmarks/ros_throughput.py [--seconds 10] [--json FILE]

A publisher (this process) sends to the real node (a process of its own); the
node's CPU time is read from /proc, what reached its estimator from `~/state`.
Loss is messages sent less messages taken; the publisher waits until it is
matched, so none is lost to discovery.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
from tables import table

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
SETTLE = 3.0  # s of traffic before counting: imports, compilation, first fit


RATE = 1000.0
_ECHO = """
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
rclpy.init()
node = rclpy.create_node('ou_adaptive_filter')
out = node.create_publisher(Imu, '~/output', 10)
node.create_subscription(Imu, 'input', out.publish,
                         QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT))
rclpy.spin(node)
"""


def filter_trial(command: list[str], seconds: float) -> dict[str, float]:
    """Return CPU share, latency quantiles (ms) and loss of one node."""
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Imu
    from std_msgs.msg import Float64
    best_effort = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
    process = subprocess.Popen(
        [sys.executable, *command], stderr=subprocess.DEVNULL,
        env={**os.environ, 'PYTHONPATH': f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"})
    node = rclpy.create_node('load')
    output = node.create_publisher(Imu, 'input', best_effort)
    sigma = node.create_publisher(Float64, 'sigma', best_effort)
    sent: dict[int, float] = {}
    late: list[float] = []

    def hear(message: Any) -> None:
        stamp = message.header.stamp
        begin = sent.pop(stamp.sec * 1_000_000_000 + stamp.nanosec, None)
        if begin is not None:
            late.append(time.perf_counter() - begin)

    node.create_subscription(Imu, '/ou_adaptive_filter/output', hear, best_effort)
    message, rng = Imu(), np.random.default_rng(1)
    values = rng.standard_normal((4096, 3)).tolist()

    def send(number: int) -> None:
        stamp = 1_000_000_000 + round(number * 1e9 / RATE)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
        turn = message.angular_velocity
        turn.x, turn.y, turn.z = values[number % 4096]
        sent[stamp] = time.perf_counter()
        output.publish(message)
        if number % 50 == 0:
            sigma.publish(Float64(data=0.3 + 0.2 * (number // 2000 % 2)))

    try:
        end = time.monotonic() + 30.0
        while not (output.get_subscription_count() and node.count_publishers(
                '/ou_adaptive_filter/output')):
            if time.monotonic() > end:
                raise SystemExit('the node did not come up within 30 s')
            # The filter opens its output when it has seen who publishes.
            rclpy.spin_once(node, timeout_sec=0.05)
        count, started = 0, time.monotonic()
        begun, cpu, wall = False, 0.0, 0.0
        while count < (SETTLE + seconds) * RATE:
            due = int((time.monotonic() - started) * RATE)
            while count < due:
                if not begun and count >= SETTLE * RATE:
                    begun = True
                    cpu, wall = cpu_seconds(process.pid), time.monotonic()
                    sent.clear()
                    late.clear()
                send(count)
                count += 1
            rclpy.spin_once(node, timeout_sec=0.0001)
        share = (cpu_seconds(process.pid) - cpu) / (time.monotonic() - wall)
        stop = time.monotonic() + 1.0
        while sent and time.monotonic() < stop:
            rclpy.spin_once(node, timeout_sec=0.01)
        p50, p99 = np.quantile(late, [0.5, 0.99]) * 1e3
        return {'cpu': share, 'p50': float(p50), 'p99': float(p99), 'got': len(late),
                'lost': len(sent)}
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(3.0)
        except subprocess.TimeoutExpired:
            # Not for ever, whatever the node does with the signal.
            process.kill()
            process.wait()
        node.destroy_node()


def filter_node(seconds: float) -> str:
    """Return a table."""
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', '98')
    import rclpy
    rclpy.init()
    rows = []
    for name, command in (('hands on only, rclpy.spin', ['-c', _ECHO]),
                          ('adaptive_filter', ['-m', 'ou_monitor.nodes.adaptive_filter'])):
        found = filter_trial(command, seconds)
        rows.append([name, f"{100.0 * found['cpu']:.0f} %", f"{found['p50']:.2f}",
                     f"{found['p99']:.2f}", f"{found['got']:.0f}", f"{found['lost']:.0f}"])
    rclpy.shutdown()
    return (table(['node', 'CPU of a core', 'latency p50, ms', 'latency p99, ms', 'came back',
                   'lost'], rows) + '\n' + _alone())


def _alone() -> str:
    """Return the time of a sample in Python, without ROS."""
    from ou_monitor import AdaptiveLowPass
    rows = []
    for name, options in (('order 1', {'order': 1}), ('order 2', {'order': 2}),
                          ('kalman, of the voltage', {'law': 'kalman', 'n0': 1e-7}),
                          ('kalman, of a gyro', {
                              'law': 'kalman', 'coupling': 20.0, 'n0': 1e-7})):
        one, took = AdaptiveLowPass(**options), []
        for k in range(20000):
            begin = time.perf_counter()
            one.step(k * 1e-3, float(k % 7), 0.3 + 0.2 * (k // 2000 % 2))
            took.append(time.perf_counter() - begin)
        p50, p99 = np.quantile(took[2000:], [0.5, 0.99]) * 1e6
        rows.append([name, f'{p50:.1f}', f'{p99:.1f}'])
    return table(['a sample in Python', 'p50, us', 'p99, us'], rows)


def cpu_seconds(pid: int) -> float:
    """Return user and system time of a process, s."""
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


class Trial:
    """One node under one kind of traffic."""

    def __init__(self, arguments: list[str], kind: Any) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        import rclpy
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'ou_monitor.nodes.estimator', '--ros-args', *arguments],
            env={**os.environ, 'PYTHONPATH': f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"})
        self.node = rclpy.create_node('load')
        self.output = self.node.create_publisher(
            kind, 'voltage', QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT))
        self.fields: dict[str, str] = {}
        self.node.create_subscription(DiagnosticArray, '/ou_estimator/state', self._hear, 10)
        self._rclpy = rclpy

    def _hear(self, message: Any) -> None:
        self.fields = {pair.key: pair.value for pair in message.status[0].values}

    def run(self, rate: float, seconds: float, make: Callable[[int], Any]) -> dict[str, float]:
        """Send at a rate for a while; return CPU share, loss and the last estimate."""
        while not self.output.get_subscription_count():
            self._rclpy.spin_once(self.node, timeout_sec=0.05)
        self._send(0, int(SETTLE * rate), rate, make)
        before = self._taken(int(SETTLE * rate))
        cpu, wall = cpu_seconds(self.process.pid), time.monotonic()
        first = int(SETTLE * rate)
        total = int((SETTLE + seconds) * rate)
        self._send(first, total, rate, make)
        cpu = (cpu_seconds(self.process.pid) - cpu) / (time.monotonic() - wall)
        taken = self._taken(total)
        return {'messages_per_s': rate, 'sent': total - first, 'taken': taken - before,
                'lost_while_starting': first - before, 'cpu_share': cpu,
                **{key: float(self.fields.get(key, 'nan'))
                   for key in ('pushed', 'used', 'alpha', 'sigma', 'noise_std')}}

    def _send(self, first: int, last: int, rate: float, make: Callable[[int], Any]) -> None:
        """Send messages first..last-1 at a rate."""
        count, started = first, time.monotonic()
        while count < last:
            due = min(first + int((time.monotonic() - started) * rate), last)
            for number in range(count, due):
                self.output.publish(make(number))
            count = max(count, due)
            self._rclpy.spin_once(self.node, timeout_sec=0.0002)

    def _taken(self, expected: int) -> int:
        """Return what the node has taken once no more is on its way."""
        end = time.monotonic() + 2.0
        while time.monotonic() < end and int(self.fields.get('messages', 0)) < expected:
            self._rclpy.spin_once(self.node, timeout_sec=0.05)
        return int(self.fields.get('messages', 0))

    def close(self) -> None:
        """End the node that this trial started."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(10.0)
        self.node.destroy_node()


def blocks(seconds: float) -> dict[str, float]:
    """Run 1 MHz in blocks of 1000."""
    from ou_monitor.model.ou import simulate
    from std_msgs.msg import Float32MultiArray
    rng = np.random.default_rng(1)
    t = np.arange(4_000_000) * 1e-6
    volts = (simulate(t, 63.0, 0.632, rng, u0=5.0)
             + 0.005 * rng.standard_normal(t.size)).astype(np.float32)
    ready = [Float32MultiArray(data=part.tolist()) for part in volts.reshape(-1, 1000)]
    trial = Trial(['-p', 'msg_config:=adc_block', '-p', 'adc.sample_rate:=1000000.0'],
                  Float32MultiArray)
    try:
        return trial.run(1000.0, seconds, lambda k: ready[k % len(ready)])
    finally:
        trial.close()


def scalars(seconds: float) -> dict[str, float]:
    """Run 10 kHz, one sample a message."""
    from ou_monitor.model.ou import simulate
    from std_msgs.msg import Float32
    t = np.arange(200_000) * 1e-4
    volts = simulate(t, 63.0, 0.632, np.random.default_rng(2), u0=5.0).tolist()
    ready = [Float32(data=value) for value in volts]
    trial = Trial(['-p', 'msg_config:=std_float32'], Float32)
    try:
        return trial.run(10_000.0, seconds, lambda k: ready[k % len(ready)])
    finally:
        trial.close()


def main() -> int:
    """Run both and print them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--json', type=Path)
    options = parser.parse_args()
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', '97')
    import rclpy
    rclpy.init()
    results = {'blocks_1_mhz': blocks(options.seconds), 'scalars_10_khz': scalars(options.seconds)}
    rclpy.shutdown()
    for name, result in results.items():
        print(name, ' '.join(f'{key}={value:.6g}' for key, value in result.items()))
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == '__main__':
    sys.exit(main())
