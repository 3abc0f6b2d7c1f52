"""
What the adaptive_filter node costs, and how late its output comes, at 1 kHz.

Run by `filter.py node`.  An Imu message (three channels) goes over DDS to the
node, a process of its own, and back; output is matched to input by its stamp.
The same way through a node that only hands messages on, by `rclpy.spin`, says
what a plain node takes (ours uses the EventsExecutor, which is faster).  The
CPU time is read from /proc.
"""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
from ros_throughput import cpu_seconds, ROOT
from tables import table

RATE, SETTLE = 1000.0, 3.0
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


def trial(command: list[str], seconds: float) -> dict[str, float]:
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


def run(seconds: float) -> str:
    """Return a table."""
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', '98')
    import rclpy
    rclpy.init()
    rows = []
    for name, command in (('hands on only, rclpy.spin', ['-c', _ECHO]),
                          ('adaptive_filter', ['-m', 'ou_monitor.nodes.adaptive_filter'])):
        found = trial(command, seconds)
        rows.append([name, f"{100.0 * found['cpu']:.0f} %", f"{found['p50']:.2f}",
                     f"{found['p99']:.2f}", f"{found['got']:.0f}", f"{found['lost']:.0f}"])
    rclpy.shutdown()
    return (table(['node', 'CPU of a core', 'latency p50, ms', 'latency p99, ms', 'came back',
                   'lost'], rows) + '\n' + _alone())


def _alone() -> str:
    """Return the time of a sample in Python, without ROS."""
    from ou_monitor import AdaptiveLowPass
    rows = []
    body = {'law': 'kalman', 'signal_bandwidth': 5.0, 'signal_rms': 1.0, 'coupling': 20.0,
            'n0': 1e-7, 'fmin': 1.0}
    for name, options in (('order 1', {'order': 1}), ('order 2', {'order': 2}),
                          ('kalman, one pole', body),
                          ('kalman, two poles', {**body, 'signal_poles': 2})):
        one, took = AdaptiveLowPass(**options), []
        for k in range(20000):
            begin = time.perf_counter()
            one.step(k * 1e-3, float(k % 7), 0.3 + 0.2 * (k // 2000 % 2))
            took.append(time.perf_counter() - begin)
        p50, p99 = np.quantile(took[2000:], [0.5, 0.99]) * 1e6
        rows.append([name, f'{p50:.1f}', f'{p99:.1f}'])
    return table(['a sample in Python', 'p50, us', 'p99, us'], rows)


if __name__ == '__main__':
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    print(run(10.0))
