"""Power spectral density of a level, measured and as the fitted OU has it."""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.offline.analyze import LevelResult
from ou_monitor.records import FloatArray, Recording
from scipy.signal import welch

_MIN_LENGTH = 32
# About this many averages: the estimate scatters by 1/sqrt(8), and there is
# still a decade below the corner in a stretch of 25 relaxation times.
_AVERAGES = 8
# Enough to show a tone as a line of its own.
_PER_DECADE = 40


def level_spectrum(recording: Recording, level: LevelResult) -> tuple[FloatArray, FloatArray]:
    """
    Return the one-sided PSD of a level (Welch, Hann), averaged over its segments.

    Limits: the samples are taken as evenly spaced at their mean rate; where
    they are not, frequencies near the Nyquist frequency are smeared.

    Parameters
    ----------
    recording : Recording
        What the level is of.
    level : LevelResult
        Level.

    Returns
    -------
    tuple of ndarray, shape (k,)
        Frequency, Hz, > 0, and PSD, V^2/Hz; empty when no segment holds 32
        samples.

    """
    longest = max((s.stop - s.start for s in level.segments), default=0)
    if longest < _MIN_LENGTH or not level.time > 0.0:
        return np.zeros(0), np.zeros(0)
    total = sum(s.stop - s.start for s in level.segments)
    rate = (total - len(level.segments)) / level.time
    length = longest
    while length > _MIN_LENGTH and _pieces(level, length) < _AVERAGES:
        length = max(_MIN_LENGTH, length * 4 // 5)
    frequency, summed, weight = np.zeros(0), np.zeros(length // 2 + 1), 0
    for s in level.segments:
        n = s.stop - s.start
        if n >= length:
            frequency, density = welch(recording.voltage[s.start:s.stop], fs=rate,
                                       nperseg=length, detrend='constant')
            summed, weight = summed + n * density, weight + n
    # The first bin above zero is what removing the mean has left; the last,
    # at the Nyquist frequency, is not doubled as the others are.
    return _even_on_log(frequency[2:-1], summed[2:-1] / weight)


def _pieces(level: LevelResult, length: int) -> int:
    """Return how many half-overlapping pieces of that length the segments hold."""
    return sum(max(0, 2 * (s.stop - s.start) // length - 1) for s in level.segments)


def _even_on_log(frequency: FloatArray, density: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average neighbours, so that the points lie evenly on a log axis."""
    if frequency.size < 3:
        return frequency, density
    bins = np.floor(_PER_DECADE * np.log10(frequency / frequency[0])).astype(np.intp)
    count = np.bincount(bins)
    some = count > 0
    return (np.bincount(bins, frequency)[some] / count[some],
            np.bincount(bins, density)[some] / count[some])


def ou_spectrum(frequency: FloatArray, alpha: float, sigma: float, rate: float,
                noise_std: float = 0.0) -> FloatArray:
    """
    Return the one-sided PSD of a *sampled* OU in white noise.

    The Lorentzian 2 sigma^2 / (alpha^2 + (2 pi f)^2) with its aliases folded
    in, which is the spectrum of an AR(1) of coefficient exp(-alpha/rate).

    Parameters
    ----------
    frequency : ndarray, shape (k,)
        Hz, below rate/2.
    alpha, sigma : float
        1/s and V/sqrt(s).
    rate : float
        Sampling rate, Hz.
    noise_std : float
        White noise, V; NaN counts as none.

    Returns
    -------
    ndarray, shape (k,)
        V^2/Hz.

    """
    phi = math.exp(-alpha / rate)
    var_inf = sigma * sigma / (2.0 * alpha)
    omega = 2.0 * math.pi * frequency / rate
    ar1 = var_inf * (1.0 - phi * phi) / (1.0 - 2.0 * phi * np.cos(omega) + phi * phi)
    white = noise_std * noise_std if math.isfinite(noise_std) else 0.0
    density: FloatArray = 2.0 / rate * (ar1 + white)
    return density
