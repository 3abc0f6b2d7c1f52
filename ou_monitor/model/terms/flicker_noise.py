"""1/f noise: no single relaxation time."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.recursion import first_order
from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class FlickerNoise(Term):
    """
    Add noise of PSD amplitude^2 / f between two frequencies.

    A sum of OUs of equal variance, two to the octave, which follows 1/f within
    2 % between the frequencies (one-sided PSD) and is flat below and steeper above.
    """

    NAME: ClassVar[str] = 'flicker_noise'
    FAMILY: ClassVar[str] = 'slow'
    STAGE: ClassVar[Stage] = Stage.LEVEL

    amplitude: float = parameter('V', 'square root of f times the PSD', 0.0)
    low: float = parameter('Hz', 'lower end', 0.0, above=True)
    high: float = parameter('Hz', 'upper end', 0.0, above=True)

    def check(self) -> None:
        """Check that the ends leave room."""
        if not self.low < self.high:
            raise ValueError(f'{self.NAME}: low must be below high, got {self.low:g} Hz and '
                             f'{self.high:g} Hz')

    def poles(self) -> FloatArray:
        """Return the relaxation rates, 1/s."""
        octaves = math.log2(self.high / self.low)
        count = max(2, math.ceil(2.0 * octaves) + 1)
        return 2.0 * math.pi * np.geomspace(self.low, self.high, count)

    def pole_std(self) -> float:
        """Return the standard deviation of each of the OUs, V."""
        # Poles spaced by d in ln(rate), each of variance v, give the one-sided PSD
        # v/d times the integral of 4 a / (a^2 + w^2) d(ln a) = v/(d f).
        poles = self.poles()
        return self.amplitude * math.sqrt(math.log(poles[1] / poles[0]))

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        poles, std = self.poles(), self.pole_std()
        sources = rng.spawn(poles.size)
        before = np.zeros(poles.size)

        def effect(s: Stretch) -> None:
            for k, pole in enumerate(poles):
                phi = np.exp(-pole * s.step)
                e = std * np.sqrt(-np.expm1(-2.0 * pole * s.step))
                x = first_order(phi, e * sources[k].standard_normal(s.t.size), before[k])
                before[k] = x[-1]
                s.level += x

        return effect
