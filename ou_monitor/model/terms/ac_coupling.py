"""AC coupling of the instrument; its corner may be mistaken for alpha."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.ou import first_order
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray

# Minimum relative difference of two rates, because the formulas below divide by the difference.
_APART = 1e-4


@dataclass(frozen=True)
class ACCoupling(Term):
    """
    A first-order high-pass between rail and reading.

    The reading is U - l + offset with dl = rate (U - l) dt, rate = 2 pi corner.
    The effect on the OU is exact in law; the sum of all other terms is
    approximated by straight lines between samples.
    """

    NAME: ClassVar[str] = 'ac_coupling'
    FAMILY: ClassVar[str] = 'instrument'
    STAGE: ClassVar[Stage] = Stage.INSTRUMENT
    ROLE: ClassVar[Role] = Role.BLOCK
    FREE: ClassVar[tuple[str, ...]] = ('corner',)
    SLOW_FIT: ClassVar[bool] = True
    BROAD: ClassVar[bool] = True
    SIGNS: ClassVar[tuple[str, ...]] = ('-band',)
    STATES: ClassVar[int] = 1
    SEVERAL: ClassVar[bool] = True
    # An instrument may have two corners; one term alone leaves a part of the effect.
    MAY_LEAVE: ClassVar[float] = 0.75
    MEANING: ClassVar[str] = (
        'The instrument is AC-coupled: the relaxation comes from its high-pass.')
    REMEDY: ClassVar[str] = (
        'Repeat with DC coupling; use the alpha of this model for the rail, not the alpha of the '
        'plain fit.')
    SEPARATED_BY: ClassVar[str] = 'the same rail DC-coupled'

    corner: float = parameter('Hz', 'corner (-3 dB) of the high-pass', 0.0, above=True)
    offset: float = parameter('V', 'mean level of the readings')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        low = x_before = level_before = math.nan
        rate = 2.0 * math.pi * self.corner

        def effect(s: Segment) -> None:
            nonlocal low, x_before, level_before
            level = s.voltage - s.x
            draws = rng.standard_normal(s.t.size)
            alpha, step = s.alpha.copy(), s.step.copy()
            first = math.isnan(low)
            if first:
                # Draw from the stationary law given x, for a level that was always constant.
                of_x = rate / (rate + alpha[0])
                spread = s.sigma[0] ** 2 / (2.0 * alpha[0]) * s.power[0] * of_x * (1.0 - of_x)
                low = float(level[0] + of_x * s.x[0] + math.sqrt(spread) * draws[0])
                x_before, level_before, step[0] = float(s.x[0]), float(level[0]), 0.0
            start, end, spread = bridge(alpha, rate, step)
            decay = np.exp(-rate * step)
            x_old = np.concatenate(([x_before], s.x[:-1]))
            level_old = np.concatenate(([level_before], level[:-1]))
            e = start * x_old + end * s.x + s.sigma * np.sqrt(spread * s.power) * draws
            # Response to a straight line from level_old to level.
            mean = np.where(step > 0.0, -np.expm1(-rate * step) / np.where(
                step > 0.0, rate * step, 1.0), 1.0)
            e += (mean - decay) * level_old + (1.0 - mean) * level
            if first:
                e[0], decay[0] = low, 0.0
            path = first_order(decay, e, low)
            low, x_before, level_before = float(path[-1]), float(s.x[-1]), float(level[-1])
            s.voltage -= path - self.offset

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return couplings whose corner is the fitted relaxation rate, and a quarter of it."""
        rate = -math.log(max(float(np.median(view.phi[1:])), 1e-300)) * view.rate / (2.0 * math.pi)
        return [cls(rate, 0.0), cls(0.25 * rate, 0.0)]

    def beside(self, ou: Term) -> Term:
        """Return a slow `ou`, because the relaxation fitted so far may be the instrument's."""
        return ou.read({**ou.values(), 'alpha': 0.3 * math.pi * self.corner})

    def pass_through(self, columns: FloatArray, s: Segment) -> FloatArray:
        """Return columns of the mean after the high-pass."""
        shown = np.empty_like(columns)
        for k in range(columns.shape[1]):
            alone = replace(s, x=np.zeros(s.t.size), sigma=np.zeros(s.t.size),
                            voltage=columns[:, k].copy())
            replace(self, offset=0.0).start(np.random.default_rng(0))(alone)
            shown[:, k] = alone.voltage
        return shown


def bridge(alpha: FloatArray, rate: float, step: FloatArray
           ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return start, end and spread of one step of a low-passed OU, given the OU at both ends."""
    # l_k = exp(-rate step) l_{k-1} + start x_{k-1} + end x_k + sigma sqrt(spread) z, with l the
    # low-passed x, and z normal.
    a = np.where(np.abs(alpha / rate - 1.0) < _APART, rate * (1.0 + _APART), alpha)
    share = rate / (rate - a)
    xx = -np.expm1(-2.0 * a * step) / (2.0 * a)
    both = -np.expm1(-(a + rate) * step) / (a + rate)
    ll = -np.expm1(-2.0 * rate * step) / (2.0 * rate)
    xl = share * (xx - both)
    end = np.divide(xl, xx, out=np.zeros_like(xx), where=xx > 0.0)
    phi = np.exp(-a * step)
    start = share * (phi - np.exp(-rate * step)) - end * phi
    spread = share * share * (xx - 2.0 * both + ll) - end * xl
    return start, end, np.maximum(spread, 0.0)
