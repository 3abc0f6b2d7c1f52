"""Power spectral density of a level, measured and as the fitted OU has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
import math

import numpy as np
from ou_monitor.analysis.levels import Segment
from ou_monitor.criticism.curves import even_on_log
from ou_monitor.records import Estimate, FloatArray, Recording
from scipy.signal import welch

_MIN_LENGTH = 32
# About this many averages: the estimate scatters by 1/sqrt(8), and there is
# still a decade below the corner in a segment of 25 relaxation times.
_AVERAGES = 8
# Enough to show a tone as a line of its own.
_PER_DECADE = 40


def _empty() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, eq=False)
class Spectrum:
    """One-sided power spectral density of a level."""

    frequency: FloatArray = field(default_factory=_empty)  # Hz, > 0, even on a log axis.
    density: FloatArray = field(default_factory=_empty)  # Measured, V^2/Hz.
    # Of the fitted OU in white noise, sampled as the data are, V^2/Hz; NaN without a fit.
    fitted: FloatArray = field(default_factory=_empty)


def level_spectrum(recording: Recording, segments: Sequence[Segment],
                   estimate: Estimate) -> Spectrum:
    """
    Return the PSD of a level (Welch, Hann), averaged over its segments.

    Limits: the samples are taken as evenly spaced at their mean rate; where
    they are not, frequencies near the Nyquist frequency are smeared.
    """
    longest = max((s.stop - s.start for s in segments), default=0)
    rate = segment_rate(recording, segments)
    if longest < _MIN_LENGTH or not rate > 0.0:
        return Spectrum()
    length = longest
    while length > _MIN_LENGTH and _pieces(segments, length) < _AVERAGES:
        length = max(_MIN_LENGTH, length * 4 // 5)
    frequency, summed, weight = np.zeros(0), np.zeros(length // 2 + 1), 0
    for s in segments:
        n = s.stop - s.start
        if n >= length:
            frequency, density = welch(recording.voltage[s.start:s.stop], fs=rate,
                                       nperseg=length, detrend='constant')
            summed, weight = summed + n * density, weight + n
    # The first bin above zero is what removing the mean has left; the last,
    # at the Nyquist frequency, is not doubled as the others are.
    frequency, density = even_on_log(frequency[2:-1], summed[2:-1] / weight, _PER_DECADE)
    fitted = np.full(frequency.size, math.nan)
    if estimate.usable:
        fitted = ou_spectrum(frequency, estimate.alpha, estimate.sigma, rate, estimate.noise_std)
    return Spectrum(frequency, density, fitted)


def segment_rate(recording: Recording, segments: Sequence[Segment]) -> float:
    """Return the mean rate of the samples within segments, Hz; 0 when there is no time."""
    steps = sum(s.stop - s.start - 1 for s in segments)
    time = float(sum(recording.t[s.stop - 1] - recording.t[s.start] for s in segments))
    return steps / time if time > 0.0 else 0.0


def _pieces(segments: Sequence[Segment], length: int) -> int:
    """Return how many half-overlapping pieces of that length the segments hold."""
    return sum(max(0, 2 * (s.stop - s.start) // length - 1) for s in segments)


def ou_spectrum(frequency: FloatArray, alpha: float, sigma: float, rate: float,
                noise_std: float = 0.0) -> FloatArray:
    """
    Return the one-sided PSD of a *sampled* OU in white noise.

    The Lorentzian 2 sigma^2 / (alpha^2 + (2 pi f)^2) with its aliases folded
    in, which is the spectrum of an AR(1) of coefficient exp(-alpha/rate).

    frequency in Hz, rate in Hz, noise_std in V.
    """
    phi = math.exp(-alpha / rate)
    var_inf = sigma * sigma / (2.0 * alpha)
    omega = 2.0 * math.pi * frequency / rate
    ar1 = var_inf * (1.0 - phi * phi) / (1.0 - 2.0 * phi * np.cos(omega) + phi * phi)
    white = noise_std * noise_std if math.isfinite(noise_std) else 0.0
    density: FloatArray = 2.0 / rate * (ar1 + white)
    return density
