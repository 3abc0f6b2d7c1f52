"""Effects of the measurement: white noise, ADC steps and limits, repeats, wrong stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.hidden_chain import forward
from ou_monitor.model.terms.laws import (
    climb, curvature_se, log_normal, mixture_cdf, normal_scores, View)
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import LawFit, parameter, Role, Term
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class MeasurementNoise(Term):
    """Add independent normal errors."""

    NAME: ClassVar[str] = 'measurement_noise'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.SENSOR
    ROLE: ClassVar[Role] = Role.NOISE
    FREE: ClassVar[tuple[str, ...]] = ('std',)
    SIGNS: ClassVar[tuple[str, ...]] = ('-autocorrelation', '+band')
    MAY_LEAVE: ClassVar[float] = 0.3
    MEANING: ClassVar[str] = 'White noise of the sensor adds to the voltage of the rail.'
    REMEDY: ClassVar[str] = (
        'Average in the ADC or use a finer range; alpha and sigma fitted without it are too high.')
    SEPARATED_BY: ClassVar[str] = (
        'the same rail at several times the sampling rate, or the input of the ADC shorted')

    std: float = parameter('V', 'standard deviation', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            draws = rng.standard_normal(s.t.size)
            for shape in s.shape:
                draws = shape(draws)
            s.voltage += self.std * s.noise * draws

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a share of the one-step error."""
        error = math.sqrt(float(np.median(view.variance)))
        return [cls(0.1 * error), cls(0.4 * error)]

    def holds(self, view: View) -> bool:
        """Return whether it is a measurable share of the one-step error."""
        return self.variance() > _LEAST * float(np.median(view.variance))

    def variance(self) -> float:
        """Return the variance that this term adds to each measurement, V^2."""
        return self.std * self.std

    def variances(self, s: Segment) -> FloatArray | float:
        """Return the same at each sample."""
        return self.variance() * np.square(s.noise)


# Share of the one-step variance below which white noise counts as 0: it moves the likelihood of n
# samples by n/4 of its square, so that 10^7 samples would not show it.
_LEAST = 1e-3


@dataclass(frozen=True)
class LopsidedNoise(Term):
    """
    Make the draws of the white noise lopsided, of unchanged mean and variance.

    A draw is sinh((asinh(normal) + skew) / tail), less its mean and over its deviation (Jones &
    Pewsey, Biometrika 96 (2009) 761): skew < 0 has falls that are rarer and deeper than the
    rises, tail < 1 more of both.  It shapes `measurement_noise`; without one it does nothing.
    """

    NAME: ClassVar[str] = 'lopsided_noise'
    FAMILY: ClassVar[str] = 'events'
    STAGE: ClassVar[Stage] = Stage.INSTRUMENT
    ROLE: ClassVar[Role] = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('skewness', 'kurtosis', 'tails')
    IMITATES: ClassVar[tuple[str, ...]] = ('clock_jitter', 'glitches', 'heavy_tails', 'jumps')
    CHANGES: ClassVar[type[Term] | None] = MeasurementNoise
    MEANING: ClassVar[str] = (
        'The white noise is lopsided: bursts of load, shorter than the time between readings and '
        'not seen in throttle, make falls rarer and deeper than rises, or the other way round.')
    REMEDY: ClassVar[str] = (
        'Take the margin from the lower side of the noise, not from its deviation; capacitance at '
        'the ESCs makes short falls shallower.')
    SEPARATED_BY: ClassVar[str] = 'the same flight at several times the sampling rate'

    skew: float = parameter('', 'asymmetry: below 0 falls are deeper than rises')
    tail: float = parameter('', 'weight of the tails: 1 as a normal law, below 1 more', 0.0,
                            above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        mean, std = _moments(self.skew, self.tail)

        def effect(s: Segment) -> None:
            s.shape.append(lambda draws: (_lopsided(draws, self.skew, self.tail) - mean) / std)

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit it to scores that are white noise for the most part, their scale free."""
        white = 1.0 - np.broadcast_to(view.trust, view.z.shape)[view.train]
        found, paid = cls._climbed(view)
        # Tails alone are told apart by where they come from: other causes are.
        return found if float(white.mean()) > _MOSTLY and paid else None

    def refit_law(self, view: View) -> LawFit:
        """Fit again, whatever other laws have taken over: the evidence says what is left."""
        return self._climbed(view)[0]

    @classmethod
    def _climbed(cls, view: View) -> tuple[LawFit, bool]:
        """Return the fit, and whether its asymmetry gains more than a parameter costs."""
        z = view.z
        edges = np.unique(np.quantile(z[view.train], np.linspace(0.0, 1.0, _CELLS + 1)))
        cells = np.clip(np.searchsorted(edges, z[view.train]) - 1, 0, edges.size - 2)
        count = np.bincount(cells, minlength=edges.size - 1)
        some = count > 0
        count = count[some].astype(np.float64)
        centre = np.bincount(cells, z[view.train], edges.size - 1)[some] / count

        def value(x: FloatArray) -> float:
            return float(count @ _lopsided_scores(centre, *x)[1])

        skewed = float(np.sign(np.mean(z[view.train] ** 3)))
        x, most = climb(value, [0.1 * skewed, -0.1, 0.0], 0.2)
        even = climb(lambda x: value(np.array([0.0, *x])), x[1:], 0.2)[1]
        scores, gain = _lopsided_scores(z, *x)
        se = curvature_se(value, x)
        tail = math.exp(x[1])
        fit = LawFit(cls(float(x[0]), tail), {'skew': float(se[0]), 'tail': tail * float(se[1])},
                     np.clip(scores, -_FARTHEST, _FARTHEST), gain, 3)
        return fit, most - even > 0.5 * math.log(z[view.train].size)


# Share of white noise in the errors from which its law is theirs; cells of scores that a fit
# tells apart; the largest score that a law gives.
_MOSTLY, _CELLS, _FARTHEST = 0.5, 400, 8.0
# Points and weights of the normal law.
_NORMAL = np.polynomial.hermite_e.hermegauss(80)


def _lopsided(draws: FloatArray, skew: float, tail: float) -> FloatArray:
    """Return normal draws as the law has them, mean and deviation not set."""
    return np.asarray(np.sinh((np.arcsinh(draws) + skew) / tail))


def _moments(skew: float, tail: float) -> tuple[float, float]:
    """Return the mean and the deviation of the law."""
    points, weights = _NORMAL[0], _NORMAL[1] / _NORMAL[1].sum()
    values = _lopsided(points, skew, tail)
    mean = float(weights @ values)
    return mean, math.sqrt(float(weights @ (values - mean) ** 2))


def _lopsided_scores(z: FloatArray, skew: float, log_tail: float, log_scale: float
                     ) -> tuple[FloatArray, FloatArray]:
    """Return normal scores under the law, and gains in log density, nats."""
    tail = math.exp(min(max(log_tail, -1.5), 1.5))
    skew = min(max(skew, -3.0), 3.0)
    mean, std = _moments(skew, tail)
    unit = std * math.exp(-log_scale)
    y = mean + unit * z
    wide = tail * np.arcsinh(y) - skew
    scores = np.sinh(wide)
    slope = np.log(np.cosh(wide)) + math.log(tail * unit) - 0.5 * np.log1p(y * y)
    return scores, slope - 0.5 * scores * scores + 0.5 * z * z


@dataclass(frozen=True)
class Quantization(Term):
    """Round to whole steps, counted from 0 V."""

    NAME: ClassVar[str] = 'quantization'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.CODE
    ROLE: ClassVar[Role] = Role.NOISE
    MEANING: ClassVar[str] = 'The steps of the ADC are comparable to the noise.'
    REMEDY: ClassVar[str] = (
        'Use a finer range of the ADC or more gain ahead of it; sigma is partly rounding.')
    SEPARATED_BY: ClassVar[str] = 'the same rail with a finer range of the ADC'

    step: float = parameter('V', 'one code', 0.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.voltage = self.step * np.rint(s.voltage / self.step)

        return effect

    def variance(self) -> float:
        """Return the variance of rounding to whole steps, V^2."""
        return self.step * self.step / 12.0


@dataclass(frozen=True)
class Saturation(Term):
    """Keep the voltage within limits."""

    NAME: ClassVar[str] = 'saturation'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.CLIP
    ROLE: ClassVar[Role] = Role.EXACT
    MEANING: ClassVar[str] = 'The voltage is clipped at the end of the range of the ADC.'
    REMEDY: ClassVar[str] = (
        'Rescale the input: the true excursions are larger, and those are the ones that matter.')
    SEPARATED_BY: ClassVar[str] = 'the same rail with a larger range'

    low: float = parameter('V', 'lowest reading')
    high: float = parameter('V', 'highest reading')

    def check(self) -> None:
        """Check that the limits leave room."""
        if not self.low < self.high:
            raise ValueError(f'{self.NAME}: low must be below high, got {self.low:g} V and '
                             f'{self.high:g} V')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            np.clip(s.voltage, self.low, self.high, out=s.voltage)

        return effect


@dataclass(frozen=True)
class HeldSamples(Term):
    """Keep each value until 1/rate later."""

    NAME: ClassVar[str] = 'held_samples'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.LOGGER
    ROLE: ClassVar[Role] = Role.EXACT
    MEANING: ClassVar[str] = 'The logger repeats its last value until the source has a new one.'
    REMEDY: ClassVar[str] = (
        'Log at the rate of the source, or drop repeats before any fit (done here).')
    SEPARATED_BY: ClassVar[str] = 'the raw samples of the ADC'

    rate: float = parameter('Hz', 'rate at which the source has new values', 0.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        last = 0.0
        turn = -1.0

        def effect(s: Segment) -> None:
            nonlocal last, turn
            # A margin for rounding: a stamp at a refresh has the new value.
            hair = 1e-6 + 2.0 * self.rate * np.spacing(np.abs(s.t))
            turns = np.floor((s.t - s.origin) * self.rate + hair)
            fresh = np.diff(turns, prepend=turn) > 0.0
            at = np.maximum.accumulate(np.where(fresh, np.arange(s.t.size), -1))
            s.voltage = np.where(at >= 0, s.voltage[np.maximum(at, 0)], last)
            last, turn = float(s.voltage[-1]), float(turns[-1])

        return effect


@dataclass(frozen=True)
class ClockJitter(Term):
    """Take each sample a normal time off its stamp, cut at 0.45 of the step."""

    NAME: ClassVar[str] = 'clock_jitter'
    FAMILY: ClassVar[str] = 'sensor'
    STAGE: ClassVar[Stage] = Stage.CLOCK
    ROLE: ClassVar[Role] = Role.LAW
    DEAR: ClassVar[bool] = True
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
        phi = min(max(float(np.median(view.phi[1:])), _LEAST_JITTER), 1.0 - _LEAST_JITTER)

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
_LEAST_JITTER = 1e-12


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
