"""What a node says on the console: once, and then rarely."""

from __future__ import annotations

import math

from ou_monitor.nodes.base import MonitorNode
from ou_monitor.online.risk.flag import FlagLevel, FlagState

# How often it is said that a topic has no publisher, s.
AGAIN = 60.0


class Console:
    """
    Says what changes.

    Parameters
    ----------
    node : MonitorNode
        Whose logger is used.

    """

    def __init__(self, node: MonitorNode) -> None:
        self._node = node
        self._waiting = -math.inf
        self._critical = False

    def waiting(self, topic: str) -> None:
        """Say that a topic has no publisher, while it has none: at once, then once a minute."""
        now, topic = self._node.steady_now(), self._node.resolve_topic_name(topic)
        if now - self._waiting < AGAIN or self._node.count_publishers(topic):
            return
        self._waiting = now
        alike = [name for name, _ in self._node.get_topic_names_and_types()
                 if topic in name and name != topic]
        hint = f" (there is {', '.join(alike)})" if alike else ''
        self._node.get_logger().info(f'Waiting for a publisher on {topic}{hint}.')

    def flag(self, state: FlagState) -> None:
        """Say when the flag becomes CRITICAL, and when it is no longer."""
        critical = state.level is FlagLevel.CRITICAL
        if critical == self._critical:
            return
        self._critical = critical
        if critical:
            self._node.get_logger().error(f'The brown-out flag is CRITICAL: {state.reason}')
        else:
            self._node.get_logger().info(
                f'The brown-out flag is no longer CRITICAL, but {state.level.name}.')
