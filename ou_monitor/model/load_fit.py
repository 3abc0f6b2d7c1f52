"""
The load model of a recording: the voltage, fitted to the regressors of the node's load filter.

The voltage is a level less a response to throttle or current, which is linear in the regressors of
`LoadFilter` or `CurrentFilter`.  The level is constant, or follows a lithium pack that the load
discharges.  The coefficients have the priors of the filters; the size of the response is fitted
too.

Limits: residuals are modelled as white noise and an OU with a time constant of 20 s and a few mV
rms; errors and evidence are those of a normal distribution about the maximum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import enum
import math

import numpy as np
from ou_monitor.model.innovations import Filter, StateSpace
from ou_monitor.model.load import (
    CELL, cells_in_series, charge_at, CURRENT_SHARE_STD, CURRENT_SHARES, INRUSH_TIME, LAG, LAGS,
    LINEAR_LAGS, lowpass, open_circuit, POWER, SAG, SAG_SD, usual_shares, WARMING, WARMING_SE)
from ou_monitor.records import FloatArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares

# Prior of a pack: charge at the first sample; ln of the time, s, in which the mean throttle or
# current empties it (wide for boats, planes and e-bikes; doc/load.md).
_CHARGE, _ENDURANCE, _BY_CURRENT = (0.7, 0.3), (math.log(450.0), 0.6), (math.log(2000.0), 1.0)
_FULLEST = 1.05  # Maximum charge at the first sample
# Prior deviations of a constant level, V per cell, and of ln size for a current, whose use is
# unknown.
_LEVEL_SD, _CURRENT_SD = 0.2, 2.0
_REACH = 4.0  # Bounds of the parameters, in prior deviations
# Mean load before the first sample, relative to the mean load (chosen on roma and cf_pair; 0.3 to
# 0.5 work).
BEFORE = 0.4
# Bins over which the data are averaged before a fit: width, s (slow error and polarisation are
# slower), maximum share of the recording, and maximum number.
_BIN, _BIN_SHARE, _MOST = 0.05, 0.01, 20_000
_LEAST = 20  # Minimum number of samples
# The slow error of the load model is an OU: its time constant, s, and the standard deviations
# tried, V per cell (the maximum was chosen on the recordings; hebi_x needs small ones).
SLOW_TIME = 20.0
_SLOW_STDS = np.geomspace(0.001, 0.00464, 5)
# Initial standard deviations of white and slow noise, V per cell, typical of the recordings.
_WHITE_START, _SLOW_START = 0.02, 0.01
# Scales tried for the heavy-tailed distribution of standardised innovations.
_SIZES = np.geomspace(0.05, 2.0, 40).tolist()
# Rounds of fitting parameters, then noise; maximum number of model evaluations in each; step of
# derivatives, in prior deviations.
_ROUNDS, _EVALUATIONS, _STEP = 4, 30, 1e-4
# Factor of the errors, because the model's form is never exact.  With 1.25, 4 of 60 simulated
# packs with two RC pairs had their lowest voltage outside its 95 % band; with 1, 7 of 40.
_FORM = 1.25


class LoadInput(enum.Enum):
    """Input to which the voltage responds."""

    NONE = 'none'
    THROTTLE = 'throttle'
    CURRENT = 'current'


@dataclass(frozen=True, eq=False)
class LoadFit:
    """A fitted load model, and its errors."""

    load: LoadInput
    falls: bool  # Whether the level falls as the load discharges a pack
    cells: int  # Cells in series
    full: float  # Throttle, or current, A, at a load of 1
    mean_load: float  # Mean of throttle^1.8 or of the absolute current / full
    # Constant level, V; or charge at the first sample, ln of the time, s, in which the mean load
    # empties a full pack, and warming (see WARMING), 1/V.  Then the coefficients, V.
    values: FloatArray
    errors: FloatArray  # Independent errors of the values, one per row
    slow_std: float = 0.0  # Standard deviation of the slow error (an OU of 20 s), V
    evidence: float = 0.0  # Log evidence for this load and this kind of level, nats

    def path(self, t: FloatArray, load: FloatArray | None) -> FloatArray:
        """Return the mean voltage, V, at stamps, s, from throttle, 0..1, or current, A."""
        return self.voltage(self.values, self.regressors(t, load))

    def draw(self, rng: np.random.Generator) -> LoadFit:
        """Draw a model from the normal distribution of the fitted values."""
        moved = rng.standard_normal(len(self.errors)) @ self.errors
        return replace(self, values=self.values + moved)

    def resized(self, factor: float) -> LoadFit:
        """Return a model whose response is larger by a factor."""
        return replace(self, values=np.concatenate((
            self.values[:self.levels], factor * self.values[self.levels:])))

    @property
    def levels(self) -> int:
        """Return the number of values that describe the level."""
        return 3 if self.falls else 1

    def regressors(self, t: FloatArray, load: FloatArray | None) -> FloatArray:
        """Return the charge drawn, in s at the mean load, and the regressors of the response."""
        if self.load is LoadInput.NONE:
            return np.zeros((1, t.size))
        if load is None:
            raise ValueError(f'the load of this model is {self.load.value}, and none was given')
        u = load / self.full
        if self.load is LoadInput.CURRENT:
            x, rows = u, [u, *(lowpass(u, t, tau) for tau in LAGS)]
        else:
            u = lowpass(u, t, LAG)
            x = u ** POWER
            slowest = lowpass(x, t, LAGS[-1], BEFORE * self.mean_load)
            rows = [x, u, u ** 3, *(lowpass(x, t, tau) for tau in LAGS[:-1]), slowest,
                    *(lowpass(u, t, tau) for tau in LINEAR_LAGS),
                    np.maximum(u - lowpass(u, t, INRUSH_TIME), 0.0)]
        return np.stack([np.cumsum(x * np.diff(t, prepend=t[0])) / self.mean_load, *rows])

    def voltage(self, values: FloatArray, rows: FloatArray) -> FloatArray:
        """Return the mean voltage, V, that these values give with `regressors`."""
        response = values[self.levels:] @ rows[1:]
        if not self.falls:
            return np.asarray(values[0] - response)
        charge, endurance, warming = values[:3].tolist()
        cell = open_circuit(np.maximum(charge - rows[0] / math.exp(endurance), -1.0))
        size = np.exp(warming * (cell - CELL))
        if self.load is LoadInput.THROTTLE:
            # A propeller draws less at a lower voltage: I ~ u (u V)^(p - 1).
            size *= (np.maximum(cell, 2.0) / CELL) ** (POWER - 1.0)
        return np.asarray(self.cells * cell - size * response)


class _Noise:
    """White noise plus a slow OU, to whiten the residuals of binned data."""

    def __init__(self, t: FloatArray, cells: int) -> None:
        self._keep = np.exp(-np.diff(t, prepend=t[0]) / SLOW_TIME)
        self._tried = (_SLOW_STDS * cells) ** 2
        self._set((_WHITE_START * cells) ** 2, (_SLOW_START * cells) ** 2)

    def _set(self, white: float, slow: float) -> None:
        self.slow = slow
        q = np.append(slow, slow * (1.0 - self._keep[1:] ** 2))
        self._filter = Filter(StateSpace(self._keep[:, None, None], q[:, None, None], np.ones(1),
                                         np.full(q.size, white)))

    def whiten(self, residuals: FloatArray) -> FloatArray:
        """Return standardised innovations."""
        return np.asarray(self._filter.innovations(residuals) / np.sqrt(self._filter.variance))

    def evidence(self, residuals: FloatArray) -> float:
        """Return the log-likelihood, nats, of innovations under Student's t (4 degrees)."""
        z = self.whiten(residuals)
        # With normal tails, a few short bursts of full throttle would dominate.
        return float(max(np.sum(-2.5 * np.log1p(0.25 * (z / size) ** 2)) + z.size * math.log(
            0.375 / size) for size in _SIZES) - 0.5 * np.log(self._filter.variance).sum())

    def learn(self, residuals: FloatArray) -> None:
        """Fit the variances of both noises to residuals of the model, V."""
        for _ in range(2):
            white = max(1e-18, float(np.mean(self._filter.innovations(residuals) ** 2)))
            scores = []
            for slow in self._tried:
                self._set(white, slow)
                z = self.whiten(residuals)
                scores.append(np.log(self._filter.variance).sum() + z @ z)
            self._set(white, float(self._tried[int(np.argmin(scores))]))


def _prior(load: LoadInput, falls: bool, volts: float, top: float, cells: int
           ) -> tuple[FloatArray, FloatArray]:
    """Return mean and root of covariance: level, ln of the size, shares of the coefficients."""
    level = [_CHARGE, _BY_CURRENT if load is LoadInput.CURRENT else _ENDURANCE,
             (WARMING, WARMING_SE)] if falls else [(top, _LEVEL_SD * cells)]
    if load is LoadInput.NONE:
        mean, deviation = np.array(level).T
        return mean, np.diag(deviation)
    size_sd, shares, root = SAG_SD, *usual_shares()
    if load is LoadInput.CURRENT:
        size_sd, shares, root = _CURRENT_SD, CURRENT_SHARES, np.diag(CURRENT_SHARE_STD)
    mean, deviation = np.array([*level, (math.log(SAG * volts), size_sd)]).T
    return np.append(mean, shares), block_diag(np.diag(deviation), root)


def fit_load(kind: LoadInput, t: FloatArray, voltage: FloatArray,
             load: FloatArray | None = None, *, falls: bool = False, left_out: slice = slice(0)
             ) -> LoadFit:
    """Fit the load model to finite samples, s, V, 0..1 or A (left_out: voltage not used)."""
    if t.size < _LEAST:
        raise ValueError(f'a fit of the load needs {_LEAST} samples, got {t.size}')
    if not (np.isfinite(voltage).all() and (np.diff(t) > 0.0).all()):
        raise ValueError('voltage must be finite, V, and stamps must rise, s')
    seen = np.ones(t.size, dtype=np.bool_)
    seen[left_out] = False
    duration = float(t[-1] - t[0])
    width = max(min(_BIN, _BIN_SHARE * duration), duration / _MOST)
    starts = np.flatnonzero(np.diff(np.floor((t - t[0]) / width + 1e-9), prepend=-1.0))

    def mean(x: FloatArray) -> FloatArray:
        """Return means over the bins used."""
        counts = np.diff(np.append(starts, t.size))
        return np.asarray((np.add.reduceat(x, starts, axis=-1) / counts)[..., seen[starts]])

    volts, top = np.quantile(voltage[seen], [0.99, 0.98]).tolist()
    cells = cells_in_series(volts)
    x, full = (np.ones(1) if load is None else load), 1.0
    if kind is LoadInput.CURRENT:
        full = max(float(np.quantile(np.abs(x), 0.99)), 1e-9)
        x = x / full
    elif kind is LoadInput.THROTTLE:
        x = x ** POWER
    centre, root = _prior(kind, falls, volts, top, cells)
    model = LoadFit(kind, falls, cells, full, max(1e-3, float(np.abs(x).mean())), centre, root)
    rows, binned = mean(model.regressors(t, load)), mean(voltage)
    noise, levels = _Noise(mean(t), cells), model.levels

    def values(z: FloatArray) -> FloatArray:
        """Return the values of the model at a point, in prior deviations from the centre."""
        theta = centre + root @ z
        return np.concatenate((theta[:levels], *(
            math.exp(size) * theta[levels + 1:] for size in theta[levels:levels + 1])))

    def residuals(z: FloatArray) -> FloatArray:
        return binned - model.voltage(values(z), rows)

    z = np.zeros(root.shape[1])
    low, high = np.full(z.size, -_REACH), np.full(z.size, _REACH)
    if falls:
        z[0], low[0], high[0] = (np.array([charge_at(top / cells), 0.0, _FULLEST])
                                 - _CHARGE[0]) / _CHARGE[1]
        z = np.clip(z, low + 1e-6, high - 1e-6)
    for _ in range(_ROUNDS):
        found = least_squares(lambda z: np.concatenate((noise.whiten(residuals(z)), z)), z,
                              bounds=(low, high), max_nfev=_EVALUATIONS)
        z = found.x
        noise.learn(residuals(z))
    moved = [(values(z + step) - values(z)) / _STEP for step in _STEP * np.eye(z.size)]
    information = found.jac.T @ found.jac
    return replace(
        model, values=values(z), errors=_FORM * np.linalg.solve(
            np.linalg.cholesky(information), np.array(moved)),
        slow_std=math.sqrt(noise.slow), evidence=noise.evidence(residuals(z)) - 0.5 * float(
            z @ z + np.linalg.slogdet(information)[1]))
