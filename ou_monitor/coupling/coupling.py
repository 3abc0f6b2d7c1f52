"""
How much of a signal, such as a gyro axis, is noise of the supply.

Limits: white noise of the voltage sensor makes the gain too small, by its share of the voltage in
the band.  Effects of throttle are regressed out if they are linear in throttle and its square,
with a lag shorter than a segment.  Motor rotation shakes the gyro and ripples the supply; only its
narrow line reveals that common cause.  A signal that *leads* the voltage is its cause, by way of
the motors.  Both are reported, neither is corrected.

Method: Fourier coefficients of half-overlapping Hann segments.  `measure_coherence` tests for
coupling.  If there is any, the signal is regressed on voltage, throttle and its square.  Each
segment is weighted by the signal's noise in it, which grows with throttle as the supply's does:
otherwise a few loud segments would decide.  Repeated readings of the ADC are dropped, because the
steps between them come from the logger.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.coupling.coherence import (
    basis_of, ComplexArray, measure_coherence, STRIDE, without)
from ou_monitor.coupling.common_grid import Grid, on_grid
from ou_monitor.errors import InputError
from ou_monitor.records import FloatArray, NAN
from ou_monitor.timeline.line import refreshes
from scipy import stats
from scipy.signal.windows import hann

# Lower end of the band, Hz: pilot and discharge are below.
LOWEST = 5.0
# Longest and shortest segment, s; number of segments aimed at.
_LONGEST, _SHORTEST, _PIECES = 1.0, 0.1, 40
FEWEST = 16
LONGEST_LAG = 0.05
# Share of the common time below which a note reports what gaps cost.
_MOST = 0.9
_BLOCKS = 12
# Probability of detection at the limiting gain.
POWER = 0.9


@dataclass(frozen=True, eq=False)
class Coupling:
    """Result of a coupling estimate."""

    seen: bool  # Whether there is coupling, at the family-wise `level`
    p_value: float  # Family-wise
    # Signal units per volt, signed, lag removed; NaN when no coupling was seen.
    gain: float
    gain_ci95: tuple[float, float]
    # Delay of the signal behind the voltage, s; NaN when no coupling was seen.
    lag: float
    lag_se: float
    limit: float  # Gain that would be detected with probability `POWER`, signal units per volt
    narrow: bool  # Only a few bins are coherent: a line that both share
    signal_leads: bool  # The signal is ahead of the voltage by three standard errors
    noise_share: float  # Share of the signal's power in the band that the voltage explains
    # Bins of the band, Hz; squared partial coherence; signal units per volt; shape (m,).
    frequency: FloatArray
    coherence: FloatArray
    response: ComplexArray
    threshold: float  # Coherence that the largest bin must exceed
    level: float  # Family-wise probability of a false alarm
    segments: float  # Effective number of segments
    partial: bool  # Whether throttle was regressed out
    grid: Grid  # Resampled series
    notes: tuple[str, ...]  # Cautions, one sentence each


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
    if grid.duration < _MOST * grid.shared:
        notes.append(f'Only {grid.duration:.3g} s of the {grid.shared:.3g} s in common were used: '
                     'the rest has gaps, or a series has another rate there; --from and --to '
                     'choose a part.')
    low, high = _band(band, grid)
    length = _segment_length(grid, low)
    frequency, pieces = _segments(grid, length, low, high)
    for name, one in zip(series, pieces[:2]):
        if not (np.abs(one)**2).sum() > 0.0:
            raise InputError(f'{name} does not change within {low:g}..{high:g} Hz')
    count = len(pieces[0])
    if count < FEWEST:
        raise InputError(
            f'the series share {grid.duration:.3g} s in {count} segments without a gap: at least '
            f'{FEWEST} segments of {length / grid.rate:.2g} s are needed')
    # A fixed seed: the same recording always gives the same result.
    found = measure_coherence(pieces[0], pieces[1], pieces[2:], level,
                              np.random.default_rng(0) if rng is None else rng)
    seen = found.p_value <= level

    v, x, rest = _weighted(pieces)
    response = (np.conj(v) * x).sum(0) / (np.abs(v)**2).sum(0)
    gain = lag = lag_se = NAN
    share = 0.0
    interval = (NAN, NAN)
    if seen:
        share = 1.0 - float(rest.sum() / (np.abs(x)**2).sum())
        gain, lag = _fit(frequency, v, x, rest / count)
        # Weights by the whole signal favour segments in which its noise opposes the voltage;
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
    leads = bool(seen and lag < -3.0 * lag_se and lag < -0.25 / grid.rate)
    if found.narrow:
        notes.append('Only a few frequencies are coherent: a line that both share, such as motor '
                     'rotation, rather than coupling.')
    if leads:
        notes.append('The signal is ahead of the voltage: the signal drives the motors and so the '
                     'load, rather than the other way round.')
    return Coupling(
        seen, found.p_value, gain, interval, lag, lag_se, found.limit(level, POWER),
        found.narrow, leads, share, frequency, found.squared, response, found.threshold, level,
        found.segments, len(pieces) > 2, grid, tuple(notes))


def _as_read(t: FloatArray, voltage: FloatArray, notes: list[str],
             ) -> tuple[FloatArray, FloatArray]:
    """Return the voltage without repeated readings, with a note."""
    good = np.isfinite(t) & np.isfinite(voltage)
    at, values, period = refreshes(t[good], voltage[good])
    if period > 1.0:
        notes.append(f'The voltage was refreshed every {period:.4g} samples: the '
                     f'{int(good.sum()) - at.size} repeats were left out.')
        return at, values
    return t, voltage


# Minimum rms of a segment of the signal, as a share of the loudest.
_QUIET = 1e-9


def _weighted(pieces: list[ComplexArray]) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Return weighted voltage and signal without the causes, and the signal's residual power."""
    weight = np.sqrt(np.mean(np.abs(pieces[1])**2, axis=1))
    # Anything quieter is rounding, or a signal that decays after standing still.
    weight = np.maximum(weight, _QUIET * weight.max())
    scaled = [one / weight[:, None] for one in pieces]
    basis = basis_of(scaled[2:])
    v, x = without(scaled[0], basis), without(scaled[1], basis)
    vv, xx = (np.abs(v)**2).sum(0), (np.abs(x)**2).sum(0)
    shared = np.abs((np.conj(v) * x).sum(0))**2 / vv
    return v, x, np.maximum(xx - shared, 1e-12 * xx)


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
            # Motor load also follows the square of throttle.
            columns.append(columns[2]**2)
            if len(found) == 3:
                found.append([])
        for start in range(0, run[0].size - length + 1, max(1, length // 2)):
            for out, column in zip(found, columns):
                part = column[start:start + length]
                out.append(np.fft.rfft(window * (part - part.mean()))[bins])
    band = np.asarray(frequency[bins], dtype=np.float64)
    return band, [np.array(out, dtype=np.complex128).reshape(-1, band.size) for out in found]


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
