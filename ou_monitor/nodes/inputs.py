"""
Inputs of a node: find sources on the graph, fetch messages, and give each a time.

The time is the message's own stamp, or else the middleware's source timestamp; under
`use_sim_time`, `/clock` maps the source timestamp to simulated time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
import time
from typing import Any

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.nodes.base import MonitorNode
from ou_monitor.nodes.clocks import SendClock, SimClockMap
from ou_monitor.nodes.sources import definition_of, find_source, Source
from ou_monitor.online.risk.flag import FlagLevel, FlagState
from ou_monitor.recordings.cdr import FieldColumn, FieldReader, MessageTable
from ou_monitor.records import FloatArray
from ou_monitor.stream.config import FieldSpec
from ou_monitor.stream.samples import Publishers
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock as ClockMessage

# Best effort, because a reliable subscription receives nothing from best-effort publishers.  The
# depth is enough for 0.2 s at 10 kHz, while the estimator is busy with a fit.
INPUT_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=2000,
                       reliability=ReliabilityPolicy.BEST_EFFORT)
# Smaller for blocks: 2000 blocks would take 80 MB.
BLOCK_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=200,
                       reliability=ReliabilityPolicy.BEST_EFFORT)
# Maximum number of messages (the size of the queue) and bytes taken at a time; processing these
# bytes takes about 50 ms and 50 MB of memory.
MOST_TAKEN, MOST_BYTES = 2000, 2_000_000
# Maximum time for which a message counts as having waited in the middleware's queue, s.
MOST_WAIT = 60.0
# Period of reminders, s, and silence after which a publisher is reported, s.
AGAIN = 60.0
MUTE = 10.0
# Sentence for a missing clock in the diagnostics of every node.
NO_CLOCK = 'use_sim_time is set, but no message arrives on /clock.'
CLOCK_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


class Stamper:
    """Gives messages their times; calls `on_jump` with the reason when their clock jumps."""

    def __init__(self, node: MonitorNode, on_jump: Callable[[str], None]) -> None:
        self._node = node
        self._on_jump = on_jump
        self._map = SimClockMap()
        self._clock_input: Subscription | None = None
        self._clock_silence = Silence(node.steady_now)
        self._jumps = node.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1),
                          on_clock_change=True),
            post_callback=node.guarded(self._jumped))
        node.at_stop(self._jumps.unregister)
        self.follow()

    @property
    def simulated(self) -> bool:
        """Whether the node runs on simulated time."""
        return self._clock_input is not None

    @property
    def waiting(self) -> bool:
        """Whether messages without a stamp cannot be placed in time yet."""
        return self.simulated and (
            not self._map.ready or self._clock_silence.age > self._map.patience)

    def follow(self) -> None:
        """Follow `use_sim_time`, which may change at run time."""
        wanted = self._node.get_clock().ros_time_is_active
        if wanted and self._clock_input is None:
            self._map, self._clock_silence = SimClockMap(), Silence(self._node.steady_now)
            self._clock_input = self._node.create_subscription(
                ClockMessage, '/clock', self._node.with_info(self._clock), CLOCK_QOS)
        elif not wanted and self._clock_input is not None:
            self._node.destroy_subscription(self._clock_input)
            self._clock_input = None

    def source_time(self, source: float, smooth: SendClock | None = None) -> float:
        """Return the time, s, of a message without a stamp, sent at `source`; NaN: undefined."""
        if smooth is not None:
            source = smooth(source)
        return self._map(source) if self.simulated else source

    def time_of(self, stamp: float, info: Any) -> float:
        """Return a header's stamp, s, or the source time if the stamp is 0 or missing."""
        return stamp or self.source_time(float(info['source_timestamp']) * 1e-9)

    def _clock(self, message: Any, info: Any) -> None:
        self._clock_silence.record()
        clock = message.clock.sec + message.clock.nanosec * 1e-9
        if self._map.add(float(info['source_timestamp']) * 1e-9, clock):
            self._on_jump('/clock stepped')

    def _jumped(self, jump: Any) -> None:
        if jump.delta.nanoseconds < 0:
            self._on_jump(f'the clock jumped back by {-jump.delta.nanoseconds * 1e-9:.3g} s')
        else:
            self._on_jump('use_sim_time was switched')


@dataclass(frozen=True, eq=False)
class Arrivals:
    """Messages of one publisher, in order of arrival."""

    column: FieldColumn  # Their contents; the sending time replaces a missing stamp
    # When the middleware received each message, by the wall clock, s; shape (m,).
    received: FloatArray
    arrived: FloatArray  # The same times by the monotonic clock, s; shape (m,)

    def split(self, at: int) -> tuple[Arrivals, Arrivals]:
        """Return the first `at` messages, and the rest."""
        first, rest = self.column.split(at)
        return (Arrivals(first, self.received[:at], self.arrived[:at]),
                Arrivals(rest, self.received[at:], self.arrived[at:]))


class PolledInput:
    """One field of a topic's messages, in batches; `beside`: a second number of each message."""

    def __init__(self, node: MonitorNode, kind: Any, topic: str, spec: FieldSpec,
                 beside: FieldSpec | None = None) -> None:
        self._node = node
        self.topic = node.resolve_topic_name(topic)
        self._input = node.create_polled(
            kind, topic, INPUT_QOS if spec.sample_rate is None else BLOCK_QOS)
        # Leave out messages that cannot be decoded.
        self._reader = FieldReader(
            spec, definition_of(kind), lambda index, why: None, beside)
        self.publishers = Publishers()
        # Messages fetched but not yet read, the times at which they were fetched (wall and
        # monotonic clock, s), and their total size, bytes.
        self._fetched: list[tuple[bytes, dict[str, Any]]] = []
        self._when: list[tuple[float, float]] = []
        self._bytes = 0

    @property
    def full(self) -> bool:
        """Whether a full batch has been fetched."""
        return len(self._fetched) >= MOST_TAKEN or self._bytes >= MOST_BYTES

    def fetch(self) -> None:
        """Fetch waiting messages before the middleware drops them; `take` reads them."""
        handle = self._input.handle
        wall, now = time.time(), self._node.steady_now()
        with handle:
            while not self.full:
                found = handle.take_message(self._input.msg_type, True)
                if found is None:
                    break
                self._fetched.append(found)
                self._when.append((wall, now))
                self._bytes += len(found[0])

    def take(self) -> Arrivals | None:
        """Return the waiting messages of the followed publisher; None if there are none."""
        self.fetch()
        taken = self._fetched
        if not taken:
            return None
        wall, now = np.array(self._when).T
        self._fetched, self._when, self._bytes = [], [], 0
        infos = [info for _, info in taken]
        sent = np.array([info['source_timestamp'] for info in infos], dtype=np.uint64)
        received = np.array([info['received_timestamp'] for info in infos]) * 1e-9
        received = np.where(received > 0.0, np.minimum(received, wall), wall)
        # Messages have waited in the middleware since their arrival.  The wait is limited, because
        # the wall clock may be set.
        arrived: FloatArray = np.maximum.accumulate(now - np.clip(
            wall - received, 0.0, MOST_WAIT))
        times: FloatArray = sent.astype(np.float64) * 1e-9
        kept = self.publishers.follow(
            [info['publication_sequence_number'] for info in infos], times, arrived,
            self._node.count_publishers(self.topic))
        data = [bytes(message) for (message, _), keep in zip(taken, kept.tolist()) if keep]
        if not data:
            return None
        ends = np.cumsum([len(message) for message in data])
        begins = np.concatenate(([0], ends[:-1]))
        table = MessageTable(b''.join(data), np.zeros(ends.size, np.uint16),
                             np.arange(ends.size, dtype=np.uint64), begins, ends)
        column = self._reader.read(table)
        # Here `log_time` holds the index of each message that could be read.
        read = np.flatnonzero(kept)[column.log_time.astype(np.int64)]
        column = column._replace(stamp=np.where(column.stamped, column.stamp, times[read]))
        return Arrivals(column, received[read], arrived[read])


def decode(data: bytes, kind: Any, topic: str) -> Any:
    """Deserialize a message of a class; InputError if it cannot be read."""
    try:
        return deserialize_message(data, kind)
    except Exception as error:
        # Catch every exception, because the middleware has no exception type of its own.
        raise InputError(f'a message on {topic} cannot be read: {error}') from error


class Silence:
    """Time since the last arrival, by the monotonic clock."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._last = -math.inf
        self.interval = 0.0

    def record(self, at: float | None = None) -> None:
        """Record an arrival (at in s; default: now) and the `interval` since the last one, s."""
        now = self._now() if at is None else at
        if self._last > -math.inf:
            self.interval = now - self._last
        self._last = now

    @property
    def age(self) -> float:
        """Seconds since the last arrival; infinity before the first arrival."""
        return self._now() - self._last

    @property
    def words(self) -> str:
        """Return ' for 3.2 s'; empty before the first arrival."""
        return f' for {self.age:.1f} s' if math.isfinite(self.age) else ''


class SourceFinder:
    """Sources of some quantities, each opened once a publisher offers a known type."""

    def __init__(self, node: MonitorNode, quantities: tuple[str, ...], values: Mapping[str, Any],
                 open_source: Callable[[Source], None]) -> None:
        self._node = node
        self._open = open_source
        self.sources = {quantity: source for quantity in quantities
                        if (source := find_source(quantity, values)) is not None}
        self.opened: dict[str, Source] = {}
        # Why each quantity is not used, such as an InputError of `open_source`; '' if it is used.
        self.problems: dict[str, str] = {}

    def watch(self, needed: str = '') -> None:
        """Check the publishers; raise an InputError if the `needed` quantity cannot be opened."""
        for quantity, source in self.sources.items():
            topic = self._node.resolve_topic_name(source.topic)
            types = types_on(self._node, topic)
            opened = self.opened.get(quantity)
            chosen = source if source.spec is not None else source.choose(types)
            problem = ''
            if opened is not None:
                # DDS drops messages of another type without a report.
                if types and opened.spec is not None and opened.spec.type not in types:
                    problem = (f"{topic} carries {', '.join(types)}, but msg_config "
                               f"'{opened.config}' expects {opened.spec.type}.")
            elif chosen is not None:
                try:
                    self._open(chosen)
                except InputError as error:
                    if quantity == needed:
                        raise
                    problem = f'{topic} is not used: {error}'
                else:
                    assert chosen.spec is not None
                    self.opened[quantity] = chosen
                    self._node.get_logger().info(
                        f'{quantity} from {topic}: {chosen.spec.type} field '
                        f"'{chosen.spec.field}' (msg_config '{chosen.config}')")
            elif types:
                known = [c.spec.type for c in source.candidates if c.spec is not None]
                problem = (f"{topic} carries {', '.join(types)}, which no generic msg_config "
                           f"describes (known: {', '.join(dict.fromkeys(known))}): set "
                           f'{quantity}.type and {quantity}.field, or msg_config.')
            if problem and self.problems.get(quantity) != problem:
                self._node.get_logger().warning(problem, throttle_duration_sec=10.0)
            self.problems[quantity] = problem


def types_on(node: Node, topic: str) -> list[str]:
    """Return the types that publishers offer on a topic (resolved name), each once."""
    return list(dict.fromkeys(
        end.topic_type for end in node.get_publishers_info_by_topic(topic)))


class Console:
    """Logs missing inputs and changes of the flag."""

    def __init__(self, node: MonitorNode) -> None:
        self._node = node
        # When the topic last had no publisher.
        self._alone = node.steady_now()
        self._critical = False

    def waiting(self, topic: str) -> None:
        """Log why no message has arrived on a topic yet."""
        # If there is no publisher, log at once, then once a minute; if there is a silent one, log
        # after `MUTE`, then once a minute.
        now, topic = self._node.steady_now(), self._node.resolve_topic_name(topic)
        if not self._node.count_publishers(topic):
            self._alone = now
            alike = [name for name, _ in self._node.get_topic_names_and_types()
                     if topic in name and name != topic]
            hint = f" (there is {', '.join(alike)})" if alike else ''
            self._node.get_logger().info(f'Waiting for a publisher on {topic}{hint}.',
                                         throttle_duration_sec=AGAIN)
        elif now - self._alone >= MUTE:
            self._node.get_logger().info(
                f'{topic} has a publisher, but no message has arrived: it sends none, or runs '
                'as another user, whose messages Fast DDS does not deliver (doc/deploy.md).',
                throttle_duration_sec=AGAIN)

    def flag(self, state: FlagState) -> None:
        """Log when the flag becomes CRITICAL, and when it ends."""
        critical = state.level is FlagLevel.CRITICAL
        if critical == self._critical:
            return
        self._critical = critical
        if critical:
            self._node.get_logger().error(f'The brown-out flag is CRITICAL: {state.reason}')
        else:
            self._node.get_logger().info(
                f'The brown-out flag is no longer CRITICAL, but {state.level.name}.')


class PublisherWatch:
    """Names of the publishers on an input's topic, and notes on their messages."""

    def __init__(self, node: MonitorNode) -> None:
        self._node = node
        self._names: tuple[str, ...] = ()
        self._publishers = Publishers()
        self._lost = self._lost_of_late = 0
        self._looked = -math.inf

    def look(self, at: PolledInput | None) -> None:
        """Take the publishers and their message counts, once there is an input."""
        if at is None:
            return
        self._names = tuple(
            f'{end.node_namespace.rstrip("/")}/{end.node_name} '
            f'[{bytes(end.endpoint_gid).hex()[-8:]}]'
            for end in self._node.get_publishers_info_by_topic(at.topic))
        publishers, now = at.publishers, self._node.steady_now()
        self._publishers = publishers
        if now - self._looked >= 1.0:
            self._lost_of_late, self._lost = publishers.lost - self._lost, publishers.lost
            self._looked = now

    def notes(self, topic: str) -> list[str]:
        """Return notes on the publishers of a topic."""
        notes = []
        if self._lost_of_late:
            notes.append(f'{self._lost_of_late} messages were lost within the last second.')
        if len(self._names) > 1:
            followed = ('the first is used, the others are ignored'
                        if self._publishers.numbered else
                        'the middleware does not number messages, so they are mixed')
            notes.append(f"{len(self._names)} publishers on {topic} ({', '.join(self._names)}): "
                         f'{followed}.')
        return notes

    def fields(self) -> dict[str, str]:
        """Return publishers and counts as fields of a status."""
        counted = self._publishers
        return {'messages_lost': str(counted.lost),
                'messages_lost_by': 'sequence numbers' if counted.numbered else 'not known',
                'foreign_messages': str(counted.foreign),
                'publishers': ', '.join(self._names)}
