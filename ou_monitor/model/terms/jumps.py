"""Steps of the supply that then relax at the rate alpha: impulses of the load."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class Jumps(Term):
    """Push the state by normal amounts at the instants of a Poisson process."""

    NAME: ClassVar[str] = 'jumps'
    FAMILY: ClassVar[str] = 'events'
    STAGE: ClassVar[Stage] = Stage.DRIVE

    rate: float = parameter('1/s', 'jumps per second', 0.0)
    mean: float = parameter('V', 'mean size')
    std: float = parameter('V', 'standard deviation of the size', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        waits, sizes = rng.spawn(2)
        next_at = math.nan

        def effect(s: Stretch) -> None:
            nonlocal next_at
            if self.rate == 0.0:
                return
            if math.isnan(next_at):
                next_at = float(s.at[0]) + waits.standard_exponential() / self.rate
            times = []
            while next_at <= s.at[-1]:
                times.append(next_at)
                next_at += waits.standard_exponential() / self.rate
            if not times:
                return
            when = np.array(times)
            # Within its step a jump has relaxed since it came.
            k = np.searchsorted(s.at, when)
            size = self.mean + self.std * sizes.standard_normal(when.size)
            np.add.at(s.push, k, size * np.exp(-s.alpha[k] * (s.at[k] - when)))

        return effect
