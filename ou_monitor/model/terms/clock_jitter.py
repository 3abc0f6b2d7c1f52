"""Time stamps are wrong by a random amount."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class ClockJitter(Term):
    """
    Take each sample a random time off its stamp.

    Normal, but never so far that two samples change places: cut at 0.45 of the
    step on either side.
    """

    NAME: ClassVar[str] = 'clock_jitter'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.CLOCK

    std: float = parameter('s', 'standard deviation of the error of a stamp', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        last = -math.inf
        stamp = -math.inf

        def effect(s: Stretch) -> None:
            nonlocal last, stamp
            gap = np.diff(s.t, prepend=stamp)
            # The step to come is not known at the end of a stretch: that behind bounds both.
            bound = np.where(np.isfinite(gap), 0.45 * gap, 0.0)
            error = self.std * rng.standard_normal(s.t.size)
            s.at = s.t + np.clip(error, -bound, bound)
            s.step = np.diff(s.at, prepend=last)
            # Uneven stamps: the sample before may have gone past this one.
            s.step = np.maximum(s.step, 0.0)
            s.at = np.maximum.accumulate(s.at)
            last, stamp = float(s.at[-1]), float(s.t[-1])

        return effect
