"""Used by estimator.py: simulated supplies with known parameters, and fits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Any

from common import number
import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

Array = npt.NDArray[np.float64]

# The reference supply: Var_inf = 3.17e-3 V^2 (56 mV), tau = 15.9 ms.
ALPHA, SIGMA, LEVEL = 63.0, 0.632, 16.2
VAR_INF = SIGMA ** 2 / (2.0 * ALPHA)
NAMES = ('alpha', 'sigma', 'var_inf')
TRUTH = np.array([ALPHA, SIGMA, VAR_INF])
DT, WINDOW = 1e-3, 2.0  # s.
ADC_STEP = 12.5e-3  # One code of a 10-bit ADC over 12.8 V.
SAG, LOW, HIGH = -0.6, 0.2, 0.7  # V at full throttle; the two throttles.
Z95 = 1.96  # 97.5 % quantile of the normal distribution.


@dataclass(frozen=True)
class Fit:
    """One fit; NaN where the method gave no value."""

    values: tuple[float, ...] = (math.nan,) * 3  # alpha 1/s, sigma V/sqrt(s), Var_inf V^2.
    log_se: tuple[float, ...] = (math.nan,) * 3  # Standard errors of the logarithms.
    status: str = 'ok'
    seconds: float = math.nan  # CPU time.


def errors(fits: list[Fit]) -> Array:
    """Return relative errors, shape (windows, 3)."""
    return np.array([fit.values for fit in fits]) / TRUTH - 1.0


def cells(fits: list[Fit], only: npt.NDArray[np.bool_] | None = None) -> list[str]:
    """Return bias and its Monte Carlo error, RMSE and coverage in %, of each parameter."""
    error, log_se = errors(fits), np.array([fit.log_se for fit in fits])
    here = np.isfinite(error).all(axis=1) & (True if only is None else only)
    if not here.any():
        return ['-'] * 9
    out = []
    for e, se in zip(error[here].T, log_se[here].T):
        inside = np.abs(np.log1p(np.maximum(e, -1.0 + 1e-12))) <= Z95 * se
        out += [f'{100.0 * e.mean():+.1f} ± {100.0 * e.std() / math.sqrt(e.size):.1f}',
                number(100.0 * math.sqrt((e * e).mean())), number(100.0 * inside.mean(), '.0f')]
    return out


def statuses(fits: list[Fit]) -> str:
    """Return the share of each status."""
    return ', '.join(f'{name} {100.0 * many / len(fits):.0f} %'
                     for name, many in Counter(fit.status for fit in fits).most_common())


def simulate(rng: np.random.Generator, count: int, n: int, dt: float = DT) -> Array:
    """Return stationary OU paths about `LEVEL`, V, sampled exactly."""
    phi = math.exp(-ALPHA * dt)
    shocks = rng.standard_normal((count, n)) * math.sqrt(VAR_INF)
    shocks[:, 1:] *= math.sqrt(-math.expm1(-2.0 * ALPHA * dt))
    paths = lfilter([1.0], [1.0, -phi], shocks, axis=1)
    return np.asarray(paths + LEVEL + ADC_STEP * rng.random((count, 1)))


def with_noise(std: float) -> Callable[[Array, np.random.Generator], Array]:
    """Return a sensor that adds white noise, V."""
    return lambda y, rng: y + std * rng.standard_normal(y.shape)


SENSORS: dict[str, Callable[[Array, np.random.Generator], Any]] = {
    'clean': with_noise(0.0), '5 mV noise': with_noise(5e-3), '20 mV noise': with_noise(20e-3),
    '12.5 mV steps': lambda y, rng: ADC_STEP * np.round(y / ADC_STEP)}


def throttle_steps(rng: np.random.Generator, count: int, n: int) -> tuple[Array, Array]:
    """Return throttle that goes up and down once in each window, and the times of its steps."""
    times = np.sort(rng.random((count, 2)) * (n - 1) * DT, axis=1)
    grid = np.arange(n) * DT
    up = (grid >= times[:, :1]) & (grid < times[:, 1:])
    return np.where(up, HIGH, LOW), times


def sagging(throttle: Array, times: Array, lag: float, dead: float = 0.0, on_grid: bool = True
            ) -> Array:
    """Return the mean that throttle causes, V: first-order lag after a dead time, s."""
    grid = np.arange(throttle.shape[1]) * DT
    response = np.zeros_like(throttle)
    for sign, at in ((1.0, times[:, :1]), (-1.0, times[:, 1:])):
        since = grid - (DT * np.ceil(at / DT - 1e-9) if on_grid else at) - dead
        shape = -np.expm1(-np.maximum(since, 0.0) / lag) if lag else 1.0
        response += sign * (since >= -1e-9) * shape
    return np.asarray(SAG * (LOW + (HIGH - LOW) * response))
