"""
This flight beside the saved model of its supply: sag, resistance and noise now over then.

Limits first: cold and age look alike; a pack warms, and its sag falls by up to a quarter within a
flight; 5 cells for 6 pass for an empty pack unless they are full; throttle that hardly moves
compares nothing.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, fields
import enum
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import LoadStart, SIZE
from ou_monitor.records import FloatArray, NAN

# Voltages and the model's answer are compared within stretches of this length, s, so that the
# level cancels out (1 s and 4 s give the same); of the last five minutes.
_STRETCH, _MOST = 2.0, 150
# Least effective number of stretches, as the error comes from how they differ.
_FEWEST = 4.0
# Least relative error of the model: what its form leaves where throttle is flown otherwise.
_FORM = 0.05
# Relative error of a size of the sag that the filter alone has learned: at least a tenth.
SIZE_ERROR = 0.1
# Least relative error of the noise: how it differs between simulated flights of one model.
_NOISE_FORM = 0.15
# Noise that counts at least, V.
_LEAST_NOISE = 1e-6
# Weaker: by more than this share, and by so many standard errors (1 % of a normal law lies above).
_LEAST, _ERRORS = 0.10, 2.33
# Relative error above which the ratio is not determined.
_VAGUE = 0.15
# Sag over the model's below which it is another pack or load: warm packs have 0.75 and more.
_OTHER = 0.7
# Level over the model's beyond which it is another pack, up or down.
OTHER_LEVEL = 1.3
# Level of a lithium cell at rest, V: at take-off, later, and at most (LiHV).
_TAKE_OFF, _EMPTY, _FULL = 3.4, 3.2, 4.4


class ModelVerdict(enum.Enum):
    """What the comparison of this flight with the model says."""

    AS_MODEL = 'as the model'
    WEAKER = 'weaker than the model'
    OTHER_PACK = 'another pack'
    CANNOT_TELL = 'cannot tell'


@dataclass(frozen=True)
class ModelComparison:
    """This flight beside the model of its supply; ratios are now over then."""

    verdict: ModelVerdict = ModelVerdict.CANNOT_TELL
    sag_ratio: float = NAN  # Of the answer to throttle
    sag_ratio_se: float = NAN  # Its standard error, the model's included
    resistance_ratio: float = NAN  # NaN without a current, now or then
    resistance_ratio_se: float = NAN
    # Of what the answer leaves while throttle moves; NaN where the model does not say.
    noise_ratio: float = NAN
    noise_ratio_se: float = NAN
    words: str = ''  # One sentence; empty: nothing to do

    def fields(self) -> dict[str, object]:
        """Return what is published; the interval of the sag is two numbers."""
        values = {f'model_{f.name}': getattr(self, f.name) for f in fields(self)}
        low, high = self.sag_ratio_95
        return values | {'model_verdict': self.verdict.name,
                         'model_sag_ratio_95': f'{low!r} {high!r}'}

    @property
    def sag_ratio_95(self) -> tuple[float, float]:
        """Return the 95 % interval of the ratio of sags."""
        return self.sag_ratio - 1.96 * self.sag_ratio_se, self.sag_ratio + 1.96 * self.sag_ratio_se


@dataclass(frozen=True)
class Contrast:
    """How a voltage answers beside what coefficients say; NaN: too few stretches."""

    ratio: float = NAN  # Slope of the voltage over the answer
    se: float = NAN
    noise: float = NAN  # Rms of what is left while throttle moves, outliers weighed down, V
    noise_se: float = NAN


class LoadContrasts:
    """Weighted products of voltage and regressors within stretches of 2 s, means taken out."""

    def __init__(self) -> None:
        # Of each: sum of the weights, 1/V^2, and products of voltage and regressors.
        self._stretches: deque[tuple[float, FloatArray]] = deque(maxlen=_MOST)
        self._begin, self._sums = NAN, np.zeros((2 + SIZE, 2 + SIZE))
        self._origin = 0.0

    def take(self, t: float, voltage: float, regressors: FloatArray, variance: float) -> None:
        """Take a voltage, V, the regressors of its throttle, and its variance, V^2 (t in s)."""
        if not t - self._begin < _STRETCH:
            total, sums = float(self._sums[0, 0]), self._sums[0, 1:]
            if total > 0.0:
                self._stretches.append((total, self._sums[1:, 1:] - np.outer(sums, sums) / total))
            self._begin, self._origin = t, voltage
            self._sums = np.zeros_like(self._sums)
        row = np.array([1.0, voltage - self._origin, *regressors])
        self._sums += np.outer(row / variance, row)

    def against(self, coefficients: npt.ArrayLike) -> Contrast:
        """Return the voltage over the answer of coefficients, V."""
        if len(self._stretches) < _FEWEST:
            return Contrast()
        a = np.asarray(coefficients, dtype=np.float64)
        weights = np.array([weight for weight, _ in self._stretches])
        products = np.array([one for _, one in self._stretches])
        along, squares = products[:, 0, 1:] @ a, products[:, 1:, 1:] @ a @ a
        total = float(squares.sum())
        if not total > 0.0:
            return Contrast()
        ratio, share = float(along.sum()) / total, squares / total
        if 1.0 / float(share @ share) < _FEWEST:
            return Contrast()
        # What each stretch leaves, were the slope of the others alone (jackknife).
        left = (along - ratio * squares) / (1.0 - share)
        # The logarithm, so that glitches in one stretch do not decide.
        squared = (products[:, 0, 0] - 2.0 * ratio * along + ratio * ratio * squares) / weights
        noise = 0.5 * np.log(np.maximum(squared, _LEAST_NOISE ** 2))
        mean = float(share @ noise)
        spread = share * (noise - mean) / (1.0 - share)
        return Contrast(ratio, math.sqrt(float(left @ left)) / total, math.exp(mean),
                        math.exp(mean) * math.sqrt(float(spread @ spread)))


def other_pack(start: LoadStart, first: float, level: float) -> str:
    """Return why the level at the first sample or now, V, is another pack's; empty: it is not."""
    cells = start.cells
    # The number of cells of a rail says nothing.
    lithium = _EMPTY <= start.volts / cells <= _FULL
    each = level / cells
    if lithium and not _EMPTY <= each <= _FULL or not (
            1.0 / OTHER_LEVEL < level / start.volts < OTHER_LEVEL):
        return f'{level:.2f} V at rest, where the model has {start.volts:.2f} V: another pack.'
    if lithium and first / cells < _TAKE_OFF:
        return (f'{first:.2f} V at rest at first is {first / cells:.2f} V for each of the '
                f"model's {cells:.0f} cells: another pack, or an empty one.")
    return ''


def judge(ratio: float, se: float, date: str) -> tuple[ModelVerdict, str]:
    """Return the verdict on a sag now over then, its error included, and the sentence."""
    if not se <= _VAGUE * max(ratio, 1.0):
        return ModelVerdict.CANNOT_TELL, ''
    more, model = ratio - 1.0, 'the model' + (f' of {date}' if date else '')
    sizes = sorted((100.0 * (abs(more) - 1.96 * se), 100.0 * (abs(more) + 1.96 * se)))
    found = f'Sag {100.0 * abs(more):.0f} % ({sizes[0]:.0f} to {sizes[1]:.0f})'
    if more > max(_LEAST, _ERRORS * se):
        return ModelVerdict.WEAKER, f'{found} above {model}: weak pack or cold.'
    if ratio + _ERRORS * se < _OTHER:
        return ModelVerdict.OTHER_PACK, f'{found} below {model}: another pack, or another load.'
    return ModelVerdict.AS_MODEL, ''


def compare(found: Contrast, start: LoadStart, ohm: float, ohm_se: float, other: str, date: str
            ) -> ModelComparison:
    """
    Return a flight beside what another one has learned, of that date.

    Resistance now in Ohm, NaN where unknown; other: why it is another pack.
    """
    ratio = found.ratio
    se = math.hypot(found.se, ratio * (start.size_se or SIZE_ERROR), ratio * _FORM)
    verdict, words = (ModelVerdict.OTHER_PACK, other) if other else judge(ratio, se, date)
    return ModelComparison(
        verdict, ratio, se, *_over(ohm, ohm_se, start.resistance, start.resistance_se),
        *_over(found.noise, math.hypot(found.noise_se, _NOISE_FORM * found.noise), start.noise,
               start.noise_se), words)


def _over(now: float, now_se: float, then: float, then_se: float) -> tuple[float, float]:
    """Return a ratio and its standard error; NaN where either is unknown."""
    if not (now > 0.0 and then > 0.0):
        return NAN, NAN
    return now / then, now / then * math.hypot(now_se / now, then_se / then)
