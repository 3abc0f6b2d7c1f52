"""
The law `kalman`: a Wiener filter of a signal in supply noise, learned in flight.

The vector z contains the outputs of four low-passes, and the input.  It is the sum of an unknown
signal and noise, z = z_s + z_n.  The statistics of the noise are known: it is `coupling` times the
supply's noise (an OU with sigma and alpha), plus white noise n0.  With the covariances C_s of the
signal and C_n of the noise, and c_s, the last column of C_s, the weights

    w = (C_s + C_n)^-1 c_s,    C_s = C_z - C_n,

give the linear combination w^T z with the least mean square error, as an estimate of the last
element of z_s (the signal, or its slope).  This is the multichannel Wiener filter (Doclo & Moonen
2002, IEEE Trans. Signal Process. 50, 2230).  C_z is a mean of z z^T over hops of 10 ms, with the
time constant `_MEMORY`.  A hop has the weight 1 / p^2, with p the power of the noise, because the
variance of z z^T grows with p^2.  In each direction, C_s keeps only the part of C_z - C_n that
exceeds the sampling error.

- Wrong noise: if the stated noise is so large that the power of the signal would be negative, the
  noise is reduced.  Noise stated too small is detected only for a derivative, where some direction
  contains almost no signal: the noise is then increased to the power in that direction.
- Manoeuvre after calm: if a hop does not fit C_s + C_n (largest normalised square above the 99.9 %
  quantile of chi squared), C_s is scaled up in proportion, which opens the filter at once.
- If the lag of the combination exceeds its limit, just enough of the input is added to meet the
  limit (`share_for_lag`).

A step of the low-passes (`filter_state`) is z' = F z + a start + b end, exact for an input that is
linear between samples; for a derivative the input is the difference quotient.

C_n for noise with autocorrelation phi^k: with the noise n' = phi n + e as a further state, the
covariance P solves P = A P A^T + q g g^T.  Its series is summed by doubling, A -> A A.

Limits: in mode `lowpass`, noise in excess of the stated noise passes as signal.  The gain at
frequency 0 is below 1.  Below 2 Hz and above 128 Hz, the filter is no better than its slowest and
its fastest low-pass.  Intervals within 1 % of each other count as equal.
"""

from __future__ import annotations

import cmath
from functools import lru_cache
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.online.filter.cutoff import time_constant
from ou_monitor.online.filter.filter_state import phase_lag, share_for_lag, transition
from ou_monitor.online.settings import FilterSettings
from ou_monitor.records import FloatArray, NAN

Complexes = npt.NDArray[np.complex128]
# Cutoffs, Hz, two octaves apart, which cover vehicle motions (benchmarks/learned.py names the
# recordings on which they were chosen).
CUTOFFS = (2.0, 8.0, 32.0, 128.0)
COUNT = len(CUTOFFS) + 1
_TWO_PI = 2.0 * math.pi
_ORDER, _SAME = 2, 0.01
# Maximum number of step lengths whose matrices are cached.
_STEPS = 64
# Convergence tolerance of the sum over powers of A.
_GONE = 1e-18


def _key(x: float) -> int:
    """Return the index of a value's bin, on a logarithmic scale with bins of 1 %."""
    return round(math.log(x) / _SAME)


@lru_cache(maxsize=_STEPS)
def step_of(key: int) -> FloatArray:
    """Return [F a b] of all low-passes for a step (`_key` of s), shape (8, 10)."""
    dt = math.exp(_SAME * key)
    size = 2 * len(CUTOFFS)
    found = np.zeros((size, size + 2))
    for k, cutoff in enumerate(CUTOFFS):
        at, step = slice(2 * k, 2 * k + 2), transition(_ORDER, _TWO_PI * cutoff * dt)
        found[at, at], found[at, size:] = step[:, :2], step[:, 2:]
    return found


def response_of(interval: float, frequency: float, slope: bool) -> Complexes:
    """Return the frequency response of each output, shape (5,) (arguments in s and Hz)."""
    step = step_of(_key(interval))
    back = np.exp(-1j * _TWO_PI * frequency * interval)
    raw = (1.0 - back) / interval if slope else 1.0 + 0.0j
    start = raw if slope else back
    states = np.linalg.solve(np.eye(step.shape[0]) - step[:, :-2] * back,
                             step[:, -2] * start + step[:, -1] * raw)
    return np.append(states[::2], raw)


@lru_cache(maxsize=_STEPS)
def noise_of(key: int, decay: float, slope: bool) -> FloatArray:
    """Return the covariance of z, shape (5, 5), for noise of variance 1 and rate decay, 1/s."""
    # key: `_key` of the interval, s; decay: infinite for white noise.
    interval, step = math.exp(_SAME * key), step_of(key)
    size = step.shape[0]
    phi = math.exp(-decay * interval)
    first, second = step[:, -2], step[:, -1]
    # State: noise, low-passes, input; their transition, and their response to new noise.
    a, g = np.zeros((size + 2, size + 2)), np.ones(size + 2)
    a[0, 0] = a[-1, 0] = phi
    a[1:-1, 1:-1] = step[:, :-2]
    if slope:
        both = (first + second) / interval
        a[1:-1, 0], g[1:-1] = both * (phi - 1.0), both
        a[-1, 0], g[-1] = (phi - 1.0) / interval, 1.0 / interval
    else:
        a[1:-1, 0], g[1:-1] = first + second * phi, second
    p = np.outer(g, g) * -math.expm1(-2.0 * decay * interval)
    while np.max(np.abs(a)) > _GONE:
        p += a @ p @ a.T
        a = a @ a
    outputs = [*range(1, size, 2), size + 1]
    return np.asarray(p[np.ix_(outputs, outputs)])


# Time between updates of the weights, s (also the time constant of the transition to new weights);
# memory, s.  Both were chosen on bf3s, roma, jd and gecko (benchmarks/learned.py).
_HOP, _MEMORY = 0.01, 5.0
# Weight of the prior (no signal), s.
_BEFORE = 1.0
# 99.9 % quantile of chi squared with 5 degrees of freedom.
_MISFIT = 20.515
# Maximum number of samples per hop, for fast inputs.
_ROWS = 256
# Regularisation: noise added to each output, as shares of its noise and of its power, and minimum.
_FLOOR, _FLOOR_OF_ALL, _TINY = 1e-9, 1e-12, 1e-200
# Minimum factor on the stated noise; maximum input that is learned from.
_LEAST, _LARGEST = 1e-3, 1e60
# Maximum time for which a sample counts, in intervals.
_GAP = 5.0
_RAW = np.eye(COUNT)[-1]


class LearnedWiener:
    """The best linear combination of low-passes and input, starting at a first sample x."""

    def __init__(self, settings: FilterSettings, x: float) -> None:
        self._settings = settings
        self._slope = settings.mode == 'derivative'
        # Estimate of the signal, or of its slope (unit/s); lag of the estimate at `lag_frequency`,
        # degrees, NaN if unknown; share of unfiltered input in the estimate.
        self.y = 0.0 if self._slope else x
        self.lag, self.mixed = NAN, 0.0
        self._x = x
        # States of the low-passes, then the input at the start and the end of the step.
        self._state = np.zeros(2 * COUNT)
        self._state[:-2:2] = self.y
        self._rows = np.empty((_ROWS, COUNT))
        self._n, self._for = 0, 0.0  # Samples in the present hop, and its duration, s
        self._weights = np.zeros(COUNT) if self._slope else _RAW.copy()
        self._offset = 0.0
        self._log_sigma = NAN
        # Means of z z^T and of its part due to noise; sums of the weights and of their squares.
        self._power = self._noise = np.zeros((COUNT, COUNT))
        self._sum = self._squares = self._level = 0.0
        self._whiten: FloatArray | None = None
        # Maximum factor on the stated noise.
        self._most = _LARGEST if self._slope else 1.0

    def configure(self, settings: FilterSettings) -> None:
        """Change settings; keep the estimate."""
        self._settings = settings

    def advance(self, dt: float, interval: float, x: float, slope: float, sigma: float,
                error: float, alpha: float) -> float:
        """Take a sample (dt in s, alpha in 1/s)."""
        state, raw = self._state, slope if self._slope else x
        state[-2], state[-1] = slope if self._slope else self._x, raw
        self._x = x
        state[:-2] = step_of(_key(dt)) @ state
        row = self._rows[self._n]
        row[:-1], row[-1] = state[:-2:2], raw
        self._n += 1
        self._for += dt
        self._offset *= math.exp(-dt / _HOP)
        found = float(row @ self._weights)
        self.y = found + self._offset
        if self._n == _ROWS or self._for > _HOP - 0.5 * interval:
            self._learn(interval, sigma, error, alpha)
            self._offset += found - float(row @ self._weights)
            self._n, self._for = 0, 0.0
        return self.y

    def _learn(self, interval: float, sigma: float, error: float, alpha: float) -> None:
        """Learn from a hop, and compute new weights."""
        rows = self._rows[:self._n]
        if not np.max(np.abs(rows)) < _LARGEST:
            return
        noise = self._noise_now(interval, sigma, error, alpha)
        misfit = self._misfit(rows)
        self._remember(rows, noise, interval)
        try:
            found = self._best(noise, misfit)
        except np.linalg.LinAlgError:
            # Discard the means: noise that was many powers of ten larger made them inaccurate.
            self._sum, self._whiten = 0.0, None
            return
        if np.all(np.isfinite(found)):
            self._limit(found, interval)

    def _best(self, noise: FloatArray, misfit: float) -> FloatArray:
        """Return the optimal weights for the present noise."""
        # Regularise power and noise.
        floor = np.diag(_FLOOR * np.diag(self._noise + noise)
                        + _FLOOR_OF_ALL * np.diag(self._power) + _TINY)
        root = np.linalg.cholesky(self._noise + floor)
        inverse = np.linalg.inv(root)
        shares, turn = np.linalg.eigh(inverse @ (self._power + floor) @ inverse.T)
        # Factor on a share: 1 plus its relative sampling error.
        unsure = 1.0 + math.sqrt(2.0 * self._squares) / self._sum
        scale = min(max(float(shares[0]) * unsure, _LEAST), self._most)
        grown = (root @ turn) * np.sqrt(np.maximum(shares - scale * unsure, 0.0))
        root = np.linalg.cholesky(scale * (noise + floor))
        inverse = np.linalg.inv(root)
        part = inverse @ grown
        shares, turn = np.linalg.eigh(part @ part.T)
        shares = np.maximum(shares, 0.0)
        self._whiten = (inverse.T @ turn) / np.sqrt(1.0 + shares)
        kept = misfit * shares / (1.0 + misfit * shares)
        return np.asarray((inverse.T @ turn) @ (kept * (turn.T @ root[-1])))

    def _noise_now(self, interval: float, sigma: float, error: float,
                   alpha: float) -> FloatArray:
        s = self._settings
        wanted = math.log(min(max(sigma, 1.0 / _LARGEST), _LARGEST))
        constant = time_constant(s, error)
        if self._log_sigma != self._log_sigma or not constant > 0.0:
            self._log_sigma = wanted
        self._log_sigma += (wanted - self._log_sigma) * (
            -math.expm1(-self._for / constant) if constant > 0.0 else 0.0)
        key = _key(interval)
        found = s.n0 / interval * noise_of(key, math.inf, self._slope)
        if s.coupling:
            supply = (s.coupling * math.exp(self._log_sigma))**2 / (2.0 * alpha)
            found = found + min(supply, _LARGEST) * noise_of(key, alpha, self._slope)
        return found

    def _misfit(self, rows: FloatArray) -> float:
        """Return the factor by which the power of the hop exceeds the model's; 1 if it fits."""
        if self._whiten is None:
            return 1.0
        squares = np.sum((rows @ self._whiten)**2, axis=1)
        if not np.max(squares) > _MISFIT:
            return 1.0
        return min(max(float(np.mean(squares)) / COUNT, 1.0), _LARGEST)

    def _remember(self, rows: FloatArray, noise: FloatArray, interval: float) -> None:
        """Include a hop and its noise in the means."""
        level = max(float(noise[-1, -1]), _TINY)
        span = min(self._for, _GAP * interval * self._n)
        if not self._sum:
            self._level, self._power, self._noise = level, noise, noise
            self._sum, self._squares = _BEFORE, _BEFORE * max(_HOP, interval)
        weight = span * min(max(self._level / level, 1e-6), 1e6)**2
        keep = math.exp(-self._for / _MEMORY)
        self._sum = keep * self._sum + weight
        self._squares = keep * keep * self._squares + weight * weight
        share = weight / self._sum
        self._power = self._power + share * (rows.T @ rows / self._n - self._power)
        self._noise = self._noise + share * (noise - self._noise)

    def _limit(self, weights: FloatArray, interval: float) -> None:
        s = self._settings
        response = response_of(interval, s.lag_frequency, self._slope)
        if self._slope:
            # Take both lags relative to the true derivative.
            response = response / (1j * _TWO_PI * s.lag_frequency)
        h, raw = complex(weights @ response), complex(response[-1])
        if not abs(h) > 1e-9 * abs(raw):
            # No output: the lag is undefined.
            self._weights, self.lag, self.mixed = weights, NAN, 0.0
            return
        most = math.radians(phase_lag(s.order, s.lowest, s.lag_frequency))
        self.mixed = share_for_lag(h, raw, most)
        self._weights = weights + self.mixed * (_RAW - weights)
        self.lag = math.degrees(-cmath.phase(h + self.mixed * (raw - h)))
