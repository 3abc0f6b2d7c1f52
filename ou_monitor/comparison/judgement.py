"""
Which difference matters most, and whether the recording could be a simulation.

Each number of the recording is scored by its distance from the median of the simulations, in
half-widths of their 95 % band; a band is never narrower than what a pilot would not notice.  The
largest score, weighted, is compared with those of the simulations among themselves: so one in
twenty recordings that are just as simulated is said to differ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.comparison.agreement import Band, Verdict
from ou_monitor.comparison.yardstick import Measures, Yardstick
from ou_monitor.records import FloatArray
from ou_monitor.text import number

# Probability that a recording which is as simulated is said to differ.
LEVEL = 0.05
# What a pilot cares for, relative to the lowest voltage and the dips.
_WEIGHTS = {'lowest': 1.0, 'falls': 1.0, 'level': 0.8, 'answer': 0.8, 'spectrum': 0.5, 'ks': 0.5}
# What a pilot would not notice: a share of the range of the voltage; factors on a rate and on a
# power; a difference of distributions.
_RANGE, _RATE, _POWER, _KS = 0.03, 1.25, 1.5, 0.05
# Half of a 95 % band.
_LOW, _HIGH = 2.5, 97.5
# Where the mean answer to a rise is read, s after it begins.
RECOVERED = 1.0


@dataclass(frozen=True)
class Difference:
    """One number, and what would be said of it."""

    kind: str  # Key of its weight
    measured: float  # Of the recording
    simulated: FloatArray  # Of each simulation; shape (seeds,)
    least: float  # Half of the narrowest band
    words: Callable[[Band], str]  # Band -> sentence without its end

    @property
    def band(self) -> Band:
        """Return the band."""
        return band(self.measured, self.simulated)

    def scores(self) -> FloatArray:
        """Return the weighted scores: of the recording, then of each simulation."""
        own = self.band
        off = np.append(self.measured, self.simulated) - own.median
        half = np.where(off > 0.0, own.high - own.median, own.median - own.low)
        return np.asarray(_WEIGHTS[self.kind] * np.abs(off) / np.maximum(half, self.least))


def band(measured: float, simulated: FloatArray) -> Band:
    """Return a number of the recording beside those of the simulations, shape (seeds,)."""
    low, median, high = np.percentile(simulated, [_LOW, 50.0, _HIGH]).tolist()
    return Band(measured, low, median, high)


def answer_times(yardstick: Yardstick) -> tuple[int, int]:
    """Return the points of the answer at the begin of a rise and at `RECOVERED` after it."""
    at = np.searchsorted(yardstick.after, [0.0, RECOVERED])
    return int(at[0]), int(at[1])


def differences(yardstick: Yardstick, own: Measures, others: Sequence[Measures],
                spread: float) -> list[Difference]:
    """Return all numbers that are judged; spread is the range of the measured voltage, V."""
    volts = max(_RANGE * spread, 1e-12)

    def of(pick: Callable[[Measures], float]) -> FloatArray:
        return np.array([pick(one) for one in others])

    found = [
        Difference('lowest', own.lowest, of(lambda m: m.lowest), volts, lambda b: (
            f'the lowest voltage is {number(b.median, 4)} V ({_span(b, 4)}), measured '
            f'{number(b.measured, 4)} V')),
        Difference('level', own.mean, of(lambda m: m.mean), volts, lambda b: (
            f'the voltage is on average {number(1e3 * abs(b.median - b.measured), 2)} mV too '
            f'{_too(b, "high", "low")}'))]
    for k, level in enumerate(yardstick.levels):
        rate = own.falls[k]
        # A count is never known better than to its own chance.
        chance = math.sqrt(max(rate * yardstick.minutes, 1.0)) / yardstick.minutes
        found.append(Difference(
            'falls', float(rate), of(lambda m, k=k: float(m.falls[k])),  # type: ignore[misc]
            max((_RATE - 1.0) * float(rate), chance), lambda b, level=level: (  # type: ignore
                f'the voltage falls through {number(level, 4)} V {number(b.median, 2)} times a '
                f'minute ({_span(b, 2)}), measured {number(b.measured, 2)}')))
    if own.answer.size:
        begin, later = answer_times(yardstick)
        found += [
            Difference('answer', float(own.answer[begin:].min()),
                       of(lambda m: float(m.answer[begin:].min())), volts, lambda b: (
                f'after rises of throttle the voltage dips by {_fall(b.median)} '
                f'({_fall(b.high)} to {_fall(b.low)}), measured {_fall(b.measured)}')),
            Difference('answer', float(own.answer[later]),
                       of(lambda m: float(m.answer[later])), volts, lambda b: (
                f'a second after rises of throttle the voltage is down by {_fall(b.median)} '
                f'({_fall(b.high)} to {_fall(b.low)}), measured {_fall(b.measured)}'))]
    for k in range(own.power.size):
        if own.power[k] > 0.0:
            low, high = yardstick.bands[k], yardstick.bands[k + 1]
            found.append(Difference(
                'spectrum', math.log(own.power[k]),
                of(lambda m, k=k: math.log(max(m.power[k], 1e-300))),  # type: ignore[misc]
                math.log(_POWER), lambda b, low=low, high=high: (  # type: ignore[misc]
                    f'between {number(low, 2)} and {number(high, 2)} Hz the simulated voltage has '
                    f'{number(math.exp(b.median - b.measured), 2)} times the measured power')))
    pooled = np.mean([m.distribution for m in others], axis=0)
    found.append(Difference(
        'ks', distance(own, pooled), of(lambda m: distance(m, pooled)), _KS, lambda b: (
            f'the shares of time at each voltage differ by up to {number(b.measured, 2)} '
            f'(simulations among themselves: {_span(b, 2)})')))
    return found


def distance(one: Measures, pooled: FloatArray) -> float:
    """Return the Kolmogorov-Smirnov distance of a distribution from that of all simulations."""
    return float(np.max(np.abs(one.distribution - pooled)))


def _span(b: Band, digits: int) -> str:
    return f'{number(b.low, digits)} to {number(b.high, digits)}'


def _too(b: Band, more: str, less: str) -> str:
    return more if b.median > b.measured else less


def _fall(v: float) -> str:
    return f'{number(-1e3 * v, 2)} mV'


def judge(found: Sequence[Difference], explained: float, moved: bool
          ) -> tuple[float, Verdict, str, str]:
    """
    Return the share of simulations as odd as the recording, verdict, what is most wrong, its kind.

    explained: share of the variance by the mean path; moved: whether throttle did.
    """
    scores = np.array([one.scores() for one in found])
    # A simulation that is at once the recording and its own judge would be flattered by its own
    # place in the band; with the recording it is one of seeds + 1.
    largest = scores.max(axis=0)
    p = float(np.mean(largest >= largest[0]))
    worst = int(np.argmax(scores[:, 0]))
    level = next(k for k, one in enumerate(found) if one.kind == 'level')
    verdict = Verdict.DIFFERS if p < LEVEL else Verdict.LOOKS_LIKE_IT
    if verdict is Verdict.LOOKS_LIKE_IT and moved and explained < 0.0:
        return p, Verdict.DIFFERS, (
            f'the mean path explains {number(100.0 * explained, 2)} % of the variance, less than '
            'a constant would'), 'path'
    if verdict is Verdict.LOOKS_LIKE_IT and scores[level, 0] > _WEIGHTS['level']:
        verdict, worst = Verdict.DIFFERS, level
    return p, verdict, found[worst].words(found[worst].band), found[worst].kind
