"""
How much of a signal, such as a gyro axis, is noise of the supply.

Limits first.  White noise of the voltage sensor makes the gain too small: by
the share of it in the voltage within the band.  What throttle does to both is
taken out as far as it follows throttle and its square linearly, with any lag
shorter than a segment; a motor's rotation that shakes the gyro and ripples the
supply is a cause of both that throttle does not carry, and is told apart by
being narrow only.  A signal that *leads* the voltage is rather its cause, by
way of the motors.  Both are said, neither is corrected.

Method: Fourier coefficients of half-overlapping Hann segments.  In every
frequency bin the signal's are regressed on those of the voltage, of throttle
and of its square, each segment weighted by the signal's power in it: the noise
of a gyro grows with throttle as that of the supply does, and unweighted a few
loud segments would decide.  Given the voltage the squared partial coherence of
a bin then exceeds c by chance with probability (1 - c)^(K - 1 - p), K segments
and p causes taken out (Halliday et al., 1995).  Two tests at half the level
each (Bonferroni): the sum of -(K - 1 - p) ln(1 - c), Gamma-distributed over
bins, and the largest one.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.coupling.common_grid import Grid, on_grid
from ou_monitor.errors import InputError
from ou_monitor.records import FloatArray, NAN
from scipy import stats
from scipy.signal.windows import hann
from scipy.special import chndtrinc

ComplexArray = npt.NDArray[np.complex128]

# Pilot and discharge lie below, Hz.
LOWEST = 5.0
# Longest and shortest segment, s, and how many the recording is cut into.
_LONGEST, _SHORTEST, _PIECES = 1.0, 0.1, 40
FEWEST = 16
# Neighbouring bins of the Hann window are correlated by 2/3, every second by 1/6.
_STRIDE = 2
# Power correlation of half-overlapping Hann segments: (1/6)^2.
_OVERLAP = 1.0 / 36.0
LONGEST_LAG = 0.05
_BLOCKS = 12
# Family-wise level of the bins that may be a line: surely not chance.
_LINE = 1e-4
# With which probability a coupling of the limiting gain would have been seen.
POWER = 0.9


@dataclass(frozen=True, eq=False)
class Coupling:
    """
    What was found.

    Attributes
    ----------
    seen : bool
        Whether there is coupling, at the family-wise `level`.
    p_value : float
        Family-wise.
    gain, gain_ci95 : float, tuple of float
        Signal units per volt, signed, lag taken out; NaN when none was seen.
    lag, lag_se : float
        Of the signal behind the voltage, s; NaN when none was seen.
    limit : float
        Gain that would have been seen with probability `POWER`, signal units
        per volt.
    narrow : bool
        Whether what was seen is in a few bins only: a line that both share.
    signal_leads : bool
        Whether the signal is surely ahead of the voltage.
    noise_share : float
        Share of the signal's power in the band that the voltage explains.
    frequency, coherence, response : ndarray, shape (m,)
        Bins of the band, Hz; squared partial coherence; signal units per volt.
    threshold : float
        Coherence that the largest bin must exceed.
    level : float
        Family-wise probability of a false alarm.
    segments : float
        Segments averaged, overlap counted out.
    partial : bool
        Whether throttle was taken out.
    grid : Grid
        Resampled series.
    notes : tuple of str
        Cautions, one sentence each.

    """

    seen: bool
    p_value: float
    gain: float
    gain_ci95: tuple[float, float]
    lag: float
    lag_se: float
    limit: float
    narrow: bool
    signal_leads: bool
    noise_share: float
    frequency: FloatArray
    coherence: FloatArray
    response: ComplexArray
    threshold: float
    level: float
    segments: float
    partial: bool
    grid: Grid
    notes: tuple[str, ...]


def estimate_coupling(
    t: FloatArray, voltage: FloatArray, signal_t: FloatArray, signal: FloatArray, *,
    throttle: FloatArray | None = None, band: tuple[float, float] | None = None,
    level: float = 0.05,
) -> Coupling:
    """Estimate the gain from the supply voltage to a signal (band in Hz, level 0..1)."""
    if not 0.0 < level < 1.0:
        raise InputError(f'the level must lie between 0 and 1, got {level:g}')
    series = {'the voltage': (t, voltage), 'the signal': (signal_t, signal)}
    notes = []
    known = throttle is not None and np.isfinite(throttle).sum() > 0.9 * throttle.size
    if known and throttle is not None and np.nanmax(throttle) > np.nanmin(throttle):
        series['the throttle'] = (t, throttle)
    elif not known:
        notes.append('Throttle is not known: what it does to both would be taken for coupling.')
    grid = on_grid(series)
    low, high = _band(band, grid)
    length = _segment_length(grid, low)
    frequency, pieces = _segments(grid, length, low, high)
    weight = np.sqrt(np.mean(np.abs(pieces[1])**2, axis=1))
    for name, one in zip(series, pieces[:2]):
        if not (np.abs(one)**2).sum() > 0.0:
            raise InputError(f'{name} does not change within {low:g}..{high:g} Hz')
    weight[weight == 0.0] = weight[weight > 0.0].min()
    scaled = [one / weight[:, None] for one in pieces]
    count = scaled[0].shape[0]
    if count < FEWEST:
        raise InputError(
            f'the series share {grid.duration:.3g} s in {count} segments without a gap: at least '
            f'{FEWEST} segments of {length / grid.rate:.2g} s are needed')
    v, x = _without(scaled[0], scaled[2:]), _without(scaled[1], scaled[2:])
    causes = len(scaled) - 2
    segments = count / (1.0 + 2.0 * _OVERLAP * (count - 1) / count)
    spare = segments - 1.0 - causes

    vv, xx = (np.abs(v)**2).sum(0), (np.abs(x)**2).sum(0)
    response = (np.conj(v) * x).sum(0) / vv
    coherence = np.clip(np.abs(response)**2 * vv / xx, 0.0, 1.0 - 1e-12)
    tested = slice(0, None, _STRIDE)
    p_sum, p_max, threshold = _tests(coherence[tested], spare, level)
    p_value = min(1.0, 2.0 * min(p_sum, p_max))
    seen = p_value <= level

    rest = np.maximum(xx - np.abs(response)**2 * vv, 1e-12 * xx)
    limit = _limit(vv[tested], rest[tested], spare, level)
    narrow = seen and _narrow(coherence, response, vv / rest, spare)
    gain = lag = lag_se = NAN
    interval = (NAN, NAN)
    if seen:
        gain, lag = _fit(frequency, v, x, rest / count)
        # Weights by the whole signal lean to segments in which its noise
        # opposes the voltage; those by the noise alone do not.
        turned = gain * np.exp(-2j * math.pi * frequency * lag) * v
        noise = np.sqrt((np.abs(x - turned)**2 / rest).sum(1))[:, None]
        v, x, turned = v / noise, x / noise, turned / noise
        density = (np.abs(x - turned)**2).mean(0)
        gain, lag = _fit(frequency, v, x, density)
        interval = _jackknife(frequency, v, x, density, lag)
        vv = (np.abs(v)**2).sum(0)
        omega = 2.0 * math.pi * frequency
        # Every second bin counts, as in the tests.
        known_by = 2.0 * gain**2 * (omega**2 * vv / density)[tested].sum() * segments / count
        lag_se = 1.0 / math.sqrt(known_by) if known_by > 0.0 else NAN
    leads = bool(seen and lag < -3.0 * lag_se and lag < -0.25 / grid.rate)
    if narrow:
        notes.append('What was seen is in a few frequencies only: a line that both share, such as '
                     'the rotation of the motors, rather than coupling.')
    if leads:
        notes.append('The signal is ahead of the voltage: it is rather the load, by way of the '
                     'motors, that answers to the signal than the other way round.')
    raw_share = float(np.sum(coherence * xx) / np.sum(xx)) if seen else 0.0
    return Coupling(
        seen, p_value, gain, interval, lag, lag_se, limit, narrow, leads, raw_share, frequency,
        coherence, response, threshold, level, segments, bool(causes), grid, tuple(notes))


def _band(band: tuple[float, float] | None, grid: Grid) -> tuple[float, float]:
    low, high = (LOWEST, grid.usable) if band is None else band
    if not 0.0 < low < high:
        raise InputError(
            f'the band {low:g}..{high:g} Hz is empty: the slower series has '
            f'{min(grid.rates):.4g} Hz and is good up to {grid.usable:.4g} Hz')
    if high > grid.usable * (1.0 + 1e-3):
        raise InputError(f'the band ends at {high:g} Hz, but the slower series has '
                         f'{min(grid.rates):.4g} Hz and is good up to {grid.usable:.4g} Hz')
    return low, high


def _segment_length(grid: Grid, low: float) -> int:
    """Return the samples of a segment: many segments, but no bin below the third."""
    seconds = min(max(grid.duration / _PIECES, _SHORTEST), _LONGEST)
    return max(32, round(max(seconds, 3.0 / low) * grid.rate))


def _segments(grid: Grid, length: int, low: float, high: float,
              ) -> tuple[FloatArray, list[ComplexArray]]:
    """Return bins, Hz, and coefficients of each series, shape (segments, bins)."""
    window = hann(length, sym=False)
    frequency = np.fft.rfftfreq(length, 1.0 / grid.rate)
    # Rates come from stamps and are not round to the last bit.
    bins = (frequency >= low * (1.0 - 1e-6)) & (frequency <= high * (1.0 + 1e-6))
    if bins.sum() < 2:
        raise InputError(f'the band {low:g}..{high:g} Hz holds {int(bins.sum())} frequencies of '
                         f'segments of {length / grid.rate:.2g} s: widen it')
    found: list[list[ComplexArray]] = [[] for _ in grid.runs[0]]
    for run in grid.runs:
        columns = list(run)
        if len(columns) == 3:
            # Motors pull with the square as well.
            columns.append(columns[2]**2)
            if len(found) == 3:
                found.append([])
        for start in range(0, run[0].size - length + 1, max(1, length // 2)):
            for out, column in zip(found, columns):
                part = column[start:start + length]
                out.append(np.fft.rfft(window * (part - part.mean()))[bins])
    band = np.asarray(frequency[bins], dtype=np.float64)
    return band, [np.array(out, dtype=np.complex128).reshape(-1, band.size) for out in found]


def _without(y: ComplexArray, causes: list[ComplexArray]) -> ComplexArray:
    """Return what a regression on the causes, bin by bin, leaves of y."""
    rest = y.copy()
    basis: list[ComplexArray] = []
    for cause in causes:
        part = cause.copy()
        size = (np.abs(part)**2).sum(0)
        for one in basis:
            part -= (np.conj(one) * part).sum(0) * one
        norm = np.sqrt((np.abs(part)**2).sum(0))
        # What is left of a cause that says the same as another is rounding
        # (of float32, relative 1e-7).
        part = np.where(norm**2 > 1e-10 * size, part / np.where(norm > 0.0, norm, 1.0), 0.0)
        basis.append(part)
    for one in basis:
        rest -= (np.conj(one) * rest).sum(0) * one
    return rest


def _tests(coherence: FloatArray, spare: float, level: float) -> tuple[float, float, float]:
    """Return the p-values of the sum and of the largest bin, and its threshold."""
    information = -spare * np.log1p(-coherence)
    p_sum = float(stats.gamma.sf(information.sum(), coherence.size))
    p_max = -math.expm1(coherence.size * math.log1p(-math.exp(-float(information.max()))))
    alone = -math.expm1(math.log1p(-0.5 * level) / coherence.size)
    return p_sum, p_max, -math.expm1(math.log(alone) / spare)


def _narrow(coherence: FloatArray, response: ComplexArray, ratio: FloatArray, spare: float,
            ) -> bool:
    """Return whether a few bins make the finding, and the others contradict their gain."""
    loud = coherence > _tests(coherence[::_STRIDE], spare, _LINE)[2]
    # A line spreads over the main lobe of the window and its first side lobes.
    near = np.convolve(loud, np.ones(9), 'same') > 0
    left = np.flatnonzero(~near)[::_STRIDE]
    if not loud.any() or left.size < 0.25 * coherence.size:
        return False
    gain = float(np.median(np.abs(response[loud])))
    far = 2.0 * spare * gain**2 * float(ratio[left].sum())
    needed = stats.chi2.isf(0.02, 2 * left.size)
    return bool(stats.ncx2.sf(needed, 2 * left.size, far) > 0.95
                and _tests(coherence[left], spare, _LINE)[0] > 0.02)


def _limit(vv: FloatArray, noise: FloatArray, spare: float, level: float) -> float:
    """Return the gain that the sum would have shown with probability `POWER`."""
    freedom = 2 * vv.size
    needed = float(stats.chi2.isf(0.5 * level, freedom))
    far = float(chndtrinc(needed, freedom, 1.0 - POWER))
    per_gain = 2.0 * spare * float((vv / noise).sum())
    return math.sqrt(far / per_gain) if per_gain > 0.0 else math.inf


def _fit(frequency: FloatArray, v: ComplexArray, x: ComplexArray, density: FloatArray,
         ) -> tuple[float, float]:
    """Return gain and lag (s) of x = gain v(t - lag) by weighted least squares."""
    cross, power = (np.conj(v) * x).sum(0) / density, (np.abs(v)**2).sum(0) / density
    step = 0.05 / frequency[-1]
    lags = np.arange(-LONGEST_LAG, LONGEST_LAG + 0.5 * step, step)
    shape = np.real(np.exp(2j * math.pi * np.outer(lags, frequency)) @ cross)
    k = int(np.argmax(np.abs(shape)))
    lag = float(lags[k])
    if 0 < k < lags.size - 1:
        a, b, c = np.abs(shape[k - 1:k + 2])
        bend = a - 2.0 * b + c
        lag += step * float(0.5 * (a - c) / bend) if bend < 0.0 else 0.0
    return _gain(frequency, cross, power, lag), lag


def _gain(frequency: FloatArray, cross: ComplexArray, power: FloatArray, lag: float) -> float:
    turned = np.real(np.exp(2j * math.pi * frequency * lag) * cross)
    return float(turned.sum() / power.sum())


def _jackknife(frequency: FloatArray, v: ComplexArray, x: ComplexArray, density: FloatArray,
               lag: float) -> tuple[float, float]:
    """Return the 95 % interval of the gain, from blocks of segments left out in turn."""
    blocks = np.array_split(np.arange(v.shape[0]), _BLOCKS)
    turn = np.exp(2j * math.pi * frequency * lag)
    above = np.array([(np.real(turn * np.conj(v[b]) * x[b]).sum(0) / density).sum()
                      for b in blocks])
    below = np.array([((np.abs(v[b])**2).sum(0) / density).sum() for b in blocks])
    gain = float(above.sum() / below.sum())
    left = (above.sum() - above) / (below.sum() - below)
    spread = math.sqrt((_BLOCKS - 1) / _BLOCKS * float(((left - left.mean())**2).sum()))
    half = float(stats.t.ppf(0.975, _BLOCKS - 1)) * spread
    return gain - half, gain + half
