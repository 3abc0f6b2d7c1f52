"""
The load model of a recording: a maximum a posteriori fit.

Limits: the priors are narrow, to bound parameters that the recording does not determine.  If a
fitted parameter is three prior standard deviations from its centre, the model's form is wrong.
Residuals are modelled as white noise and an OU with a time constant of 20 s and a few mV rms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import cells_in_series, charge_at, LoadModel, lowpass
from ou_monitor.model.ou import first_order
from ou_monitor.records import FloatArray, NAN
from scipy.optimize import least_squares

# Prior centre and standard deviation of each parameter (of its logarithm unless in _LINEAR): usual
# figures of lithium-polymer packs with two RC pairs, narrowed on the recordings; lag and endurance
# were widened again on simulated boats, planes and e-bikes (doc/load.md).
_PRIOR = {
    'size': (math.log(0.12), 0.7), 'power': (math.log(1.8), 0.1),
    'fast_share': (math.log(0.2), 0.3), 'fast_time': (math.log(1.0), 0.7),
    'slow_share': (math.log(0.3), 0.3), 'slow_time': (math.log(20.0), 0.3),
    'inrush': (math.log(0.5), 1.0), 'lag': (math.log(0.01), 1.2),
    'endurance': (math.log(450.0), 0.6), 'charge': (0.7, 0.3), 'before': (0.3, 0.4),
    'heating': (2.0, 1.0),
}
_NAMES = tuple(_PRIOR)
_LINEAR = {'charge': (0.0, 1.05), 'before': (0.0, 1.5), 'heating': (0.0, 8.0)}
# Prior deviations and centres for a current, whose scale and use are unknown.
_OF_CURRENT = {'size': 2.0, 'fast_share': 0.7, 'slow_share': 0.7, 'endurance': 1.0}
_CENTRE = {'endurance': math.log(2000.0)}
# Prior deviation of a constant level, V per cell (it replaces the charge).
_LEVEL_SD = 0.2
# Search for the delay of the load: number of shifts tried to each side, and maximum delay, s.
_SHIFTS, _LATEST = 10, 0.2
_PAYS = 0.95  # Ratio to which a delay must reduce the squared residuals
_SLOWER = 1.0  # Time constant of the high-pass that removes trends, s
_LATE = 0.06  # Time constant of the low-pass for the second regressor, s
# Bounds of the parameters, in prior deviations from the centre.
_REACH = 3.0
# Bins over which the data are averaged before a fit: width, s (slow error and polarisation are
# slower), and maximum share of the recording.
_BIN, _BIN_SHARE = 0.05, 0.01
_LEAST = 20  # Minimum number of samples
# The slow error of the load model is an OU: its time constant, s, and the standard deviations
# tried, V per cell (the maximum was chosen on the recordings).
SLOW_TIME = 20.0
_SLOW_STDS = np.geomspace(0.001, 0.00464, 5)
# Initial standard deviations of white and slow noise, V per cell, typical of the recordings.
_WHITE_START, _SLOW_START = 0.02, 0.01
# Scales tried for the heavy-tailed distribution of standardised innovations.
_SIZES = np.geomspace(0.05, 2.0, 40).tolist()
# Rounds of fitting parameters, then noise; maximum number of model evaluations in each.
_ROUNDS, _EVALUATIONS = 4, 30


@dataclass(frozen=True)
class LoadFit:
    """A fitted load model, and its errors."""

    model: LoadModel
    # Covariance of the parameters as fitted, logarithms unless in _LINEAR; shape (12, 12).
    covariance: FloatArray
    condition: float  # Condition number of the Jacobian in prior deviations
    noise_std: float  # White noise of a 50 ms mean, V
    slow_std: float  # Standard deviation of the slow error (an OU of 20 s), V
    evidence: float  # Log evidence (Laplace) for this load and this kind of level, nats

    def draw(self, rng: np.random.Generator) -> LoadModel:
        """Draw a model from the normal distribution of the fitted parameters, within bounds."""
        low, high, _, _ = _bounds(self.model)
        moved = rng.multivariate_normal(_theta(self.model), self.covariance)
        return _moved(self.model, np.clip(moved, low, high))


def _theta(model: LoadModel) -> FloatArray:
    """Return the parameters as fitted; a constant level, V per cell, replaces the charge."""
    return np.array([
        model.constant_level / model.cells
        if name == 'charge' and math.isfinite(model.constant_level)
        else getattr(model, name) if name in _LINEAR
        else math.log(getattr(model, name)) for name in _NAMES])


def _moved(model: LoadModel, theta: FloatArray) -> LoadModel:
    values: dict[str, Any] = {name: float(x) if name in _LINEAR else math.exp(x)
                              for name, x in zip(_NAMES, theta)}
    if math.isfinite(model.constant_level):
        values['constant_level'] = values.pop('charge') * model.cells
    return replace(model, **values)


def _bounds(model: LoadModel) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return lower and upper bounds, prior centre and deviation, for the model's kind of level."""
    wide = _OF_CURRENT if model.full_current else {}
    other = _CENTRE if model.full_current else {}
    centre = np.array([other.get(name, _PRIOR[name][0]) for name in _NAMES])
    deviation = np.array([wide.get(name, _PRIOR[name][1]) for name in _NAMES])
    level = _NAMES.index('charge')
    centre[level] = _theta(model)[level]
    constant_level = math.isfinite(model.constant_level)
    if constant_level:
        deviation[level] = _LEVEL_SD
    low, high = centre - _REACH * deviation, centre + _REACH * deviation
    for name, (least, most) in _LINEAR.items():
        if not (constant_level and name == 'charge'):
            low[_NAMES.index(name)], high[_NAMES.index(name)] = least, most
    return low, high, centre, deviation


def timing(t: FloatArray, v: FloatArray, load: FloatArray) -> tuple[float, float]:
    """Return the delay of a load, s, and 1 if voltage falls when the load rises, else -1."""
    # Shifts are counted in tenths of the sampling step.
    dt = float(np.median(np.diff(t)))
    unit = dt / _SHIFTS
    slow = min(_SLOWER, 0.3 * float(t[-1] - t[0]))
    left = v - lowpass(v, t, slow)
    late = lowpass(load, t, _LATE)
    loads = np.stack((load, late)) - lowpass(load, t, slow)

    def fit(order: int, *shifts: int) -> tuple[float, float]:
        """Return the squared residuals of `order`-th differences, and product load * voltage."""
        # X: the mean of the load over the shifts.
        X = np.diff(np.mean([[np.interp(t + shift * unit, t, row) for row in loads]
                             for shift in shifts], axis=0), order)
        y = np.diff(left, order)
        product = X @ y
        return float(y @ y - product @ np.linalg.lstsq(
            X @ X.T, product, rcond=1e-9)[0]), float(product[0])

    found: dict[int, tuple[float, float]] = {}
    coarse, best = max(1, math.ceil(_LATEST / dt / _SHIFTS)), 0
    for by in (coarse, math.ceil(coarse / _SHIFTS)):
        for k in range(-_SHIFTS, _SHIFTS + 1):
            shift = best + k * by * _SHIFTS
            if shift not in found and abs(shift) * unit <= _LATEST:
                found[shift] = fit(0, shift)
        best = min(sorted(found, key=abs), key=lambda shift: found[shift][0])
    # A best shift at the end of the range is not a minimum.
    inside = abs(best) < max(found)
    best = best if inside and found[best][0] < _PAYS * found[0][0] else 0
    # A delay wrong by half a sample leaves glitch-like errors at steep changes of the load.  But a
    # shift by part of a sample also smooths a noisy load.  So the shifted load must fit better
    # than its mean with the oppositely shifted load, which is equally smooth.
    fine = {k: fit(1, best + k)[0] for k in range(-_SHIFTS, _SHIFTS + 1)}
    k = min(sorted(fine, key=abs), key=lambda k: fine[k])
    pays = min(fine[0], fit(1, best + k, best - k)[0]) > fine[k] * t.size ** (1.0 / t.size)
    return (best + k * pays) * unit, -1.0 if found[best][1] > 0.0 else 1.0


class _Noise:
    """White noise plus a slow OU, to whiten the residuals of binned data."""

    def __init__(self, t: FloatArray, cells: int) -> None:
        self._keep = np.exp(-np.diff(t) / SLOW_TIME)
        self._tried = (_SLOW_STDS * cells) ** 2
        self.white = (_WHITE_START * cells) ** 2
        self.slow = (_SLOW_START * cells) ** 2
        # Results for the last two variances: a fit needs them hundreds of times.
        self._found: tuple[tuple[float, float], tuple[FloatArray, FloatArray, FloatArray]] | None
        self._found = None

    def whiten(self, residuals: FloatArray, slow: float | None = None,
               ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return standardised innovations, their variances, V^2, and the innovations, V."""
        variance, kept, passed = self._predictor(self.slow if slow is None else slow)
        innovations = residuals - first_order(
            kept, np.append(0.0, passed * residuals[:-1]), 0.0)
        return innovations / np.sqrt(variance), variance, innovations

    def _predictor(self, q: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return variances of innovations, V^2, and the coefficients of the recursion."""
        if self._found is None or self._found[0] != (self.white, q):
            values, p, white = [], q, self.white
            for a in self._keep.tolist():
                values.append(p + white)
                p = a * a * p * white / (p + white) + q * (1.0 - a * a)
            variance = np.array([*values, p + white])
            gain = 1.0 - white / variance
            kept = np.append(0.0, self._keep * (1.0 - gain[:-1]))
            self._found = (white, q), (variance, kept, self._keep * gain[:-1])
        return self._found[1]

    def evidence(self, residuals: FloatArray) -> float:
        """Return the log-likelihood, nats, of innovations under Student's t (4 degrees)."""
        z, variance, _ = self.whiten(residuals)
        # With normal tails, a few short bursts of full throttle would dominate.
        return float(max(np.sum(-2.5 * np.log1p(0.25 * (z / size) ** 2)) + z.size * math.log(
            0.375 / size) for size in _SIZES) - 0.5 * np.log(variance).sum())

    def learn(self, residuals: FloatArray) -> None:
        """Fit the variances of both noises to residuals of the model, V."""
        for _ in range(2):
            self.white = float(np.mean(self.whiten(residuals)[2] ** 2))
            scores = []
            for slow in self._tried:
                z, variance, _ = self.whiten(residuals, slow)
                scores.append(np.log(variance).sum() + z @ z)
            self.slow = float(self._tried[int(np.argmin(scores))])


def _template(t: FloatArray, voltage: FloatArray, throttle: FloatArray | None,
              current: FloatArray | None, constant_level: bool) -> LoadModel:
    """Return the parts of a model that are not fitted: cells, and the load's scale and delay."""
    load = throttle if current is None else current
    if load is None:
        raise ValueError('a fit of the load needs throttle or current')
    full = delay = 0.0
    if current is None:
        # The mean load only scales `endurance`, so 1.6 may differ from the fitted `power`.
        moving = load > 0.05
        mean = float((load[moving] ** 1.6).mean()) if moving.any() else 0.1
    else:
        delay, sign = timing(t, voltage, load)
        full = sign * max(float(np.quantile(np.abs(current), 0.99)), 1e-9)
        mean = max(1e-3, float(np.maximum(current / full, 0.0).mean()))
    return LoadModel(cells_in_series(float(np.quantile(voltage, 0.99))), mean, full_current=full,
                     delay=delay, constant_level=0.0 if constant_level else NAN)


def _bins(t: FloatArray) -> tuple[Callable[[FloatArray], FloatArray], npt.NDArray[np.intp]]:
    """Return a function that averages over bins, and the index of each bin's first sample."""
    width = min(_BIN, _BIN_SHARE * float(t[-1] - t[0]))
    index = np.floor((t - t[0]) / width + 1e-9).astype(int)
    starts = np.concatenate(([0], np.flatnonzero(np.diff(index)) + 1))
    counts = np.diff(np.append(starts, t.size))
    return lambda x: np.asarray(np.add.reduceat(x, starts) / counts, dtype=np.float64), starts


def level_evidence(t: FloatArray, voltage: FloatArray) -> float:
    """Return the log evidence, comparable to LoadFit.evidence, for a constant level alone."""
    mean, _ = _bins(t)
    cells = cells_in_series(float(np.quantile(voltage, 0.99)))
    noise, left = _Noise(mean(t), cells), mean(voltage - np.median(voltage))
    for _ in range(_ROUNDS):
        noise.learn(left)
        one = noise.whiten(np.ones(left.size))[0]
        left = left - float(one @ noise.whiten(left)[0]) / float(one @ one)
    # Laplace approximation for one parameter, at the centre of its prior.
    return noise.evidence(left) - 0.5 * math.log(float(one @ one) * (_LEVEL_SD * cells) ** 2)


def fit_load(t: FloatArray, voltage: FloatArray, throttle: FloatArray | None,
             current: FloatArray | None = None, *, constant_level: bool = False,
             left_out: tuple[float, float] | None = None, near: LoadFit | None = None) -> LoadFit:
    """Fit the load model to finite samples (s, V, 0..1), or with a current, A, as the load."""
    # The level is constant (`constant_level`) or follows a lithium pack.  Voltage between the
    # stamps left_out, s, is not used.  `near`, a similar fit (for example to all the voltage),
    # provides the starting point, and the cells, scale and delay, which are not fitted.
    if t.size < _LEAST:
        raise ValueError(f'a fit of the load needs {_LEAST} samples, got {t.size}')
    if not (np.isfinite(voltage).all() and (np.diff(t) > 0.0).all()):
        raise ValueError('voltage must be finite, V, and stamps must rise, s')
    seen = np.ones(t.size, dtype=np.bool_) if left_out is None else (
        (t < left_out[0]) | (t > left_out[1]))
    if not seen.any():
        raise ValueError('no voltage is left for the fit')
    model = near.model if near is not None else _template(
        t, voltage, throttle, current, constant_level)
    top = float(np.quantile(voltage[seen], 0.98))
    centred = (replace(model, constant_level=top) if math.isfinite(model.constant_level) else
               replace(model, charge=charge_at(top / model.cells)))
    low, high, centre, deviation = _bounds(centred)
    mean, starts = _bins(t)
    used = seen[starts]
    noise = _Noise(mean(t)[used], model.cells)
    binned = mean(voltage)[used]

    def residuals(theta: FloatArray) -> FloatArray:
        return binned - mean(_moved(model, theta).path(t, throttle, current))[used]

    def cost(theta: FloatArray) -> FloatArray:
        return np.concatenate((noise.whiten(residuals(theta))[0], (theta - centre) / deviation))

    start = centre if near is None else _theta(near.model)
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
    off = (theta - centre) / deviation
    evidence = noise.evidence(residuals(theta)) - 0.5 * float(off @ off) - float(
        np.log(sizes).sum())
    return LoadFit(_moved(model, theta), covariance, float(sizes[0] / sizes[-1]),
                   math.sqrt(noise.white), math.sqrt(noise.slow), evidence)
