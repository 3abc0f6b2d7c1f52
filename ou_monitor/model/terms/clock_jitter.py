"""Time stamps are wrong by a random amount."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.hidden_chain import forward
from ou_monitor.model.terms.laws import (
    climb, curvature_se, LawFit, log_normal, mixture_cdf, normal_scores, View)
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class ClockJitter(Term):
    """
    Take each sample a random time off its stamp.

    Normal, but never so far that two samples change places: cut at 0.45 of the
    step on either side.
    """

    NAME: ClassVar[str] = 'clock_jitter'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.CLOCK
    ROLE: ClassVar[Role] = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('kurtosis', 'clustering')
    IMITATES: ClassVar[tuple[str, ...]] = ('glitches', 'heavy_tails', 'jumps')
    MEANING: ClassVar[str] = 'Time stamps are off by a random amount.'
    REMEDY: ClassVar[str] = 'Stamp in the interrupt of the ADC, not where the message is sent.'
    SEPARATED_BY: ClassVar[str] = 'stamps by the clock of the ADC recorded beside the others'

    std: float = parameter('s', 'standard deviation of the error of a stamp', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        last = -math.inf
        stamp = -math.inf

        def effect(s: Segment) -> None:
            nonlocal last, stamp
            gap = np.diff(s.t, prepend=stamp)
            # The step to come is not known at the end of a segment: that behind bounds both.
            bound = np.where(np.isfinite(gap), 0.45 * gap, 0.0)
            error = self.std * rng.standard_normal(s.t.size)
            # Uneven stamps: the sample before may have gone past this one.
            s.at = np.maximum(np.maximum.accumulate(s.t + np.clip(error, -bound, bound)), last)
            s.step = np.diff(s.at, prepend=last)
            last, stamp = float(s.at[-1]), float(s.t[-1])

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit hidden errors of the stamps: a step that is longer has more noise in it."""
        return cls._climbed(view, [math.log(0.2), 0.0], 40)

    def refit_law(self, view: View) -> LawFit | None:
        """Fit again, from where it was."""
        return self._climbed(view, [math.log(min(max(self.std * view.rate, 0.02), 0.44)), 0.0], 20)

    @classmethod
    def _climbed(cls, view: View, start: list[float], most: int) -> LawFit | None:
        """Return the fit near a start."""
        step = 1.0 / view.rate
        z = view.z[view.train]
        square = z * z
        if float(np.mean(square**2)) > _MOST_KURTOSIS or _together(square) > _MOST_TOGETHER:
            # Errors of half a step at the most leave less; and a step that was too
            # long makes the next too short.
            return None
        state = view.state / np.sqrt(view.variance)
        z, inside = z[:_SHORT], state[view.train][:_SHORT]
        phi = min(max(float(np.median(view.phi[1:])), _LEAST), 1.0 - _LEAST)

        def value(x: FloatArray) -> float:
            if not -4.0 < x[0] < -0.8:
                return -math.inf
            return float(_errors(z, inside, phi, x)[1].sum())

        x, _ = climb(value, start, most=most)
        before, density, std, mean, law = _errors(view.z, state, phi, x)
        weight = (before[:, :, None] * law[None, None, :]).reshape(view.z.size, -1)
        wide = np.broadcast_to(std.reshape(-1), weight.shape)
        moved = state[:, None] * mean.reshape(-1)
        scores = normal_scores(mixture_cdf(view.z, weight, moved, wide))
        error = math.exp(x[0]) * step
        return LawFit(cls(error), {'std': error * float(curvature_se(value, x)[0])}, scores,
                      density - log_normal(view.z), 2)


def _together(square: FloatArray) -> float:
    """Return the correlation of neighbouring squares, as a normal score."""
    c = square - square.mean()
    return math.sqrt(c.size) * float(c[1:] @ c[:-1]) / float(c @ c)


# Samples that the error is fitted on, the largest fourth moment it can leave, and
# the largest correlation of neighbouring squares: it makes that negative.
_SHORT, _MOST_KURTOSIS, _MOST_TOGETHER = 15000, 6.0, 4.0
# Levels of the error of a stamp.
_LEVELS = 7


# As near as coefficients come to 0 and 1.
_LEAST = 1e-12


def _errors(z: FloatArray, state: FloatArray, phi: float, x: FloatArray
            ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """
    Return the law of the error before, densities, scales, shifts of pairs, and the prior.

    A shift is what a step that is longer moves the score by, per score that the rail is
    away from its mean.
    """
    nodes = np.linspace(-2.4, 2.4, _LEVELS)
    law = np.exp(-0.5 * nodes * nodes)
    law /= law.sum()
    error = math.exp(x[0]) * nodes
    span = np.maximum(1.0 + error[None, :] - error[:, None], 0.05)
    keep = phi ** span
    var = math.exp(2.0 * x[1]) * (1.0 - keep * keep) / (1.0 - phi * phi)
    shift = keep - phi
    transition = np.broadcast_to(law, (_LEVELS, _LEVELS))
    log_density = log_normal(z, shift[:, :, None] * state, var[:, :, None])
    before, density = forward(log_density.transpose(2, 0, 1), transition, law)
    return before, density, np.sqrt(var), shift, law
