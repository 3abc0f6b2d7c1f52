"""Functions for the terms of spectral lines: states, and detection of broad and moving lines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.records import FloatArray, NAN
from scipy.signal import welch

_MOST = 3  # Number of candidate lines examined


def phase_noise(linewidth: float, rng: np.random.Generator
                ) -> Callable[[FloatArray], FloatArray]:
    """Return a function of the steps, s, that draws the phase noise of a line (width in Hz)."""
    last = 0.0

    def walk(step: FloatArray) -> FloatArray:
        nonlocal last
        if not linewidth > 0.0:
            return np.zeros(step.size)
        spread = np.sqrt(2.0 * math.pi * linewidth * np.where(np.isfinite(step), step, 0.0))
        path = last + np.cumsum(spread * rng.standard_normal(step.size))
        last = float(path[-1])
        return np.asarray(path)

    return walk


def rotation(turn: FloatArray, damping: float, step: FloatArray, std: float,
             lag: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return f, q and h (see `Term.block`) of two states that rotate, decay and are driven."""
    # turn: angle in each step, rad; damping in 1/s; std in V.  Autocovariance of the first state:
    # std^2 exp(-damping t) (cos a + lag sin a), with a the angle in time t.
    shrink = np.exp(-damping * step)
    f, q = np.empty((step.size, 2, 2)), np.zeros((step.size, 2, 2))
    along, across = shrink * np.cos(turn), shrink * np.sin(turn)
    f[:, 0, 0] = f[:, 1, 1] = along
    f[:, 1, 0], f[:, 0, 1] = across, -across
    left = std * std * -np.expm1(-2.0 * damping * step)
    if lag == 0.0:
        q[:, 0, 0] = q[:, 1, 1] = left
    else:
        # Stationary covariance (11: 1, 12: -lag, 22: 1 + 2 lag^2, times std^2) less its rotation.
        more, mixed = 2.0 * lag * lag * std * std, 2.0 * lag * std * std * along * across
        q[:, 0, 0] = left - more * across * across - mixed
        q[:, 1, 1] = left + more * (1.0 - along * along) + mixed
        q[:, 0, 1] = q[:, 1, 0] = (more * along * across - lag * std * std * (
            1.0 - along * along + across * across))
    return f, q, np.array([1.0, 0.0])


# `power_spread`: number of segments per 1 / linewidth, and minimum number of segments.
_FINE, _ENOUGH = 4.0, 12
# Limits of `power_spread`.  Above CONSTANT, a peak is not a line of constant amplitude; below
# RINGING, it is not ringing.  Between 0.7 and 0.85 it can be either, and the evidence decides.
# Of 60 lines and 60 ringings, simulated with outliers:
# 14 segments: 60 lines and 10 ringings below CONSTANT, 2 lines and 54 ringings above RINGING;
# 33 segments: 60 lines and 2 ringings below CONSTANT, 0 lines and 60 ringings above RINGING.
CONSTANT, RINGING = 0.85, 0.7


def power_spread(view: View, frequency: float, linewidth: float) -> float:
    """Return interquartile range / median of a line's powers in segments (arguments in Hz)."""
    # 0 for a line of constant amplitude; ln 3 / ln 2 = 1.58 for ringing driven by noise, whose
    # powers are exponentially distributed; NaN with too few segments.  Outliers hardly matter.
    length = int(view.rate / (_FINE * max(linewidth, 1.0 / float(view.at[-1]))))
    v, at = view.residual, view.at
    count = v.size // max(length, 1)
    if count < _ENOUGH or length * frequency < _FINE * view.rate:
        return NAN
    turned = (v - v.mean()) * np.exp(-2j * math.pi * (frequency * at % 1.0))
    power = np.abs(turned[:count * length].reshape(count, length) @ np.hanning(length)) ** 2
    low, middle, high = np.percentile(power, [25.0, 50.0, 75.0]).tolist()
    return float((high - low) / middle)


def prominence(z: FloatArray, rate: float, frequency: float, width: float) -> float:
    """Return a peak's excess over both sides, in standard errors; -inf if a side is missing."""
    # rate, frequency and width in Hz.
    power = np.abs(np.fft.rfft(z - z.mean()))[1:] ** 2
    away = (np.fft.rfftfreq(z.size, 1.0 / rate)[1:] - frequency) / width
    inside = power[np.abs(away) <= 0.5]
    sides = [power[(sign * away > 1.0) & (sign * away < 2.5)] for sign in (-1.0, 1.0)]
    if not inside.size or not all(side.size for side in sides):
        return -math.inf
    # The relative error of a mean of n exponential variables is 1 / sqrt(n).
    return min(math.log(inside.mean() / side.mean()) / math.sqrt(1 / inside.size + 1 / side.size)
               for side in sides)


def broad_peaks(z: FloatArray, rate: float) -> list[tuple[float, float]]:
    """Return frequency, Hz, and damping, 1/s, of broad spectral peaks of scores (rate in Hz)."""
    found = []
    for length in (64, 256, 1024, 4096):
        if z.size < 4 * length:
            continue
        frequency, density = welch(z, rate, nperseg=length)
        # The lowest bins contain slow noise, not ringing.
        density[:3] = 0.0
        at = int(np.argmax(density))
        # Cramer bound of the tail of a mean of exponentials, against the number of bins searched.
        mean, segments = float(density[at] / np.median(density[3:])), z.size / length
        if segments * (mean - 1.0 - math.log(max(mean, 1e-9))) > math.log(density.size):
            found.append((float(frequency[at]), 4.0 * math.pi * rate / length))
    return found


def order_lines(view: View) -> list[tuple[float, float]]:
    """Return idle and slope, Hz, of lines that follow throttle (Hough transform, refined)."""
    if view.throttle is None:
        return []
    z, u = view.z[view.train], view.throttle[view.train]
    # `_unwound` searches the whole recording, in longer segments: if a line follows throttle
    # exactly, it stays sharp in them.
    found = sorted([line for length in _lengths(view.rate)
                    for line in _hough(z, u, view.rate, length)[:_MOST]]
                   + _unwound(view.z, view.throttle, view.rate), key=lambda line: -line.rise)
    return [_refined(z, u, view.rate, line.idle, line.slope, view.rate / (2.0 * line.length))
            for line in found[:_MOST]]


def order_power(z: FloatArray, u: FloatArray, rate: float) -> tuple[float, float]:
    """Return the `rise` of the strongest line that follows throttle, and the number of trials."""
    top, trials = 0.0, 0.0
    for length in _lengths(rate):
        best = _hough(z, u, rate, length)
        if best:
            top = max(top, best[0].rise)
            trials += _INDEPENDENT * 2.0 * length * len(best)
    return top, trials


# Share of the examined lines that count as independent: small, because neighbours share most
# bins.  With this share, 1 of 120 simulated flights of white noise exceeded the 95 % point.
_INDEPENDENT = 0.02
# Maximum slope, in sampling rates: from idle to full throttle a line may fold once and return.
_REACH = 1.0
# Ratio of long to short segments; short segments show lines while throttle moves fast.
_SHORTER = 8


def _lengths(rate: float) -> tuple[int, ...]:
    """Return the lengths of segments, samples: about 0.25 s, and an eighth of it."""
    long = int(1 << max(5, round(math.log2(max(32.0, 0.25 * rate)))))
    short = max(long // _SHORTER, 32)
    return (long,) if short == long else (long, short)


@dataclass(frozen=True)
class _Line:
    """A line that follows throttle."""

    rise: float  # Lower bound of -ln(probability of such a power by chance)
    # Frequency at zero throttle, and its change up to full throttle, Hz.
    idle: float
    slope: float
    length: int  # Samples in a segment


def _hough(z: FloatArray, u: FloatArray, rate: float, length: int) -> list[_Line]:
    """Return for each slope the line with the best idle frequency, strongest first."""
    count = z.size // length
    if count < 8 or np.ptp(u) < 0.02:
        return []
    shape = z[:count * length].reshape(count, length)
    power = np.abs(np.fft.rfft(shape * np.hanning(length), 2 * length, axis=1)) ** 2
    # Normalise each bin, which suppresses lines at a fixed frequency.
    power = (power / power.mean(axis=0)).astype(np.float32)
    load = u[:count * length].reshape(count, length).mean(axis=1)
    width = rate / (2.0 * length)
    bins = power.shape[1] - 1
    best: list[_Line] = []
    # Beyond the Nyquist frequency a line is folded back.
    fold = np.abs((np.arange(3 * bins) + bins) % (2 * bins) - bins)
    folded = np.ascontiguousarray(power[:, fold])
    total = np.empty(bins, dtype=np.float32)
    reach = _REACH * rate
    for slope in np.arange(-reach, reach, 2.0 * width / np.ptp(load)):
        shift = np.rint(slope * load / width).astype(np.int64)
        total[:] = 0.0
        for row, first in zip(folded, (shift % (2 * bins)).tolist(), strict=True):
            total += row[first:first + bins]
        k = int(np.argmax(total))
        # Cramer bound of the tail of a mean of `count` exponentials.
        mean = float(total[k]) / count
        rise = count * (mean - 1.0 - math.log(max(mean, 1e-9)))
        best.append(_Line(rise if mean > 1.0 else 0.0, k * width, float(slope), length))
    best.sort(key=lambda line: -line.rise)
    return best


def _unwound(z: FloatArray, u: FloatArray, rate: float) -> list[_Line]:
    """Return the strongest lines in segments of 1 s, in which their phase follows throttle."""
    length = round(_UNWOUND * rate)
    count = z.size // max(length, 1)
    if length < 8 or count < 8 or np.ptp(u) < 0.02:
        return []
    moves = np.cumsum(u - u.mean())[:count * length].reshape(count, length) / rate
    # From one slope to the next, the phase changes by half a cycle within a segment in which
    # throttle moves much (90 % quantile).
    step = 0.5 / max(float(np.percentile(np.ptp(moves, axis=1), 90.0)), 1e-6)
    # A line with a negative slope is found as its mirror image at negative frequencies.
    slopes = np.arange(0.0, _REACH * rate, step)
    if slopes.size * z.size > _DEAREST:
        return []
    back = np.exp(-2j * math.pi * step * moves)
    wave = z[:count * length].reshape(count, length).astype(np.complex128)
    found = []
    for slope in slopes.tolist():
        power = (np.abs(np.fft.fft(wave, 2 * length, axis=1)) ** 2).mean(axis=0) / length
        k = int(np.argmax(power))
        mean = float(power[k])
        rise = count * (mean - 1.0 - math.log(mean)) if mean > 1.0 else 0.0
        centre = float(np.fft.fftfreq(2 * length, 1.0 / rate)[k])
        slope = math.copysign(slope, centre)
        found.append(_Line(rise, abs(centre) - slope * float(u.mean()), slope, length))
        wave *= back
    found.sort(key=lambda line: -line.rise)
    return found[:_MOST]


# Length of the segments of `_unwound`, s; maximum slopes x samples: 1 s of processor time.
_UNWOUND, _DEAREST = 1.0, 3e7


def _refined(z: FloatArray, u: FloatArray, rate: float, idle: float, slope: float, width: float
             ) -> tuple[float, float]:
    """Refine idle and slope: maximise the power in segments that grow to the whole recording."""
    turns = np.cumsum(u - u.mean()) / rate
    idle += slope * float(u.mean())
    at = np.arange(z.size) / rate
    length = max(64, int(rate / width))
    while True:
        pieces = max(1, z.size // length)
        size = z.size // pieces
        reach = 1.5 / (length / rate)
        spread = max(float(np.ptp(turns[:size])), 1e-3)
        slopes = slope + np.linspace(-1.0, 1.0, 9) * min(1.0 / spread, 4.0 * width / 0.02)
        idles = idle + np.linspace(-1.0, 1.0, 9) * reach
        top = -1.0
        waves = np.exp(-2j * math.pi * idles[:, None] * at)
        for s in slopes:
            warped = z * np.exp(-2j * math.pi * s * turns)
            for f, turning in zip(idles, waves, strict=True):
                wave = (warped * turning)[:pieces * size]
                value = float((np.abs(wave.reshape(pieces, size).sum(axis=1)) ** 2).sum()) / size
                if value > top:
                    top, idle_best, slope_best = value, float(f), float(s)
        idle, slope = idle_best, slope_best
        if pieces == 1:
            return idle - slope * float(u.mean()), slope
        length *= 4
