"""A line at a fixed frequency: ESC switching or its alias, a DC-DC converter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.spectral_lines import find_lines, fit_sinusoid, Line, on_grid
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.lines import keeps_its_height, rotation, wandering
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import by_parameters, parameter, Role, Term
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class Tone(Term):
    """
    Add amplitude * sin(2 pi frequency t + phase), whose phase may wander.

    The phase does a random walk that widens the line to `linewidth` (full width at
    half of its height).
    """

    NAME: ClassVar[str] = 'tone'
    FAMILY: ClassVar[str] = 'line'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    # A line that wanders is two states, not known columns.
    ROLE: ClassVar[Role] = by_parameters(
        Role.MEAN, lambda term: Role.BLOCK if term.linewidth else Role.MEAN)
    LINEAR: ClassVar[tuple[str, ...]] = by_parameters(
        ('amplitude', 'phase'), lambda term: () if term.linewidth else ('amplitude', 'phase'))
    FREE: ClassVar[tuple[str, ...]] = by_parameters(
        (), lambda term: ('amplitude', 'frequency', 'linewidth') if term.linewidth else ())
    SIGNS: ClassVar[tuple[str, ...]] = ('line',)
    SEARCH: ClassVar[float] = 10.0
    STATES: ClassVar[int] = 2
    SEVERAL: ClassVar[bool] = True
    RECURS: ClassVar[bool] = True
    MAY_LEAVE: ClassVar[float] = 0.3
    MEANING: ClassVar[str] = (
        'A line at a fixed frequency: PWM of an ESC or its alias, or a DC-DC converter.')
    REMEDY: ClassVar[str] = (
        'Find the source by its frequency; sample at another rate to identify an alias.')
    SEPARATED_BY: ClassVar[str] = (
        'the same at two sampling rates: an alias moves, a true line does not')

    amplitude: float = parameter('V', 'peak', 0.0)
    frequency: float = parameter('Hz', 'frequency', 0.0, above=True)
    phase: float = parameter('rad', 'phase at the first sample')
    linewidth: float = parameter('Hz', 'width of the line; 0: a pure tone', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        wander = wandering(self.linewidth, rng)

        def effect(s: Segment) -> None:
            phase = 2.0 * math.pi * ((s.at - s.origin) * self.frequency % 1.0) + self.phase
            s.level += self.amplitude * np.sin(phase + wander(s.step))

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the strongest lines of what is left over, and the first of them wandering."""
        found = [cls.at(line, view) for line in lines_of(view)[:_MOST]]
        spread = math.sqrt(float(np.median(view.variance)))
        return [*found, *(cls(0.3 * spread, line.frequency, 0.0, _WANDERS) for line in found[:1])]

    @classmethod
    def at(cls, line: Line, view: View) -> Tone:
        """Return a start for a line of what is left over: where it is over the whole recording."""
        grid = on_grid(view.at, view.z)
        wave = fit_sinusoid(grid.values, grid.rate, line.frequency, line.resolution)
        return cls(0.0, wave.frequency, 0.0, 0.0)

    def holds(self, view: View) -> bool:
        """Return whether it is a line, not ringing."""
        return self.linewidth < SHARP * self.frequency and (
            self.linewidth < WIDEST
            or keeps_its_height(view, self.frequency, self.linewidth))

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the two states of a line that wanders, which turn."""
        turn = 2.0 * math.pi * self.frequency * np.where(np.isfinite(s.step), s.step, 0.0)
        return rotation(turn, math.pi * self.linewidth, s.step, self.amplitude / math.sqrt(2.0))

    def columns(self, s: Segment) -> FloatArray:
        """Return the line in phase and in quadrature."""
        columns = []
        for phase in (0.0, 0.5 * math.pi):
            level = replace(s, level=np.zeros(s.t.size))
            unit = replace(self, amplitude=1.0, phase=phase, linewidth=0.0)
            unit.start(np.random.default_rng(0))(level)
            columns.append(level.level)
        return np.stack(columns, axis=1)

    def linear_values(self) -> list[float]:
        """Return the coefficients of the columns."""
        return [self.amplitude * math.cos(self.phase), self.amplitude * math.sin(self.phase)]

    def with_linear(self, beta: Sequence[float]) -> Tone:
        """Return the line with these coefficients."""
        return replace(self, amplitude=math.hypot(*beta), phase=math.atan2(beta[1], beta[0]))


def lines_of(view: View) -> tuple[Line, ...]:
    """Return the lines of what is left over, strongest first."""
    # In all of it: a line may have begun late, and its frequency is no parameter of a
    # likelihood, but pays for its search.
    grid = on_grid(view.at, view.z)
    return find_lines([grid.values], grid.rate, false_alarm=_PROPOSED).lines


# Lines that are tried, one after the other; probability that noise proposes one, where the
# evidence of a fit decides.
_MOST, _PROPOSED = 3, 0.5
# Linewidth to start from, Hz, and that from which a line is ringing that dies out, if it
# does not keep its height.
_WANDERS, WIDEST = 0.3, 2.0
# Width of the widest line, in frequencies.
SHARP = 0.05
