"""The logger repeats the last value until the source has a new one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term


@dataclass(frozen=True)
class HeldSamples(Term):
    """Keep each value until 1/rate later."""

    NAME: ClassVar[str] = 'held_samples'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.LOGGER
    ROLE: ClassVar[Role] = Role.EXACT
    MEANING: ClassVar[str] = 'The logger repeats its last value until the source has a new one.'
    REMEDY: ClassVar[str] = (
        'Log at the rate of the source, or drop repeats before any fit (done here).')
    SEPARATED_BY: ClassVar[str] = 'the raw samples of the ADC'

    rate: float = parameter('Hz', 'rate at which the source has new values', 0.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        last = 0.0
        turn = -1.0

        def effect(s: Segment) -> None:
            nonlocal last, turn
            # A hair more, so that a stamp at the very turn does not miss it by rounding.
            hair = 1e-6 + 2.0 * self.rate * np.spacing(np.abs(s.t))
            turns = np.floor((s.t - s.origin) * self.rate + hair)
            fresh = np.diff(turns, prepend=turn) > 0.0
            at = np.maximum.accumulate(np.where(fresh, np.arange(s.t.size), -1))
            s.voltage = np.where(at >= 0, s.voltage[np.maximum(at, 0)], last)
            last, turn = float(s.voltage[-1]), float(turns[-1])

        return effect
