"""Example of a cause: a consumer whose current is a rectified sine, like a heartbeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.term import Effect, parameter, Role, Segment, Term, View


@dataclass(frozen=True)
class Heartbeat(Term):
    """Add a rectified sine with a period of 1 s."""

    NAME: ClassVar[str] = 'heartbeat'
    FAMILY: ClassVar[str] = 'events'
    ROLE: ClassVar[Role] = Role.MEAN
    LINEAR: ClassVar[tuple[str, ...]] = ('height',)
    SIGNS: ClassVar[tuple[str, ...]] = ('line', 'band', 'autocorrelation')
    IMITATES: ClassVar[tuple[str, ...]] = ('tone',)
    MEANING: ClassVar[str] = 'Something draws current once a second.'
    REMEDY: ClassVar[str] = 'Look for a beacon.'
    SEPARATED_BY: ClassVar[str] = 'the beacon switched off'

    height: float = parameter('V', 'height of each beat')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.level += self.height * np.abs(np.sin(np.pi * (s.at - s.origin)))

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return beats of any height."""
        return (cls(0.0),)
