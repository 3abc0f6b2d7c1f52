"""
How much of a signal, such as a gyro axis, is noise of the supply.

Limits: white noise of the voltage sensor lowers the gain by its share of the power in the band.
Effects of throttle are regressed out if they are linear in throttle and its square, with a lag
shorter than a segment.  Reported but not corrected: motor rotation, which disturbs both gyro and
supply and shows as a narrow line; a signal that *leads* the voltage because it drives the motors.

Method: Fourier coefficients of half-overlapping Hann segments.  `measure_coherence` tests for
coupling.  If there is any, the signal is regressed on voltage, throttle and its square.  Segments
are divided by the noise of the signal, which grows with throttle, so that a few loud ones do not
dominate.  Repeated readings of the ADC are dropped: the steps that they make come from the logger.

Cubic splines bring all series to an even grid with the highest of their rates.  If this is more
than 8 times the lowest rate, the grid has 4 times the lowest rate, and series more than 1.5 times
as fast as the grid are averaged.  The usable band ends at a quarter of the lowest rate; above it,
the spline attenuates by more than 3 %.  Limits: aliases of the original sampling remain, and a
stamp error of e seconds gives a phase error of 2 pi f e.

`measure_coherence` tests whether two series of any spectra are coherent: the sum over bins and the
largest bin are compared with their values when the signs of blocks of neighbouring segments are
random (Freedman and Lane, 1983).  Each bin of each segment is divided by the rms of the signal
over the bins around it, because a manoeuvre changes the shape of the gyro spectrum.  If the signal
is then white Gaussian, the squared partial coherence of a bin exceeds c by chance with probability
(1 - c)^(K - 1 - p), for any voltage, with K segments and p causes (throttle and its square)
regressed out (Halliday et al., 1995): this gives the threshold and the detectable gain.

Limits: both signs of the series must be equally likely.  A line with the same frequency and phase
in both series is detected although it is not coupling (`narrow`).
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.records import FloatArray, NAN
from ou_monitor.timeline import in_order, new_readings, repeats_words
from scipy import stats
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter1d, uniform_filter1d
from scipy.signal.windows import hann
from scipy.special import chndtrinc

ComplexArray = npt.NDArray[np.complex128]

# Lower end of the band, Hz; stick inputs and discharge are slower.
LOWEST = 5.0
# Longest and shortest segment, s; target number of segments, not counting overlap.
_LONGEST, _SHORTEST, _PIECES = 1.0, 0.1, 40
FEWEST = 16  # Minimum number of segments
LONGEST_LAG = 0.05  # Maximum lag that is searched, s
# Share of the common time; if less is used, a note says so.
_SHARE_USED = 0.9
_BLOCKS = 12  # Blocks of the jackknife
# Probability with which a gain at the reported limit is detected.
POWER = 0.9


@dataclass(frozen=True, eq=False)
class Coherence:
    """Share of a signal that a voltage explains, for each bin, with its test."""

    p_value: float  # Family-wise, of the sum over bins and the largest bin
    coherence: FloatArray  # Squared partial coherence, 0..1; shape (m,)
    response: ComplexArray  # Signal units per volt; shape (m,)
    # Power of the voltage over the power of the unexplained signal, in 1 / gain^2; shape (m,).
    ratio: FloatArray
    threshold: float  # Coherence that the largest bin must exceed
    # Effective number of segments; that number less the fitted parameters.
    segments: float
    spare: float
    narrow: bool  # Only a few bins are coherent, and the others contradict their gain
    level: float  # Family-wise probability of a false alarm

    @property
    def seen(self) -> bool:
        """Return whether there is coupling, at the family-wise `level`."""
        return self.p_value <= self.level

    @property
    def limit(self) -> float:
        """Return the gain that is detected with probability `POWER`, signal units per volt."""
        ratio = self.ratio[::STRIDE]
        freedom = 2 * ratio.size
        needed = float(stats.chi2.isf(0.5 * self.level, freedom))
        far = float(chndtrinc(needed, freedom, 1.0 - POWER))
        per_gain = 2.0 * self.spare * float(ratio.sum())
        return math.sqrt(far / per_gain) if per_gain > 0.0 else math.inf


@dataclass(frozen=True, eq=False)
class Coupling(Coherence):
    """Result of a coupling estimate."""

    # Signal units per volt, signed, lag removed; NaN without coupling.
    gain: float
    gain_ci95: tuple[float, float]
    # Delay of the signal behind the voltage, s; NaN without coupling.
    lag: float
    lag_se: float
    signal_leads: bool  # Whether the signal leads the voltage, by three standard errors
    noise_share: float  # Share of the signal's power in the band that the voltage explains
    frequency: FloatArray  # Bins of the band, Hz; shape (m,)
    partial: bool  # Whether throttle was regressed out
    grid: Grid  # Resampled series
    notes: tuple[str, ...]  # Cautions, one sentence each


def as_data(found: Coupling, name: str, signal: str, unit: str, notes: tuple[str, ...],
            ) -> dict[str, Any]:
    """Return the result for JSON."""
    return {
        'recording': name, 'signal': signal, 'signal_unit': unit or None, 'seen': found.seen,
        'p_value': found.p_value, 'level': found.level,
        'gain_per_v': found.gain, 'gain_ci95': found.gain_ci95,
        'gain_limit_per_v': found.limit, 'lag_s': found.lag, 'lag_se_s': found.lag_se,
        'share_of_signal': found.noise_share, 'narrow': found.narrow,
        'signal_leads': found.signal_leads, 'throttle_taken_out': found.partial,
        'segments': found.segments, 'duration_s': found.grid.duration,
        'rate_hz': found.grid.rate, 'voltage_rate_hz': found.grid.rates[0],
        'signal_rate_hz': found.grid.rates[1], 'gaps': found.grid.gaps,
        'dropped': {'voltage': found.grid.lost[0], 'signal': found.grid.lost[1]},
        'frequency_hz': found.frequency, 'coherence': found.coherence,
        'coherence_threshold': found.threshold, 'gain_by_frequency': abs(found.response),
        'notes': [*notes, *found.notes]}


def estimate_coupling(
    t: FloatArray, voltage: FloatArray, signal_t: FloatArray, signal: FloatArray, *,
    throttle: FloatArray | None = None, band: tuple[float, float] | None = None,
    level: float = 0.05, rng: np.random.Generator | None = None,
) -> Coupling:
    """Estimate the gain from the supply voltage to a signal (band in Hz, level 0..1)."""
    if not 0.0 < level < 1.0:
        raise InputError(f'the level must lie between 0 and 1, got {level:g}')
    notes: list[str] = []
    series = {'the voltage': _as_read(t, voltage, notes), 'the signal': (signal_t, signal)}
    known = throttle is not None and np.isfinite(throttle).sum() > 0.9 * throttle.size
    if known and throttle is not None and np.nanmax(throttle) > np.nanmin(throttle):
        series['the throttle'] = (t, throttle)
    elif not known:
        notes.append('Throttle is unknown: its effect on both series would count as coupling.')
    grid = on_grid(series)
    if grid.duration < _SHARE_USED * grid.shared:
        notes.append(f'Only {grid.duration:.3g} s of the {grid.shared:.3g} s that all series '
                     'cover were used: elsewhere a series has gaps or another rate. --from and '
                     '--to choose a part.')
    low, high = _band(band, grid)
    # Long enough for the band to start at the third bin or later.
    seconds = max(min(max(grid.duration / _PIECES, _SHORTEST), _LONGEST), 3.0 / low)
    length = max(32, round(seconds * grid.rate))
    frequency, pieces = _segments(grid, length, low, high)
    for name, one in zip(series, pieces[:2]):
        if not (np.abs(one)**2).sum() > 0.0:
            raise InputError(f'{name} does not change within {low:g}..{high:g} Hz')
    if np.array_equal(pieces[0], pieces[1]):
        raise InputError(f'{name} is the voltage itself: name another signal')
    count = len(pieces[0])
    if count < FEWEST:
        raise InputError(
            f'the series share {grid.duration:.3g} s in {count} segments without a gap: at least '
            f'{FEWEST} segments of {length / grid.rate:.2g} s are needed')
    # A fixed seed: the same recording always gives the same result.
    found = measure_coherence(pieces[0], pieces[1], pieces[2:], level,
                              np.random.default_rng(0) if rng is None else rng)
    v, x, rest = _weighted(pieces)
    response = (np.conj(v) * x).sum(0) / (np.abs(v)**2).sum(0)
    gain = lag = lag_se = NAN
    share = 0.0
    interval = (NAN, NAN)
    if found.seen:
        share = 1.0 - float(rest.sum() / (np.abs(x)**2).sum())
        gain, lag = _fit(frequency, v, x, rest / count)
        # Weights by the whole signal favour segments in which its noise cancels the coupled part;
        # weights by the noise alone do not.
        turned = gain * np.exp(-2j * math.pi * frequency * lag) * v
        noise = np.sqrt((np.abs(x - turned)**2 / rest).sum(1))[:, None]
        v, x, turned = v / noise, x / noise, turned / noise
        density = (np.abs(x - turned)**2).mean(0)
        gain, lag = _fit(frequency, v, x, density)
        interval = _jackknife(frequency, v, x, density, lag)
        vv = (np.abs(v)**2).sum(0)
        omega = 2.0 * math.pi * frequency
        # Every second bin counts, as in the tests.
        known_by = (2.0 * gain**2 * (omega**2 * vv / density)[::STRIDE].sum()
                    * found.segments / count)
        lag_se = 1.0 / math.sqrt(known_by) if known_by > 0.0 else NAN
    leads = bool(found.seen and lag < -3.0 * lag_se and lag < -0.25 / grid.rate)
    return Coupling(
        **{**vars(found), 'response': response}, gain=gain, gain_ci95=interval, lag=lag,
        lag_se=lag_se, signal_leads=leads, noise_share=share, frequency=frequency,
        partial=len(pieces) > 2, grid=grid, notes=tuple(notes))


def _as_read(t: FloatArray, voltage: FloatArray, notes: list[str],
             ) -> tuple[FloatArray, FloatArray]:
    """Return the voltage without repeated readings; add a note on the repeats."""
    good = np.isfinite(t) & np.isfinite(voltage)
    places, at, period = new_readings(t[good], voltage[good])
    if period > 1.0:
        notes.append(repeats_words(t[good], at))
        return at, voltage[good][places]
    return t, voltage


# Minimum rms of a segment of the signal, as a share of the loudest.
_QUIET = 1e-9


def _weighted(pieces: list[ComplexArray]) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Return weighted voltage and signal without the causes, and the signal's residual power."""
    weight = np.sqrt(np.mean(np.abs(pieces[1])**2, axis=1))
    # A quieter segment contains only rounding errors, or the decay of a filter.
    weight = np.maximum(weight, _QUIET * weight.max())
    scaled = [one / weight[:, None] for one in pieces]
    basis = basis_of(scaled[2:])
    v, x = without(scaled[0], basis), without(scaled[1], basis)
    vv, xx = (np.abs(v)**2).sum(0), (np.abs(x)**2).sum(0)
    shared = np.abs((np.conj(v) * x).sum(0))**2 / vv
    return v, x, np.maximum(xx - shared, 1e-12 * xx)


def _band(band: tuple[float, float] | None, grid: Grid) -> tuple[float, float]:
    low, high = (LOWEST, grid.usable) if band is None else band
    if not 0.0 < low < high <= grid.usable * (1.0 + 1e-3):
        raise InputError(
            f'no band {low:g}..{high:g} Hz: the slower series has {min(grid.rates):.4g} Hz and is '
            f'usable up to {grid.usable:.4g} Hz')
    return low, high


def _segments(grid: Grid, length: int, low: float, high: float,
              ) -> tuple[FloatArray, list[ComplexArray]]:
    """Return bins, Hz, and coefficients of each series, shape (segments, bins)."""
    window = hann(length, sym=False)
    frequency = np.fft.rfftfreq(length, 1.0 / grid.rate)
    # The tolerance allows for rates from stamps, which are not exact.
    bins = (frequency >= low * (1.0 - 1e-6)) & (frequency <= high * (1.0 + 1e-6))
    if bins.sum() < 2:
        raise InputError(f'the band {low:g}..{high:g} Hz holds {int(bins.sum())} frequencies of '
                         f'segments of {length / grid.rate:.2g} s: widen it')
    # Motor load also follows the square of throttle.
    runs = [(*run, run[2]**2) if len(run) == 3 else run
            for run in grid.runs if run[0].size >= length]

    def coefficients(k: int) -> ComplexArray:
        found = [np.empty((0, int(bins.sum())))]
        for run in runs:
            parts = sliding_window_view(run[k], length)[::length // 2]
            parts = window * (parts - parts.mean(axis=1, keepdims=True))
            found.append(np.fft.rfft(parts)[:, bins])
        return np.concatenate(found).astype(np.complex128)

    return frequency[bins], [coefficients(k) for k in range(len(runs[0]) if runs else 2)]


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
    """Return the 95 % interval of the gain by a jackknife over blocks of segments."""
    turn = np.exp(2j * math.pi * frequency * lag)
    above, below = (
        np.array([one.sum() for one in np.array_split((power / density).sum(1), _BLOCKS)])
        for power in (np.real(turn * np.conj(v) * x), np.abs(v)**2))
    gain = float(above.sum() / below.sum())
    left = (above.sum() - above) / (below.sum() - below)
    spread = math.sqrt((_BLOCKS - 1) / _BLOCKS * float(((left - left.mean())**2).sum()))
    half = float(stats.t.ppf(0.975, _BLOCKS - 1)) * spread
    return gain - half, gain + half


# Minimum pause, in typical steps, that is a gap; gaps are not interpolated.
GAP = 3.0
# Maximum ratio of the fastest to the slowest rate; above it, the grid has `_STEPS` times the
# slowest rate, and faster series are averaged.
_FASTEST = 8.0
_STEPS = 4.0
# Cubic splines need four points.
_LEAST_SAMPLES = 4


@dataclass(frozen=True, eq=False)
class Grid:
    """Series on one grid."""

    rate: float  # Rate of the grid, Hz
    usable: float  # Highest frequency at which no series is attenuated by more than 3 %, Hz
    # Parts without a gap in any series; each a tuple of the series, shape (n,).
    runs: list[tuple[FloatArray, ...]]
    rates: tuple[float, ...]  # Median rate of each series, Hz
    # Dropped samples of each series: not finite, or with a repeated stamp.
    lost: tuple[int, ...]
    gaps: int  # Gaps between the parts
    shared: float  # Time between the latest start and the earliest end of the series, s

    @property
    def duration(self) -> float:
        """Total duration of the parts, s."""
        return sum(run[0].size for run in self.runs) / self.rate


def on_grid(series: dict[str, tuple[FloatArray, FloatArray]]) -> Grid:
    """Bring series, each of stamps, s, and values, onto one grid."""
    clean: list[tuple[FloatArray, FloatArray]] = []
    lost, rates = [], []
    for name, (t, values) in series.items():
        which, _ = in_order(t, values[:, None], float(np.finfo(np.float64).max))
        stamps, kept = t[which], values[which]
        if stamps.size < _LEAST_SAMPLES:
            raise InputError(f'{name} has {stamps.size} finite samples: at least {_LEAST_SAMPLES} '
                             'are needed')
        lost.append(int(t.size - stamps.size))
        rates.append(float(1.0 / np.median(np.diff(stamps))))
        clean.append((stamps, kept))
    slowest, fastest = min(rates), max(rates)
    rate = fastest if fastest <= _FASTEST * slowest else _STEPS * slowest
    shared = _shared([_spans(t, 1.0 / r) for (t, _), r in zip(clean, rates)])
    runs, begin = [], min(t[0] for t, _ in clean)
    for start, stop in shared:
        # One grid for all parts, so that a lag means the same in each.
        first = int(np.ceil((start - begin) * rate - 1e-9))
        last = int(np.floor((stop - begin) * rate + 1e-9))
        if last - first >= _LEAST_SAMPLES:
            at = begin + np.arange(first, last + 1) / rate
            runs.append(tuple(_sampled(at, t, x, r, rate) for (t, x), r in zip(clean, rates)))
    if not runs:
        ranges = ', '.join(f'{name} {t[0]:.6g}..{t[-1]:.6g} s'
                           for name, (t, _) in zip(series, clean))
        raise InputError(f'the series have no time in common: {ranges}')
    span = min(float(t[-1]) for t, _ in clean) - max(float(t[0]) for t, _ in clean)
    return Grid(rate, 0.25 * slowest, runs, tuple(rates), tuple(lost), len(runs) - 1, span)


def _spans(t: FloatArray, step: float) -> FloatArray:
    """Return the parts without a gap: first and last stamp of each, s; shape (parts, 2)."""
    breaks = np.flatnonzero(np.diff(t) > GAP * step)
    starts, stops = np.append(0, breaks + 1), np.append(breaks, t.size - 1)
    long = stops - starts >= _LEAST_SAMPLES
    return np.stack((t[starts[long]], t[stops[long]]), axis=1)


def _shared(spans: list[FloatArray]) -> FloatArray:
    """Return the parts that all series cover."""
    ends = np.concatenate(spans)
    # A part ends where another begins: it ends first.
    order = np.lexsort((np.tile((1, 0), len(ends)), ends.ravel()))
    covered = np.cumsum(np.tile((1, -1), len(ends))[order])
    begin = np.flatnonzero(covered == len(spans))
    return np.stack((ends.ravel()[order][begin], ends.ravel()[order][begin + 1]), axis=1)


def _sampled(at: FloatArray, t: FloatArray, x: FloatArray, own: float, rate: float) -> FloatArray:
    inside = slice(max(int(np.searchsorted(t, at[0] - 2.0 / own)) - 1, 0),
                   int(np.searchsorted(t, at[-1] + 2.0 / own)) + 1)
    t, x = t[inside], x[inside]
    if own > 1.5 * rate:
        # Average over the steps of the grid; empty steps are interpolated.
        place = np.rint((t - at[0]) * rate).astype(np.intp)
        good = (place >= 0) & (place < at.size)
        count = np.bincount(place[good], minlength=at.size)
        total = np.bincount(place[good], x[good], minlength=at.size)
        filled = count > 0
        means: FloatArray = np.interp(at, at[filled], total[filled] / count[filled])
        return means
    if t.size < _LEAST_SAMPLES:
        line: FloatArray = np.interp(at, t, x)
        return line
    spline: FloatArray = CubicSpline(t, x)(at)
    return spline


# Bins over which the power of the signal is averaged.
_AROUND = 11
# Neighbouring bins of the Hann window are correlated by 2/3, bins two apart by 1/6.
STRIDE = 2
# Power correlation of half-overlapping Hann segments: (1/6)^2.
OVERLAP = 1.0 / 36.0
# Number of random draws of signs; if `_COUNTED` or fewer of them reach the statistic, the p-value
# is extrapolated.
_DRAWS, _COUNTED = 499, 10
# Maximum number of segments that share a drawn sign (a block), because overlap, lines and slow
# manoeuvres correlate them; minimum number of blocks, so that 2^16 different draws exist.
_BLOCK, _SIGNED = 16, 16
# Family-wise significance level at which a bin counts as coherent in `_is_narrow`.
_LINE = 1e-4


def measure_coherence(voltage: ComplexArray, signal: ComplexArray, causes: list[ComplexArray],
                      level: float, rng: np.random.Generator) -> Coherence:
    """Test Fourier coefficients of shape (segments, bins), with the causes regressed out."""
    weight = 1.0 / local_size(signal)
    # Each bin contributes to its own weight; `share` corrects the bias.
    share = 1.0 - 1.0 / _independent(signal.shape[1])
    whole = weight * signal
    basis = basis_of([weight * cause for cause in causes])
    v, x = without(weight * voltage, basis), without(whole, basis)
    # The equivalent number of segments without overlap.
    count = len(signal)
    segments = count / (1.0 + 2.0 * OVERLAP * (count - 1) / count)
    spare = segments - 1.0 - len(causes)
    vv, xx = (np.abs(v)**2).sum(0), (np.abs(x)**2).sum(0)
    response = (np.conj(v) * x).sum(0) / np.where(vv > 0.0, vv, 1.0)
    squared = np.clip(np.abs(response)**2 * vv / xx, 0.0, 1.0 - 1e-12)
    ratio = share**2 * vv / np.maximum(xx - np.abs(response)**2 * vv, 1e-12 * xx)
    response = response / share
    tested = slice(None), slice(None, None, STRIDE)
    p_value = min(1.0, 2.0 * min(_sign_test(
        v[tested], whole[tested], [one[tested] for one in basis], rng)))
    narrow = p_value <= level and _is_narrow(squared, response, ratio, spare)
    return Coherence(p_value, squared, response, ratio, _threshold(squared, spare, level),
                     segments, spare, narrow, level)


def local_size(signal: ComplexArray) -> FloatArray:
    """Return the root mean square of a signal around each bin of each segment."""
    power = np.abs(signal)**2
    if power.shape[1] > _AROUND:
        mean = uniform_filter1d(power, _AROUND, axis=1, mode='reflect')
    else:
        mean = np.broadcast_to(power.mean(axis=1, keepdims=True), power.shape)
    # A running sum leaves rounding errors after a loud bin.
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
        # If a cause repeats another, only rounding errors remain (float32: 1e-7).
        basis.append(np.where(norm**2 > 1e-10 * size, part / np.where(norm > 0.0, norm, 1.0),
                              0.0))
    return basis


def without(y: ComplexArray, basis: list[ComplexArray]) -> ComplexArray:
    """Return the residual of y after regression on orthonormal directions in each bin."""
    rest = y.copy()
    for one in basis:
        rest -= (np.conj(one) * rest).sum(0) * one
    return rest


def _threshold(squared: FloatArray, spare: float, level: float) -> float:
    """Return the coherence that the largest bin exceeds by chance with probability level / 2."""
    alone = -math.expm1(math.log1p(-0.5 * level) / squared[::STRIDE].size)
    return -math.expm1(math.log(alone) / spare)


def _sign_test(v: ComplexArray, x: ComplexArray, basis: list[ComplexArray],
               rng: np.random.Generator) -> tuple[float, float]:
    count = len(x)
    length = max(1, min(_BLOCK, count // _SIGNED))
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
    # Random signs remove the correlation between blocks, which the measurement still has.
    information[0] /= 1.0 + 2.0 * OVERLAP * (starts.size - 1) / count
    return _tail(information.sum(1), 'gamma'), _tail(information.max(1), 'gumbel')


def _power(signs: FloatArray, parts: ComplexArray) -> FloatArray:
    power: FloatArray = (signs @ parts.real)**2 + (signs @ parts.imag)**2
    return power


def _tail(drawn: FloatArray, law: str) -> float:
    """Return the p-value of the first value: counted, or by a fitted law if few reach it."""
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


def _is_narrow(squared: FloatArray, response: ComplexArray, ratio: FloatArray, spare: float
               ) -> bool:
    """Return whether only a few bins are coherent and the others contradict their gain."""
    loud = squared > _threshold(squared, spare, _LINE)
    # A line spreads over the main lobe of the window and its first side lobes.
    near = maximum_filter1d(loud.astype(np.int8), 9) > 0
    left = np.flatnonzero(~near)[::STRIDE]
    if not loud.any() or left.size < 0.25 * squared.size:
        return False
    gain = float(np.median(np.abs(response[loud])))
    far = 2.0 * spare * gain**2 * float(ratio[left].sum())
    needed = stats.chi2.isf(0.02, 2 * left.size)
    return bool(stats.ncx2.sf(needed, 2 * left.size, far) > 0.95
                and stats.gamma.sf(-spare * np.log1p(-squared[left]).sum(), left.size) > 0.02)
