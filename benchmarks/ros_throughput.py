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

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
SETTLE = 3.0  # s of traffic before counting: imports, compilation, first fit


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
