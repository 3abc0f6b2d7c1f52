"""
The load model of a recording: a maximum a posteriori fit.

Limits first: the priors are narrow, so that no parameter can run away where the recording does
not decide it; a parameter at three prior deviations says that the form does not hold.
Residuals are white noise and an Ornstein-Uhlenbeck process of 20 s and of a few mV.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from ou_monitor.model.load import CELL, cells_in_series, charge_at, LoadModel
from ou_monitor.records import determined, FloatArray, log_interval, NAN
from scipy.linalg import solve_banded
from scipy.optimize import least_squares

# Centre and deviation of each parameter; of its logarithm, but for those of _LINEAR.  Usual
# figures of lithium-polymer packs with two RC pairs, tightened on the recordings (doc/load.md).
_PRIOR = {
    'size': (math.log(0.12), 0.7), 'power': (math.log(1.8), 0.1),
    'fast_share': (math.log(0.2), 0.3), 'fast_time': (math.log(1.0), 0.7),
    'slow_share': (math.log(0.3), 0.3), 'slow_time': (math.log(20.0), 0.3),
    'inrush': (math.log(0.5), 1.0), 'lag': (math.log(0.01), 0.7),
    'endurance': (math.log(350.0), 0.4), 'charge': (0.7, 0.3), 'before': (0.3, 0.4),
}
_NAMES = tuple(_PRIOR)
_LINEAR = {'charge': (0.0, 1.05), 'before': (0.0, 1.5)}
# Bounds of the others: prior deviations from the centre.
_REACH = 3.0
# Mean of the data over this time, s, before the fit: OU and polarisation are slower.
_BIN = 0.05
# Time constant of the residual OU, s, and the deviations tried, V a cell (cap: doc/load.md).
_SLOW_TIME = 20.0
_SLOW_STDS = np.geomspace(0.001, 0.00464, 5)
# White and slow noise at the start, V a cell: the order of the recordings.
_WHITE_START, _SLOW_START = 0.02, 0.01
# Rounds of fit and noise; evaluations of the model in each.
_ROUNDS, _EVALUATIONS = 4, 30


@dataclass(frozen=True)
class LoadFit:
    """
    A fitted load model, and how well it is known.

    Attributes
    ----------
    model : LoadModel
        The parameters.
    covariance : ndarray, shape (11, 11)
        Covariance of the parameters as fitted (logarithms, but for charge and before).
    condition : float
        Condition number of the Jacobian in prior deviations.
    noise_std : float
        White noise of a 50 ms mean, V.
    slow_std : float
        Standard deviation of the OU of 20 s, V.

    """

    model: LoadModel
    covariance: FloatArray
    condition: float
    noise_std: float
    slow_std: float

    def draw(self, rng: np.random.Generator) -> LoadModel:
        """Return a model within the errors of this one."""
        low, high, _, _ = _bounds(self.model.charge)
        moved = rng.multivariate_normal(self._theta, self.covariance)
        fixed = {'cells': self.model.cells, 'mean_load': self.model.mean_load,
                 'full_current': self.model.full_current}
        return _model(np.clip(moved, low, high), fixed)

    @property
    def _theta(self) -> FloatArray:
        """Return the parameters as fitted."""
        return np.array([getattr(self.model, name) if name in _LINEAR
                         else math.log(getattr(self.model, name)) for name in _NAMES])

    @property
    def at_bounds(self) -> tuple[str, ...]:
        """Return the parameters that stand at a bound."""
        low, high, centre, deviation = _bounds(self.model.charge)
        edge = np.minimum(self._theta - low, high - self._theta) < 1e-3 * deviation
        return tuple(name for name, there in zip(_NAMES, edge) if there)

    @property
    def resistance(self) -> tuple[float, float, float]:
        """Return the resistance, Ohm, and its 95 % interval, statistical only; NaN without I."""
        if not self.model.full_current:
            return NAN, NAN, NAN
        value = self.model.size * self.model.cells * CELL / self.model.full_current
        low, high = log_interval(value, math.sqrt(self.covariance[0, 0]))
        return value if determined(value, low, high) else NAN, low, high


def _bounds(charge: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return lower and upper bounds, prior centre and deviation; charge centred as given."""
    centre = np.array([charge if name == 'charge' else _PRIOR[name][0] for name in _NAMES])
    deviation = np.array([_PRIOR[name][1] for name in _NAMES])
    low, high = centre - _REACH * deviation, centre + _REACH * deviation
    for name, (least, most) in _LINEAR.items():
        low[_NAMES.index(name)], high[_NAMES.index(name)] = least, most
    return low, high, centre, deviation


class _Noise:
    """White noise and OU: whitens residuals of binned data; stamps in s."""

    def __init__(self, t: FloatArray, cells: int) -> None:
        self._keep = np.exp(-np.diff(t) / _SLOW_TIME)
        self._tried = (_SLOW_STDS * cells) ** 2
        self.white = (_WHITE_START * cells) ** 2
        self.slow = (_SLOW_START * cells) ** 2
        # What the last two variances gave: a fit asks for them hundreds of times.
        self._found: tuple[tuple[float, float], tuple[FloatArray, FloatArray, FloatArray]] | None
        self._found = None

    def whiten(self, residuals: FloatArray, slow: float | None = None,
               ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return standardised innovations, their variances, V^2, and the innovations, V."""
        variance, bands, passed = self._predictor(self.slow if slow is None else slow)
        right = np.zeros(residuals.size)
        right[1:] = passed * residuals[:-1]
        innovations = residuals - solve_banded((1, 0), bands, right, check_finite=False)
        return innovations / np.sqrt(variance), variance, innovations

    def _predictor(self, q: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return variances of innovations, V^2, the recursion, and what passes to the next."""
        if self._found is None or self._found[0] != (self.white, q):
            n = self._keep.size + 1
            keep, values, p, white = self._keep.tolist(), [], q, self.white
            for a in keep:
                values.append(p + white)
                p = a * a * p * white / (p + white) + q * (1.0 - a * a)
            variance = np.array([*values, p + white])
            gain = 1.0 - white / variance
            bands = np.ones((2, n))
            bands[1, :-1] = -self._keep * (1.0 - gain[:-1])
            bands[1, -1] = 0.0
            self._found = (white, q), (variance, bands, self._keep * gain[:-1])
        return self._found[1]

    def learn(self, residuals: FloatArray) -> None:
        """Fit both variances to residuals, V, of the model."""
        for _ in range(2):
            self.white = float(np.mean(self.whiten(residuals)[2] ** 2))
            scores = []
            for slow in self._tried:
                z, variance, _ = self.whiten(residuals, slow)
                scores.append(np.log(variance).sum() + z @ z)
            self.slow = float(self._tried[int(np.argmin(scores))])


def _model(theta: FloatArray, fixed: dict[str, Any]) -> LoadModel:
    values: dict[str, Any] = {name: float(x) if name in _LINEAR else math.exp(x)
                              for name, x in zip(_NAMES, theta)}
    return LoadModel(**values, **fixed)


def fit_load(t: FloatArray, voltage: FloatArray, throttle: FloatArray,
             current: FloatArray | None = None,
             left_out: tuple[float, float] | None = None, near: LoadFit | None = None) -> LoadFit:
    """
    Fit the load model; with current, A, that is the load instead of throttle.

    t in s, voltage in V, throttle in 0..1; all finite, stamps rising.  Voltage between the stamps
    left_out, s, is not looked at.  A fit that is near by, as of all the voltage, saves most of the
    work.
    """
    if t.size < 2 or not t[-1] - t[0] > 20 * _BIN:
        raise ValueError(f'a fit of the load needs more than {20 * _BIN:g} s')
    if not (np.isfinite(voltage).all() and (np.diff(t) > 0.0).all()):
        raise ValueError('voltage must be finite, V, and stamps must rise, s')
    seen = np.ones(t.size, dtype=np.bool_) if left_out is None else (
        (t < left_out[0]) | (t > left_out[1]))
    if not seen.any():
        raise ValueError('no voltage is left for the fit')
    top = float(np.quantile(voltage[seen], 0.99))
    fixed: dict[str, Any] = {'cells': cells_in_series(top)}
    # 1.6: below the prior's exponent, as the level takes a part; a scale of `endurance`.
    moving = throttle > 0.05
    fixed['mean_load'] = float((throttle[moving] ** 1.6).mean()) if moving.any() else 0.1
    if current is not None:
        fixed['full_current'] = max(float(np.quantile(current, 0.99)), 1e-9)
        fixed['mean_load'] = max(
            1e-3, float(np.maximum(current, 0.0).mean()) / fixed['full_current'])
    low, high, centre, deviation = _bounds(
        charge_at(float(np.quantile(voltage[seen], 0.98)) / fixed['cells']))
    index = np.floor((t - t[0]) / _BIN + 1e-9).astype(int)
    starts = np.concatenate(([0], np.flatnonzero(np.diff(index)) + 1))
    counts = np.diff(np.append(starts, t.size))

    def mean(x: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(x, starts) / counts, dtype=np.float64)

    used = seen[starts]
    noise = _Noise(mean(t)[used], fixed['cells'])
    binned = mean(voltage)[used]

    def residuals(theta: FloatArray) -> FloatArray:
        return binned - mean(_model(theta, fixed).path(t, throttle, current))[used]

    def cost(theta: FloatArray) -> FloatArray:
        return np.concatenate((noise.whiten(residuals(theta))[0], (theta - centre) / deviation))

    start = centre if near is None else near._theta
    theta = np.clip(start, low + 1e-6, high - 1e-6)
    if near is not None:
        noise.white, noise.slow = near.noise_std ** 2, near.slow_std ** 2
    for _ in range(_ROUNDS if near is None else 1):
        found = least_squares(cost, theta, bounds=(low, high), x_scale=deviation,
                              max_nfev=_EVALUATIONS)
        theta = np.clip(found.x, low + 1e-6, high - 1e-6)
        noise.learn(residuals(theta))
    scaled = found.jac * deviation
    sizes = np.linalg.svd(scaled, compute_uv=False)
    covariance = np.linalg.inv(scaled.T @ scaled) * np.outer(deviation, deviation)
    return LoadFit(_model(theta, fixed), covariance, float(sizes[0] / sizes[-1]),
                   math.sqrt(noise.white), math.sqrt(noise.slow))
