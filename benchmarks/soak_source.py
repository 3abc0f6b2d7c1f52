"""
The source of a soak, in a process of its own: voltages at 1 kHz, with dips, as scheduled.

    python soak_source.py SEED SECONDS LOG [dense]

Each phase and each dip is one line of JSON in the log: when its first and last sample were sent
(monotonic clock, s), and how many; ten times a second the messages sent so far are one.  Samples
that are due while the process has no CPU are sent as soon as it has, with the stamps of when they
were due.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
import random
import signal
import subprocess
import sys
import time
from typing import Any, TextIO

import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import BatteryState
from soak_schedule import Dip, dips, Phase, phases, RATE
from std_msgs.msg import Float64

FLOOD = Path(__file__).resolve().parents[1] / 'test/support/flood.py'
TOPIC = '/soak/voltage'
QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
# Of the supply: relaxation, 1/s, noise, V/sqrt(s), level, V.
ALPHA, SIGMA, LEVEL = 63.0, 0.2, 5.0
# Share of bad values where there are some, and what they are, V.
BAD = 0.2
HUGE = (1e200, 1e30, -1e30, math.inf, -math.inf, 1e-160, 1e5)
# Samples sent at once; and at most to catch up.
BURST, MOST = 100, 1000


class Source:
    """Sends what is due."""

    def __init__(self, seed: int, seconds: float, log: TextIO, dense: bool) -> None:
        self._rng = random.Random(f'source {seed}')
        self._log = log
        self._phases = phases(seed, seconds)
        self._dips = dips(seed, self._phases, dense)
        self._node = rclpy.create_node('soak_source')
        self._output: Any = self._node.create_publisher(BatteryState, TOPIC, QOS)
        self._second: subprocess.Popen[bytes] | None = None
        self._phase = self._phases[0]
        self._away, self._offset, self._jump_at = 0.0, 0.0, 0.0
        self._low: list[float] = []
        self._count, self._counted = 0, -math.inf
        self._start = self._wall = 0.0

    def run(self) -> None:
        """Send until the schedule ends."""
        while not self._output.get_subscription_count():
            time.sleep(0.01)
        self._start, self._wall = time.monotonic(), time.time()
        self._note(kind='start', at=self._start)
        self._enter(self._phase)
        sent, at, dip_at = 0, 0, 0
        while at < len(self._phases):
            due = int((time.monotonic() - self._start) * RATE)
            lump = self._phase.kind == 'lumps' and sent / RATE % 6.0 < 3.0
            burst = BURST if lump or self._phase.kind == 'burst' else 1
            self._tell_count()
            sent = max(sent, due - MOST)
            while due - sent >= burst or sent / RATE >= self._phase.end:
                now = sent / RATE
                if now >= self._phase.end:
                    at += 1
                    self._leave(self._phase)
                    if at == len(self._phases):
                        return
                    self._phase = self._phases[at]
                    self._enter(self._phase)
                    break
                # A step behind the end of a dip tells of it.
                while dip_at < len(self._dips) and now > _end(self._dips[dip_at]):
                    self._tell(dip_at)
                    dip_at += 1
                for _ in range(burst):
                    self._send(sent / RATE, self._dips[dip_at:dip_at + 1])
                    sent += 1
            time.sleep(0.001)

    def _note(self, **about: Any) -> None:
        self._log.write(json.dumps(about) + '\n')
        self._log.flush()

    def _tell_count(self) -> None:
        now = time.monotonic()
        if now - self._counted >= 0.1:
            self._counted = now
            self._note(kind='sent', at=now, count=self._count)

    def _tell(self, number: int) -> None:
        dip = self._dips[number]
        if self._low:
            self._note(kind='dip', begin=self._low[0], end=self._low[-1], samples=len(self._low),
                       phase=self._phase.kind, unseen=dip.unseen, voltage=dip.voltage)
        self._low = []

    def _enter(self, phase: Phase) -> None:
        self._note(kind='phase', name=phase.kind, at=time.monotonic())
        self._offset = self._jump_at = 0.0
        if phase.kind == 'second':
            self._second = subprocess.Popen(
                [sys.executable, FLOOD, '200', '0.0', TOPIC, 'BatteryState'],
                stderr=subprocess.DEVNULL)
        elif phase.kind in ('restart', 'type'):
            self._node.destroy_publisher(self._output)
            self._output = self._node.create_publisher(
                Float64, TOPIC, QOS) if phase.kind == 'type' else None

    def _leave(self, phase: Phase) -> None:
        if phase.kind in ('restart', 'type'):
            if self._output is not None:
                self._node.destroy_publisher(self._output)
            self._output = self._node.create_publisher(BatteryState, TOPIC, QOS)
        self._end_second()

    def _end_second(self) -> None:
        """End the other publisher, in order or not."""
        if self._second is not None:
            self._second.send_signal(self._rng.choice([signal.SIGINT, signal.SIGKILL]))
            self._second.wait()
            self._second = None

    def close(self) -> None:
        """End."""
        self._end_second()
        self._node.destroy_node()

    def _send(self, now: float, near: list[Dip]) -> None:
        """Send the sample of a time, s."""
        phi = math.exp(-ALPHA / RATE)
        self._away = phi * self._away + SIGMA * math.sqrt(
            (1.0 - phi * phi) / (2.0 * ALPHA)) * self._rng.gauss(0.0, 1.0)
        kind, value = self._phase.kind, LEVEL + self._away
        # The last seconds of a phase are the first publisher's alone: what is lost of the other
        # is not taken for its own.
        if kind == 'second' and now > self._phase.end - 2.0:
            self._end_second()
        low = bool(near) and near[0].begin <= now <= _end(near[0])
        if low:
            value = near[0].voltage
        if kind in ('silent', 'restart'):
            return
        if kind == 'type':
            self._output.publish(Float64(data=value))
            return
        self._count += 1
        if kind == 'only_nan':
            value = math.nan
        elif kind in ('nan', 'huge') and self._rng.random() < BAD:
            value = math.nan if kind == 'nan' else self._rng.choice(HUGE)
        elif kind == 'millivolts':
            value *= 1000.0
        elif low:
            self._low.append(time.monotonic())
        message = BatteryState(voltage=_single(value))
        stamp = self._stamp(kind, now)
        message.header.stamp.sec = int(stamp)
        message.header.stamp.nanosec = int((stamp - int(stamp)) * 1e9)
        self._output.publish(message)

    def _stamp(self, kind: str, now: float) -> float:
        """Return the stamp of the sample of a time, s."""
        begin = self._wall + self._phase.begin
        t = self._wall + now
        if kind in ('none', 'lumps'):
            return 0.0
        if kind == 'frozen':
            return begin
        if kind == 'backwards':
            return 2.0 * begin - t
        if kind == 'future':
            return t + 3e8
        if kind == 'wild':
            return t + self._rng.uniform(-100.0, 100.0)
        if kind == 'fast':
            return begin + 1000.0 * (t - begin)
        if kind == 'jumps':
            if now > self._jump_at:
                self._jump_at = now + self._rng.uniform(0.2, 1.0)
                self._offset += self._rng.choice([-1.0, 1.0]) * 10.0 ** self._rng.uniform(-2, 6)
            return min(max(t + self._offset, 1.0), 2.0 ** 31 - 1.0)
        return t


def _end(dip: Dip) -> float:
    return dip.begin + dip.length - 0.5 / RATE


def _single(value: float) -> float:
    """Return a value that a float32 of a message takes."""
    return math.copysign(math.inf, value) if abs(value) > 3e38 else value


def main() -> None:
    """Run."""
    rclpy.init()
    with Path(sys.argv[3]).open('w', encoding='utf-8') as log:
        source = Source(int(sys.argv[1]), float(sys.argv[2]), log, 'dense' in sys.argv[4:])
        try:
            source.run()
        except KeyboardInterrupt:
            pass
        finally:
            source.close()
            rclpy.try_shutdown()


if __name__ == '__main__':
    main()
