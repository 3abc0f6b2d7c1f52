"""Markov switching of the mean or of sigma, unrelated to throttle."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.term import Effect, parameter, Stage, Stretch, Term


@dataclass(frozen=True)
class RegimeSwitching(Term):
    """
    Switch between two states; in the second, add a level and multiply sigma.

    Exact in law: the instants of switching are drawn, and sigma is integrated over
    the part of a step that it holds for.
    """

    NAME: ClassVar[str] = 'regime_switching'
    FAMILY: ClassVar[str] = 'switching'
    STAGE: ClassVar[Stage] = Stage.DRIVE

    rate_up: float = parameter('1/s', 'rate of going into the second state', 0.0, above=True)
    rate_down: float = parameter('1/s', 'rate of leaving it', 0.0, above=True)
    level: float = parameter('V', 'what the second state adds to the level')
    sigma_ratio: float = parameter('', 'sigma in the second state / in the first', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        waits = rng
        up = False
        next_at = math.nan

        def effect(s: Stretch) -> None:
            nonlocal up, next_at
            if math.isnan(next_at):
                up = bool(rng.random() * (self.rate_up + self.rate_down) < self.rate_up)
                next_at = float(s.at[0]) + waits.standard_exponential() / (
                    self.rate_down if up else self.rate_up)
            times = []
            states = [up]
            while next_at <= s.at[-1]:
                up = not up
                times.append(next_at)
                states.append(up)
                next_at += waits.standard_exponential() / (self.rate_down if up else self.rate_up)
            when = np.array(times)
            seen = np.array(states, dtype=np.float64)
            # The state at each sample, and at the begin of each step.
            now = seen[np.searchsorted(when, s.at, side='right')]
            before = np.concatenate(([seen[0]], now[:-1]))
            s.level += self.level * now
            more = self.sigma_ratio * self.sigma_ratio - 1.0
            if more == 0.0:
                return
            factor = 1.0 + more * before
            # What is left of a change within a step: the share of the step's
            # noise that comes after it.
            k = np.searchsorted(s.at, when)
            share = np.expm1(-2.0 * s.alpha[k] * (s.at[k] - when)) / np.expm1(
                -2.0 * s.alpha[k] * s.step[k])
            np.add.at(factor, k, more * share * np.diff(seen))
            s.power *= np.maximum(factor, 0.0)

        return effect
