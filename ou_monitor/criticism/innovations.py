"""
One-step innovations of an OU in white noise, and what their spectrum shows of another pole.

Under the fitted model the innovations are independent and standard normal, and the ordinates of
their periodogram independent and exponential.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.records import Estimate, Flag, FloatArray, NAN
from scipy import stats
from scipy.signal import lfilter

# Steps that differ by less than this share of the median are even.
_EVEN = 0.2
# Rates of the second relaxation that are looked for, in those of the first.
FACTORS = (1.0 / 30.0, 1.0 / 10.0, 1.0 / 3.0, 3.0, 10.0)
# Fewer ordinates than this tell nothing; segments shorter than this give none.
_FEWEST, _SHORTEST = 64, 64


def fresh(voltage: FloatArray, estimate: Estimate) -> np.ndarray:
    """Return which samples were measured, not repeated by the logger (voltage in V)."""
    if Flag.HELD_SAMPLES not in estimate.flags or voltage.size < 2:
        return np.ones(voltage.size, dtype=np.bool_)
    return np.append(True, voltage[1:] != voltage[:-1])


def innovations(t: FloatArray, deviation: FloatArray, alpha: float, var_inf: float,
                noise_var: float) -> FloatArray:
    """
    Return the standardised one-step innovations of a sampled OU in white noise.

    t in s, deviation in V.
    """
    if deviation.size < 2 or not math.isfinite(alpha):
        return deviation / math.sqrt(var_inf + noise_var)
    dt = np.diff(t)
    # Float64 seconds since 1970 resolve 0.24 us: an even clock looks a little uneven.
    step = float(np.median(dt))
    if noise_var > 0.0 or bool((np.abs(dt - step) < _EVEN * step).all()):
        phi = math.exp(-alpha * float(dt.mean()))
        gain, variance = _settled(phi, var_inf, noise_var)
        # The predictor forgets with phi (1 - gain): an ARMA(1,1) turned round.
        e = lfilter([1.0, -phi], [1.0, -phi * (1.0 - gain)], deviation)
        scaled = np.asarray(e / math.sqrt(variance))
        scaled[0] = deviation[0] / math.sqrt(var_inf + noise_var)
        return scaled
    phis = np.exp(-alpha * dt)
    steps = (deviation[1:] - phis * deviation[:-1]) / np.sqrt(
        -var_inf * np.expm1(-2.0 * alpha * dt))
    return np.concatenate(([deviation[0] / math.sqrt(var_inf)], steps))


def _settled(phi: float, var_inf: float, noise_var: float) -> tuple[float, float]:
    """Return the steady Kalman gain and the variance of the innovations."""
    if not noise_var > 0.0:
        return 1.0, var_inf * (1.0 - phi * phi)
    q = var_inf * (1.0 - phi * phi)
    # Predicted variance p = phi^2 p r / (p + r) + q, solved for p.
    b = noise_var * (1.0 - phi * phi) - q
    p = 0.5 * (-b + math.sqrt(b * b + 4.0 * q * noise_var))
    return p / (p + noise_var), p + noise_var


def join(parts: Sequence[FloatArray]) -> FloatArray:
    """Return the parts one after the other; empty for none."""
    return np.concatenate(parts) if parts else np.zeros(0)


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
