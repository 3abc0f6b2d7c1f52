"""
Sinusoids in a voltage: fits at given frequencies, and detection of clear tones.

`tones` is for the node, which must not load SciPy; `spectral_lines` detects weaker lines, in
averaged periodograms.  The periodogram ordinates of noise are exponentially distributed.  The
ratio of an ordinate to the median of its N neighbours (the j-th smallest) exceeds r with
probability prod_(i=1..j) 1 / (1 + r / (N - i + 1)), because the spacings of ordered exponential
variables are independent and exponential (Renyi 1953).  So the test needs no model of the
spectrum.

Limits: as in `spectral_lines`.  Each piece of a few seconds is tested separately, so tones that
are visible only in the average over pieces are missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

# Probability of reporting a line, at any load level, in a recording without lines.
FALSE_ALARM = 0.01
# Maximum length of a short piece, s, because tones of motors and converters drift.
SHORT = 4.0
# Minimum number of periods of a line in a piece: with fewer, slow noise looks like a line, and
# subtracting mean and trend removes a part of the line.
FIRST = 10
# Neighbours of an ordinate: distance of the nearest, in bins, and their number.  Only every second
# ordinate is a neighbour, because the window correlates adjacent ordinates.
GUARD, NEIGHBOURS = 4, 64
# Maximum factor on the number of neighbours in long pieces, whose bins are narrower.
_MORE = 4
# Number of bins on either side over which the window spreads a steady line.
LOBE = 2
# Minimum number of samples in a piece, and of ordinates that are searched.
FEWEST_SAMPLES, FEWEST_TESTED = 128, 32
# Parts of a piece whose phases are compared, and frequencies tried for each bin of the piece.
_PHASES, _TRIED = 64, 32


@dataclass(frozen=True)
class Sinusoid:
    """A sinusoid fitted to a piece."""

    amplitude: float  # Peak, V
    frequency: float  # Hz
    phase: float  # Argument of the sine at the first sample, rad

    def sampled(self, t: FloatArray) -> FloatArray:
        """Return the voltage, V, at times since the first sample, s."""
        wave: FloatArray = self.amplitude * np.sin(
            2.0 * math.pi * (t * self.frequency % 1.0) + self.phase)
        return wave


def fit_sinusoid(piece: FloatArray, rate: float, frequency: float, reach: float) -> Sinusoid:
    """Return the strongest sinusoid near a frequency (piece in V; rate, reach in Hz)."""
    v = piece - piece.mean()
    size = max(1, v.size // _PHASES)
    count = v.size // size
    # Reduce each part of the piece to one complex number, in a frame rotating at `frequency`.
    turns = frequency / rate
    sums = v[:count * size].reshape(count, size) @ _rotation(turns, size)
    sums *= _rotation(turns * size, count)
    shifts = np.fft.fftfreq(_TRIED * count, size / rate)
    power = np.abs(np.fft.fft(np.hanning(count + 2)[1:-1] * sums, shifts.size))
    power[(np.abs(shifts) > reach) | (frequency + shifts <= 0.0)
          | (frequency + shifts >= 0.5 * rate)] = 0.0
    top = int(np.argmax(power))
    # Interpolate by a parabola: an error of half a step would leave 3 % of the amplitude.
    before, here, after = (float(power[k % power.size]) for k in (top - 1, top, top + 1))
    bent = before - 2.0 * here + after
    off = 0.5 * (before - after) / bent if before and after and bent < 0.0 else 0.0
    best = frequency + float(shifts[top] + off * shifts[1])
    wave = _rotation(best / rate, v.size)
    waves = np.column_stack((-wave.imag, wave.real))
    sine, cosine = np.linalg.solve(waves.T @ waves, waves.T @ v).tolist()
    return Sinusoid(math.hypot(sine, cosine), best, math.atan2(cosine, sine))


def without_sinusoids(piece: FloatArray, rate: float, frequencies: Sequence[float],
                      reach: float) -> FloatArray:
    """Subtract, one after another, the strongest sinusoid near each frequency, Hz (piece in V)."""
    for frequency in frequencies:
        piece = piece - fit_sinusoid(piece, rate, frequency, reach).sampled(
            np.arange(piece.size) / rate)
    return piece


def _rotation(turns: float, count: int) -> npt.NDArray[np.complex128]:
    """Return a unit phasor that rotates backwards by a number of turns per sample."""
    found: npt.NDArray[np.complex128] = np.exp(-2j * math.pi * (turns * np.arange(count) % 1.0))
    return found


def local_median(density: FloatArray, where: np.ndarray, near: int) -> FloatArray:
    """Return the upper median of each ordinate's nearest neighbours; shape of `where`."""
    n = where.size
    # If there are many neighbours, adjacent ordinates share one median.
    hop = max(1, near // NEIGHBOURS)
    centres = np.minimum(np.arange(0, n, hop) + hop // 2, n - 1)
    guard = GUARD + hop // 2
    side = np.arange(guard, guard + near, 2)
    both = np.concatenate((-side[::-1], side))
    found = np.empty(centres.size)
    inside = (centres >= side[-1]) & (centres < n - side[-1])
    inner = np.flatnonzero(inside)
    for part in np.array_split(inner, max(1, inner.size * near // (1 << 18))):
        values = density[where[0] + centres[part, None] + both[None, :]]
        found[part] = np.partition(values, near // 2, axis=1)[:, near // 2]
    # Near an end, one side has too few neighbours: take more from the other side.
    reach = np.arange(guard, guard + 4 * near, 2)
    offsets = np.concatenate((-reach[::-1], reach))
    edges = np.flatnonzero(~inside)
    index = centres[edges, None] + offsets[None, :]
    there = (index >= 0) & (index < n)
    distance = np.where(there, np.abs(offsets)[None, :], np.iinfo(np.int64).max)
    chosen = np.argpartition(distance, near - 1, axis=1)[:, :near]
    values = density[where[0] + np.take_along_axis(np.where(there, index, 0), chosen, 1)]
    found[edges] = np.partition(values, near // 2, axis=1)[:, near // 2]
    return np.repeat(found, hop)[:n]


def groups(hits: np.ndarray) -> list[np.ndarray]:
    """Group the ordinates that belong to one line."""
    if not hits.size:
        return []
    return list(np.split(hits, np.flatnonzero(np.diff(hits) > 2 * LOBE) + 1))


def tones(v: FloatArray, white: FloatArray, rate: float, lowest: float = 0.0) -> FloatArray:
    """Return the sum of clear tones in evenly spaced samples, V (rate and lowest in Hz)."""
    # white: innovations of v; lines are detected in their flatter spectrum.
    found, pieces = np.zeros(v.size), math.ceil(v.size / (SHORT * rate))
    for where in np.array_split(np.arange(v.size), max(1, pieces)):
        n = where.size
        tested = np.arange(max(FIRST, math.ceil(lowest * n / rate)), n // 2 - 1)
        if n < FEWEST_SAMPLES or tested.size < FEWEST_TESTED:
            continue
        e = white[where]
        power = np.abs(np.fft.rfft((e - e.mean()) * np.hanning(n))) ** 2
        near = neighbours(tested.size)
        ratio = power[tested] / np.maximum(local_median(power, tested, near), 1e-300)
        ranks = near - np.arange(near // 2 + 1)
        log_p = -np.log1p(ratio[:, None] / ranks).sum(axis=1)
        hits = np.flatnonzero(log_p < math.log(FALSE_ALARM / (pieces * tested.size)))
        peaks = [int(group[np.argmax(ratio[group])]) for group in groups(hits)]
        found[where] = v[where] - without_sinusoids(v[where], rate, [
            tested[peak] * rate / n for peak in sorted(peaks, key=lambda k: -ratio[k])], rate / n)
    return found


def neighbours(ordinates: int, share: float = 1.0) -> int:
    """Return the number of neighbours, which is even and grows with the length of the piece."""
    # share: length of the piece relative to a short one, so that neighbours span equal bands, Hz.
    there = max(2, (ordinates - 2 * GUARD) // 4 * 2)
    return min(there, NEIGHBOURS * min(_MORE, max(1, int(share))))
