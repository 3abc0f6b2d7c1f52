"""
Simulated supplies with known parameters, the same for every method.

Exact sampling of the OU (no Euler step), started in its stationary law.
"""

from __future__ import annotations

from collections.abc import Callable
import math

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

Array = npt.NDArray[np.float64]

# The reference supply: Var_inf = 3.17e-3 V^2 (56 mV), tau = 15.9 ms.
ALPHA = 63.0
SIGMA = 0.632
VAR_INF = SIGMA ** 2 / (2.0 * ALPHA)
TRUTH = {'alpha': ALPHA, 'sigma': SIGMA, 'var_inf': VAR_INF}
LEVEL = 16.2
DT = 1e-3
WINDOW = 2.0
# One code of a 10-bit ADC over 12.8 V.
ADC_STEP = 12.5e-3
# Sag of 0.3 V for a throttle step of 0.5.
SAG = -0.6
LOW, HIGH = 0.2, 0.7


def simulate(rng: np.random.Generator, count: int, n: int, dt: float = DT) -> Array:
    """
    Return stationary OU paths about `LEVEL`, V.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness.
    count, n : int
        Paths, and samples in each.
    dt : float
        Step, s.

    Returns
    -------
    ndarray, shape (count, n)
        Each path has its own level within one ADC code, so that rounding
        does not meet the same thresholds every time.

    """
    phi = math.exp(-ALPHA * dt)
    shocks = rng.standard_normal((count, n)) * math.sqrt(VAR_INF)
    shocks[:, 1:] *= math.sqrt(-math.expm1(-2.0 * ALPHA * dt))
    paths = lfilter([1.0], [1.0, -phi], shocks, axis=1)
    return np.asarray(paths + LEVEL + ADC_STEP * rng.random((count, 1)), dtype=np.float64)


def with_noise(std: float) -> Callable[[Array, np.random.Generator], Array]:
    """Return a sensor that adds white noise, V."""
    def sensor(y: Array, rng: np.random.Generator) -> Array:
        return y + std * rng.standard_normal(y.shape)
    return sensor


def rounded(y: Array, rng: np.random.Generator) -> Array:
    """Return what an ADC with steps of `ADC_STEP` makes of it."""
    return ADC_STEP * np.round(y / ADC_STEP)


SENSORS = {
    'clean': with_noise(0.0),
    '5 mV noise': with_noise(5e-3),
    '20 mV noise': with_noise(20e-3),
    '12.5 mV steps': rounded,
}


def throttle_steps(rng: np.random.Generator, count: int, n: int, dt: float = DT
                   ) -> tuple[Array, Array]:
    """
    Return throttle that goes up and down again once in each window.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness.
    count, n : int
        Windows, and samples in each.
    dt : float
        Step between samples, s.

    Returns
    -------
    throttle : ndarray, shape (count, n)
        0..1, as sampled.
    times : ndarray, shape (count, 2)
        When it moved, s after the first sample: uniform over the window, not
        on the sampling grid.

    """
    times = np.sort(rng.random((count, 2)) * (n - 1) * dt, axis=1)
    grid = np.arange(n) * dt
    up = (grid >= times[:, :1]) & (grid < times[:, 1:])
    return np.where(up, HIGH, LOW), times


def sagging(throttle: Array, times: Array, lag: float, delay: float = 0.0, on_grid: bool = True,
            dt: float = DT) -> Array:
    """
    Return the mean that throttle causes, V.

    Parameters
    ----------
    throttle, times : ndarray
        See `throttle_steps`.
    lag : float
        Time constant of the first-order response, s; 0 for at once.
    delay : float
        Dead time before it, s.
    on_grid : bool
        Whether the response starts when the step is first sampled, or at the
        step itself, up to `dt` earlier.
    dt : float
        Step between samples, s.

    Returns
    -------
    ndarray, shape (count, n)
        `SAG` times the throttle as the supply feels it.

    """
    grid = np.arange(throttle.shape[1]) * dt
    response = np.zeros_like(throttle)
    for sign, at in ((1.0, times[:, :1]), (-1.0, times[:, 1:])):
        begin = dt * np.ceil(at / dt - 1e-9) if on_grid else at
        since = grid - begin - delay
        began = since >= -1e-9
        shape = -np.expm1(-np.maximum(since, 0.0) / lag) if lag else 1.0
        response += sign * began * shape
    return np.asarray(SAG * (LOW + (HIGH - LOW) * response), dtype=np.float64)
