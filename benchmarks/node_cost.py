"""
CPU of the nodes per message, against nodes that only count messages or read a field (1 min).

    .venv/bin/python benchmarks/node_cost.py [--seconds 10] [--page doc/results/node_cost.md]

All nodes listen to the same publisher at the same time, as separate processes with the same
executor.  A busy machine affects all of them alike, so compare the ratios, not the microseconds.
The CPU time of the whole process, from /proc, is divided by the number of voltages.  The voltage
is an OU rail that sags under a throttle of 50 Hz, so the estimator finds alpha, load and risk.
"""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from common import arguments, deliver, ROOT, table
import numpy as np
from ou_monitor.model.ou import simulate

DOMAIN = '63'
# Listens to a topic and publishes the number of messages, 10 times per second as the nodes do.
_LISTENER = """
import sys, rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64
kind, topic, job, name = {'Float64': Float64, 'Imu': Imu}[sys.argv[1]], *sys.argv[2:5]
rclpy.init()
node = rclpy.create_node(name)
count, total = 0, 0.0
output = node.create_publisher(kind, '~/output', 10)

def hear(message):
    global count, total
    count += 1
    if job == 'reads':
        total += message.data if kind is Float64 else message.angular_velocity.x
    elif job == 'echoes':
        message.angular_velocity.x *= 0.5
        output.publish(message)

node.create_subscription(kind, topic, hear, QoSProfile(
    depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT), raw=job == 'counts')
out = node.create_publisher(Float64, '~/count', 10)
node.create_timer(0.1, lambda: out.publish(Float64(data=float(count))))
executor = EventsExecutor()
executor.add_node(node)
while rclpy.ok():
    executor.spin_once(timeout_sec=1.0)
"""
# Throttle messages per second, sent with the voltages.
STICK = 50.0
# Kind of the messages, and label and command of each node.
CASES: tuple[tuple[str, list[tuple[str, list[str]]]], ...] = (
    ('Float64', [
        ('counts', ['-c', _LISTENER, 'Float64', 'voltage', 'counts', 'n0']),
        ('reads its field', ['-c', _LISTENER, 'Float64', 'voltage', 'reads', 'n1']),
        ('`estimator`', ['-m', 'ou_monitor.nodes', 'estimator', '--ros-args', '-p',
                         'brownout.voltage:=13.0'])]),
    ('Imu', [
        ('counts', ['-c', _LISTENER, 'Imu', 'input', 'counts', 'n0']),
        ('changes and publishes', ['-c', _LISTENER, 'Imu', 'input', 'echoes', 'n1']),
        ('`adaptive_filter`', ['-m', 'ou_monitor.nodes', 'adaptive_filter'])]))


def cpu_seconds(pid: int) -> float:
    """Return the CPU time of a process."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def memory(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    (line,) = [line for line in Path(f'/proc/{pid}/status').read_text().splitlines()
               if line.startswith('VmRSS')]
    return int(line.split()[1]) / 1024.0


def rail(rate: float) -> tuple[list[float], list[float]]:
    """Return 40 s of an OU rail under load (40 1/s, 0.3 V/sqrt(s), 4 mV), and its throttle."""
    rng = np.random.default_rng(1)
    n = round(40.0 * rate)
    walk = np.zeros(round(40.0 * STICK))
    for k in range(1, walk.size):
        walk[k] = 0.97 * walk[k - 1] + 0.05 * rng.standard_normal()
    sticks = np.clip(0.4 + walk, 0.0, 1.0)
    load = sticks[np.minimum((np.arange(n) * STICK / rate).astype(int), sticks.size - 1)]
    volts = (15.0 - load + simulate(np.arange(n) / rate, 40.0, 0.3, rng)
             + 4e-3 * rng.standard_normal(n))
    return volts.tolist(), sticks.tolist()


def trial(kind: str, nodes: list[tuple[str, list[str]]], rate: float, seconds: float
          ) -> list[list[str]]:
    """Return one row for each node; all run on one topic at once."""
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Imu
    from std_msgs.msg import Float64
    message: Any = Float64() if kind == 'Float64' else Imu()
    node = rclpy.create_node('load')
    topic = 'voltage' if kind == 'Float64' else 'input'
    output = node.create_publisher(type(message), topic, QoSProfile(
        depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT))
    stick = node.create_publisher(Float64, 'throttle', 10)
    values, sticks = rail(rate)
    moved = 0
    # A node that rejects its input costs little, so the table shows how often the risk was known.
    risks: list[float] = []
    node.create_subscription(
        Float64, '/ou_estimator/brownout_risk', lambda m: risks.append(m.data), 10)
    processes, begun = [], []
    try:
        for number, (_, command) in enumerate(nodes, 1):
            processes.append(subprocess.Popen(
                [sys.executable, *command], stderr=subprocess.DEVNULL, env={
                    **os.environ, 'PYTHONPATH': f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"}))
            until = time.monotonic() + 120.0
            while output.get_subscription_count() < number:
                if time.monotonic() > until:
                    raise SystemExit(f'{command} did not come up within 120 s')
                rclpy.spin_once(node, timeout_sec=0.02)
            begun.append(cpu_seconds(processes[-1].pid))
        sent, start, before, first = 0, time.monotonic(), [0.0] * len(nodes), 0
        while (now := time.monotonic() - start) < 3.0 + seconds:
            due = int(now * rate)
            while sent < due:
                stamp = 1_000_000_000 + round(sent * 1e9 / rate)
                if kind == 'Float64':
                    if sent * STICK / rate >= moved:
                        stick.publish(Float64(data=sticks[moved % len(sticks)]))
                        moved += 1
                    message.data = values[sent % len(values)]
                else:
                    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
                    message.angular_velocity.x = values[sent % len(values)]
                output.publish(message)
                sent += 1
            if not first and now > 3.0:
                first, before = sent, [cpu_seconds(process.pid) for process in processes]
                risks.clear()
            rclpy.spin_once(node, timeout_sec=0.0005)
        used = [cpu_seconds(process.pid) - b for process, b in zip(processes, before)]
        rss = [memory(process.pid) for process in processes]
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
        for process in processes:
            try:
                process.wait(20.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        node.destroy_node()
    each = [1e6 * cpu / (sent - first) for cpu in used]
    return [[f'{kind}, {rate:g} Hz', name, f'{cost:.0f}', f'{cost / each[0]:.1f}',
             f'{cost / each[1]:.1f}', f'{1e-4 * cost * rate:.1f}',
             f'{100.0 * np.mean(np.isfinite(risks)):.0f}' if risks and 'estimator' in name else '',
             f'{start_up:.2f}', f'{mb:.0f}']
            for (name, _), cost, start_up, mb in zip(nodes, each, begun, rss)]


def main() -> int:
    """Measure, and write the table."""
    parser = arguments(__doc__)
    parser.add_argument('--seconds', type=float, default=10.0)
    args = parser.parse_args()
    os.environ['ROS_DOMAIN_ID'] = DOMAIN
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    import rclpy
    rclpy.init()
    rows = []
    for (kind, nodes), rate in ((CASES[0], 100.0), (CASES[0], 1000.0), (CASES[0], 5000.0),
                                (CASES[1], 1000.0)):
        rows += trial(kind, nodes, rate, args.seconds)
    rclpy.shutdown()
    text = table(['messages', 'node', 'us of CPU a message', 'times counting', 'times typed',
                  '% of a core', 'risk known, %',
                  'start-up, s of CPU', 'RSS, MB'], rows)
    text += (f'\nPython {sys.version.split()[0]}, NumPy {np.__version__}, '
             f'{args.seconds:g} s each, all nodes of a block at the same time.\n')
    deliver(text, args.page, 'nodes')
    return 0


if __name__ == '__main__':
    sys.exit(main())
