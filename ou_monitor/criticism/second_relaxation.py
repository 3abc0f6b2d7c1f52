"""
Whether a second relaxation rides on the one that was fitted: a score test.

Under the fitted model the ordinates of the periodogram of the innovations are independent and
exponential.  A second OU, slower or faster by a known factor, lifts them in a known pattern; what
the fit can absorb of it (alpha, sigma, white noise) is projected out of the pattern, and what is
left is compared with the ordinates.  This is the most powerful test near the model, where lags of
innovations see nothing: a wander ten times slower is correlated over hundreds of them.

Limits: `FACTORS` only, each alone, one-sided (an instrument that removes slow parts is not looked
for); straight drifts are taken out; samples count as even.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.criticism.quality_item import QualityItem, Severity
from ou_monitor.records import FloatArray, NAN
from scipy import stats

# Rates of the second relaxation that are looked for, in those of the first.
FACTORS = (1.0 / 30.0, 1.0 / 10.0, 1.0 / 3.0, 3.0, 10.0)
# Fewer ordinates than this tell nothing; segments shorter than this give none.
_FEWEST, _SHORTEST = 64, 64


def second_relaxation(parts: Sequence[FloatArray], rate: float, alpha: float, var_inf: float,
                      noise_var: float) -> tuple[float, float]:
    """Test for a second relaxation (rate in Hz)."""
    frequency, power = _periodogram(parts, rate)
    if frequency.size < _FEWEST:
        return NAN, NAN
    power = power / power.mean() - 1.0
    omega = 2.0 * np.pi * frequency / rate
    step = alpha / rate
    fitted = var_inf * _shape(omega, step) + noise_var
    # What the fit absorbs: a factor of all, a change of alpha, a change of the white noise.
    nudge = 1e-3
    slope = (_shape(omega, step * (1.0 + nudge)) - _shape(omega, step * (1.0 - nudge))) / nudge
    absorbed = np.linalg.qr(np.column_stack((
        np.ones(omega.size), var_inf * slope / fitted, 1.0 / fitted)))[0]
    best, share = 1.0, NAN
    for factor in FACTORS:
        pattern = var_inf * _shape(omega, factor * step) / fitted
        full = float(pattern @ pattern)
        pattern = pattern - absorbed @ (absorbed.T @ pattern)
        left = float(pattern @ pattern)
        if not left > 1e-6 * full:
            continue
        score = float(pattern @ power)
        # A weighted sum of exponentials is skewed as few of them carry it.
        skew = 2.0 * float(np.sum(pattern ** 3)) / left ** 1.5
        p = float(stats.pearson3.sf(score / math.sqrt(left), skew))
        if p < best:
            best, share = p, score / left
    return min(1.0, len(FACTORS) * best), share


def second_items(throttles: Sequence[float]) -> list[QualityItem]:
    """Say where a second relaxation was found (throttles 0..1)."""
    return [QualityItem('SECOND_RELAXATION', Severity.WARNING, (
        'A second relaxation, slower or faster, stands beside the one that was fitted: alpha, tau '
        'and Var_inf are of a mixture, and their intervals hold for neither; the other levels may '
        'hide the same. `ou-monitor discover` fits both.'), tuple(throttles))] if throttles else []


def _shape(omega: FloatArray, step: float) -> FloatArray:
    """Return the spectrum of a sampled OU of variance 1; `step` is alpha times the step."""
    phi = math.exp(-step)
    found: FloatArray = -math.expm1(-2.0 * step) / (1.0 - 2.0 * phi * np.cos(omega) + phi * phi)
    return found


def _periodogram(parts: Sequence[FloatArray], rate: float) -> tuple[FloatArray, FloatArray]:
    """Return frequencies, Hz, and ordinates of all parts, straight drifts taken out."""
    frequencies: list[FloatArray] = [np.zeros(0)]
    powers: list[FloatArray] = [np.zeros(0)]
    for part in parts:
        n = part.size
        if n < _SHORTEST:
            continue
        # Its first innovation has no past, and the trend is that of the rest.
        count = np.arange(n) - 0.5 * (n - 1)
        level = part - part.mean() - count * float(count @ part) / float(count @ count)
        powers.append(np.square(np.abs(np.fft.rfft(level)[1:(n + 1) // 2])) / n)
        frequencies.append(rate / n * np.arange(1.0, (n + 1) // 2))
    return np.concatenate(frequencies), np.concatenate(powers)
