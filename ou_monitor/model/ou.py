"""
The Ornstein-Uhlenbeck process: exact discretisation, moments, sample paths.

dU = -alpha (U - u0) dt + sigma dW, alpha in 1/s, sigma in V/sqrt(s).
Uhlenbeck & Ornstein, Phys. Rev. 36 (1930) 823.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from scipy.linalg import solve_banded


def stationary_variance(alpha: float, sigma: float) -> float:
    """Return Var_inf = sigma^2 / (2 alpha), V^2, for alpha in 1/s and sigma in V/sqrt(s)."""
    return sigma * sigma / (2.0 * alpha)


def transition(alpha: float, sigma: float, dt: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return decay and added variance, V^2, over dt, s (alpha in 1/s, sigma in V/sqrt(s))."""
    steps = np.asarray(dt, dtype=np.float64)
    if not alpha > 0.0 or not math.isfinite(alpha):
        raise ValueError(f'alpha must be positive and finite, got {alpha} 1/s')
    if not sigma >= 0.0 or not math.isfinite(sigma):
        raise ValueError(f'sigma must be zero or positive and finite, got {sigma} V/sqrt(s)')
    if not (np.isfinite(steps).all() and (steps >= 0.0).all()):
        raise ValueError('time steps must be finite and not negative, s')
    phi = np.exp(-alpha * steps)
    q = -stationary_variance(alpha, sigma) * np.expm1(-2.0 * alpha * steps)
    return phi, q


def simulate(
    t: npt.ArrayLike, alpha: float, sigma: npt.ArrayLike, rng: np.random.Generator, *,
    u0: npt.ArrayLike = 0.0, start: float | None = None,
) -> FloatArray:
    """Draw a path, V, at stamps, s, exact in law (alpha in 1/s, sigma in V/sqrt(s), u0 in V)."""
    stamps = np.asarray(t, dtype=np.float64)
    if stamps.ndim != 1:
        raise ValueError(f't must have shape (n,), got {stamps.shape}')
    n = stamps.size
    phi, unit_q = transition(alpha, 1.0, np.diff(stamps))
    intensity = np.broadcast_to(np.asarray(sigma, dtype=np.float64), (n,))
    if n and not (np.isfinite(intensity).all() and (intensity >= 0.0).all()):
        raise ValueError('sigma must be zero or positive and finite, V/sqrt(s)')
    noise = rng.standard_normal(n)
    x = np.empty(n)
    if n:
        first = start
        if first is None:
            first = math.sqrt(stationary_variance(alpha, float(intensity[0]))) * noise[0]
        kicks = np.append(first, noise[1:] * intensity[1:] * np.sqrt(unit_q))
        bands = np.ones((2, n))
        bands[1] = np.append(-phi, 0.0)
        x = solve_banded((1, 0), bands, kicks, check_finite=False)
    return x + np.asarray(u0, dtype=np.float64)
