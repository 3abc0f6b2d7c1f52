"""
Whether two series share anything: a test at its stated level whatever their spectra do.

Limits first: the series must be zero-mean in the band and as likely as their
negatives, given their sizes; a line of the same frequency and of one phase in both is
found, and is no coupling (`narrow` tells it).  What both owe to throttle must have
been taken out, or counts as shared.

A vehicle that manoeuvres changes the shape of a gyro's spectrum, not only its
size.  With one weight for each segment the quiet segments then decide the
high bins, and fewer count than are averaged.  So each bin of each segment is
divided by the root mean square of the signal over the bins around it.  If the
signal is then white Gaussian the squared partial coherence of a bin exceeds c
by chance with probability (1 - c)^(K - 1 - p), whatever the voltage is: K
segments and p causes taken out (Halliday et al., 1995).  A line that moves, or bursts, are
not made white by that.  Therefore the same statistics are computed with the
signs of the signal drawn at random for blocks of neighbouring segments, which leaves
every size as it is (Freedman and Lane, 1983); a coherence must be too large for
either law.
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
# Draws of signs, and how many of them must reach a statistic to be counted
# rather than extrapolated.
_DRAWS, _COUNTED = 499, 10
# Segments that share a sign: the overlap correlates neighbours, and a line or what leaks from
# slow manoeuvres does so further.  Few segments make shorter blocks, so that there are
# 2^16 draws.
_BLOCK, _BLOCKS = 16, 16
# Family-wise level of the bins that may be a line: surely not chance.
_LINE = 1e-4


@dataclass(frozen=True, eq=False)
class Coherence:
    """What a voltage explains of a signal, bin by bin, and how surely."""

    p_value: float  # Family-wise: of the sum over bins and the largest bin, each at half the level
    squared: FloatArray  # Squared partial coherence, 0..1; shape (m,)
    response: ComplexArray  # Signal units per volt; shape (m,)
    # Power of the voltage over that of the rest of the signal, 1 / gain^2, as far as the test can
    # use it; shape (m,).
    ratio: FloatArray
    threshold: float  # Coherence that the largest bin must exceed
    # Segments averaged, overlap counted out; those less what was fitted.
    segments: float
    spare: float
    narrow: bool  # Whether a few bins make the finding, and the others contradict their gain

    def limit(self, level: float, power: float) -> float:
        """Return the gain that the sum would have shown with probability `power`."""
        ratio = self.ratio[::STRIDE]
        freedom = 2 * ratio.size
        needed = float(stats.chi2.isf(0.5 * level, freedom))
        far = float(chndtrinc(needed, freedom, 1.0 - power))
        per_gain = 2.0 * self.spare * float(ratio.sum())
        return math.sqrt(far / per_gain) if per_gain > 0.0 else math.inf


def effective_segments(count: int) -> float:
    """Return how many segments without overlap average as well."""
    return count / (1.0 + 2.0 * OVERLAP * (count - 1) / count)


def measure_coherence(voltage: ComplexArray, signal: ComplexArray, causes: list[ComplexArray],
                      level: float, rng: np.random.Generator) -> Coherence:
    """Test Fourier coefficients of shape (segments, bins), the causes' share taken out."""
    weight = 1.0 / local_size(signal)
    # The weights hold the signal itself: as if one of so many powers were taken away.
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
    # A running sum leaves rounding where a loud bin has left the window.
    floor = max(1e-14 * float(power.max()), float(np.finfo(np.float64).tiny))
    size: FloatArray = np.sqrt(np.maximum(mean, floor))
    return size


def _independent(bins: int) -> float:
    """Return how many powers without correlation would scatter as the mean of those around."""
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
        # What is left of a cause that says the same as another is rounding
        # (of float32, relative 1e-7).
        basis.append(np.where(norm**2 > 1e-10 * size, part / np.where(norm > 0.0, norm, 1.0),
                              0.0))
    return basis


def without(y: ComplexArray, basis: list[ComplexArray]) -> ComplexArray:
    """Return what a regression on orthonormal directions, bin by bin, leaves of y."""
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
    # The first draw is what was measured.
    signs[0] = 1.0
    power = (np.abs(x)**2).sum(0)
    size = (np.abs(v)**2).sum(0)
    # The causes are taken out of the signal anew, with its drawn signs.
    taken = np.zeros((len(signs), x.shape[1]))
    for one in basis:
        taken += _power(signs, np.add.reduceat(np.conj(one) * x, starts))
    shared = _power(signs, np.add.reduceat(np.conj(v) * x, starts))
    squared = shared / np.where(size > 0.0, size, 1.0) / np.maximum(power - taken, 1e-12 * power)
    information = -np.log1p(-np.clip(squared, 0.0, 1.0 - 1e-12))
    # Drawn signs lose the correlation of neighbours across the ends of blocks.
    information[0] /= 1.0 + 2.0 * OVERLAP * (starts.size - 1) / count
    return _tail(information.sum(1), 'gamma'), _tail(information.max(1), 'gumbel')


def _power(signs: FloatArray, parts: ComplexArray) -> FloatArray:
    """Return squared sums of the parts of blocks, shape (draws, bins)."""
    power: FloatArray = (signs @ parts.real)**2 + (signs @ parts.imag)**2
    return power


def _tail(drawn: FloatArray, law: str) -> float:
    """Return the share of draws that reach the first; the tail of a law where few do."""
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
    """Return whether a few bins make the finding, and the others contradict their gain."""
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
