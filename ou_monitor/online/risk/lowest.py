"""
The lowest voltage of a horizon: as the load filter has it, and as the flight has corrected that.

A future is three groups of samples: throttle goes to a peak at once, with the inrush of a rise,
stays, and goes to a rest.  Its lowest voltage has nearly the mean mu = min over groups of
(mean path - sd a(n)) and the variance of the path there plus (sd b(n))^2; a and b are mean and
deviation of the largest of n running medians of three normal samples.  Limits: the mean path
within a group is its average; groups count as if only the lowest could be the lowest of all;
samples of noise are independent, as the load filter takes them.

The flight's own law, from horizons that are complete: (lowest - start) / s = b0 + b1 (mu - start)
/ s + k e with mean mu and deviation s as above: least squares that forget, e of Student's t with
five degrees of freedom.  Now and then a law is wrong: a share of horizons is then as the
excursions are.  That share is counted with the rule of succession, each horizon as likely as the
two make it.  Overlapping horizons count as step / horizon each.  Limits: one bias and one gain
for all throttles; between two horizons all is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import INRUSH_TIME, ripple
from ou_monitor.model.passage.law import normal_below
from ou_monitor.online.load.supply_load import LAGS, LoadState, POWER
from ou_monitor.records import FloatArray

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
    over = normal_below(-x)
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


# Degrees of freedom: tails of a model that is wrong now and then.
FREEDOM = 5.0
_NORM = math.exp(math.lgamma(0.5 * FREEDOM + 0.5) - math.lgamma(0.5 * FREEDOM)) / math.sqrt(
    math.pi * (FREEDOM - 2.0))
# Coefficients of its tail in the squares of sqrt(FREEDOM / (FREEDOM + t^2)), last first.
_TAIL = [8.0 / (3.0 * math.pi) * math.comb(2 * k, k) / 4.0**k / (2 * k + 5)
         for k in range(9, -1, -1)]
# Horizons' worth of the prior, its variance, and the prior of bias and gain.
_PRIOR, _PRIOR_VARIANCE = 5.0, 3.0
_BIAS, _GAIN = 0.5, 0.4
# Memory, s; largest square of a miss that counts; misses beyond 3 deviations weigh less.
MEMORY, _LARGEST, _HUBER = 120.0, 36.0, 3.0
# Error of the model as a share of the drop.
_SHARE = 0.1


def density(x: FloatArray, mean: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return the density of Student's t of that mean and deviation, elementwise."""
    z = (x - mean) / deviation
    return np.asarray(_NORM / deviation * (1.0 + z * z / (FREEDOM - 2.0)) ** (
        -0.5 * (FREEDOM + 1.0)))


def below(level: float, mean: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return P(x < level) of that Student's t, elementwise."""
    t = (level - mean) / deviation * math.sqrt(FREEDOM / (FREEDOM - 2.0))
    # Abramowitz & Stegun 26.7.4; far out its terms cancel, and the tail is summed.
    angle = np.arctan2(math.sqrt(FREEDOM), np.abs(t))
    c = np.sin(angle)
    tail = (angle - np.cos(angle) * c * (1.0 + 2.0 / 3.0 * c * c)) / math.pi
    tail = np.where(c < 0.2, c**5 * np.polyval(_TAIL, c * c), tail)
    return np.asarray(np.where(t < 0.0, tail, 1.0 - tail))


class LowestLaw:
    """Bias, gain and spread of the lowest voltage: b0, b1, k^2, and the errors of b0 and b1."""

    def __init__(self, values: FloatArray) -> None:
        self.values = values

    def moments(self, mean: FloatArray, deviation: FloatArray, start: float
                ) -> tuple[FloatArray, FloatArray]:
        """Return mean and deviation, V, of the lowest voltage, errors of the law included."""
        bias, gain, variance, c00, c01, c11 = self.values.tolist()
        deviation = np.hypot(deviation, _SHARE * (start - mean))
        x = (mean - start) / deviation
        return start + deviation * (bias + gain * x), deviation * np.sqrt(
            variance + c00 + 2.0 * c01 * x + c11 * x * x)


class Calibrator:
    """Learns a `LowestLaw` from completed horizons."""

    def __init__(self) -> None:
        self._prior = np.diag([_BIAS ** -2, _GAIN ** -2])
        self._first = self._prior @ (0.0, 1.0)
        self._information, self._weighted = self._prior.copy(), self._first.copy()
        self._count = self._squares = 0.0
        self._settle()

    def _settle(self) -> None:
        self._b = np.linalg.solve(self._information, self._weighted)
        self._variance = (_PRIOR * _PRIOR_VARIANCE + self._squares) / (_PRIOR + self._count)
        errors = np.linalg.inv(self._information) * self._variance
        self.law = LowestLaw(np.array([*self._b, self._variance, errors[0, 0], errors[0, 1],
                                       errors[1, 1]]))

    def add(self, low: float, mean: float, deviation: float, start: float, weight: float,
            elapsed: float) -> None:
        """Learn from a completed horizon: lowest, predicted and first voltage, V."""
        deviation = math.hypot(deviation, _SHARE * (start - mean))
        keep = math.exp(-elapsed / MEMORY)
        row = np.array([1.0, (mean - start) / deviation])
        y = (low - start) / deviation
        miss = y - float(row @ self._b)
        least = weight * min(1.0, _HUBER * math.sqrt(self._variance) / max(abs(miss), 1e-9))
        self._count = self._count * keep + weight
        self._squares = self._squares * keep + weight * min(miss * miss, _LARGEST)
        self._information = self._prior + (
            self._information - self._prior) * keep + least * np.outer(row, row)
        self._weighted = self._first + (self._weighted - self._first) * keep + least * y * row
        self._settle()


class FarShare:
    """Share of horizons that are not as a law says; `right` count as right before any."""

    def __init__(self, right: float = 1.0) -> None:
        self._right, self._wrong = right, 1.0
        self._first = right

    @property
    def value(self) -> float:
        """Return the share."""
        return self._wrong / (self._wrong + self._right)

    def add(self, law: float, far: float, weight: float, elapsed: float) -> float:
        """Learn from the densities, 1/V, of a lowest voltage; return that of both together."""
        keep = math.exp(-elapsed / MEMORY)
        share = self.value
        both = share * far + (1.0 - share) * law
        wrong = share * far / both if both > 0.0 else 1.0
        self._wrong = 1.0 + (self._wrong - 1.0) * keep + weight * wrong
        self._right = self._first + (self._right - self._first) * keep + weight * (1.0 - wrong)
        return both
