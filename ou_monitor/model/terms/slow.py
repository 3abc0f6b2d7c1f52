"""Slow changes besides the OU (trend, second relaxation, 1/f noise), and AC coupling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.ou import first_order
from ou_monitor.model.terms.term import (
    by_parameters, Effect, NEXT_TO_ZERO, parameter, Role, Segment, Stage, Term, View)
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class Drift(Term):
    """
    Add rate * t + curvature * t^2 + charge * q.

    t is the time since the first sample, s, and q the integral of throttle since then, s.  A
    curvature or charge of 0 is not fitted.
    """

    NAME = 'drift'
    FAMILY = 'slow'
    STAGE = Stage.LEVEL
    NEEDS_THROTTLE = by_parameters(False, lambda term: term.charge != 0.0)
    ROLE = Role.MEAN
    LINEAR = by_parameters(
        ('rate', 'curvature', 'charge'), lambda term: (
            'rate', *(name for name in ('curvature', 'charge') if getattr(term, name))))
    SIGNS = ('time', 'band 0')
    MEASURED = True
    # The form of a larger effect is never exact, and a trend may explain the little that is left.
    LEAST_SHARE = 0.02
    MEANING: ClassVar[str] = by_parameters(
        'The mean moves slowly (a fall is negative): discharge or warming.',
        lambda term: ('The mean moves slowly, by rate without load plus charge at full load (a '
                      'fall is negative): discharge or warming.')
        if term.charge else Drift.MEANING)
    REMEDY = 'Use a window in which the drift is small, or remove the trend first.'
    SEPARATED_BY = 'a recording several times as long'

    rate: float = parameter('V/s', 'slope at the first sample, without load')
    curvature: float = parameter('V/s^2', 'coefficient of t^2')
    charge: float = parameter('V/s', 'slope added at full load', default=0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        drawn = 0.0

        def effect(s: Segment) -> None:
            nonlocal drawn
            t = s.at - s.origin
            s.level += (self.rate + self.curvature * t) * t
            if self.charge:
                # The first sample has no step before it.
                step = np.where(np.isfinite(s.step), s.step, 0.0)
                sums = drawn + np.cumsum(step * s.throttle)
                drawn = float(sums[-1])
                s.level += self.charge * sums

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a straight line, a parabola, and both with the charge drawn by the load."""
        forms = cls(0.0, 0.0), cls(0.0, NEXT_TO_ZERO)
        return forms if view.throttle is None else (
            *forms, *(replace(form, charge=NEXT_TO_ZERO) for form in forms))


# Minimum number of relaxation times in a recording, and maximum number in a step: with more, at
# most 5 % of a deviation reaches the next sample, so the noise looks white.
_LEAST = 3.0


@dataclass(frozen=True)
class SecondRelaxation(Term):
    """Add an independent OU."""

    NAME = 'second_relaxation'
    FAMILY = 'slow'
    STAGE = Stage.LEVEL
    ROLE = Role.BLOCK
    FREE = ('alpha', 'sigma')
    SLOW_FIT = True
    BROAD = True
    SIGNS = ('band', 'autocorrelation')
    STATES = 1
    IMITATES = ('flicker_noise', 'regime_switching')
    SEVERAL = True
    RECURS = True
    MEANING = (
        'A second relaxation, with its own rate, adds to the first: a second storage element.')
    REMEDY = 'Keep both relaxations in the model: a single alpha describes neither.'
    SEPARATED_BY = 'a recording ten times as long, $load held still'

    alpha: float = parameter('1/s', 'its relaxation rate', 0.0, above=True)
    sigma: float = parameter('V/sqrt(s)', 'its noise intensity', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        before = 0.0

        def effect(s: Segment) -> None:
            nonlocal before
            phi = np.exp(-self.alpha * s.step)
            var = -np.expm1(-2.0 * self.alpha * s.step) / (2.0 * self.alpha)
            x = first_order(phi, self.sigma * np.sqrt(var) * rng.standard_normal(s.t.size), before)
            before = float(x[-1])
            s.level += x

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return candidates slower and faster than the ou, with less variance."""
        rate = -math.log(max(float(np.median(view.phi[1:])), 1e-300)) * view.rate
        spread = float(np.std(view.residual))
        slowest = _LEAST / float(view.at[-1])
        found = [cls(a, 0.5 * spread * math.sqrt(2.0 * a))
                 for a in (rate / 60.0, rate / 15.0, rate / 4.0) if a > slowest]
        return [*found, cls(6.0 * rate, 0.3 * spread * math.sqrt(12.0 * rate))]

    def holds(self, view: View) -> bool:
        """Return whether the relaxation fits into the recording, but not into a step."""
        return _LEAST / float(view.at[-1]) < self.alpha < _LEAST * view.rate

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        phi = np.exp(-self.alpha * s.step)
        q = self.sigma * self.sigma * -np.expm1(-2.0 * self.alpha * s.step) / (2.0 * self.alpha)
        return phi[:, None, None], q[:, None, None], np.ones(1)


# Octaves between poles, for simulations (before the low-pass, 1/f within 0.2 %) and for fits
# (within 6 %).
_FINE, _COARSE = 0.5, 3.0
# Last pole, and corner of the low-pass, relative to the upper frequency.  The low-pass removes
# 1.5 % at the upper frequency, and most of the noise above the last pole.
_LADDER, _CORNER = 4.5, 8.0
# Minimum ratio of the corner to the lower frequency; below it, one or two relaxations suffice.
_LEAST_SPAN = 30.0


@dataclass(frozen=True)
class FlickerNoise(Term):
    """
    Add noise of PSD amplitude^2 / f between two frequencies.

    A sum of OUs, two per octave, behind a first-order low-pass at 8 * high.  The one-sided PSD
    follows 1/f within 2 % from `low` to `high`, is flat below `low`, and falls as 1/f^3, then as
    1/f^4, above the corner, like noise behind a circuit of that bandwidth.  Exact in law at any
    spacing.
    """

    NAME = 'flicker_noise'
    FAMILY = 'slow'
    STAGE = Stage.LEVEL
    ROLE = Role.BLOCK
    FREE = ('amplitude', 'high')
    SLOW_FIT = True
    BROAD = True
    SIGNS = ('band', 'autocorrelation')
    # Minimum number of states; it grows by one every three octaves.
    STATES = 4
    IMITATES = ('regime_switching', 'second_relaxation')
    MEANING = '1/f noise: there is no single relaxation time.'
    REMEDY = 'Alpha depends on the length of the window: compare only windows of equal length.'
    SEPARATED_BY = 'a recording over two more decades of frequency'

    amplitude: float = parameter('V', 'square root of (f times PSD)', 0.0)
    low: float = parameter('Hz', 'lower end', 0.0, above=True)
    high: float = parameter('Hz', 'upper end; 1/8 of the corner of the low-pass', 0.0,
                            above=True)

    def check(self) -> None:
        """Check that low is below high."""
        if not self.low < self.high:
            raise ValueError(f'{self.NAME}: low must be below high, got {self.low:g} Hz and '
                             f'{self.high:g} Hz')

    def poles(self) -> FloatArray:
        """Return the relaxation rates before the low-pass, 1/s."""
        return _sum(self.low, _LADDER * self.high, _FINE)[0]

    def pole_std(self) -> FloatArray:
        """Return the standard deviation of each of the OUs, V."""
        return self.amplitude * np.sqrt(_sum(self.low, _LADDER * self.high, _FINE)[1])

    @property
    def corner(self) -> float:
        """Return the rate of the low-pass, 1/s."""
        return 2.0 * math.pi * _CORNER * self.high

    def start(self, rng: np.random.Generator) -> Effect:
        poles, std, rate = self.poles(), self.pole_std(), self.corner
        *sources, last = rng.spawn(poles.size + 1)
        before, low = np.zeros(poles.size), math.nan

        def effect(s: Segment) -> None:
            nonlocal low
            first = math.isnan(low)
            step = s.step.copy()
            if first:
                # Draw the state of the low-pass from its stationary law, not from a step.
                step[0] = 0.0
            driven, spread = np.zeros(s.t.size), np.zeros(s.t.size)
            of_first = 0.0
            for k, pole in enumerate(poles):
                phi = np.exp(-pole * s.step)
                e = std[k] * np.sqrt(-np.expm1(-2.0 * pole * s.step))
                x = first_order(phi, e * sources[k].standard_normal(s.t.size), before[k])
                of_old, of_new, left = bridge(pole, rate, step)
                driven += of_old * np.concatenate(([before[k]], x[:-1])) + of_new * x
                spread += 2.0 * pole * std[k] ** 2 * left
                before[k] = x[-1]
                share = rate / (rate + pole)
                if first:
                    of_first += share * x[0]
                    spread[0] += std[k] ** 2 * share * (1.0 - share)
            if first:
                driven[0] = of_first
            driven += np.sqrt(spread) * last.standard_normal(s.t.size)
            filtered = first_order(np.exp(-rate * s.step), driven, 0.0 if first else low)
            low = float(filtered[-1])
            s.level += filtered

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return noise over all frequencies of the recording, with a third of its variance."""
        low, high = 1.0 / float(view.at[-1]), 0.2 * view.rate / _CORNER
        if _CORNER * high < _LEAST_SPAN * low:
            return ()
        spread = float(np.std(view.residual))
        return (cls(spread * math.sqrt(0.3 / math.log(_CORNER * high / low)), low, high),)

    def holds(self, view: View) -> bool:
        """Return whether the range of 1/f is too wide to be one or two relaxations."""
        return bool(_CORNER * self.high > _LEAST_SPAN * self.low)

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return one state for each pole and one for the low-pass; for fits, few poles suffice."""
        poles, variances = _sum(self.low, _LADDER * self.high, _COARSE)
        variances = self.amplitude ** 2 * variances
        # Most recordings have only a few different steps.
        step, which = np.unique(s.step, return_inverse=True)
        rate, finite = self.corner, np.isfinite(step)
        last = poles.size
        f = np.zeros((step.size, last + 1, last + 1))
        q = np.zeros_like(f)
        f[:, last, last] = np.exp(-rate * step)
        share = rate / (rate + poles)
        for k, (pole, variance, of_long) in enumerate(zip(poles, variances, share, strict=True)):
            phi = np.exp(-pole * step)
            added = variance * -np.expm1(-2.0 * pole * step)
            of_old, of_new, left = bridge(pole, rate, np.where(finite, step, 0.0))
            f[:, k, k], q[:, k, k] = phi, added
            f[:, last, k] = of_old + of_new * phi
            q[:, k, last] = q[:, last, k] = np.where(finite, of_new * added, of_long * variance)
            q[:, last, last] += np.where(
                finite, of_new * of_new * added + 2.0 * pole * variance * left, of_long * variance)
        return f[which], q[which], np.eye(last + 1)[last]


def _sum(low: float, high: float, octaves: float) -> tuple[FloatArray, FloatArray]:
    """Return relaxation rates, 1/s, and variances whose one-sided PSD is nearly 1/f, V^2/Hz."""
    # The integral of 4 a / (a^2 + w^2) d(ln a) over all rates a is 1/f.  It is computed by the
    # midpoint rule between the ends, and by two-point Gauss-Legendre quadrature below the lower
    # end (in a) and above the upper end (in 1/a).
    count = max(1, math.ceil(math.log2(high / low) / octaves))
    width = math.log(high / low) / count
    inner = low * np.exp(width * (np.arange(count) + 0.5))
    nodes = 0.5 + np.array([-0.5, 0.5]) / math.sqrt(3.0)
    rates = 2.0 * math.pi * np.concatenate((low * nodes, inner, high / nodes))
    outer = 0.5 / nodes
    return rates, np.concatenate((outer, np.full(count, width), outer))


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

    NAME = 'ac_coupling'
    FAMILY = 'instrument'
    STAGE = Stage.INSTRUMENT
    ROLE = Role.BLOCK
    FREE = ('corner',)
    SLOW_FIT = True
    BROAD = True
    SIGNS = ('-band',)
    STATES = 1
    SEVERAL = True
    # An instrument may have two corners; one term alone leaves a part of the effect.
    MAY_LEAVE = 0.75
    MEANING = 'The instrument is AC-coupled: the relaxation comes from its high-pass.'
    REMEDY = (
        'Repeat with DC coupling; use the alpha of this model for the rail, not the alpha of the '
        'plain fit.')
    SEPARATED_BY = 'the same rail DC-coupled'

    corner: float = parameter('Hz', 'corner (-3 dB) of the high-pass', 0.0, above=True)
    offset: float = parameter('V', 'mean level of the readings')

    def start(self, rng: np.random.Generator) -> Effect:
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


def bridge(alpha: FloatArray | float, rate: float, step: FloatArray
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
