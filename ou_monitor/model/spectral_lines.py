"""
Spectral lines: detection by a test, measurement with errors, and removal.

`analyze` searches each load level, `discover` the scores of a model, `compare` the residuals.

Whatever the distribution of the noise, its periodogram ordinates are exponentially distributed,
and sums of K ordinates follow a gamma distribution.  A line is an ordinate that exceeds its
neighbours.  The noise at each frequency is estimated by the median of neighbouring ordinates,
whose distribution is known exactly; so the test needs no model of the spectrum, and a second line
nearby does not hide the first.  There are two passes: over pieces of a few seconds, because tones
of motors and converters drift, and over the longest possible pieces, in which a tone of constant
frequency (from a crystal oscillator) is clearest.

Each line is subtracted as a sinusoid with its own amplitude, phase and frequency in each piece of
the length in which the line was found; this also removes a little noise.

Limits: the noise is treated as constant over the neighbours (about 60 bins on either side, up to
260 in long pieces).  A line must also exceed the nearest eight ordinates on either side, so that a
slope or a wide hump of the noise does not count as a line; a narrower resonance does.  Samples are
treated as evenly spaced; a line may be an alias; frequencies below `FIRST` periods per piece are
not searched.  A line whose frequency changes is spread over bins, and may be missed.  If a tone
moves by more than a bin within a piece, or is modulated, its sidebands remain after subtraction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.sinusoid import (
    FALSE_ALARM, FEWEST_SAMPLES, FEWEST_TESTED, FIRST, groups, GUARD, LOBE,
    local_median, NEIGHBOURS, neighbours, SHORT, without_sinusoids)
from ou_monitor.records import FloatArray, NAN
from ou_monitor.text import Z95
from scipy.optimize import brentq
from scipy.signal import welch
from scipy.special import bdtrc, betaincinv, chndtrinc, gammaincc, gammaincinv

# Maximum number of samples in a long piece; limits memory and time.
_LONGEST = 1 << 20
# Nodes and weights of quadrature over 0..1.
_QUANTILES = 0.5 * (np.polynomial.legendre.leggauss(64)[0] + 1.0)
_WEIGHTS = 0.5 * np.polynomial.legendre.leggauss(64)[1]
# Number of nearest ordinates on each side that a line must exceed, and maximum p-value of this
# comparison; the weakest detected lines have about 0.003.
_BESIDE, _UNLIKE = 8, 0.05
# Maximum ratio of samples after interpolation to samples given.
_FILLED = 4.0


@dataclass(frozen=True)
class Line:
    """A line in the spectrum."""

    frequency: float  # Hz, below half the sampling rate
    resolution: float  # Width of a bin, Hz: the error of the frequency
    # Root mean square and its 95 % interval, V.
    rms: float
    rms_low: float
    rms_high: float
    share: float  # Share of the variance of the segments in which it is measured
    p_value: float  # p-value of its ordinate, times the number of ordinates tested at all levels


# Maximum distance of a harmonic from a multiple of the fundamental, in fundamentals, and maximum
# probability that unrelated lines form an equally complete comb by chance.
_NEAR_MULTIPLE, _UNRELATED = 0.01, 1e-3


def fundamental_of(frequencies: Sequence[float]) -> float:
    """Return the frequency of which most lines (Hz) are multiples; NaN if chance explains it."""
    f = np.asarray(frequencies, dtype=np.float64)
    most, fundamental = 2, NAN
    for trial in np.unique(np.outer(f, (1.0, 0.5, 1.0 / 3.0)))[::-1].tolist():
        order = np.rint(f / trial).astype(np.intp)
        near = (order > 0) & (np.abs(f / trial - order) < _NEAR_MULTIPLE)
        count = np.unique(order[near]).size
        # bdtrc is the probability of more than that many.
        if count > most and (3.0 * f.size * bdtrc(count - 2, f.size, 2.0 * _NEAR_MULTIPLE)
                             < _UNRELATED):
            most = count
            fundamental = float(f[near] @ order[near] / (order[near] @ order[near]))
    return fundamental


@dataclass(frozen=True)
class LineSearch:
    """Result of a search for lines."""

    lines: tuple[Line, ...] = ()  # Strongest first
    tested: int = 0  # Ordinates tested at this load level
    # Lowest and highest frequency searched, Hz.
    lowest: float = NAN
    highest: float = NAN
    # RMS of a line that is detected with 90 % probability at the median noise density, V.
    detectable: float = NAN
    why_not: str = ''  # Why there was no search; empty if there was one


@dataclass(frozen=True, eq=False)
class EvenGrid:
    """Samples on an evenly spaced grid, with missing ones interpolated."""

    values: FloatArray  # Samples
    where: npt.NDArray[np.intp]  # Grid indices of the samples that were given
    rate: float  # Samples per second, Hz


# Step, relative to the median, below which a sample may lie between points of the grid.
SHORT_STEP = 0.75


def on_grid(t: FloatArray, values: FloatArray) -> EvenGrid:
    """Return samples on a grid of the median step, to which steps are rounded (t in s)."""
    step = np.diff(t)
    usual = float(np.median(step)) if step.size else math.inf
    ratio = step / usual
    number = np.maximum(1.0, np.rint(ratio))
    # Samples between grid points: add up their short steps, and round the sum.
    short = ratio < SHORT_STEP
    if (short[1:] & short[:-1]).any():
        passed = np.cumsum(np.where(short, ratio, 0.0))
        whole = np.rint(passed - np.maximum.accumulate(np.where(short, 0.0, passed)))
        number = np.where(short, np.diff(whole, prepend=0.0), number)
    if number.sum() > _FILLED * t.size:
        # If most of the time is gaps, ignore the gaps.
        number = np.ones(step.size)
    where = np.append(0.0, np.cumsum(number)).astype(np.intp)
    rate = float(where[-1] / (t[-1] - t[0])) if step.size else NAN
    if where[-1] == step.size:
        return EvenGrid(values, where, rate)
    return EvenGrid(np.interp(np.arange(where[-1] + 1.0), where, values), where, rate)


def find_lines(parts: Sequence[FloatArray], rate: float, *, false_alarm: float = FALSE_ALARM,
               levels: int = 1, white: Sequence[FloatArray] = (), lowest: float = 0.0,
               wide: bool = False) -> LineSearch:
    """Search evenly spaced segments, V, for lines (rate and lowest in Hz); strongest first."""
    # levels: number of load levels searched, which share false_alarm.
    # white: innovations of `parts`, in which lines are detected if `parts` are not white noise.
    # wide: whether a line may be as wide as a hump of the noise.
    # Subtract the mean first, because detrending a large constant leaves rounding errors.
    parts, white = ([part - part.mean() for part in some if part.size]
                    for some in (parts, white or parts))
    sizes = [part.size for part in parts]
    short = _piece_length(sizes, max(FEWEST_SAMPLES, int(SHORT * rate)))
    if not (short and rate > 0.0):
        return LineSearch(why_not=f'no segment holds {FEWEST_SAMPLES} samples')
    tested = {length: np.arange(max(FIRST, math.ceil(lowest * length / rate)), length // 2 - 1)
              for length in (short, _piece_length(sizes, _LONGEST))}
    if tested[short].size < FEWEST_TESTED:
        return LineSearch(why_not=f'too few frequencies lie above {lowest:g} Hz')
    count = sum(where.size for where in tested.values())
    found: list[Line] = []
    detectable = NAN
    for length, where in tested.items():
        lines, least = _search(parts, white, rate, length, where,
                               false_alarm / (levels * count), wide)
        # A line found in both passes is measured in the short pieces, because it may drift, unless
        # it reaches FALSE_ALARM in the long pieces only.
        for line in lines:
            same = [other for other in found if abs(line.frequency - other.frequency)
                    < 2 * LOBE * other.resolution]
            if all(other.p_value > max(line.p_value, FALSE_ALARM / (levels * count))
                   for other in same):
                found = [other for other in found if other not in same] + [line]
        detectable = least if length == short else detectable
    found = [replace(line, p_value=min(1.0, levels * count * line.p_value)) for line in found]
    found.sort(key=lambda line: -line.rms)
    first = min(float(where[0]) / length for length, where in tested.items() if where.size)
    return LineSearch(tuple(found), count, first * rate, float(tested[short][-1]) * rate / short,
                      detectable)


def _search(parts: Sequence[FloatArray], whites: Sequence[FloatArray], rate: float, length: int,
            where: np.ndarray, chance: float, wide: bool) -> tuple[list[Line], float]:
    """Return lines among ordinates, at a false-alarm level, and the detectable rms, V."""
    pieces = sum(part.size // length for part in parts)
    raw, white = (sum(part.size // length * welch(
        part, rate, nperseg=length, noverlap=0, detrend='linear')[1]
        for part in some if part.size >= length) / pieces for some in (parts, whites))
    df, k = rate / length, float(pieces)
    near = neighbours(where.size, length / (SHORT * rate))
    middle = local_median(white, where, near)
    ratio = white[where] / np.maximum(middle, 1e-300)
    limit = threshold(k, near, chance)
    hits = np.flatnonzero(ratio > limit)
    if not wide:
        # A hump consists of many adjacent high ordinates: multiply p by their number.
        count = np.searchsorted(hits, hits + NEIGHBOURS) - np.searchsorted(hits, hits - NEIGHBOURS)
        hits = hits[_beside(white, where[hits], k) * count < _UNLIKE]
    p = np.ones(where.size)
    p[hits] = tail(ratio[hits], k, near)
    background = raw[where] / np.maximum(white[where], 1e-300) * middle
    # The median of a gamma variable, in units of its mean.
    background /= float(gammaincinv(k, 0.5)) / k
    # Use only the segments in which lines are measured, because shorter ones may be quieter.
    held = [part for part in parts if part.size >= length]
    total = float(sum(part @ part for part in held) / sum(part.size for part in held))
    lines = [_measure(raw, background, white[where], middle, where, group, p, df, total, k)
             for group in groups(hits)]
    return lines, _detectable(float(np.median(background)), df, k, limit)


def _beside(density: FloatArray, at: np.ndarray, pieces: float) -> FloatArray:
    """Return p-values of ordinates against the nearest ones on the side that is higher."""
    # Where the spectrum of the noise is steep or has a hump, the median of all neighbours may be
    # far below the ordinates on one side.
    found = np.zeros(at.size)
    for k, centre in enumerate(at.tolist()):
        for side in (density[max(1, centre - GUARD - _BESIDE + 1):max(1, centre - GUARD + 1)],
                     density[centre + GUARD:centre + GUARD + _BESIDE]):
            if side.size:
                middle = np.partition(side, side.size // 2)[side.size // 2]
                found[k] = max(found[k], float(tail(
                    density[centre] / np.maximum(middle, 1e-300)[None], pieces, side.size)[0]))
    return found


def tail(ratio: FloatArray, pieces: float, neighbours: int) -> FloatArray:
    """Return the probability that noise exceeds a multiple of the median of its neighbours."""
    at = _medians(pieces, neighbours)
    found: FloatArray = gammaincc(pieces, np.outer(ratio, at)) @ _WEIGHTS
    return found


@lru_cache(maxsize=256)
def _medians(pieces: float, neighbours: int) -> FloatArray:
    """Return quantiles of the median of the neighbours, over which `tail` averages."""
    j = neighbours // 2 + 1
    return np.asarray(gammaincinv(pieces, betaincinv(j, neighbours - j + 1, _QUANTILES)))


@lru_cache(maxsize=256)
def threshold(pieces: float, neighbours: int, level: float) -> float:
    """Return the ratio at which `tail` is `level`."""
    def beyond(log: float) -> float:
        return math.log(max(float(tail(np.array([math.exp(log)]), pieces, neighbours)[0]),
                            1e-300)) - math.log(level)
    return math.exp(brentq(beyond, 0.0, 12.0))


def _piece_length(sizes: Sequence[int], most: int) -> int:
    """Return the length of pieces, up to `most`, at which a line is detected best."""
    longest = max(sizes, default=0)
    if longest < FEWEST_SAMPLES:
        return 0
    top = min(longest, most)
    best, score = top, 0.0
    for length in {top, *(size for size in sizes if FEWEST_SAMPLES <= size < top)}:
        # The power of a line grows with the number of pieces, the scatter of the noise only with
        # its root.
        gained = length * math.sqrt(sum(size // length for size in sizes))
        if gained > score:
            best, score = length, gained
    return best


def _measure(raw: FloatArray, background: FloatArray, white: FloatArray, middle: FloatArray,
             where: np.ndarray, group: np.ndarray, p: FloatArray, df: float, total: float, k: float
             ) -> Line:
    low, high = max(0, group[0] - LOBE), min(where.size, group[-1] + LOBE + 1)
    if group.size <= 2 * LOBE + 1:
        peak = int(group[np.argmax(white[group])])
        low, high = max(0, peak - LOBE), min(where.size, peak + LOBE + 1)
    density, noise = raw[where[low:high]], background[low:high]
    # The mean of a gamma variable, in units of its median.
    excess = np.maximum(white[low:high] - k / float(gammaincinv(k, 0.5)) * middle[low:high], 0.0)
    power = float((density - noise).sum() * df)
    floor = float(noise.mean() * df)
    # Hann window: sum w^4 / (sum w^2)^2 = 1.94 / n; correlations of neighbours 4/9 and 1/36.
    bins = high - low
    spread = bins + 2.0 * ((bins - 1) * 4.0 / 9.0 + max(bins - 2, 0) / 36.0)
    se = math.sqrt((3.89 * max(power, 0.0) * floor + spread * floor ** 2) / k)
    reach = Z95 * se
    return Line(float((where[low:high] * excess).sum() / excess.sum() * df), df,
                math.sqrt(max(power, 0.0)), math.sqrt(max(power - reach, 0.0)),
                math.sqrt(max(power + reach, 0.0)),
                min(1.0, max(power, 0.0) / total) if total else NAN, float(p[group].min()))


def _detectable(density: float, df: float, k: float, limit: float) -> float:
    """Return the RMS of a line that exceeds the limit with 90 % probability, V."""
    lift = float(chndtrinc(2.0 * limit * float(gammaincinv(k, 0.5)), 2.0 * k, 0.1))
    # A line at the centre of a bin has 2/3 of its power there; halfway between two bins, 0.48.
    return math.sqrt(lift / (2.0 * k) * density * df / 0.48)


def without_lines(voltage: FloatArray, rate: float, lines: Sequence[Line]) -> FloatArray:
    """Return one segment without lines (voltage in V, rate in Hz, result in V)."""
    for line in lines if voltage.size else ():
        pieces = max(1, round(voltage.size * line.resolution / rate))
        voltage = np.concatenate([
            without_sinusoids(piece, rate, (line.frequency,), line.resolution)
            for piece in np.array_split(voltage, pieces)])
    return voltage


def even_on_log(x: FloatArray, y: FloatArray, per_decade: int) -> tuple[FloatArray, FloatArray]:
    """Average a curve over increasing x > 0 in even bins of log x."""
    if x.size < 3:
        return x, y
    bins = np.floor(per_decade * np.log10(x / x[0])).astype(np.intp)
    count = np.bincount(bins)
    some = count > 0
    return np.bincount(bins, x)[some] / count[some], np.bincount(bins, y)[some] / count[some]
