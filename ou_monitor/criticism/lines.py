"""
Spectral lines: found by a test, measured with their error, taken out.

A periodogram ordinate of noise is exponential, and the sum of K of them gamma, whatever the law
of the noise; a line stands out of its neighbours.  The level of the noise at each frequency is
the median of neighbouring ordinates, whose law is known exactly, so the test needs no model of
the spectrum and a second line nearby does not hide the first.

A line of 4 mV beside an OU of 18 mV moves alpha by 30 % and sigma by 15 % (1 kHz, 120 Hz): the
fit takes it for a part of the relaxation.  So each line is taken out as a sinusoid of its own
amplitude, phase and frequency in each piece of the length that the search used, by least squares;
a little noise of that bin goes with it.

Limits: the noise is taken as level over the neighbours (some 60 bins either side), so a resonance
narrower than that is reported as a line; samples are taken as evenly spaced; a line may be the
alias of one above half the rate; below `FIRST` periods of a piece nothing is looked for; with
the false-alarm rate go changes of frequency, which spread a line until it is not found.  A tone
that moves by more than a bin within a piece, or is modulated, leaves its sidebands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
import math

import numpy as np
from ou_monitor.records import FloatArray, NAN
from ou_monitor.text import Z95
from scipy.signal import lfilter
from scipy.special import betaincinv, chndtr, gammaincc, gammaincinv

# Probability that a recording without lines has one reported at any of its levels.
FALSE_ALARM = 0.01
# Lowest frequency, in periods of a piece: below, what removing mean and trend has left.
FIRST = 4
# A piece is at most so long, s: tones of motors and converters are no steadier.
_LONGEST = 4.0
_FEWEST = 128
# Neighbours: every second ordinate (those next to each other are correlated by the window),
# from this many bins away on, so many in all.
_GUARD, _NEIGHBOURS = 4, 64
# Bins that the window spreads a steady line over, either side.
_LOBE = 2
_QUANTILES = 0.5 * (np.polynomial.legendre.leggauss(64)[0] + 1.0)
_WEIGHTS = 0.5 * np.polynomial.legendre.leggauss(64)[1]
# Frequencies tried either side of the line's, in bins, and how many.
_REACH, _TRIED = 1.0, 33


@dataclass(frozen=True)
class Line:
    """
    A line in the spectrum.

    Attributes
    ----------
    frequency : float
        Hz, below half the sampling rate.
    resolution : float
        Width of a bin, Hz: what the frequency is known to.
    rms, rms_low, rms_high : float
        Its root mean square and the 95 % interval, V.
    share : float
        Share of the variance of the level.
    p_value : float
        Of an ordinate so large, times the ordinates tested at all levels.

    """

    frequency: float
    resolution: float
    rms: float
    rms_low: float
    rms_high: float
    share: float
    p_value: float


@dataclass(frozen=True)
class LineSearch:
    """
    What was looked for and found.

    Attributes
    ----------
    lines : tuple of Line
        Strongest first.
    tested : int
        Ordinates tested at this level.
    lowest, highest : float
        Frequencies looked at, Hz.
    detectable : float
        RMS of a line that is found with 90 % probability where the noise is at its median, V.
    why_not : str
        Why nothing was looked for; empty when it was.

    """

    lines: tuple[Line, ...] = ()
    tested: int = 0
    lowest: float = NAN
    highest: float = NAN
    detectable: float = NAN
    why_not: str = ''


def find_lines(parts: Sequence[FloatArray], rate: float, *, false_alarm: float = FALSE_ALARM,
               levels: int = 1, memory: float = 0.0) -> LineSearch:
    """Look for lines in stretches of evenly spaced samples (parts in V, rate in Hz)."""
    length = _piece_length([part.size for part in parts], rate)
    if length < _FEWEST or not rate > 0.0:
        return LineSearch(why_not=f'no segment holds {_FEWEST} samples')
    window = np.hanning(length + 1)[:-1]
    pieces = [part[k * length:(k + 1) * length] for part in parts
              for k in range(part.size // length)]
    raw, white = np.zeros(length // 2 + 1), np.zeros(length // 2 + 1)
    count = np.arange(length) - 0.5 * (length - 1)
    for piece in pieces:
        level = piece - piece.mean() - count * float(count @ piece) / float(count @ count)
        raw += np.abs(np.fft.rfft(window * level)) ** 2
        whitened = lfilter([1.0, -memory], [1.0], level)
        whitened[0] = 0.0
        white += np.abs(np.fft.rfft(window * whitened)) ** 2
    # One-sided density; what a constant filter does to both sides of a ratio cancels.
    df = rate / length
    raw *= 2.0 / (rate * float(window @ window) * len(pieces))
    where = np.arange(FIRST, length // 2 - 1)
    middle = _local_median(white, where)
    k = float(len(pieces))
    near = min(_NEIGHBOURS, _strided(where.size))
    ratio = white[where] / np.maximum(middle, 1e-300)
    limit = threshold(k, near, false_alarm / (levels * where.size))
    hits = np.flatnonzero(ratio > limit)
    p = np.ones(where.size)
    p[hits] = tail(ratio[hits], k, near) * where.size * levels
    background = raw[where] / np.maximum(white[where], 1e-300) * middle
    # The median of a gamma variable, in units of its mean.
    background /= float(gammaincinv(k, 0.5)) / k
    total = float(sum(((part - part.mean()) ** 2).sum() for part in parts)
                  / sum(part.size for part in parts))
    lines = [_measure(raw, background, where, group, p, df, total, k)
             for group in _groups(hits)]
    lines.sort(key=lambda line: -line.rms)
    typical = float(np.median(background))
    return LineSearch(tuple(lines), int(where.size), float(where[0] * df), float(where[-1] * df),
                      _detectable(typical, df, k, limit))


def tail(ratio: FloatArray, pieces: float, neighbours: int) -> FloatArray:
    """Return the probability that noise exceeds a multiple of its neighbours' median."""
    at = _medians(pieces, neighbours)
    found: FloatArray = gammaincc(pieces, np.outer(ratio, at)) @ _WEIGHTS
    return found


@lru_cache(maxsize=256)
def _medians(pieces: float, neighbours: int) -> FloatArray:
    """Return quantiles of the median of the neighbours, for the average over it."""
    j = neighbours // 2 + 1
    return np.asarray(gammaincinv(pieces, betaincinv(j, neighbours - j + 1, _QUANTILES)))


@lru_cache(maxsize=256)
def threshold(pieces: float, neighbours: int, level: float) -> float:
    """Return the ratio that `tail` gives a probability `level` to."""
    low, high = 0.0, 12.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        passes = float(tail(np.array([math.exp(middle)]), pieces, neighbours)[0]) < level
        low, high = (low, middle) if passes else (middle, high)
    return math.exp(high)


def _piece_length(sizes: Sequence[int], rate: float) -> int:
    """Return the length of pieces for which a line of given power is found best."""
    longest = max(sizes, default=0)
    if longest < _FEWEST:
        return 0
    top = min(longest, max(_FEWEST, int(_LONGEST * rate)))
    best, score = top, 0.0
    for length in {top, *(size for size in sizes if _FEWEST <= size < top)}:
        # The power of a line adds up over the pieces, the scatter of noise with their root.
        gained = length * math.sqrt(sum(size // length for size in sizes))
        if gained > score:
            best, score = length, gained
    return best


def _strided(n: int) -> int:
    """Return how many neighbours n ordinates can give, even."""
    return max(2, (n - 2 * _GUARD) // 4 * 2)


def _local_median(density: FloatArray, where: np.ndarray) -> FloatArray:
    """Return the upper median of the nearest neighbours on either side, shape of `where`."""
    n = where.size
    near = min(_NEIGHBOURS, _strided(n))
    side = np.arange(_GUARD, _GUARD + near, 2)
    both = np.concatenate((-side[::-1], side))
    found = np.empty(n)
    inner = np.arange(side[-1], n - side[-1])
    for part in np.array_split(inner, max(1, inner.size // 4096)):
        values = density[where[0] + part[:, None] + both[None, :]]
        found[part] = np.partition(values, near // 2, axis=1)[:, near // 2]
    # Near an end there are more on one side: the nearest, wherever they lie.
    reach = np.arange(_GUARD, _GUARD + 4 * near, 2)
    offsets = np.concatenate((-reach[::-1], reach))
    edges = np.setdiff1d(np.arange(n), inner)
    index = edges[:, None] + offsets[None, :]
    inside = (index >= 0) & (index < n)
    distance = np.where(inside, np.abs(offsets)[None, :], np.iinfo(np.int64).max)
    chosen = np.argpartition(distance, near - 1, axis=1)[:, :near]
    values = density[where[0] + np.take_along_axis(np.where(inside, index, 0), chosen, 1)]
    found[edges] = np.partition(values, near // 2, axis=1)[:, near // 2]
    return found


def _groups(hits: np.ndarray) -> list[np.ndarray]:
    """Join ordinates of one line."""
    if not hits.size:
        return []
    return list(np.split(hits, np.flatnonzero(np.diff(hits) > 2 * _LOBE) + 1))


def _measure(raw: FloatArray, background: FloatArray, where: np.ndarray, group: np.ndarray,
             p: FloatArray, df: float, total: float, k: float) -> Line:
    """Return frequency and power of the line that a group of ordinates belongs to."""
    low, high = max(0, group[0] - _LOBE), min(where.size, group[-1] + _LOBE + 1)
    if group.size <= 2 * _LOBE + 1:
        peak = int(group[np.argmax(raw[where[group]])])
        low, high = max(0, peak - _LOBE), min(where.size, peak + _LOBE + 1)
    density, noise = raw[where[low:high]], background[low:high]
    excess = np.maximum(density - noise, 0.0)
    power = float((density - noise).sum() * df)
    floor = float(noise.mean() * df)
    # Window of Hann: sum w^4 / (sum w^2)^2 = 1.94 / n; correlations 4/9 and 1/36 of neighbours.
    bins = high - low
    spread = bins + 2.0 * ((bins - 1) * 4.0 / 9.0 + max(bins - 2, 0) / 36.0)
    se = math.sqrt((3.89 * max(power, 0.0) * floor + spread * floor ** 2) / k)
    reach = Z95 * se
    return Line(float((where[low:high] * excess).sum() / excess.sum() * df), df,
                math.sqrt(max(power, 0.0)), math.sqrt(max(power - reach, 0.0)),
                math.sqrt(max(power + reach, 0.0)), max(power, 0.0) / total if total else NAN,
                float(min(p[group].min(), 1.0)))


def _detectable(density: float, df: float, k: float, limit: float) -> float:
    """Return the RMS that passes the limit with 90 % probability, V."""
    # A line on a bin has 2/3 of its power there; between two bins 0.48.
    return math.sqrt(_lift(k, limit) / (2.0 * k) * density * df / 0.48)


@lru_cache(maxsize=256)
def _lift(k: float, limit: float) -> float:
    """Return the noncentrality with which an ordinate passes the limit nine times in ten."""
    least = 2.0 * limit * float(gammaincinv(k, 0.5))
    low, high = 0.0, 10.0 * least + 100.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        seen = float(chndtr(least, 2.0 * k, middle)) <= 0.1
        low, high = (low, middle) if seen else (middle, high)
    return high


def without_lines(voltage: FloatArray, rate: float, lines: Sequence[Line]) -> FloatArray:
    """Return one stretch without lines (voltage in V, rate in Hz, result in V)."""
    if not lines or not voltage.size:
        return voltage
    pieces = max(1, round(voltage.size * lines[0].resolution / rate))
    return np.concatenate([_cleaned(piece, rate, lines)
                           for piece in np.array_split(voltage, pieces)])


def _cleaned(piece: FloatArray, rate: float, lines: Sequence[Line]) -> FloatArray:
    """Return a piece less one sinusoid a line."""
    mean = float(piece.mean())
    left: FloatArray = piece - mean
    angle = 2.0 * np.pi / rate * np.arange(piece.size)
    window = np.hanning(piece.size + 2)[1:-1]
    for line in lines:
        tried = line.frequency + line.resolution * np.linspace(-_REACH, _REACH, _TRIED)
        tried = tried[(tried > 0.0) & (tried < 0.5 * rate)]
        power = [abs(np.exp(-1j * f * angle) @ (window * left)) for f in tried]
        best = float(tried[int(np.argmax(power))])
        waves = np.column_stack((np.cos(best * angle), np.sin(best * angle)))
        left = left - waves @ np.linalg.lstsq(waves, left, rcond=None)[0]
    return left + mean
