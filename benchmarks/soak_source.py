"""
Used by soak.py: its schedule, drawn from a seed, and the source of voltages at 1 kHz.

    python soak_source.py SEED SECONDS LOG [dense]

Two schedules run in parallel: voltages (phases, with dips at random times), and actions on the
node (parameters, services, CPU).  Each phase and each dip is one line of JSON in the log, with the
times of its first and last sample (monotonic clock, s) and their number; ten times per second
another line has the number of messages sent so far.  Samples that are due while the process has no
CPU are sent later, with the stamps at which they were due.
"""

from __future__ import annotations

from dataclasses import dataclass
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
from std_msgs.msg import Float64

# -- the schedule

RATE = 1000.0  # Hz.
# Kinds of phases with their weights.  Stamps: `good` (the time of the sample), `none` (0),
# `frozen` (the start of the phase), `backwards`, `jumps` (steps of 10 ms to 12 days, either way),
# `future` (nine years ahead), `wild` (each within 100 s of the truth), `fast` (milliseconds taken
# for seconds).  Values: `nan`, `huge` (a fifth of the samples).  Also: `burst` (sent 100 at once),
# `lumps` (no stamps, and three of six seconds sent 100 at once), `second` (another publisher of
# the topic comes, and ends or is killed).
SEEN = {'good': 6.0, 'none': 2.0, 'frozen': 1.0, 'backwards': 1.0, 'jumps': 1.0, 'future': 1.0,
        'wild': 1.0, 'fast': 1.0, 'nan': 1.0, 'huge': 1.0, 'burst': 1.0, 'lumps': 1.0,
        'second': 1.0}
# Phases without usable voltages: all samples NaN, millivolts, another message type, a publisher
# that pauses, or one that ends and restarts.
UNSEEN = {'only_nan': 0.7, 'millivolts': 0.7, 'type': 0.7, 'silent': 0.7, 'restart': 1.0}
# In these phases no estimate is possible, so the flag must never be false.
NEVER_FALSE = ('frozen', 'backwards', 'wild', 'only_nan', 'type', 'silent')
LONG, SHORT = (4.0, 12.0), (2.0, 4.0)
# Times in which dips may be missed, s: after a new publisher (discovery), after the start, and
# before a publisher ends (its last messages may be lost).
SETTLE, FIRST, LEAVE = 1.0, 3.0, 0.3
# Of dips: time between them, s (dense: the least at which they can be distinguished), length, s,
# and voltage, V (never above the lowest floor that is set).
BETWEEN, DENSE, DIP, DEPTH = (1.5, 5.0), (1.3, 2.0), (0.04, 0.08), (3.0, 4.1)
# Time between two actions on the node, s.
PAUSE = (1.0, 5.0)
SLICES = ((0.02, 0.01), (0.05, 0.05), (0.2, 0.1), (0.4, 0.2))


@dataclass(frozen=True)
class Phase:
    """Messages of the source from `begin` to `end`, s."""

    kind: str
    begin: float
    end: float


@dataclass(frozen=True)
class Dip:
    """One dip."""

    begin: float  # s.
    length: float  # s.
    voltage: float  # V.
    unseen: str  # Why the node cannot see it; empty if it must.


@dataclass(frozen=True)
class Event:
    """An action on the node at `begin`, s."""

    kind: str
    begin: float
    about: Any = None


def phases(seed: int, seconds: float) -> list[Phase]:
    """Return the phases."""
    rng = random.Random(f'phases {seed}')
    weights = {**SEEN, **UNSEEN}
    made, now = [Phase('good', 0.0, FIRST + 2.0)], FIRST + 2.0
    while now < seconds:
        # Phases do not overlap: if the source paused while the second publisher is there, the
        # node would follow the second one.
        kind = rng.choices(list(weights), list(weights.values()))[0]
        length = rng.uniform(*(LONG if kind in SEEN else SHORT))
        if kind == 'second':
            length = max(length, 8.0)
        made.append(Phase(kind, now, min(now + length, seconds)))
        now += length
    return made


def dips(seed: int, sent: list[Phase], dense: bool = False) -> list[Dip]:
    """Return the dips, whole milliseconds each."""
    rng = random.Random(f'dips {seed}')
    made: list[Dip] = []
    now = 0.0
    while True:
        now = round(now + rng.uniform(*(DENSE if dense else BETWEEN)), 3)
        length = round(rng.uniform(*DIP), 3)
        if now + length >= sent[-1].end:
            return made
        made.append(Dip(now, length, rng.uniform(*DEPTH), _unseen(now, now + length, sent)))


def _unseen(begin: float, end: float, sent: list[Phase]) -> str:
    if begin < FIRST:
        return 'start'
    for phase in sent:
        if phase.kind in UNSEEN:
            ends = phase.kind in ('type', 'restart')
            before, after = (LEAVE, SETTLE) if ends else (0.1, 0.1)
            if end > phase.begin - before and begin < phase.end + after:
                return phase.kind
    return ''


def events(seed: int, seconds: float, fifo: str, model: str) -> list[Event]:
    """Return the actions on the node (fifo, model: paths of files)."""
    rng = random.Random(f'events {seed}')
    made, now = [], FIRST
    while True:
        now += rng.uniform(*PAUSE)
        if now > seconds - 10.0:
            return made
        kind = rng.choices(['set', 'refused', 'clear', 'slices', 'busy'], [6, 4, 1, 1.5, 1])[0]
        about: Any = None
        if kind == 'set':
            about = [good_parameter(rng, model) for _ in range(rng.choice([1, 1, 1, 3]))]
        elif kind == 'refused':
            about = [rng.choice(bad_parameters(fifo))]
        elif kind in ('slices', 'busy'):
            about = (rng.uniform(3.0, 12.0), rng.choice(SLICES))
        made.append(Event(kind, now, about))
        if kind in ('slices', 'busy'):
            now += about[0]


def good_parameter(rng: random.Random, model: str) -> tuple[str, Any]:
    """Return a parameter and a value that are accepted whatever the others are."""
    return rng.choice([
        lambda: ('window', rng.uniform(0.5, 4.0)),
        lambda: ('stale_after', rng.uniform(0.5, 2.0)),
        lambda: ('publish_rate', rng.uniform(5.0, 20.0)),
        lambda: ('brownout.horizon', rng.uniform(0.5, 5.0)),
        lambda: ('brownout.warn', rng.uniform(0.005, 0.05)),
        lambda: ('brownout.critical', rng.uniform(0.1, 0.5)),
        lambda: ('brownout.leave', rng.uniform(0.1, 0.9)),
        lambda: ('brownout.hold', rng.choice([0.0, 0.0, 0.2, 1.0])),
        lambda: ('brownout.delay', rng.choice([0.0, 0.2])),
        lambda: ('brownout.latch', rng.random() < 0.3),
        lambda: ('brownout.floor', rng.uniform(4.15, 4.35)),
        lambda: ('brownout.floor_time', rng.uniform(0.005, 0.03)),
        lambda: ('brownout.budget_limit', rng.choice([0.0, 0.02])),
        lambda: ('model_file', rng.choice(['', model])),
    ])()


def bad_parameters(fifo: str) -> list[tuple[str, Any]]:
    """Return parameters that must be refused."""
    return [
        ('window', -1.0), ('window', math.nan), ('window', 'long'), ('window', 1e9),
        ('publish_rate', 0.0), ('publish_rate', 1e9), ('publish_rate', math.inf),
        ('brownout.warn', 0.6), ('brownout.warn', -0.1), ('brownout.critical', 0.001),
        ('brownout.leave', 1.0), ('brownout.floor', 100.0), ('brownout.floor', math.nan),
        ('brownout.latch', 1), ('brownout.hold', -1.0),
        ('model_file', fifo), ('model_file', '/dev/zero'), ('model_file', '/no/such.yaml'),
        ('voltage.topic', 'elsewhere'), ('lock_parameters', True), ('no_such_parameter', 1.0)]


# -- the source

FLOOD = Path(__file__).resolve().parents[1] / 'test/support/flood.py'
TOPIC = '/soak/voltage'
# Of the supply: relaxation, 1/s, noise, V/sqrt(s), level, V.
ALPHA, SIGMA, LEVEL = 63.0, 0.2, 5.0
# Share of bad values in a phase that has them, and the values, V.
BAD = 0.2
HUGE = (1e200, 1e30, -1e30, math.inf, -math.inf, 1e-160, 1e5)
# Number of samples sent at once, and at most to catch up.
BURST, MOST = 100, 1000


class Source:
    """Sends the messages of the schedule when they are due."""

    def __init__(self, seed: int, seconds: float, log: TextIO, dense: bool) -> None:
        self._rng = random.Random(f'source {seed}')
        self._log = log
        self._phases = phases(seed, seconds)
        self._dips = dips(seed, self._phases, dense)
        self._node = rclpy.create_node('soak_source')
        self._output = self._publisher(BatteryState)
        self._second: subprocess.Popen[bytes] | None = None
        self._phase = self._phases[0]
        self._away, self._offset, self._jump_at = 0.0, 0.0, 0.0
        self._low: list[float] = []
        self._count, self._counted = 0, -math.inf
        self._start = self._wall = 0.0

    def _publisher(self, kind: Any) -> Any:
        return self._node.create_publisher(kind, TOPIC, QoSProfile(
            depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT))

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
            self._note_count()
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
                # Note a dip once its end has passed.
                while dip_at < len(self._dips) and now > _end(self._dips[dip_at]):
                    self._note_dip(dip_at)
                    dip_at += 1
                for _ in range(burst):
                    self._send(sent / RATE, self._dips[dip_at:dip_at + 1])
                    sent += 1
            time.sleep(0.001)

    def _note(self, **about: Any) -> None:
        self._log.write(json.dumps(about) + '\n')
        self._log.flush()

    def _note_count(self) -> None:
        now = time.monotonic()
        if now - self._counted >= 0.1:
            self._counted = now
            self._note(kind='sent', at=now, count=self._count)

    def _note_dip(self, number: int) -> None:
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
            self._output = self._publisher(Float64) if phase.kind == 'type' else None

    def _leave(self, phase: Phase) -> None:
        if phase.kind in ('restart', 'type'):
            if self._output is not None:
                self._node.destroy_publisher(self._output)
            self._output = self._publisher(BatteryState)
        self._end_second()

    def _end_second(self) -> None:
        """End the other publisher, cleanly or not."""
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
        # In the last seconds of a phase only the first publisher sends, so that messages lost with
        # the other are not counted as its own.
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
        # As float32: infinity if too large.
        message = BatteryState(
            voltage=math.copysign(math.inf, value) if abs(value) > 3e38 else value)
        stamp = self._stamp(kind, now)
        message.header.stamp.sec = int(stamp)
        message.header.stamp.nanosec = int((stamp - int(stamp)) * 1e9)
        self._output.publish(message)

    def _stamp(self, kind: str, now: float) -> float:
        """Return the stamp of the sample of a time, s."""
        begin, t = self._wall + self._phase.begin, self._wall + now
        if kind == 'jumps' and now > self._jump_at:
            self._jump_at = now + self._rng.uniform(0.2, 1.0)
            self._offset += self._rng.choice([-1.0, 1.0]) * 10.0 ** self._rng.uniform(-2, 6)
        return {'none': 0.0, 'lumps': 0.0, 'frozen': begin, 'backwards': 2.0 * begin - t,
                'future': t + 3e8, 'wild': t + self._rng.uniform(-100.0, 100.0),
                'fast': begin + 1000.0 * (t - begin),
                'jumps': min(max(t + self._offset, 1.0), 2.0 ** 31 - 1.0)}.get(kind, t)


def _end(dip: Dip) -> float:
    return dip.begin + dip.length - 0.5 / RATE


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
