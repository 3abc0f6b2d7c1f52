"""Response of the mean to throttle: immediate sag, lag, inrush, slow polarisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.segment import Effect, first_order, Segment, Stage
from ou_monitor.model.terms.term import by_parameters, NEXT_TO_ZERO, parameter, Role, Term


# Evidence that a growth must gain beyond the price of its parameter, nats: that of a cause.
# Without it, 5 of 72 simulated flights with a steady sag were said to grow; with it, none.
_GROWS = 6.0


@dataclass(frozen=True)
class LoadSag(Term):
    """
    Subtract (linear + growth * t) * throttle + square * throttle^2 from the level.

    t counts from the first sample: the resistance of a pack grows as it empties, and falls as it
    warms.  A square or growth of exactly 0 is left out, of a fit too.
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
        'The mean falls with throttle: IR drop of battery, leads and regulator.')
    REMEDY: ClassVar[str] = (
        'Give the estimator throttle, so that it takes the sag out; thicker or shorter leads '
        'reduce it.')
    SEPARATED_BY: ClassVar[str] = 'throttle held for some seconds at several levels'

    linear: float = parameter('V', 'fall at full throttle, linear part')
    square: float = parameter('V', 'fall at full throttle, square part')
    growth: float = parameter('V/s', 'growth of the linear part', default=0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            linear = self.linear + self.growth * (s.at - s.origin)
            s.level -= (linear + self.square * s.throttle) * s.throttle

        return effect

    def at(self, t: float) -> LoadSag:
        """Return the sag as it is t seconds after the first sample, growing no more."""
        return LoadSag(self.linear + self.growth * t, self.square)

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a straight line and a parabola, each as it stays and as it grows."""
        return tuple(cls(0.0, square, growth) for growth in (0.0, NEXT_TO_ZERO)
                     for square in (0.0, NEXT_TO_ZERO))


# Difference below which stamps are equal, s: bags count in ns.
_HAIR = 1e-9


@dataclass(frozen=True)
class LoadTransient(Term):
    """
    Add gain * (throttle - its low-pass of time constant tau), after a delay, and rise * its rises.

    A step of throttle shows as gain * exp(-t/tau), one upwards as (gain + rise) * exp(-t/tau):
    motors draw more as they run up, and give nothing back as they run down.  gain of the sign of
    the sag (> 0 when the voltage falls) delays the sag: with gain equal to the sag it is
    low-passed.  gain < 0 deepens the fall at first (inrush).
    """

    NAME: ClassVar[str] = 'load_transient'
    FAMILY: ClassVar[str] = 'load'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.MEAN
    # The rise is left out of a fit where it is 0.
    LINEAR: ClassVar[tuple[str, ...]] = by_parameters(
        ('gain', 'rise'), lambda term: ('gain', 'rise') if term.rise else ('gain',))
    SIGNS: ClassVar[tuple[str, ...]] = ('throttle',)
    SEARCH: ClassVar[float] = 3.4
    MEASURED: ClassVar[bool] = True
    SEVERAL: ClassVar[bool] = True
    RECURS: ClassVar[bool] = True
    MEANING: ClassVar[str] = (
        'The mean answers to changes of throttle: lag, inrush or slow polarisation recovery.')
    REMEDY: ClassVar[str] = (
        'Count the dip after a throttle step into the brown-out margin; capacitance at the ESC '
        'shortens it.')
    SEPARATED_BY: ClassVar[str] = (
        'single steps of throttle, each held for ten times the time in which the answer dies out')

    gain: float = parameter('V', 'answer to a step of full throttle, at once')
    tau: float = parameter('s', 'time in which it dies out', 0.0, above=True)
    delay: float = parameter('s', 'time until the answer begins', 0.0)
    rise: float = parameter('V', 'more of it where throttle rises', default=0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        slow = math.nan
        times = np.empty(0)
        values = np.empty(0)

        def effect(s: Segment) -> None:
            nonlocal slow, times, values
            throttle = s.throttle
            if self.delay > 0.0:
                # What was set `delay` ago; before the first sample, what it had.
                times = np.concatenate((times, s.at))
                values = np.concatenate((values, throttle))
                # A margin for rounding, for delays of whole steps.
                hair = _HAIR + 2.0 * np.spacing(np.abs(s.at))
                then = np.searchsorted(times, s.at - self.delay + hair, side='right') - 1
                throttle = values[np.maximum(then, 0)]
                keep = max(int(then[-1]), 0)
                times, values = times[keep:], values[keep:]
            if math.isnan(slow):
                slow = float(throttle[0])
            phi = np.exp(-s.step / self.tau)
            low = first_order(phi, (1.0 - phi) * throttle, slow)
            slow = float(low[-1])
            change = throttle - low
            s.level += self.gain * change + self.rise * np.maximum(change, 0.0)

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return time constants from half a step to a quarter of the recording, and delays."""
        step = 1.0 / view.rate
        longest = 0.25 * float(view.at[-1])
        if longest <= 2.0 * step:
            return ()
        count = max(2, math.ceil(2.0 * math.log2(longest / (SHORTEST * step))))
        lags = [cls(0.0, float(tau), 0.0) for tau in np.geomspace(
            SHORTEST * step, longest, count)]
        # Late by whole steps, and for good: a delay.
        latest = max(_LATEST, 4.0 * step)
        late = np.unique(np.rint(np.geomspace(step, latest, _DELAYS) / step)) * step
        inrush = [cls(0.0, lag.tau, 0.0, NEXT_TO_ZERO) for lag in lags if lag.tau < _INRUSH]
        return [*lags, *inrush, *(
            cls(0.0, _FOR_GOOD * 4.0 * longest, float(delay)) for delay in late)]


# Steps of the recording in the shortest time constant that it shows: a seventh of the answer is
# left at the next reading.
SHORTEST = 0.5
# Longest time in which motors run up, s.
_INRUSH = 0.2
# Delays tried, and the longest of them, s.
_DELAYS, _LATEST = 12, 0.1
# Share of a recording's duration in which a response loses a hundredth: it cannot follow a trend.
_FOR_GOOD = 100.0
