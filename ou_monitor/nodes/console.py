"""Console messages of a node: changes of its state, and the publishers of its voltage."""

from __future__ import annotations

import math
from typing import Any

from ou_monitor.nodes.base import MonitorNode
from ou_monitor.online.risk.flag import FlagLevel, FlagState
from ou_monitor.stream.samples import Publishers

# Period of reminders, and silence of a publisher before it is reported, s.
AGAIN = 60.0
MUTE = 10.0


class Console:
    """Logs changes with the node's logger."""

    def __init__(self, node: MonitorNode) -> None:
        self._node = node
        self._waiting = self._muted = -math.inf
        self._critical = False

    def waiting(self, topic: str) -> None:
        """
        Say why a topic has brought no message yet.

        Without a publisher: at once, then once a minute; with a silent publisher: after a while.
        """
        now, topic = self._node.steady_now(), self._node.resolve_topic_name(topic)
        if self._node.count_publishers(topic):
            self._mute(now, topic)
            return
        self._muted = -math.inf
        if now - self._waiting < AGAIN:
            return
        self._waiting = now
        alike = [name for name, _ in self._node.get_topic_names_and_types()
                 if topic in name and name != topic]
        hint = f" (there is {', '.join(alike)})" if alike else ''
        self._node.get_logger().info(f'Waiting for a publisher on {topic}{hint}.')

    def _mute(self, now: float, topic: str) -> None:
        if self._muted == -math.inf:
            self._muted = now + MUTE
        if now < self._muted:
            return
        self._muted = now + AGAIN
        self._node.get_logger().info(
            f'{topic} has a publisher, but no message has come: it sends none, or runs as another '
            'user, whose messages Fast DDS does not deliver (doc/deploy.md).')

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
    """Names of the publishers of one topic, and counts of their messages, in words."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._publishers = Publishers()
        self._lost = self._lost_of_late = 0
        self._looked = -math.inf

    def look(self, ends: list[Any], publishers: Publishers, now: float) -> None:
        """Take the publishers (endpoints) and their message counts (now in s)."""
        self._names = tuple(
            f'{end.node_namespace.rstrip("/")}/{end.node_name} '
            f'[{bytes(end.endpoint_gid).hex()[-8:]}]' for end in ends)
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
            followed = ('the first is followed, the others are left out'
                        if self._publishers.numbered else
                        'the middleware does not number messages, so they are mixed')
            notes.append(f"{len(self._names)} publishers on {topic} ({', '.join(self._names)}): "
                         f'{followed}.')
        return notes

    def fields(self) -> dict[str, str]:
        """Return the same as fields of a status."""
        counted = self._publishers
        return {'messages_lost': str(counted.lost),
                'messages_lost_by': 'sequence numbers' if counted.numbered else 'not known',
                'foreign_messages': str(counted.foreign),
                'publishers': ', '.join(self._names)}
