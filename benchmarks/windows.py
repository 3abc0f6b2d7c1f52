"""
Simulated supplies with known parameters, the same for every method, and the fits to them.

Exact sampling of the OU (no Euler step), started in its stationary law.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
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


NAMES = ('alpha', 'sigma', 'var_inf')
# Two-sided 95 % point of the normal distribution.
Z95 = 1.959963984540054
_RESAMPLES = 400


@dataclass(frozen=True)
class Fit:
    """One fit."""

    # 1/s, V/sqrt(s), V^2; NaN when the method gave none.
    alpha: float
    sigma: float
    var_inf: float
    # Standard errors of the logarithms; NaN when the method gives none.
    log_se: tuple[float, ...] = (math.nan, math.nan, math.nan)
    status: str = 'ok'  # What the method says of it.

    @staticmethod
    def failed(status: str) -> Fit:
        """Return a fit without numbers."""
        return Fit(math.nan, math.nan, math.nan, status=status)


@dataclass
class Fits:
    """Fits of one method to many windows."""

    fits: list[Fit] = field(default_factory=list)  # One per window, in order.
    seconds: list[float] = field(default_factory=list)  # CPU time of each.

    def relative(self, truth: dict[str, float]) -> Array:
        """Return relative errors, shape (windows, 3)."""
        values = np.array([[f.alpha, f.sigma, f.var_inf] for f in self.fits])
        return np.asarray(values / np.array([truth[name] for name in NAMES]) - 1.0)

    def summary(self, truth: dict[str, float], only: npt.NDArray[np.bool_] | None = None
                ) -> dict[str, object]:
        """Return bias, its Monte Carlo error, RMSE, coverage, time and outcomes."""
        errors = self.relative(truth)
        told = np.isfinite(errors)
        if only is not None:
            told &= only[:, None]
        out: dict[str, object] = {
            'windows': len(self.fits), 'told': int(told.all(axis=1).sum()),
            'statuses': dict(Counter(f.status for f in self.fits)),
            'cpu_ms': 1e3 * float(np.median(self.seconds)) if self.seconds else math.nan}
        log_se = np.array([f.log_se for f in self.fits])
        for i, name in enumerate(NAMES):
            e, se = errors[told[:, i], i], log_se[told[:, i], i]
            if not e.size:
                out[name] = dict.fromkeys(('bias', 'bias_mc', 'rmse', 'coverage', 'median'),
                                          math.nan)
                continue
            has = np.isfinite(se)
            inside = np.abs(np.log1p(np.maximum(e[has], -1 + 1e-12))) <= Z95 * se[has]
            out[name] = {
                'bias': 100.0 * float(e.mean()),
                'bias_mc': 100.0 * float(e.std(ddof=1)) / math.sqrt(e.size) if e.size > 1
                else math.nan,
                'rmse': 100.0 * math.sqrt(float((e * e).mean())),
                'median': 100.0 * float(np.median(e)),
                # A method that gives an error only sometimes is not counted as giving one.
                'coverage': 100.0 * float(inside.mean()) if has.mean() > 0.5 else math.nan}
        return out


def rmse_ratio(one: Array, other: Array, paired: bool) -> tuple[float, float]:
    """Return the ratio of two root mean squares and its bootstrap error."""
    both = np.isfinite(one) & np.isfinite(other)
    a, b = one[both] ** 2, other[both] ** 2
    if a.size < 2:
        return math.nan, math.nan
    rng = np.random.default_rng(1)
    pick = rng.integers(0, a.size, (_RESAMPLES, a.size))
    again = pick if paired else rng.integers(0, a.size, (_RESAMPLES, a.size))
    spread = np.sqrt(a[pick].mean(axis=1) / b[again].mean(axis=1))
    return math.sqrt(float(a.mean() / b.mean())), float(spread.std())


def simulate(rng: np.random.Generator, count: int, n: int, dt: float = DT) -> Array:
    """Return stationary OU paths about `LEVEL`, V."""
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
    """Return throttle that goes up and down again once in each window."""
    times = np.sort(rng.random((count, 2)) * (n - 1) * dt, axis=1)
    grid = np.arange(n) * dt
    up = (grid >= times[:, :1]) & (grid < times[:, 1:])
    return np.where(up, HIGH, LOW), times


def sagging(throttle: Array, times: Array, lag: float, delay: float = 0.0, on_grid: bool = True,
            dt: float = DT) -> Array:
    """Return the mean that throttle causes, V."""
    grid = np.arange(throttle.shape[1]) * dt
    response = np.zeros_like(throttle)
    for sign, at in ((1.0, times[:, :1]), (-1.0, times[:, 1:])):
        begin = dt * np.ceil(at / dt - 1e-9) if on_grid else at
        since = grid - begin - delay
        began = since >= -1e-9
        shape = -np.expm1(-np.maximum(since, 0.0) / lag) if lag else 1.0
        response += sign * began * shape
    return np.asarray(SAG * (LOW + (HIGH - LOW) * response), dtype=np.float64)
