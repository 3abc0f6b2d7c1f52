"""Complex poles: ringing of an LC filter, or of a supply loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.lines import broad_peaks, rotation
from ou_monitor.model.terms.recursion import first_order
from ou_monitor.model.terms.term import Effect, parameter, Role, Stage, Stretch, Term, View
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class Resonance(Term):
    """
    Add the real part of a complex OU: noise with a rounded spectral line.

    Autocovariance std^2 exp(-damping |tau|) cos(2 pi frequency tau), exact in law at
    any spacing.
    """

    NAME: ClassVar[str] = 'resonance'
    FAMILY: ClassVar[str] = 'line'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    ROLE: ClassVar[Role] = Role.BLOCK
    FREE: ClassVar[tuple[str, ...]] = ('frequency', 'damping', 'std')
    SIGNS: ClassVar[tuple[str, ...]] = ('line', 'band')
    SEARCH: ClassVar[float] = 5.0

    frequency: float = parameter('Hz', 'of the ringing', 0.0, above=True)
    damping: float = parameter('1/s', 'rate at which ringing dies out', 0.0, above=True)
    std: float = parameter('V', 'standard deviation', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        before = 0.0 + 0.0j

        def effect(s: Stretch) -> None:
            nonlocal before
            n = s.t.size
            pairs = rng.standard_normal((n, 2))
            kicks = (pairs[:, 0] + 1j * pairs[:, 1]) * self.std * np.sqrt(
                -np.expm1(-2.0 * self.damping * s.step))
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
        return [cls(frequency, width, 0.5 * spread)
                for frequency, width in broad_peaks(view.z[view.train], view.rate)]

    def block(self, s: Stretch) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return its two states, which turn."""
        turn = 2.0 * math.pi * self.frequency * np.where(np.isfinite(s.step), s.step, 0.0)
        return rotation(turn, self.damping, s.step, self.std)

    @property
    def rings(self) -> bool:
        """Whether it turns at all before it dies out."""
        return self.damping < 2.0 * math.pi * self.frequency
