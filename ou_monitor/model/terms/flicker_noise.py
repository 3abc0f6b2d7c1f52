"""1/f noise: no single relaxation time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.recursion import first_order
from ou_monitor.model.terms.term import Effect, parameter, Role, Stage, Stretch, Term, View
from ou_monitor.records import FloatArray

# Octaves from pole to pole: 1/f within 0.2 %, and within 6 %.
_FINE, _COARSE = 0.5, 3.0


@dataclass(frozen=True)
class FlickerNoise(Term):
    """
    Add noise of PSD amplitude^2 / f between two frequencies.

    A sum of OUs, two to the octave, which follows 1/f within 2 % between the
    frequencies, the ends included (one-sided PSD), and is flat below and steeper
    above.
    """

    NAME: ClassVar[str] = 'flicker_noise'
    FAMILY: ClassVar[str] = 'slow'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    ROLE: ClassVar[Role] = Role.BLOCK
    FREE: ClassVar[tuple[str, ...]] = ('amplitude', 'high')
    SIGNS: ClassVar[tuple[str, ...]] = ('band', 'autocorrelation')

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
        return _sum(self.low, self.high, _FINE)[0]

    def pole_std(self) -> FloatArray:
        """Return the standard deviation of each of the OUs, V."""
        return self.amplitude * np.sqrt(_sum(self.low, self.high, _FINE)[1])

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        poles, std = self.poles(), self.pole_std()
        sources = rng.spawn(poles.size)
        before = np.zeros(poles.size)

        def effect(s: Stretch) -> None:
            for k, pole in enumerate(poles):
                phi = np.exp(-pole * s.step)
                e = std[k] * np.sqrt(-np.expm1(-2.0 * pole * s.step))
                x = first_order(phi, e * sources[k].standard_normal(s.t.size), before[k])
                before[k] = x[-1]
                s.level += x

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return noise over all frequencies of the recording, of a third of its variance."""
        low, high = 1.0 / float(view.at[-1]), 0.5 * view.rate
        if high < 4.0 * low:
            return ()
        spread = float(np.std(view.residual))
        return (cls(spread * math.sqrt(0.3 / math.log(high / low)), low, high),)

    def block(self, s: Stretch) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return one state a pole; for a fit one pole in three octaves is enough."""
        poles, variances = _sum(self.low, self.high, _COARSE)
        count = poles.size
        f = np.zeros((s.t.size, count, count))
        q = np.zeros_like(f)
        for k, pole in enumerate(poles):
            f[:, k, k] = np.exp(-pole * s.step)
            q[:, k, k] = -self.amplitude ** 2 * variances[k] * np.expm1(-2.0 * pole * s.step)
        return f, q, np.ones(count)


def _sum(low: float, high: float, octaves: float) -> tuple[FloatArray, FloatArray]:
    """
    Return relaxation rates, 1/s, and variances whose one-sided PSD is nearly 1/f, V^2/Hz.

    The integral of 4 a / (a^2 + w^2) d(ln a) over all rates a is 1/f.  Between
    the ends it becomes a sum by the midpoint rule; what is left on either side
    (in a below, in 1/a above) by Gauss-Legendre of two points.
    """
    count = max(1, math.ceil(math.log2(high / low) / octaves))
    width = math.log(high / low) / count
    inner = low * np.exp(width * (np.arange(count) + 0.5))
    nodes = 0.5 + np.array([-0.5, 0.5]) / math.sqrt(3.0)
    rates = 2.0 * math.pi * np.concatenate((low * nodes, inner, high / nodes))
    outer = 0.5 / nodes
    return rates, np.concatenate((outer, np.full(count, width), outer))
