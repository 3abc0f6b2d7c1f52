"""How the mean voltage responds to throttle: sag, lag, inrush, slow polarisation."""

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


# Evidence required for a growth in addition to the penalty of its parameter, nats.  Without this
# requirement, a growth was found in 5 of 72 simulated flights with a steady sag; with it, in none.
_GROWS = 6.0


@dataclass(frozen=True)
class LoadSag(Term):
    """
    Subtract (linear + growth * t) * throttle + square * throttle^2 from the level.

    t is the time since the first sample.  The growth describes a pack whose resistance rises as it
    empties, and falls as it warms.  A square or growth of exactly 0 is not fitted.
    """

    NAME: ClassVar[str] = 'load_sag'
    FAMILY: ClassVar[str] = 'load'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.MEAN
    LINEAR: ClassVar[tuple[str, ...]] = by_parameters(
        ('linear', 'square', 'growth'), lambda term: (
            'linear', *(name for name in ('square', 'growth') if getattr(term, name))))
    SIGNS: ClassVar[tuple[str, ...]] = ('throttle', 'growing effect')
    SEARCH: ClassVar[float] = by_parameters(0.0, lambda term: _GROWS if term.growth else 0.0)
    MEASURED: ClassVar[bool] = True
    LIVE: ClassVar[bool] = True
    MEANING: ClassVar[str] = (
        'The mean falls with throttle: IR drop of battery, leads and regulator. The estimates are '
        'settled values; sag and resistance of the supply refer to 1 s after a step.')
    REMEDY: ClassVar[str] = (
        'Give the estimator the throttle, so that it removes the sag; thicker or shorter leads '
        'reduce it.')
    SEPARATED_BY: ClassVar[str] = 'throttle held for some seconds at several levels'

    linear: float = parameter('V', 'drop at full throttle, linear part',
                              label='settled fall, linear')
    square: float = parameter('V', 'drop at full throttle, quadratic part',
                              label='settled fall, square')
    growth: float = parameter('V/s', 'growth of the linear part', default=0.0)

    def change(self, s: Segment) -> None:
        linear = self.linear + self.growth * (s.at - s.origin)
        s.level -= (linear + self.square * s.throttle) * s.throttle

    def at(self, t: float) -> LoadSag:
        """Return the sag t seconds after the first sample, without growth."""
        return LoadSag(self.linear + self.growth * t, self.square)

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a straight line, a parabola, and a parabola that grows."""
        # A straight line is not combined with growth, because the search would then add a slow
        # transient for the curvature.
        return cls(0.0, 0.0), cls(0.0, NEXT_TO_ZERO), cls(0.0, NEXT_TO_ZERO, NEXT_TO_ZERO)


# Evidence per sample, nats, that `lagged` needs beyond other forms: errors shrink by 0.2 %.
# Chosen on 12 simulated packs, gecko and cf_takeoff; in the recordings, the forms nearly tie.
_LAGGED = 0.002
# Tolerance of stamps, s: the resolution of a bag.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class LoadTransient(Term):
    """
    Add gain * d(u) + square * d(u^2) + lagged * (u^2 - low(u)^2) + rise * max(d(u), 0).

    u is the delayed throttle, low(x) the low-pass of x (tau), and d(x) = x - low(x).  A unit step
    up adds (gain + rise) * exp(-t/tau), and a unit step down adds -gain * exp(-t/tau): motors draw
    more current while they speed up, but return no current while they slow down.  gain > 0 delays
    the sag; gain < 0 deepens it at first (inrush).  If gain and square equal the sag's linear and
    square, the sag is low-passed; if gain and lagged do, throttle is low-passed before the sag,
    as by a motor whose speed lags.
    """

    NAME: ClassVar[str] = 'load_transient'
    FAMILY: ClassVar[str] = 'load'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.MEAN
    # A rise, square or lagged of 0 is not fitted.
    LINEAR: ClassVar[tuple[str, ...]] = by_parameters(
        ('gain', 'rise', 'square', 'lagged'), lambda term: (
            'gain', *(name for name in ('rise', 'square', 'lagged') if getattr(term, name))))
    SIGNS: ClassVar[tuple[str, ...]] = ('throttle',)
    SEARCH: ClassVar[float] = 3.4
    FORM_COST: ClassVar[float] = by_parameters(0.0, lambda term: _LAGGED * (term.lagged != 0.0))
    MEASURED: ClassVar[bool] = True
    SEVERAL: ClassVar[bool] = True
    RECURS: ClassVar[bool] = True
    MEANING: ClassVar[str] = by_parameters(
        'The mean responds to changes of throttle: lag, inrush or slow recovery of polarisation.',
        lambda term: term.about()[0])
    REMEDY: ClassVar[str] = by_parameters(
        'Include the fall after a throttle step in the brown-out margin.',
        lambda term: term.about()[1])
    SEPARATED_BY: ClassVar[str] = (
        'single steps of throttle, each held for ten times the time constant of the response')

    gain: float = parameter('V', 'part of a step to full throttle that decays with tau',
                            label='decaying part')
    tau: float = parameter('s', 'time constant of the decay', 0.0, above=True)
    delay: float = parameter('s', 'delay before the response begins', 0.0)
    rise: float = parameter('V', 'added to the gain while throttle rises', default=0.0)
    square: float = parameter('V', 'decaying part that follows the square of throttle',
                              label='decaying part, square', default=0.0)
    lagged: float = parameter('V', 'decaying part that follows the square of the lagging throttle',
                              label='decaying part, square of the lag', default=0.0)

    def about(self) -> tuple[str, str]:
        """Return meaning and remedy of a response of this sign and time constant."""
        kind = type(self)
        late = self.gain + self.rise + self.square + self.lagged > 0.0
        return (kind.MEANING, kind.REMEDY) if self.delay else _ABOUT[self.tau > _INRUSH, late]

    def start(self, rng: np.random.Generator) -> Effect:
        slow: dict[int, float] = {}
        times = np.empty(0)
        values = np.empty(0)
        last = math.nan

        def effect(s: Segment) -> None:
            nonlocal times, values, last
            throttle = s.throttle
            if self.delay > 0.0:
                # Use the throttle `delay` ago; at the beginning, the first throttle.
                times = np.concatenate((times, s.at))
                values = np.concatenate((values, throttle))
                # Tolerance for rounding, in case the delay is a whole number of steps.
                rounding = _ROUNDING + 2.0 * np.spacing(np.abs(s.at))
                then = np.searchsorted(times, s.at - self.delay + rounding, side='right') - 1
                throttle = values[np.maximum(then, 0)]
                keep = max(int(then[-1]), 0)
                times, values = times[keep:], values[keep:]
            phi = np.exp(-s.step / self.tau)
            # Each throttle holds until the next one.
            held = np.concatenate((throttle[:1] if math.isnan(last) else [last], throttle[:-1]))
            last = float(throttle[-1])

            def change(power: int) -> FloatArray:
                value, before = throttle ** power, held ** power
                low = first_order(phi, (1.0 - phi) * before, slow.get(power, float(before[0])))
                slow[power] = float(low[-1])
                return value - low

            if self.gain or self.rise or self.lagged:
                linear = change(1)
                s.level += self.gain * linear + self.rise * np.maximum(linear, 0.0)
                # u^2 - low^2 with low = u - linear.
                s.level += self.lagged * (2.0 * throttle - linear) * linear
            if self.square:
                s.level += self.square * change(2)

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return time constants from half a step to an eighth of the recording, and delays."""
        step = 1.0 / view.rate
        longest = LONGEST * float(view.at[-1])
        if longest <= 2.0 * step:
            return ()
        count = max(2, math.ceil(2.0 * math.log2(longest / (SHORTEST * step))))
        lags = [cls(0.0, float(tau), 0.0) for tau in np.geomspace(
            SHORTEST * step, longest, count)]
        # A pure delay, of whole steps, is a response that never decays.
        latest = max(_LATEST, 4.0 * step)
        delays = np.unique(np.rint(np.geomspace(step, latest, _DELAYS) / step)) * step
        late = [cls(0.0, _LASTING / LONGEST * longest, float(delay)) for delay in delays]
        return tuple(form for term in (*lags, *late) for form in term.forms(view.by_current))

    def forms(self, by_current: bool) -> tuple[LoadTransient, ...]:
        """Return variants to fit: linear, with a square, and those of motors if fast enough."""
        names = ['square']
        if self.tau < _INRUSH and not self.delay:
            # A measured current does not lag behind the motors.
            names += ['rise'] if by_current else ['rise', 'lagged']
        plain = replace(self, rise=0.0, square=0.0, lagged=0.0)
        return plain, *(replace(plain, **{name: NEXT_TO_ZERO}) for name in names)


# Shortest visible time constant, in steps: a seventh of the response remains at the next sample.
SHORTEST = 0.5
# Longest time constant, as a share of the recording, because a slower response looks like a drift
# (with 0.25, held-out scores of ar8, jd and cf_takeoff were lower).
LONGEST = 0.125
# Longest time that motors take to speed up, s.
_INRUSH = 0.2
# Meaning and remedy; keys: whether the response is slower than the motors, and whether it delays
# the fall rather than deepening it.
_ABOUT = {
    (False, True): ('Part of the fall lags behind throttle: motors and filters respond late.',
                    'Expect a smaller fall in short bursts of throttle.'),
    (False, False): ('The voltage falls deepest just after throttle rises: inrush of motors.',
                     'Include this fall in the brown-out margin; capacitance at the ESC reduces '
                     'it.'),
    (True, True): ('Part of the fall follows throttle slowly, and recovers as slowly: '
                   'polarisation of a battery, or a slow regulator.',
                   'Set the brown-out margin for the longest burst of throttle.'),
    (True, False): ('Part of the fall after a rise of throttle recovers while throttle is held: a '
                    'regulator corrects it, or a battery warms.',
                    LoadTransient.REMEDY)}
# Number of delays to try, and maximum delay, s.
_DELAYS, _LATEST = 12, 0.1
# Time constant, in durations of the recording, for a response that never decays.
_LASTING = 100.0
