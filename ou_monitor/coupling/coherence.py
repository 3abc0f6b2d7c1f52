"""
Test whether two series share anything, at a stated level whatever their spectra.

Limits: given their sizes, the series must be zero-mean in the band and as likely as their
negatives.  A line of the same frequency and phase in both is found although it is not coupling
(`narrow`).  Effects of throttle on both must be regressed out, or count as shared.

A manoeuvre changes the shape of a gyro's spectrum, not only its size.  With one weight for each
segment the quiet segments would decide the high bins.  So each bin of each segment is divided by
the root mean square of the signal over the bins around it.  If the signal is then white Gaussian,
the squared partial coherence of a bin exceeds c by chance with probability (1 - c)^(K - 1 - p),
for any voltage, with K segments and p causes regressed out (Halliday et al., 1995).  Moving lines
and bursts are not whitened by that.  So the same statistics are computed with random signs of the
signal for blocks of neighbouring segments, which keep every size (Freedman and Lane, 1983); a
coherence must be too large for both laws.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from scipy import stats
from scipy.ndimage import uniform_filter1d
from scipy.special import chndtrinc

ComplexArray = npt.NDArray[np.complex128]

# Bins that the signal's power is averaged over.
_AROUND = 11
# Neighbouring bins of the Hann window are correlated by 2/3, every second by 1/6.
STRIDE = 2
# Power correlation of half-overlapping Hann segments: (1/6)^2.
OVERLAP = 1.0 / 36.0
# Random draws of signs; number that must reach a statistic for its p-value to be their share
# rather than extrapolated.
_DRAWS, _COUNTED = 499, 10
# Segments that share a sign: overlap correlates neighbours, lines and slow manoeuvres more
# distant ones.  With few segments blocks are shorter, so that 2^16 draws exist.
_BLOCK, _BLOCKS = 16, 16
# Family-wise level of bins that may be a line: far beyond chance.
_LINE = 1e-4


@dataclass(frozen=True, eq=False)
class Coherence:
    """Share of a signal that a voltage explains, for each bin, with its tests."""

    p_value: float  # Family-wise: of the sum over bins and the largest bin, each at half the level
    squared: FloatArray  # Squared partial coherence, 0..1; shape (m,)
    response: ComplexArray  # Signal units per volt; shape (m,)
    # Power of the voltage over the power of the unexplained signal, 1 / gain^2; shape (m,).
    ratio: FloatArray
    threshold: float  # Coherence that the largest bin must exceed
    # Effective number of segments; the same less the fitted parameters.
    segments: float
    spare: float
    narrow: bool  # Only a few bins are coherent, and the others contradict their gain

    def limit(self, level: float, power: float) -> float:
        """Return the gain that the sum would detect with probability `power`."""
        ratio = self.ratio[::STRIDE]
        freedom = 2 * ratio.size
        needed = float(stats.chi2.isf(0.5 * level, freedom))
        far = float(chndtrinc(needed, freedom, 1.0 - power))
        per_gain = 2.0 * self.spare * float(ratio.sum())
        return math.sqrt(far / per_gain) if per_gain > 0.0 else math.inf


def effective_segments(count: int) -> float:
    """Return the equivalent number of segments without overlap."""
    return count / (1.0 + 2.0 * OVERLAP * (count - 1) / count)


def measure_coherence(voltage: ComplexArray, signal: ComplexArray, causes: list[ComplexArray],
                      level: float, rng: np.random.Generator) -> Coherence:
    """Test Fourier coefficients of shape (segments, bins), with the causes regressed out."""
    weight = 1.0 / local_size(signal)
    # The weights contain the signal: equivalent to losing one of so many independent powers.
    share = 1.0 - 1.0 / _independent(signal.shape[1])
    whole = weight * signal
    basis = basis_of([weight * cause for cause in causes])
    v, x = without(weight * voltage, basis), without(whole, basis)
    segments = effective_segments(len(signal))
    spare = segments - 1.0 - len(causes)
    vv, xx = (np.abs(v)**2).sum(0), (np.abs(x)**2).sum(0)
    response = (np.conj(v) * x).sum(0) / np.where(vv > 0.0, vv, 1.0)
    squared = np.clip(np.abs(response)**2 * vv / xx, 0.0, 1.0 - 1e-12)
    ratio = share**2 * vv / np.maximum(xx - np.abs(response)**2 * vv, 1e-12 * xx)
    response = response / share
    p_sum, p_max, threshold = chance(squared[::STRIDE], spare, level)
    tested = slice(None), slice(None, None, STRIDE)
    drawn_sum, drawn_max = _drawn(v[tested], whole[tested], [one[tested] for one in basis], rng)
    p_value = min(1.0, 2.0 * min(max(p_sum, drawn_sum), max(p_max, drawn_max)))
    narrow = p_value <= level and _narrow(squared, response, ratio, spare)
    return Coherence(p_value, squared, response, ratio, threshold, segments, spare, narrow)


def local_size(signal: ComplexArray) -> FloatArray:
    """Return the root mean square of a signal around each bin of each segment."""
    power = np.abs(signal)**2
    if power.shape[1] > _AROUND:
        mean = uniform_filter1d(power, _AROUND, axis=1, mode='reflect')
    else:
        mean = np.broadcast_to(power.mean(axis=1, keepdims=True), power.shape)
    # A running sum leaves rounding errors behind a loud bin.
    floor = max(1e-14 * float(power.max()), float(np.finfo(np.float64).tiny))
    size: FloatArray = np.sqrt(np.maximum(mean, floor))
    return size


def _independent(bins: int) -> float:
    """Return the equivalent number of independent powers in a local mean."""
    around = min(bins, _AROUND)
    pairs = (1.0 - 1.0 / around) * (2.0 / 3.0)**2 + max(0.0, 1.0 - 2.0 / around) / 36.0
    return around / (1.0 + 2.0 * pairs)


def basis_of(causes: list[ComplexArray]) -> list[ComplexArray]:
    """Return orthonormal directions of the causes, bin by bin."""
    basis: list[ComplexArray] = []
    for cause in causes:
        size = (np.abs(cause)**2).sum(0)
        part = without(cause, basis)
        norm = np.sqrt((np.abs(part)**2).sum(0))
        # A cause that repeats another leaves rounding only (float32: 1e-7).
        basis.append(np.where(norm**2 > 1e-10 * size, part / np.where(norm > 0.0, norm, 1.0),
                              0.0))
    return basis


def without(y: ComplexArray, basis: list[ComplexArray]) -> ComplexArray:
    """Return the residual of y after regression on orthonormal directions in each bin."""
    rest = y.copy()
    for one in basis:
        rest -= (np.conj(one) * rest).sum(0) * one
    return rest


def chance(squared: FloatArray, spare: float, level: float) -> tuple[float, float, float]:
    """Return the p-values of the sum and of the largest bin, and its threshold."""
    information = -spare * np.log1p(-squared)
    p_sum = float(stats.gamma.sf(information.sum(), squared.size))
    p_max = -math.expm1(squared.size * math.log1p(-math.exp(-float(information.max()))))
    alone = -math.expm1(math.log1p(-0.5 * level) / squared.size)
    return p_sum, p_max, -math.expm1(math.log(alone) / spare)


def _drawn(v: ComplexArray, x: ComplexArray, basis: list[ComplexArray],
           rng: np.random.Generator) -> tuple[float, float]:
    """Return the p-values of the sum and of the largest bin under random signs."""
    count = len(x)
    length = max(1, min(_BLOCK, count // _BLOCKS))
    starts = np.arange(0, count, length)
    signs = rng.choice((-1.0, 1.0), (_DRAWS + 1, starts.size))
    # The first row is the measurement.
    signs[0] = 1.0
    power = (np.abs(x)**2).sum(0)
    size = (np.abs(v)**2).sum(0)
    # Regress the causes out of the signal with the drawn signs.
    taken = np.zeros((len(signs), x.shape[1]))
    for one in basis:
        taken += _power(signs, np.add.reduceat(np.conj(one) * x, starts))
    shared = _power(signs, np.add.reduceat(np.conj(v) * x, starts))
    squared = shared / np.where(size > 0.0, size, 1.0) / np.maximum(power - taken, 1e-12 * power)
    information = -np.log1p(-np.clip(squared, 0.0, 1.0 - 1e-12))
    # Random signs remove the correlation across ends of blocks.
    information[0] /= 1.0 + 2.0 * OVERLAP * (starts.size - 1) / count
    return _tail(information.sum(1), 'gamma'), _tail(information.max(1), 'gumbel')


def _power(signs: FloatArray, parts: ComplexArray) -> FloatArray:
    """Return squared sums over the blocks, shape (draws, bins)."""
    power: FloatArray = (signs @ parts.real)**2 + (signs @ parts.imag)**2
    return power


def _tail(drawn: FloatArray, law: str) -> float:
    """Return the share of draws that reach the first; with few, the tail of a fitted law."""
    reached = int((drawn >= drawn[0] * (1.0 - 1e-12)).sum())
    if reached > _COUNTED:
        return reached / drawn.size
    mean, variance = float(drawn[1:].mean()), float(drawn[1:].var())
    if not variance > 0.0:
        return 1.0
    if law == 'gamma':
        return float(stats.gamma.sf(drawn[0], mean**2 / variance, scale=variance / mean))
    scale = math.sqrt(6.0 * variance) / math.pi
    return float(stats.gumbel_r.sf(drawn[0], mean - float(np.euler_gamma) * scale, scale))


def _narrow(squared: FloatArray, response: ComplexArray, ratio: FloatArray, spare: float) -> bool:
    """Return whether only a few bins are coherent and the others contradict their gain."""
    loud = squared > chance(squared[::STRIDE], spare, _LINE)[2]
    # A line spreads over the main lobe of the window and its first side lobes.
    near = np.convolve(loud, np.ones(9), 'same') > 0
    left = np.flatnonzero(~near)[::STRIDE]
    if not loud.any() or left.size < 0.25 * squared.size:
        return False
    gain = float(np.median(np.abs(response[loud])))
    far = 2.0 * spare * gain**2 * float(ratio[left].sum())
    needed = stats.chi2.isf(0.02, 2 * left.size)
    return bool(stats.ncx2.sf(needed, 2 * left.size, far) > 0.95
                and chance(squared[left], spare, _LINE)[0] > 0.02)
