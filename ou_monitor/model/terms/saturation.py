"""Clipping at a rail of the ADC."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term


@dataclass(frozen=True)
class Saturation(Term):
    """Keep the voltage within limits."""

    NAME: ClassVar[str] = 'saturation'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.CLIP
    ROLE: ClassVar[Role] = Role.EXACT
    MEANING: ClassVar[str] = 'The voltage is clipped at the end of the range of the ADC.'
    REMEDY: ClassVar[str] = (
        'Rescale the input: the true excursions are larger, and those are the ones that matter.')
    SEPARATED_BY: ClassVar[str] = 'the same rail with a larger range'

    low: float = parameter('V', 'lowest reading')
    high: float = parameter('V', 'highest reading')

    def check(self) -> None:
        """Check that the limits leave room."""
        if not self.low < self.high:
            raise ValueError(f'{self.NAME}: low must be below high, got {self.low:g} V and '
                             f'{self.high:g} V')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            np.clip(s.voltage, self.low, self.high, out=s.voltage)

        return effect
