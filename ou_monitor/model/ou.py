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
from scipy.linalg.lapack import dtbtrs
from scipy.signal import lfilter


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
        x = first_order(np.append(0.0, phi), kicks, 0.0)
    return x + np.asarray(u0, dtype=np.float64)


def first_order(phi: FloatArray, e: FloatArray, before: float) -> FloatArray:
    """Return x with x_k = phi_k x_{k-1} + e_k; before: the value before the first."""
    n = e.size
    if not n:
        return np.empty(0)
    if steady(phi[1:]):
        x: FloatArray = lfilter([1.0], [1.0, -phi[-1]], e, zi=[phi[0] * before])[0]
        return x
    # A lower bidiagonal system with a unit diagonal, in the memory order of LAPACK, which avoids
    # a slow copy.
    band = np.empty((2, n), order='F')
    band[0] = 1.0
    np.negative(phi[1:], out=band[1, :-1])
    band[1, -1] = 0.0
    right = np.array(e[:, None], order='F')
    right[0] += phi[0] * before
    solved: FloatArray = dtbtrs(band, right, uplo='L', diag='U', overwrite_b=True)[0][:, 0]
    return solved


def steady(values: FloatArray) -> bool:
    """Return whether all values are equal."""
    # Compare the last value first, because it mostly differs from the first if values vary.
    return not values.size or values.strides == (0,) or bool(
        values[0] == values[-1] and (values == values[0]).all())
