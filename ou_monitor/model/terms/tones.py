"""Spectral lines: of a tone, of a resonance, and of a tone whose frequency follows throttle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.ou import first_order
from ou_monitor.model.sinusoid import fit_sinusoid
from ou_monitor.model.spectral_lines import find_lines, Line, on_grid
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.lines import (
    broad_peaks, CONSTANT, order_lines, phase_noise, power_spread, RINGING, rotation)
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import by_parameters, parameter, Role, Term
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class Tone(Term):
    """Add a sine whose phase is a random walk, so that its spectral line is `linewidth` wide."""

    NAME: ClassVar[str] = 'tone'
    FAMILY: ClassVar[str] = 'line'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    # If the phase wanders, the term has two states instead of known columns.
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
        'A spectral line at a fixed frequency: PWM of an ESC or its alias, or a DC-DC converter.')
    REMEDY: ClassVar[str] = (
        'Find the source from its frequency; sample at another rate to identify an alias.')
    SEPARATED_BY: ClassVar[str] = (
        'the same rail at two sampling rates: an alias moves, a true line does not')

    amplitude: float = parameter('V', 'peak', 0.0)
    frequency: float = parameter('Hz', 'frequency', 0.0, above=True)
    phase: float = parameter('rad', 'phase at the first sample')
    linewidth: float = parameter('Hz', 'width of the line; 0: a pure tone', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        wander = phase_noise(self.linewidth, rng)

        def effect(s: Segment) -> None:
            phase = 2.0 * math.pi * ((s.at - s.origin) * self.frequency % 1.0) + self.phase
            s.level += self.amplitude * np.sin(phase + wander(s.step))

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the strongest lines of the residual, the first also with a wandering phase."""
        found = [cls.at(line, view) for line in lines_of(view)[:_MOST]]
        spread = math.sqrt(float(np.median(view.variance)))
        least = _WANDERS / float(view.at[-1])
        return [*found, *(cls(0.3 * spread, line.frequency, 0.0, width) for line in found[:1]
                          for width in (least, math.sqrt(least * SHARP * line.frequency))
                          if width < SHARP * line.frequency)]

    @classmethod
    def at(cls, line: Line, view: View) -> Tone:
        """Return a starting point at the frequency of a line, refined over the whole recording."""
        grid = on_grid(view.at, view.z)
        wave = fit_sinusoid(grid.values, grid.rate, line.frequency, line.resolution)
        return cls(0.0, wave.frequency, 0.0, 0.0)

    def holds(self, view: View) -> bool:
        """Return whether this is a line rather than ringing."""
        return self.linewidth < SHARP * self.frequency and (
            self.linewidth < WIDEST
            or not power_spread(view, self.frequency, self.linewidth) > CONSTANT)

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the two rotating states of a line whose phase wanders."""
        turn = 2.0 * math.pi * self.frequency * np.where(np.isfinite(s.step), s.step, 0.0)
        return rotation(turn, math.pi * self.linewidth, s.step, self.amplitude / math.sqrt(2.0))

    def columns(self, s: Segment) -> FloatArray:
        """Return a sine and a cosine of unit amplitude."""
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
        """Return the tone with these coefficients."""
        return replace(self, amplitude=math.hypot(*beta), phase=math.atan2(beta[1], beta[0]))


def lines_of(view: View) -> tuple[Line, ...]:
    """Return the lines of the residual, strongest first."""
    # Include the held-out part, because a line may begin late.  A penalty covers the
    # search for its frequency.
    grid = on_grid(view.at, view.z)
    return find_lines([grid.values], grid.rate, false_alarm=_PROPOSED, wide=True).lines


# Maximum number of lines tried, and their false-alarm probability, which is large because the
# evidence decides later.
_MOST, _PROPOSED = 3, 0.5
# A fit starts from two linewidths: _WANDERS times the resolution of the recording, and the
# geometric mean of this and the maximum.  A line wider than WIDEST, Hz, must have a constant
# amplitude; otherwise it is ringing.
_WANDERS, WIDEST = 3.0, 2.0
SHARP = 0.05  # Maximum width of a line relative to its frequency


@dataclass(frozen=True)
class Resonance(Term):
    """
    Add noise with a broad spectral line.

    Autocovariance std^2 exp(-damping |tau|) (cos(w |tau|) + tilt damping/w sin(w |tau|)),
    w = 2 pi frequency; exact in law at any spacing.  tilt = 0 is the real part of a
    complex OU, 1 the voltage of the capacitor of an LC filter (passes low
    frequencies), -1 the current of its choke (nothing at 0 Hz).
    """

    NAME: ClassVar[str] = 'resonance'
    FAMILY: ClassVar[str] = 'line'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    ROLE: ClassVar[Role] = Role.BLOCK
    # The tilt is fitted unless it is 0.
    FREE: ClassVar[tuple[str, ...]] = by_parameters(
        ('frequency', 'damping', 'std'),
        lambda term: ('frequency', 'damping', 'std', *(('tilt',) if term.tilt else ())))
    SLOW_FIT: ClassVar[bool] = True
    SIGNS: ClassVar[tuple[str, ...]] = ('line', '+band', 'autocorrelation')
    SEARCH: ClassVar[float] = 5.0
    STATES: ClassVar[int] = 2
    SEVERAL: ClassVar[bool] = True
    RECURS: ClassVar[bool] = True
    # A limit is needed, because a broad line fits almost any spectrum.
    MAY_LEAVE: ClassVar[float] = 0.1
    # Ringing that is driven by noise is Gaussian, so it has no bursts and no third moments.
    REFUTED_BY: ClassVar[tuple[str, ...]] = ('bursts', 'products of three')
    MEANING: ClassVar[str] = 'The rail rings: inductance of the leads against the capacitors.'
    REMEDY: ClassVar[str] = 'Damp it with a resistive (electrolytic) capacitor or shorter leads.'
    SEPARATED_BY: ClassVar[str] = 'constant throttle, sampled at ten times that frequency'

    frequency: float = parameter('Hz', 'frequency of the ringing', 0.0, above=True)
    damping: float = parameter('1/s', 'decay rate of the ringing', 0.0, above=True)
    std: float = parameter('V', 'standard deviation', 0.0)
    tilt: float = parameter('', 'slope of the spectrum: 1 low-pass, -1 band-pass', -1.0, 1.0)

    def moved(self, name: str, by: float) -> Resonance:
        """Return the term with one coordinate moved: the tilt, or the logarithm of another."""
        if name != 'tilt':
            return super().moved(name, by)
        return replace(self, tilt=min(max(self.tilt + by, -_STEEPEST), _STEEPEST))

    def per_coordinate(self, name: str) -> float:
        """Return the derivative of a parameter with respect to its coordinate."""
        return 1.0 if name == 'tilt' else super().per_coordinate(name)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        before = 0.0 + 0.0j

        def effect(s: Segment) -> None:
            nonlocal before
            n = s.t.size
            pairs = rng.standard_normal((n, 2))
            q = self.block(s)[1]
            low = np.sqrt(np.maximum(q[:, 0, 0], 0.0))
            across = np.divide(q[:, 0, 1], low, out=np.zeros(n), where=low > 0.0)
            rest = np.sqrt(np.maximum(q[:, 1, 1] - across * across, 0.0))
            kicks = low * pairs[:, 0] + 1j * (across * pairs[:, 0] + rest * pairs[:, 1])
            # In a rotating frame, the ringing is an OU with a real rate.
            turn = np.exp(2j * math.pi * self.frequency * ((s.at - s.origin) % (
                1.0 / self.frequency)))
            phi = np.exp(-self.damping * s.step)
            kicks /= turn
            still = first_order(phi, kicks.real, before.real) + 1j * first_order(
                phi, kicks.imag, before.imag)
            before = complex(still[-1])
            s.level += (still * turn).real

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return starting points at the broad peaks of the residual."""
        spread = float(np.sqrt(np.median(view.variance)))
        return [cls(frequency, width, 0.5 * spread, tilt)
                for frequency, width in broad_peaks(view.z[view.train], view.rate)
                for tilt in (0.0, -_STEEP, _STEEP)]

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the two rotating states of the ringing."""
        turn = 2.0 * math.pi * self.frequency * np.where(np.isfinite(s.step), s.step, 0.0)
        return rotation(turn, self.damping, s.step, self.std,
                        self.tilt * self.damping / (2.0 * math.pi * self.frequency))

    def holds(self, view: View) -> bool:
        """Return whether this oscillates, and decays faster than a line."""
        width = self.damping / math.pi
        # It is ringing if its line is too wide for a tone, or if its amplitude varies.
        return width < 2.0 * self.frequency and (width >= SHARP * self.frequency or (
            width > WIDEST and not power_spread(view, self.frequency, width) < RINGING))


# Initial and maximum |tilt|: at 1, a step would add no noise to one of the states.
_STEEP, _STEEPEST = 0.9, 0.99


@dataclass(frozen=True)
class ThrottleTone(Term):
    """Add a sine of frequency idle + slope * throttle, with the random phase of `Tone`."""

    NAME: ClassVar[str] = 'throttle_tone'
    FAMILY: ClassVar[str] = 'line'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.BLOCK
    FREE: ClassVar[tuple[str, ...]] = ('amplitude', 'linewidth')
    SLOW_FIT: ClassVar[bool] = True
    SIGNS: ClassVar[tuple[str, ...]] = ('order', 'line')
    SEARCH: ClassVar[float] = 9.0
    STATES: ClassVar[int] = 2
    SEVERAL: ClassVar[bool] = True
    RECURS: ClassVar[bool] = True
    MAY_LEAVE: ClassVar[float] = 0.3
    MEANING: ClassVar[str] = 'A spectral line that follows throttle: commutation of the motors.'
    REMEDY: ClassVar[str] = 'Add capacitance at the ESC, or a notch that follows throttle.'
    SEPARATED_BY: ClassVar[str] = 'a slow sweep of throttle'

    amplitude: float = parameter('V', 'peak', 0.0)
    idle: float = parameter('Hz', 'frequency at zero throttle; below 0 for an alias')
    slope: float = parameter('Hz', 'frequency at full throttle less idle')
    phase: float = parameter('rad', 'phase at the first sample')
    linewidth: float = parameter('Hz', 'width of the line; 0: it follows throttle exactly', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        turns = 0.0
        wander = phase_noise(self.linewidth, rng)

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
        """Return the strongest lines of the residual that move with throttle."""
        if view.throttle is None:
            return ()
        spread = math.sqrt(float(np.median(view.variance)))
        moving = _MOVES / float(view.at[-1]) / max(float(np.ptp(view.throttle)), 1e-6)
        return [cls(0.3 * spread, idle, slope, 0.0, 0.05)
                for idle, slope in order_lines(view) if abs(slope) > moving]

    def holds(self, view: View) -> bool:
        """Return whether throttle moves the line by more than its width."""
        return view.throttle is not None and (
            abs(self.slope) * float(view.throttle[view.train].std()) > _MORE * self.linewidth)

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return two states, which rotate at the frequency for the throttle."""
        step = np.where(np.isfinite(s.step), s.step, 0.0)
        turn = 2.0 * math.pi * (self.idle + self.slope * s.throttle) * step
        damping = math.pi * max(self.linewidth, _NARROWEST)
        return rotation(turn, damping, s.step, self.amplitude / math.sqrt(2.0))


# Minimum change of a line's frequency over the range of throttle, in bins; lines that change less
# are tones.
_MOVES = 30.0
# Minimum change of a line's frequency by one standard deviation of throttle, in linewidths.
_MORE = 1.0
_NARROWEST = 1e-4  # Minimum linewidth of the two states, Hz
