"""Effects of the measurement: noise, ADC resolution and range, repeats, wrong stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model.hidden_chain import forward
from ou_monitor.model.terms.term import (
    climb, curvature_se, Effect, LawFit, LOG_2PI, log_normal, mixture_cdf, normal_scores,
    parameter, Role, Segment, Stage, Term, View)
from ou_monitor.records import FloatArray
from scipy.special import ndtr


@dataclass(frozen=True)
class MeasurementNoise(Term):
    """Add independent normal errors."""

    NAME = 'measurement_noise'
    FAMILY = 'sensor'
    STAGE = Stage.SENSOR
    ROLE = Role.NOISE
    FREE = ('std',)
    SIGNS = ('-autocorrelation', '+band')
    MAY_LEAVE = 0.3
    MEANING = (
        'The readings have white noise: from the sensor, or from a rail that relaxes faster than '
        'the sampling, which looks the same.')
    REMEDY = (
        'Sample faster to tell sensor noise from a fast rail; against sensor noise, average in '
        'the ADC or use a finer range. Alpha and sigma fitted without this noise are too high.')
    SEPARATED_BY = (
        'the same rail at several times the sampling rate, or the input of the ADC shorted')

    std: float = parameter('V', 'standard deviation', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        def effect(s: Segment) -> None:
            draws = rng.standard_normal(s.t.size)
            for shape in s.shape:
                draws = shape(draws)
            s.voltage += self.std * s.noise * draws

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return starting points at two shares of the one-step error."""
        error = math.sqrt(float(np.median(view.variance)))
        return [cls(0.1 * error), cls(0.4 * error)]

    def holds(self, view: View) -> bool:
        """Return whether the noise is a measurable share of the one-step variance."""
        return self.variance() > _LEAST * float(np.median(view.variance))

    def variance(self) -> float:
        return self.std * self.std

    def variances(self, s: Segment) -> FloatArray | float:
        return self.variance() * np.square(s.noise)


# Share of the one-step variance below which white noise counts as 0: a share s changes the log
# likelihood of n samples by n s^2/4, which is too little to detect even with 10^7 samples.
_LEAST = 1e-3


@dataclass(frozen=True)
class LopsidedNoise(Term):
    """
    Make the white noise asymmetric or heavy-tailed, with the same mean and variance.

    A draw is sinh((asinh(normal) + skew) / tail), standardised (Jones & Pewsey, Biometrika 96
    (2009) 761).  With skew < 0, dips are rarer and deeper than rises; with tail < 1, both tails
    are heavier.  Without a `measurement_noise`, the term has no effect.
    """

    NAME = 'lopsided_noise'
    FAMILY = 'events'
    STAGE = Stage.INSTRUMENT
    ROLE = Role.LAW
    SIGNS = ('skewness', 'kurtosis', 'tails')
    IMITATES = ('clock_jitter', 'glitches', 'heavy_tails', 'jumps')
    CHANGES = MeasurementNoise
    MAY_LEAVE = 0.3
    MEANING = (
        'The white noise is asymmetric, with dips rarer and deeper than rises or the reverse: '
        'load pulses that are shorter than the time between readings and not visible in $load.')
    REMEDY = (
        'Take the margin from the quantile of the dips, not from the rms; capacitance at the ESCs '
        'makes short dips shallower.')
    SEPARATED_BY = 'the same flight at several times the sampling rate'

    skew: float = parameter('', 'asymmetry: below 0, dips are deeper than rises')
    tail: float = parameter('', '1: normal tails, below 1: heavier tails', 0.0,
                            above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        mean, std = _moments(self.skew, self.tail)

        def effect(s: Segment) -> None:
            s.shape.append(lambda draws: (_lopsided(draws, self.skew, self.tail) - mean) / std)

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit the scores, if the white noise makes them asymmetric; their scale is free."""
        found, paid = cls._best_fit(view)
        # Other causes describe heavy tails without asymmetry.
        return found if paid and _of_readings(view) else None

    def refit_law(self, view: View) -> LawFit:
        """Fit again, without the conditions of `fit_law`: evidence decides if the cause stays."""
        return self._best_fit(view)[0]

    @classmethod
    def _best_fit(cls, view: View) -> tuple[LawFit, bool]:
        """Return the fit, and whether the asymmetry gains more than the penalty of a parameter."""
        z = view.z
        white = max(_LEAST, 1.0 - float(np.median(view.trust)))
        edges = np.unique(np.quantile(z[view.train], np.linspace(0.0, 1.0, _CELLS + 1)))
        cells = np.clip(np.searchsorted(edges, z[view.train]) - 1, 0, edges.size - 2)
        count = np.bincount(cells, minlength=edges.size - 1)
        some = count > 0
        count = count[some].astype(np.float64)
        centre = np.bincount(cells, z[view.train], edges.size - 1)[some] / count

        def value(x: FloatArray) -> float:
            return float(count @ _lopsided_law(centre, white, *x)[0])

        skewed = float(np.sign(np.mean(z[view.train] ** 3)))
        x, most = climb(value, [0.1 * skewed, -0.1, 0.0], 0.2)
        even = climb(lambda x: value(np.array([0.0, *x])), x[1:], 0.2)[1]
        x = np.clip(x, *_RANGE)
        gain, below = _lopsided_law(z, white, *x)
        scores = normal_scores(below)
        se = curvature_se(value, x)
        tail = math.exp(x[1])
        factor, bias = _as_normal(z, white, x)
        fit = LawFit(cls(float(x[0]), tail), {'skew': float(se[0]), 'tail': tail * float(se[1])},
                     np.clip(scores, -_FARTHEST, _FARTHEST), gain, 3, white=factor,
                     bias=bias * np.sqrt(view.variance))
        return fit, most - even > 0.5 * math.log(z[view.train].size)


def _as_normal(z: FloatArray, white: float, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return factors on the white noise, and errors of the readings in units of the scores."""
    # A reading moves the mean of the state by the state's variance times the slope of the log
    # density (Masreliez, IEEE Trans. Autom. Control 20 (1975) 107).  A normal law does the same
    # with these variances and errors.  The variance is the score over the slope, as for a normal
    # law of unknown variance (ones are added because their zeros differ), and up to a factor such
    # that a fit of normal laws with these variances finds the size of the noise.
    low, high = (_lopsided_law(z + by, white, *x)[0] for by in (-_NUDGE, _NUDGE))
    slope = z - (high - low) / (2.0 * _NUDGE)
    square = z * z
    whole = (1.0 + square) / np.maximum(1.0 + z * slope, _FLAT)
    whole = np.maximum(whole * float(np.mean(square / whole) / np.mean(square)), 1.0 - white)
    return (whole - 1.0) / white + 1.0, z - slope * whole


def _of_readings(view: View) -> bool:
    """Return whether white noise, not the drive, causes most of the third moment of the scores."""
    # After an error of a reading, the next one has the opposite sign, times the gain of the
    # filter; after an excursion of the drive, it has the same sign, times the rest of the gain.
    z, phi, gain = (np.broadcast_to(each, view.z.shape)[view.train]
                    for each in (view.z, view.phi, view.trust))
    third = float(np.mean(z ** 3))
    after = float(np.mean(z[:-1] ** 2 * z[1:])) / third if third else 0.0
    return after < float(np.median(phi)) * (0.5 - float(np.median(gain)))


# Step of numerical slopes of a log density, and minimum of a divisor.
_NUDGE, _FLAT = 1e-2, 1e-2
_CELLS = 400  # Number of bins of scores in a fit
# Range of skew, ln tail and ln scale.
_RANGE = np.array([[-3.0, -1.5, -math.inf], [3.0, 1.5, math.inf]])
_FARTHEST = 8.0  # Limit at which scores are clipped
# Points and weights for expectations over a normal distribution.
_NORMAL = np.polynomial.hermite_e.hermegauss(80)


def _lopsided(draws: FloatArray, skew: float, tail: float) -> FloatArray:
    return np.asarray(np.sinh((np.arcsinh(draws) + skew) / tail))


def _moments(skew: float, tail: float) -> tuple[float, float]:
    """Return mean and standard deviation of the transformed draws."""
    points, weights = _NORMAL[0], _NORMAL[1] / _NORMAL[1].sum()
    values = _lopsided(points, skew, tail)
    mean = float(weights @ values)
    return mean, math.sqrt(float(weights @ (values - mean) ** 2))


def _lopsided_law(z: FloatArray, white: float, skew: float, log_tail: float, log_scale: float
                  ) -> tuple[FloatArray, FloatArray]:
    """Return gains in log density over N(0, 1), nats, and probabilities of lower scores."""
    # A score is the sum of white noise, a share `white` of its variance, and a normal rest.
    skew, log_tail, log_scale = np.clip((skew, log_tail, log_scale), *_RANGE).tolist()
    tail = math.exp(log_tail)
    mean, std = _moments(skew, tail)
    unit = std * math.exp(-log_scale) / math.sqrt(white)

    def normal(y: FloatArray) -> FloatArray:
        """Return the normal draw, less the skew, from which white noise is made."""
        return np.asarray(tail * np.arcsinh(mean + unit * y) - skew)

    share = np.diff(ndtr(np.sinh(normal(_EDGES))))
    share = np.fft.irfft(np.fft.rfft(share) * np.exp(-0.5 * (1.0 - white) * _OMEGA ** 2),
                         share.size)
    density = np.interp(z, _EDGES[:-1] + 0.5 * _CELL, share / _CELL, 0.0, 0.0)
    below = np.interp(z, _EDGES[1:], np.cumsum(share))
    far = np.flatnonzero(density < _LEAST_DENSITY)
    if far.size:
        y = z[far] - math.sqrt(1.0 - white) * _REST[0][:, None]
        wide = normal(y)
        scores = np.sinh(wide)
        below[far] = _REST[1] @ ndtr(scores)
        density[far] = _REST[1] @ (np.exp(-0.5 * scores * scores) * np.cosh(wide) / np.hypot(
            1.0, mean + unit * y)) * tail * unit / math.sqrt(2.0 * math.pi)
    return np.log(density + _TINY) + 0.5 * (z * z + LOG_2PI), below


# Cells of scores in which the density is computed by a Fourier transform, and their frequencies.
_CELL = 0.0125
_EDGES = _CELL * np.arange(-1000.0, 1001.0)
_OMEGA = 2.0 * np.pi * np.fft.rfftfreq(_EDGES.size - 1, _CELL)
# Density below which rounding errors of that transform matter, and a quadrature over the normal
# rest takes its place: its points and weights.
_LEAST_DENSITY = 1e-9
_REST = tuple(part / scale for part, scale in zip(
    np.polynomial.hermite_e.hermegauss(12), (1.0, math.sqrt(2.0 * math.pi)), strict=True))
_TINY = 1e-300


@dataclass(frozen=True)
class Quantization(Term):
    """Round to a multiple of `step`."""

    NAME = 'quantization'
    FAMILY = 'sensor'
    STAGE = Stage.CODE
    ROLE = Role.NOISE
    MEANING = 'The resolution of the ADC is comparable to the noise.'
    REMEDY = 'Use a smaller range of the ADC or more gain before it; a part of sigma is rounding.'
    SEPARATED_BY = 'the same rail with a smaller range of the ADC'

    step: float = parameter('V', 'resolution, one code', 0.0, above=True)

    def change(self, s: Segment) -> None:
        s.voltage = self.step * np.rint(s.voltage / self.step)

    def variance(self) -> float:
        return self.step * self.step / 12.0


@dataclass(frozen=True)
class Saturation(Term):
    """Clip the voltage at limits."""

    NAME = 'saturation'
    FAMILY = 'sensor'
    STAGE = Stage.CLIP
    ROLE = Role.EXACT
    MEANING = 'The voltage is clipped at the end of the range of the ADC.'
    REMEDY = 'Rescale the input: the true excursions are larger than recorded.'
    SEPARATED_BY = 'the same rail with a larger range'

    low: float = parameter('V', 'lowest reading')
    high: float = parameter('V', 'highest reading')

    def check(self) -> None:
        """Check that low is below high."""
        if not self.low < self.high:
            raise ValueError(f'{self.NAME}: low must be below high, got {self.low:g} V and '
                             f'{self.high:g} V')

    def change(self, s: Segment) -> None:
        np.clip(s.voltage, self.low, self.high, out=s.voltage)


@dataclass(frozen=True)
class HeldSamples(Term):
    """Repeat each value for 1/rate."""

    NAME = 'held_samples'
    FAMILY = 'sensor'
    STAGE = Stage.LOGGER
    ROLE = Role.EXACT
    MEANING = 'The logger repeats the last value until the source has a new one.'
    REMEDY = 'Log at the rate of the source, or remove repeats before a fit, as this program does.'
    SEPARATED_BY = 'the raw samples of the ADC'

    rate: float = parameter('Hz', 'update rate of the source', 0.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        last = 0.0
        turn = -1.0

        def effect(s: Segment) -> None:
            nonlocal last, turn
            # Tolerance for rounding, because a stamp at the time of an update has the new value.
            hair = 1e-6 + 2.0 * self.rate * np.spacing(np.abs(s.t))
            turns = np.floor((s.t - s.origin) * self.rate + hair)
            fresh = np.diff(turns, prepend=turn) > 0.0
            at = np.maximum.accumulate(np.where(fresh, np.arange(s.t.size), -1))
            s.voltage = np.where(at >= 0, s.voltage[np.maximum(at, 0)], last)
            last, turn = float(s.voltage[-1]), float(turns[-1])

        return effect


@dataclass(frozen=True)
class ClockJitter(Term):
    """Take each sample at its stamp plus a normal error, clipped at 0.45 of the step."""

    NAME = 'clock_jitter'
    FAMILY = 'sensor'
    STAGE = Stage.CLOCK
    ROLE = Role.LAW
    SLOW_FIT = True
    SIGNS = ('kurtosis', 'clustering')
    IMITATES = ('glitches', 'heavy_tails', 'jumps')
    MEANING = 'Time stamps have random errors.'
    REMEDY = 'Take the stamp in the interrupt of the ADC, not when sending.'
    SEPARATED_BY = 'a recording that also has the stamps of the ADC'

    std: float = parameter('s', 'standard deviation of the error of a stamp', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        last = -math.inf
        stamp = -math.inf

        def effect(s: Segment) -> None:
            nonlocal last, stamp
            gap = np.diff(s.t, prepend=stamp)
            # Limit the error by the step before the sample, because at the end of a segment the
            # next step is unknown.
            bound = np.where(np.isfinite(gap), 0.45 * gap, 0.0)
            error = self.std * rng.standard_normal(s.t.size)
            # With uneven stamps, the errors may swap two samples, but times must not decrease.
            s.at = np.maximum(np.maximum.accumulate(s.t + np.clip(error, -bound, bound)), last)
            s.step = np.diff(s.at, prepend=last)
            last, stamp = float(s.at[-1]), float(s.t[-1])

        return effect

    @classmethod
    def variants(cls) -> Sequence[type[Term]]:
        return (JitterOnLines,)

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit the errors of the stamps, which are visible because longer steps add more noise."""
        return cls._best_fit(view, [math.log(0.2), 0.0], 40)

    def refit_law(self, view: View) -> LawFit | None:
        return self._best_fit(
            view, [math.log(min(max(self.std * view.rate, 0.02), 0.44)), 0.0], 20)

    @classmethod
    def _best_fit(cls, view: View, start: list[float], most: int) -> LawFit | None:
        step = 1.0 / view.rate
        z = view.z[view.train]
        square = z * z
        if (float(np.mean(square**2)) > _MOST_KURTOSIS
                or _square_correlation(square) > _MOST_CORRELATION):
            # Not jitter: errors of at most half a step cause a smaller kurtosis.  Also, a step
            # that is too long makes the next one too short, so jitter makes the correlation of
            # neighbouring squares negative.
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


@dataclass(frozen=True)
class JitterOnLines(ClockJitter):
    """Errors of stamps that are visible on pure tones: white noise in proportion to the slope."""

    ROLE = Role.NOISE
    FREE = ('std',)
    SLOW_FIT = False

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a starting point if the errors are larger where pure tones are steeper."""
        square = np.square(np.broadcast_to(view.slope, view.z.shape)[view.train])
        usual = float(square.mean())
        if not float(square.std()) > 0.0:
            return ()
        # Score test: the correlation of squared errors and squared slopes.
        x, e = square - usual, np.square(view.z[view.train])
        score = float(x @ e) / (math.sqrt(x.size) * float(x.std()) * float(e.std()))
        std = math.sqrt(float(np.median(view.variance)) / (2.0 * usual))
        return [cls(min(std, 0.4 / view.rate))] if score > 0.0 else ()

    def holds(self, view: View) -> bool:
        """Return whether the errors are too small to change the order of the samples."""
        return self.std * view.rate < _MOST_ERROR

    def variances(self, s: Segment) -> FloatArray:
        return np.square(self.std * s.slope)


_MOST_ERROR = 0.45  # Maximum standard deviation of the errors of stamps, in steps


def _square_correlation(square: FloatArray) -> float:
    """Return the correlation of neighbouring squares in standard errors."""
    c = square - square.mean()
    return math.sqrt(c.size) * float(c[1:] @ c[:-1]) / float(c @ c)


_SHORT = 15000  # Maximum number of samples in a fit
_MOST_KURTOSIS = 6.0  # Maximum fourth moment of the scores that jitter can cause
_MOST_CORRELATION = 4.0  # Maximum correlation of neighbouring squares, in standard errors
_LEVELS = 7  # Number of discrete values of a stamp's error
_LEAST_JITTER = 1e-12  # Minimum distance of phi from 0 and 1


def _errors(z: FloatArray, state: FloatArray, phi: float, x: FloatArray
            ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return probabilities of the previous stamp's error, log densities, stds, shifts, prior."""
    # Stds and shifts of the score are for pairs of successive errors; a shift is the effect of a
    # wrong step, per unit of `state`.  The prior is the law of one error.
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
