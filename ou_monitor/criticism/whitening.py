"""
Stretches of a level as one-step innovations: independent and standard normal under its model.

Limits: where white noise was found and the steps are uneven, the gain is that of the mean step.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.records import Estimate, Flag, FloatArray
from scipy.signal import lfilter

# Steps that differ by less than this share of the median are even.
_EVEN = 0.2


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
