"""
Subscriptions: types found on the graph, and the time of every message.

Time is the message's own stamp; without one it is the middleware's source
timestamp, under `use_sim_time` mapped to simulated time through `/clock`.
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any

from ou_monitor.nodes.base import MonitorNode
from ou_monitor.nodes.clocks import SendClock, SimClockMap
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock as ClockMessage

# Best effort, because a reliable subscription receives nothing from best-effort publishers;
# deep enough for 0.2 s at 10 kHz while the estimator fits.
INPUT_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=2000,
                       reliability=ReliabilityPolicy.BEST_EFFORT)
CLOCK_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


class Stamper:
    """
    Time of messages, and notice when that time steps back.

    Parameters
    ----------
    node : MonitorNode
        Whose clock and subscriptions are used.
    on_jump : callable
        Called with the reason when the clock stepped: what came before is
        void.

    """

    def __init__(self, node: MonitorNode, on_jump: Callable[[str], None]) -> None:
        self._node = node
        self._on_jump = on_jump
        self._map = SimClockMap()
        self._clock_input: Subscription | None = None
        self._jumps = node.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1),
                          on_clock_change=True),
            post_callback=node.guarded(self._jumped))
        self.follow()

    @property
    def simulated(self) -> bool:
        """Whether the node runs on simulated time."""
        return self._clock_input is not None

    @property
    def waiting(self) -> bool:
        """Whether messages without a stamp cannot be placed in time yet."""
        return self.simulated and not self._map.ready

    def follow(self) -> None:
        """Follow `use_sim_time`, which may change at run time."""
        wanted = self._node.get_clock().ros_time_is_active
        if wanted and self._clock_input is None:
            self._map = SimClockMap()
            self._clock_input = self._node.create_subscription(
                ClockMessage, '/clock', self._node.with_info(self._clock), CLOCK_QOS)
        elif not wanted and self._clock_input is not None:
            self._node.destroy_subscription(self._clock_input)
            self._clock_input = None

    def source_time(self, info: Any, smooth: SendClock | None = None) -> float:
        """Return the time, s, of a message without a stamp; NaN when not known yet."""
        source = float(info['source_timestamp']) * 1e-9
        if smooth is not None:
            source = smooth(source)
        return self._map(source) if self.simulated else source

    def time_of(self, message: Any, info: Any) -> float:
        """Return the header's stamp, s; without one (or when it is 0) the source time."""
        header = getattr(message, 'header', None)
        if header is not None and (header.stamp.sec or header.stamp.nanosec):
            return float(header.stamp.sec + header.stamp.nanosec * 1e-9)
        return self.source_time(info)

    def _clock(self, message: Any, info: Any) -> None:
        clock = message.clock.sec + message.clock.nanosec * 1e-9
        if self._map.add(float(info['source_timestamp']) * 1e-9, clock):
            self._on_jump('/clock stepped')

    def _jumped(self, jump: Any) -> None:
        if jump.delta.nanoseconds < 0:
            self._on_jump(f'the clock jumped back by {-jump.delta.nanoseconds * 1e-9:.3g} s')
        else:
            self._on_jump('use_sim_time was switched')


class Silence:
    """Time since something last arrived, by the monotonic clock."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._last = -math.inf
        self.interval = 0.0

    def heard(self) -> None:
        """Take an arrival; `interval` is the time since the one before, s."""
        now = self._now()
        if self._last > -math.inf:
            self.interval = now - self._last
        self._last = now

    @property
    def age(self) -> float | None:
        """Seconds since the last arrival; None when there was none."""
        return None if self._last == -math.inf else self._now() - self._last


def types_on(node: MonitorNode, topic: str) -> list[str]:
    """Return the types that publishers offer on a topic (resolved name), each once."""
    return list(dict.fromkeys(
        end.topic_type for end in node.get_publishers_info_by_topic(topic)))
