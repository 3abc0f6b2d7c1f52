"""What reading the voltage adds: white noise, steps and ends of the ADC, repeated values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class MeasurementNoise(Term):
    """Add independent normal errors."""

    NAME: ClassVar[str] = 'measurement_noise'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.SENSOR
    ROLE: ClassVar[Role] = Role.NOISE
    FREE: ClassVar[tuple[str, ...]] = ('std',)
    SIGNS: ClassVar[tuple[str, ...]] = ('-autocorrelation', '+band')
    MAY_LEAVE: ClassVar[float] = 0.3
    MEANING: ClassVar[str] = 'White noise of the sensor adds to the voltage of the rail.'
    REMEDY: ClassVar[str] = (
        'Average in the ADC or use a finer range; alpha and sigma fitted without it are too high.')
    SEPARATED_BY: ClassVar[str] = (
        'the same rail at several times the sampling rate, or the input of the ADC shorted')

    std: float = parameter('V', 'standard deviation', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.voltage += self.std * s.noise * rng.standard_normal(s.t.size)

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a share of the one-step error."""
        error = math.sqrt(float(np.median(view.variance)))
        return [cls(0.1 * error), cls(0.4 * error)]

    def holds(self, view: View) -> bool:
        """Return whether it is there at all beside the one-step error."""
        return self.variance() > _LEAST * float(np.median(view.variance))

    def variance(self) -> float:
        """Return the variance that this term adds to each measurement, V^2."""
        return self.std * self.std

    def variances(self, s: Segment) -> FloatArray | float:
        """Return the same at each sample."""
        return self.variance() * np.square(s.noise)


# Share of the one-step variance below which white noise is none: it moves the likelihood of n
# samples by n/4 of its square, so that 10^7 samples would not show it.
_LEAST = 1e-3


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
