"""
Compare this flight with the saved model of its supply: ratios of sag, resistance and noise.

Limits: a cold pack looks like an old one; a full 5S pack in place of a 6S one is not detected at
once; steady throttle allows no comparison.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, fields
import enum
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import LoadStart, SIZE, WARMING, WARMING_SE
from ou_monitor.records import FloatArray, NAN

# Length, s, of the stretches within which voltage and the model's response are compared, so that
# the level cancels out (1 s and 4 s give the same); maximum number kept, for five minutes.
_STRETCH, _MOST = 2.0, 150
# Minimum effective number of stretches; the error comes from their scatter.
_FEWEST = 4.0
# Relative error of the model's form, which is inexact if throttle is used differently.
_FORM = 0.05
# Relative error of a sag that the filter has learned without contrasts.
SIZE_ERROR = 0.1
# Further relative error of the noise: its scatter between simulated flights of one model.
_NOISE_FORM = 0.15
# Number of throttle bins of the noise, and number of bins, 0.1 of throttle, that are combined.
BINS, NEAR = 50, 5
# Minimum number of samples in the combined bins.
_LEAST_NEAR = 10.0
# Further relative error of the discharge per load: rms of ln of its ratio on 12 recorded pairs
# (halves of gecko, nazgul and hiro, three flights of roma), with packs at different charges.
_DISCHARGE_FORM = 0.64
# A pack is weaker if its sag exceeds the model's both by this share and by this number of standard
# errors of the logarithm (chance exceeds that number in 1 % of cases).
_LEAST, _ERRORS = 0.10, 2.33
# Relative error above which the ratio is not determined.
_VAGUE = 0.15
# Ratio of the sag to the model's below which the pack or the load must be another one (warm packs
# have at least 0.75).
_OTHER = 0.7
# Ratio of two levels, up or down, beyond which the pack must be another one.
OTHER_LEVEL = 1.3
# Limits of a lithium cell's level at rest, V: minimum at take-off, minimum, and maximum (LiHV).
_TAKE_OFF, _EMPTY, _FULL = 3.4, 3.2, 4.4


class ModelVerdict(enum.Enum):
    """Result of comparing this flight with the model."""

    AS_MODEL = 'as the model'
    WEAKER = 'weaker than the model'
    OTHER_PACK = 'another pack'
    CANNOT_TELL = 'cannot tell'


@dataclass(frozen=True)
class ModelComparison:
    """This flight compared with the model of its supply; ratios are this flight over the model."""

    verdict: ModelVerdict = ModelVerdict.CANNOT_TELL
    sag_ratio: float = NAN  # Ratio of the responses to throttle
    sag_ratio_se: float = NAN  # Its standard error, which includes the model's
    # Ratio of the resistances; NaN unless the current is known in both flights.
    resistance_ratio: float = NAN
    resistance_ratio_se: float = NAN
    # Ratio of the noise of a sample at steady throttle, at the throttle of the model's noise; NaN
    # unless both flights used that throttle.
    noise_ratio: float = NAN
    noise_ratio_se: float = NAN
    # Ratio of the discharge per load, known to a factor of two.
    discharge_ratio: float = NAN
    discharge_ratio_se: float = NAN
    words: str = ''  # One sentence; empty: nothing to report

    def fields(self) -> dict[str, object]:
        """Return the published fields; the interval of the sag ratio consists of two numbers."""
        values = {f'model_{f.name}': getattr(self, f.name) for f in fields(self)}
        low, high = (self.sag_ratio + z * self.sag_ratio_se for z in (-1.96, 1.96))
        return values | {'model_verdict': self.verdict.name,
                         'model_sag_ratio_95': f'{low!r} {high!r}'}


@dataclass(frozen=True)
class Contrast:
    """Measured response to throttle relative to a predicted one; NaN: too few stretches."""

    ratio: float = NAN  # Slope of voltage over predicted response
    se: float = NAN
    # Mean open-circuit voltage of a cell, V, with the weights of the slope.
    level: float = NAN
    # Relative change of the slope with that voltage, 1/V, and its standard error.
    warming: float = WARMING
    warming_se: float = WARMING_SE


class LoadContrasts:
    """Products of voltage and regressors in stretches of 2 s, means removed; noise by throttle."""

    def __init__(self) -> None:
        # For each stretch: level of a cell, V; weighted products of voltage and regressors.
        self._stretches: deque[tuple[float, FloatArray]] = deque(maxlen=_MOST)
        self._begin, self._sums = NAN, np.zeros((2 + SIZE, 2 + SIZE))
        self._origin = 0.0
        # For each bin of throttle: number of samples, and sum of squared residuals, V^2.
        self._noise = np.zeros((2, BINS + 1))

    def take_noise(self, throttle: float, samples: float, square: float) -> None:
        """Take the number of samples at a steady throttle, and their squared residuals, V^2."""
        self._noise[:, int(throttle * BINS + 0.5)] += samples, square

    def noise(self, flown: tuple[float, float]) -> tuple[float, float]:
        """Return the noise of a sample, V, midway between two throttles, and its error; or NaN."""
        # At one throttle and per sample, because noise grows with the load, and the mean of a
        # block has less of it at a higher rate.
        first = max(0, int(0.5 * sum(flown) * BINS + 0.5) - NEAR // 2)
        samples, square = self._noise[:, first:first + NEAR].sum(axis=1).tolist()
        if samples < _LEAST_NEAR:
            return NAN, NAN
        return math.sqrt(square / samples), math.sqrt(0.5 * square) / samples

    def take(self, t: float, voltage: float, regressors: FloatArray, variance: float,
             level: float) -> None:
        """Take a voltage, V, regressors, variance, V^2, and the level of a cell, V (t in s)."""
        if not t - self._begin < _STRETCH:
            total, sums = float(self._sums[0, 0]), self._sums[0, 1:]
            if total > 0.0:
                self._stretches.append((level, self._sums[1:, 1:] - np.outer(sums, sums) / total))
            self._begin, self._origin = t, voltage
            self._sums = np.zeros_like(self._sums)
        row = np.array([1.0, voltage - self._origin, *regressors])
        self._sums += np.outer(row / variance, row)

    def against(self, coefficients: npt.ArrayLike) -> Contrast:
        """Compare the voltage with the response, V, that these coefficients predict."""
        if len(self._stretches) < _FEWEST:
            return Contrast()
        a = np.asarray(coefficients, dtype=np.float64)
        levels, products = map(np.array, zip(*self._stretches))
        along, squares = products[:, 0, 1:] @ a, products[:, 1:, 1:] @ a @ a
        total = float(squares.sum())
        if not total ** 2 > _FEWEST * float(squares @ squares):
            return Contrast()
        ratio, share = float(along.sum()) / total, squares / total
        # Residual of each stretch from the slope of the other stretches (jackknife).
        left = (along - ratio * squares) / (1.0 - share)
        level = float(share @ levels)
        return Contrast(ratio, math.sqrt(float(left @ left)) / total, level,
                        *_warming(levels - level, along / ratio - squares, squares))


def _warming(levels: FloatArray, left: FloatArray, squares: FloatArray) -> tuple[float, float]:
    """Return the slope of relative residuals over level, 1/V, and its error, using the prior."""
    weight = float(squares @ levels ** 2)
    if not weight > 0.0:
        return WARMING, WARMING_SE
    slope = float(levels @ left) / weight
    each = levels * (left - slope * levels * squares)
    # The model's form may be wrong by _FORM at both ends of the range of levels; this range is
    # sqrt(12) standard deviations wide if the levels are uniform.
    variance = (float(each @ each) / weight + _FORM ** 2 * float(squares.sum()) / 6.0) / weight
    own, usual = 1.0 / variance, WARMING_SE ** -2
    return (slope * own + WARMING * usual) / (own + usual), (own + usual) ** -0.5


def other_pack(start: LoadStart, highest: float, level: float) -> str:
    """Return why the highest or present level, V, indicates another pack; '': it does not."""
    cells = start.cells
    # A regulated rail has no meaningful number of cells.
    if not _EMPTY <= start.volts / cells <= _FULL:
        other = not 1.0 / OTHER_LEVEL < level / start.volts < OTHER_LEVEL
    elif highest / cells < _TAKE_OFF:
        # Use the highest level, because the flight may have emptied a charged pack.
        return (f'The highest voltage at rest, {highest:.2f} V, is {highest / cells:.2f} V for '
                f"each of the model's {cells:.0f} cells: another pack, or an empty one.")
    else:
        other = level / cells > _FULL
    return (f'{level:.2f} V at rest, where the model has {start.volts:.2f} V: another pack.'
            if other else '')


def judge(ratio: float, se: float, date: str) -> tuple[ModelVerdict, str]:
    """Return the verdict on a sag ratio with its standard error, and a sentence."""
    if not se <= _VAGUE * max(ratio, 1.0):
        return ModelVerdict.CANNOT_TELL, ''
    more, model = ratio - 1.0, 'the model' + (f' of {date}' if date else '')
    sizes = sorted((100.0 * (abs(more) - 1.96 * se), 100.0 * (abs(more) + 1.96 * se)))
    found = f'Sag {100.0 * abs(more):.0f} % ({sizes[0]:.0f} to {sizes[1]:.0f})'
    # Most errors are multiplicative, so the error of the logarithm hardly depends on ageing.
    if more > _LEAST and math.log(ratio) > _ERRORS * se / ratio:
        return ModelVerdict.WEAKER, f'{found} above {model}: weak or cold pack.'
    if ratio + _ERRORS * se < _OTHER:
        return ModelVerdict.OTHER_PACK, f'{found} below {model}: another pack, or another load.'
    return ModelVerdict.AS_MODEL, ''


def compare(contrasts: LoadContrasts, start: LoadStart, ohm: float, ohm_se: float, other: str,
            date: str, discharge: float, discharge_se: float) -> ModelComparison:
    """Compare this flight with an earlier model (ohm: now; other: from `other_pack`)."""
    found, (noise, noise_se) = contrasts.against(start.coefficients), contrasts.noise(start.flown)
    # Correct the ratio to equal levels, because the sag changes as a pack empties and warms.
    apart = found.level - (start.level or start.volts / start.cells)
    as_found = math.exp(-start.warming * apart)
    ratio = found.ratio * as_found
    se = math.hypot(found.se * as_found, ratio * (start.size_se or SIZE_ERROR), ratio * _FORM,
                    ratio * start.warming_se * apart)
    verdict, words = (ModelVerdict.OTHER_PACK, other) if other else judge(ratio, se, date)
    return ModelComparison(
        verdict, ratio, se, *_over(ohm, ohm_se, start.resistance, start.resistance_se),
        *_over(noise, math.hypot(noise_se, _NOISE_FORM * noise), start.noise, start.noise_se),
        *_over(discharge, math.hypot(discharge_se, _DISCHARGE_FORM * discharge), start.discharge,
               0.0), words)


def _over(now: float, now_se: float, then: float, then_se: float) -> tuple[float, float]:
    """Return a ratio and its standard error; NaN where either is unknown."""
    if not (now > 0.0 and then > 0.0):
        return NAN, NAN
    return now / then, now / then * math.hypot(now_se / now, then_se / then)
