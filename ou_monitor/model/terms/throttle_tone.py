"""A line whose frequency follows throttle: commutation of the motors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.lines import order_lines, rotation, wandering
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class ThrottleTone(Term):
    """
    Add amplitude * sin(phase), the phase running at idle + slope * throttle.

    The phase also wanders, which widens the line to `linewidth` (full width at
    half of its height).
    """

    NAME: ClassVar[str] = 'throttle_tone'
    FAMILY: ClassVar[str] = 'line'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.BLOCK
    FREE: ClassVar[tuple[str, ...]] = ('amplitude', 'linewidth')
    DEAR: ClassVar[bool] = True
    SIGNS: ClassVar[tuple[str, ...]] = ('order', 'line')
    SEARCH: ClassVar[float] = 9.0
    STATES: ClassVar[int] = 2
    SEVERAL: ClassVar[bool] = True
    RECURS: ClassVar[bool] = True
    # A line that is clearly there would pass for sigma or alpha that follow throttle; by
    # chance no score is as high.
    CLEAR_ABOVE: ClassVar[Mapping[str, float]] = {'order line': 10.0}
    MAY_LEAVE: ClassVar[float] = 0.3
    MEANING: ClassVar[str] = 'A line whose frequency follows throttle: commutation of the motors.'
    REMEDY: ClassVar[str] = 'Capacitance at the ESC; a notch that follows throttle.'
    SEPARATED_BY: ClassVar[str] = 'a slow sweep of throttle'

    amplitude: float = parameter('V', 'peak', 0.0)
    idle: float = parameter('Hz', 'frequency at zero throttle, below 0 where it folds back')
    slope: float = parameter('Hz', 'what full throttle adds to it')
    phase: float = parameter('rad', 'phase at the first sample')
    linewidth: float = parameter('Hz', 'width of the line; 0: it follows throttle alone', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        turns = 0.0
        wander = wandering(self.linewidth, rng)

        def effect(s: Segment) -> None:
            nonlocal turns
            step = np.where(np.isfinite(s.step), s.step, 0.0)
            run = turns + np.cumsum((self.idle + self.slope * s.throttle) * step)
            turns = float(run[-1]) % 1.0
            phase = 2.0 * math.pi * run + self.phase
            s.level += self.amplitude * np.sin(phase + wander(s.step))

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the strongest lines of what is left over that throttle moves at all."""
        if view.throttle is None:
            return ()
        spread = math.sqrt(float(np.median(view.variance)))
        moving = _MOVES / float(view.at[-1]) / max(float(np.ptp(view.throttle)), 1e-6)
        return [cls(0.3 * spread, idle, slope, 0.0, 0.05)
                for idle, slope in order_lines(view) if abs(slope) > moving]

    def holds(self, view: View) -> bool:
        """Return whether throttle moves the line by more than it is wide."""
        return view.throttle is not None and (
            abs(self.slope) * float(view.throttle[view.train].std()) > _MORE * self.linewidth)

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return its two states, which turn as throttle says."""
        step = np.where(np.isfinite(s.step), s.step, 0.0)
        turn = 2.0 * math.pi * (self.idle + self.slope * s.throttle) * step
        damping = math.pi * max(self.linewidth, _NARROWEST)
        return rotation(turn, damping, s.step, self.amplitude / math.sqrt(2.0))


# Lines that throttle moves by fewer than this many widths of a bin are tones.
_MOVES = 30.0
# What throttle moves it by, of a standard deviation, in widths of the line.
_MORE = 1.0
# A line narrower than this would be no noise at all, Hz.
_NARROWEST = 1e-4
