"""
The lowest voltage of a future whose throttle is given, from what the load filter knows.

A future is three groups of samples: throttle goes to a peak at once, with the inrush of a rise,
stays, and goes to a rest.  Its lowest voltage has nearly the mean mu = min over groups of
(mean path - sd a(n)) and the variance of the path there plus (sd b(n))^2; a and b are mean and
deviation of the largest of n running medians of three normal samples.

Limits: the mean path within a group is its average; groups count as if only the lowest could
be the lowest of all; samples of noise are independent, as the load filter takes them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import INRUSH_TIME, ripple
from ou_monitor.online.supply_load import LAGS, LoadState, POWER
from ou_monitor.records import FloatArray
from scipy.special import ndtr

# The first group after a rise, in time constants of the inrush.
_RISE = 2.0
# Share of a rise of throttle that counts for the inrush: pilots ramp, in 0.2 s or so, and a ramp
# has its time constant over its length of the inrush of a step.
_SHARE_OF_RISE = INRUSH_TIME / 0.2


def _integral(y: FloatArray, x: FloatArray) -> float:
    """Return the integral by trapezoids (NumPy's is called otherwise in 1.26 and in 2)."""
    return float(0.5 * np.sum(np.diff(x) * (y[1:] + y[:-1])))


def _largest_medians() -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Return ln n, and mean and deviation of the largest of n running medians of three normals.

    It stays below x unless two of three neighbours pass x: a chain of three states (samples
    since the last that passed), whose steps are doubled.
    """
    x = np.linspace(-6.0, 8.0, 561)
    over = ndtr(-x)
    step = np.zeros((x.size, 3, 3))
    step[:, 0, 0], step[:, 0, 1] = 1.0 - over, over
    step[:, 1, 2] = step[:, 2, 0] = 1.0 - over
    first = step @ step
    counts, means, deviations = [], [], []
    power = step
    for k in range(17):
        below = (first @ power)[:, 0].sum(axis=1)
        # Integrals of 1 - F from the lowest x on.
        mean = x[0] + _integral(1.0 - below, x)
        square = x[0] ** 2 + _integral(2.0 * x * (1.0 - below), x)
        counts.append(k * np.log(2.0))
        means.append(mean)
        deviations.append(np.sqrt(square - mean ** 2))
        power = power @ power
    return np.array(counts), np.array(means), np.array(deviations)


_LN_N, _MEAN, _DEVIATION = _largest_medians()


@dataclass(frozen=True, eq=False)
class Futures:
    """
    Throttle to come, in k ways.

    Attributes
    ----------
    peak, rest : ndarray, shape (k,)
        Throttle at first, and after that, 0..1.
    dwell : ndarray, shape (k,)
        Time at the peak, s.

    """

    peak: FloatArray
    dwell: FloatArray
    rest: FloatArray

    def after(self, first: Futures) -> Futures:
        """Return the first and then these."""
        return Futures(*(np.concatenate(pair) for pair in (
            (first.peak, self.peak), (first.dwell, self.dwell), (first.rest, self.rest))))


@dataclass(frozen=True)
class Sampling:
    """Interval of the samples, s, and the usual sqrt|du| from one to the next."""

    interval: float
    activity: float


def held(throttle: npt.ArrayLike, dwell: npt.ArrayLike, rest: float) -> Futures:
    """Return futures that go to a throttle, stay for a time, s, and come back to `rest`."""
    peak, times = np.broadcast_arrays(*np.atleast_1d(throttle, dwell))
    return Futures(peak.astype(np.float64), times.astype(np.float64),
                   np.full(peak.shape, rest))


def _groups(state: LoadState, u: FloatArray, tau: FloatArray, inrush: FloatArray) -> FloatArray:
    """Return the regressors (k, j, 9) of groups in the order in which they are flown."""
    x = u ** POWER
    g = -state.size
    rows = np.empty(u.shape + (9,))
    rows[..., 0] = 1.0
    rows[..., 1] = -state.fall * np.cumsum(x * tau, axis=1)
    rows[..., 2], rows[..., 3], rows[..., 4] = g * x, g * u, g * u ** 3
    rows[..., 8] = g * inrush
    for column, (low, lag) in enumerate(zip(state.lags, LAGS), start=5):
        decay = np.exp(-tau / lag)
        share = (1.0 - decay) * lag / np.maximum(tau, 1e-9)
        now: FloatArray = np.full(u.shape[0], low)
        for j in range(u.shape[1]):
            apart = now - x[:, j]
            rows[:, j, column] = g * (x[:, j] + apart * share[:, j])
            now = x[:, j] + apart * decay[:, j]
    return rows


def mean_now(state: LoadState) -> float:
    """Return the mean voltage, V, at the present throttle and lags, without inrush."""
    one = np.ones((1, 1))
    rows = _groups(state, one * state.throttle, one * 1e-9, 0.0 * one)
    return float(rows[0, 0] @ state.mean)


def lowest(state: LoadState, futures: Futures, horizon: float, sampling: Sampling
           ) -> tuple[FloatArray, FloatArray]:
    """Return mean and deviation, V, of the lowest voltage of each future, shape (k,)."""
    peak, dt = futures.peak, sampling.interval
    span = max(horizon, dt)
    stay = np.clip(futures.dwell, dt, span)
    first = np.minimum(stay, max(2.0 * dt, _RISE * INRUSH_TIME))
    tau = np.stack([first, stay - first, span - stay], axis=1)
    u = np.stack([peak, peak, futures.rest], axis=1)
    up = np.maximum(0.0, peak - state.throttle) * _SHARE_OF_RISE
    inrush = np.zeros_like(u)
    inrush[:, 0] = up
    rows = _groups(state, u, tau, inrush)
    activity = np.full_like(u, sampling.activity)
    activity[:, 0] = np.maximum(np.sqrt(up), sampling.activity)
    b = state.log_variance
    sd = np.exp(0.5 * (b[0] + b[1] * ripple(np.clip(u, *state.flown)) + b[2] * activity))
    ln_n = np.log(np.maximum(tau / dt, 1.0))
    low = np.where(tau > 0.5 * dt, rows @ state.mean - sd * np.interp(ln_n, _LN_N, _MEAN), np.inf)
    j = np.argmin(low, axis=1)
    k = np.arange(j.size)
    row = rows[k, j]
    known = np.maximum(((row @ state.covariance) * row).sum(axis=1), 0.0)
    noise = sd[k, j] * np.interp(ln_n[k, j], _LN_N, _DEVIATION)
    return low[k, j], np.sqrt(known + noise ** 2)
