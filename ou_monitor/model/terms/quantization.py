"""Steps of the ADC, or of the oscilloscope."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term


@dataclass(frozen=True)
class Quantization(Term):
    """Round to whole steps, counted from 0 V."""

    NAME: ClassVar[str] = 'quantization'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.CODE
    ROLE: ClassVar[Role] = Role.NOISE
    MEANING: ClassVar[str] = 'The steps of the ADC are comparable to the noise.'
    REMEDY: ClassVar[str] = (
        'Use a finer range of the ADC or more gain ahead of it; sigma is partly rounding.')
    SEPARATED_BY: ClassVar[str] = 'the same rail with a finer range of the ADC'

    step: float = parameter('V', 'one code', 0.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.voltage = self.step * np.rint(s.voltage / self.step)

        return effect

    def variance(self) -> float:
        """Return the variance of rounding to whole steps, V^2."""
        return self.step * self.step / 12.0
