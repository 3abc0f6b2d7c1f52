"""Complex poles: ringing of an LC filter, or of a supply loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.lines import broad_peaks, keeps_its_height, rotation
from ou_monitor.model.terms.segment import Effect, first_order, Segment, Stage
from ou_monitor.model.terms.term import by_parameters, parameter, Role, Term
from ou_monitor.model.terms.tone import SHARP, WIDEST
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class Resonance(Term):
    """
    Add noise with a rounded spectral line.

    Autocovariance std^2 exp(-damping |tau|) (cos(w |tau|) + tilt damping/w sin(w |tau|)),
    w = 2 pi frequency; exact in law at any spacing.  tilt = 0 is the real part of a
    complex OU, 1 the voltage of the capacitor of an LC filter (all of it below the
    line), -1 that across its choke (none at 0 Hz).
    """

    NAME: ClassVar[str] = 'resonance'
    FAMILY: ClassVar[str] = 'line'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    ROLE: ClassVar[Role] = Role.BLOCK
    # The tilt is fitted where it is not 0.
    FREE: ClassVar[tuple[str, ...]] = by_parameters(
        ('frequency', 'damping', 'std'),
        lambda term: ('frequency', 'damping', 'std', *(('tilt',) if term.tilt else ())))
    DEAR: ClassVar[bool] = True
    SIGNS: ClassVar[tuple[str, ...]] = ('line', '+band', 'autocorrelation')
    SEARCH: ClassVar[float] = 5.0
    STATES: ClassVar[int] = 2
    SEVERAL: ClassVar[bool] = True
    RECURS: ClassVar[bool] = True
    # A broad line fits almost any spectrum.
    MAY_LEAVE: ClassVar[float] = 0.1
    # What rings under noise does not come and go, nor makes three neighbours depend on
    # each other.
    REFUTED_BY: ClassVar[tuple[str, ...]] = ('bursts', 'products of three')
    MEANING: ClassVar[str] = 'The rail rings: inductance of the leads against the capacitors.'
    REMEDY: ClassVar[str] = 'Damp it with a resistive (electrolytic) capacitor or shorter leads.'
    SEPARATED_BY: ClassVar[str] = 'a sampling rate of ten times the ringing, throttle held still'

    frequency: float = parameter('Hz', 'of the ringing', 0.0, above=True)
    damping: float = parameter('1/s', 'rate at which ringing dies out', 0.0, above=True)
    std: float = parameter('V', 'standard deviation', 0.0)
    tilt: float = parameter('', 'slope of the spectrum: 1 low-pass, -1 band-pass', -1.0, 1.0)

    def moved(self, name: str, by: float) -> Resonance:
        """Return the term with one coordinate moved: the tilt itself, logarithms else."""
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
            # In a frame that turns along, it is an OU with a real rate.
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
        """Return the broad peaks of what is left over."""
        spread = float(np.sqrt(np.median(view.variance)))
        return [cls(frequency, width, 0.5 * spread, tilt)
                for frequency, width in broad_peaks(view.z[view.train], view.rate)
                for tilt in (0.0, -_STEEP, _STEEP)]

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return its two states, which turn."""
        turn = 2.0 * math.pi * self.frequency * np.where(np.isfinite(s.step), s.step, 0.0)
        return rotation(turn, self.damping, s.step, self.std,
                        self.tilt * self.damping / (2.0 * math.pi * self.frequency))

    def holds(self, view: View) -> bool:
        """Return whether it turns before it dies out, and dies out sooner than a line does."""
        width = self.damping / math.pi
        # What is too wide for a tone; or would be one but for its height.
        return width < 2.0 * self.frequency and (width >= SHARP * self.frequency or (
            width > WIDEST and not keeps_its_height(view, self.frequency, width)))


# Tilt to begin with, and at most: at 1 a step would add no noise in one direction.
_STEEP, _STEEPEST = 0.9, 0.99
