"""Who publishes the voltage, and what was lost of it within the last second."""

from __future__ import annotations

import math
from typing import Any

from ou_monitor.stream.arrival import Publishers


class PublisherWatch:
    """Names of the publishers of one topic, and counts of their messages, in words."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._publishers = Publishers()
        self._lost = self._lost_of_late = 0
        self._looked = -math.inf

    def look(self, ends: list[Any], publishers: Publishers, now: float) -> None:
        """Take who publishes (endpoints), and what was counted of them (now in s)."""
        self._names = tuple(
            f'{end.node_namespace.rstrip("/")}/{end.node_name} '
            f'[{bytes(end.endpoint_gid).hex()[-8:]}]' for end in ends)
        self._publishers = publishers
        if now - self._looked >= 1.0:
            self._lost_of_late, self._lost = publishers.lost - self._lost, publishers.lost
            self._looked = now

    def notes(self, topic: str) -> list[str]:
        """Return what is to be said of the publishers of a topic."""
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
