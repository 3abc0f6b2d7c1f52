"""
The voltage of a battery under load: cells, regressors and priors; start values for a flight.

Limits: the form and its constants were chosen on recordings (doc/load.md).  All motors count as
alike.  Charge is computed from the load; from throttle alone, wind and payload cause errors.

The start values (`LoadStart`: the response to throttle, known at take-off) come from one craft and
one pack on one day; the filter widens their errors by the scatter between packs.  They set no
level for the next flight, because the pack's charge at take-off is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
import math
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

Number = TypeVar('Number', float, FloatArray)

# Cell voltage at which the size of the sag is defined, V: the plateau of a lithium-polymer cell.
CELL = 3.8
# A full cell has 4.20 V; 50 mV allow for the error of the sensor.
FULL_CELL = 4.25
# E(s) = a exp(-35 s) + b + c s + d s^2 + e s^3, the form of Chen & Rincon-Mora (2006), fitted
# to a common table for hobby cells (7.7 mV rms).
_KNEE_SIZE, _KNEE_RATE = -0.39705, 35.0
_CUBIC = (3.66631, 0.35371, -0.22145, 0.41052)
# Charge below which a straight line replaces the curve, and slope of the line, V: an error of a
# few per cent in charge must not put a prediction beyond the knee.  Slopes of 0.6 to 2.0 V work.
_KNEE, _KNEE_SLOPE = 0.079, 1.2
# Relative change of the response per volt of a cell's open-circuit voltage, 1/V, because a pack
# warms as it empties (the effect of the propellers is separate), and the scatter of this change
# between packs.  Measured between halves of a flight or successive flights: 0.6 (gecko), 1.3
# (nazgul), -0.1 +- 0.7 (hiro), 0.5 (roma); mean and prediction error by DerSimonian & Laird,
# Control. Clin. Trials 7 (1986) 177.
WARMING, WARMING_SE = 0.7, 0.33
# Time constant of the inrush, s: a motor's current settles in about 20 ms.
INRUSH_TIME = 0.02


def open_circuit(charge: npt.ArrayLike) -> FloatArray:
    """Return the open-circuit voltage of a cell, V, at a charge of 0..1."""
    s = np.asarray(charge, dtype=np.float64)
    above = np.maximum(s, _KNEE)
    curve = np.polynomial.polynomial.polyval(above, _CUBIC) + _KNEE_SIZE * np.exp(
        -_KNEE_RATE * above)
    return np.asarray(curve + _KNEE_SLOPE * np.minimum(s - _KNEE, 0.0), dtype=np.float64)


# The curve as a table, for its inverse and its slope.
CHARGES = np.linspace(-0.2, 1.1, 261)
LEVELS = open_circuit(CHARGES)
SLOPES = np.gradient(LEVELS, CHARGES)


def charge_at(cell: float) -> float:
    """Return the charge, 0..1, of a cell with an open-circuit voltage of `cell`, V."""
    return float(np.interp(cell, LEVELS, CHARGES))


def cells_in_series(voltage: float) -> int:
    """Return the smallest number of cells that can have a voltage, V."""
    return max(1, int(np.ceil(voltage / FULL_CELL)))


def ripple(throttle: Number) -> Number:
    """Return the ripple current of an ESC, relative to its maximum at a throttle of 0.7."""
    return throttle * (1.4 - throttle) / 0.49


def lowpass(x: FloatArray, t: FloatArray, tau: float, start: float | None = None) -> FloatArray:
    """Return x after a first-order low-pass of tau, s; exact for x held over each step."""
    # Imported here, because the nodes do not need it: SciPy takes 35 MB.
    from ou_monitor.model.ou import first_order
    keep = np.exp(-np.diff(t, prepend=t[0]) / tau)
    return first_order(keep, (1.0 - keep) * x, float(x[0]) if start is None else start)


# Time constants of the response in flight, s: motors (0.06), sensors and converters (0.35),
# polarisation (2 and 15, rounded medians of fits of two RC pairs).  They are a factor of 6 to 8
# apart, so that sums of their responses approximate any time constant up to 10 s.
LAGS = (0.06, 0.35, 2.0, 15.0)
# Those of LAGS after which the response has a part linear in throttle too, s.
LINEAR_LAGS = (0.35, 2.0)
# Exponent p of throttle in the load x; the level has the exponent p - 1.
POWER = 1.8
# Lag of the whole response to throttle, s: half of the response time of an ESC.
LAG = 0.004
# Number of coefficients: of x = u^1.8, u, u^3, x after LAGS, u after LINEAR_LAGS, and inrush.
SIZE = 4 + len(LAGS) + len(LINEAR_LAGS)
# Number of fields at the end of LoadStart that a model file may omit.
_OPTIONAL = 9
_COLUMNS = ('coefficients', 'covariance', 'log_variance', 'flown')


@dataclass(frozen=True)
class LoadStart:
    """The response to throttle, as learned by `LoadFilter`."""

    cells: float  # Cells in series.
    volts: float  # Open-circuit voltage when the response was learned, V.
    # Voltage drop at full throttle, V, due to each of x, u, u^3, x after LAGS, u after
    # LINEAR_LAGS, and inrush.
    coefficients: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]  # Of the coefficients, V^2.
    discharge: float  # Charge drawn per time at full load, 1/s.
    # ln of the variance, V^2, of white noise: constant, and coefficients of ripple and sqrt|du|.
    log_variance: tuple[float, float, float]
    flown: tuple[float, float]  # 10 % and 90 % quantile of throttle; 2 % and 98 % if those agree.
    delay: float = 0.0  # Delay of the recorded throttle behind the voltage, s.
    resistance: float = 0.0  # Ohm; 0: no measured current affects the voltage.
    resistance_se: float = 0.0  # Its standard error, Ohm.
    # Noise of a sample at steady throttle, midway between `flown`, V, and its error; 0: unknown.
    noise: float = 0.0
    noise_se: float = 0.0
    size_se: float = 0.0  # Relative standard error of the size of the response; 0: unknown.
    # Mean open-circuit voltage of a cell while the size was measured, V; 0: unknown.
    level: float = 0.0
    # Relative change of the size per volt of that level, 1/V, and its standard error.
    warming: float = WARMING
    warming_se: float = WARMING_SE

    def __post_init__(self) -> None:
        P = np.array(self.covariance, dtype=np.float64)
        if len(self.coefficients) != SIZE or P.shape != (SIZE, SIZE):
            raise ValueError(f'the load needs {SIZE} coefficients and {SIZE} rows of {SIZE} '
                             'covariances')
        if len(self.log_variance) != 3 or len(self.flown) != 2:
            raise ValueError('the load needs 3 numbers of log_variance and 2 of flown')
        positive = (self.discharge, self.resistance, self.resistance_se, self.noise,
                    self.noise_se, self.size_se, self.level, self.warming_se)
        numbers = (*self.coefficients, *P.ravel().tolist(), *self.log_variance, *self.flown,
                   self.cells, self.volts, self.delay, self.warming, *positive)
        if not all(map(math.isfinite, numbers)):
            raise ValueError('the numbers of the load must be finite')
        if not np.allclose(P, P.T, rtol=1e-6, atol=1e-9 * float(np.abs(P.diagonal()).max())):
            raise ValueError('the covariance of the load must be symmetric')
        if np.linalg.eigvalsh(P)[0] < -1e-9 * float(P.diagonal().max()):
            raise ValueError('the covariance of the load must have no negative eigenvalue')
        if not (self.cells > 0.0 and self.volts > 0.0 and min(positive) >= 0.0
                and 0.0 <= self.flown[0] <= self.flown[1] <= 1.0 and 0.0 <= self.delay <= 1.0):
            raise ValueError('the load needs cells and volts above 0, discharge, resistance '
                             'and noise of at least 0, flown and delay (s) within 0..1')

    def values(self) -> dict[str, Any]:
        """Return the entries of a model file."""
        return {f.name: [list(row) if isinstance(row, tuple) else row
                         for row in getattr(self, f.name)]
                if f.name in _COLUMNS else getattr(self, f.name) for f in fields(self)}

    @classmethod
    def read(cls, values: dict[str, Any]) -> LoadStart:
        """Return the start values in a model file."""
        names = [f.name for f in fields(cls)]
        for name in values:
            if name not in names:
                raise ValueError(f"the load has no entry '{name}', only {', '.join(names)}")
        missing = [name for name in names[:-_OPTIONAL] if name not in values]
        if missing:
            raise ValueError(f"the load lacks '{missing[0]}'")
        try:
            return cls(**{name: _numbers(value) for name, value in values.items()})
        except TypeError as error:
            raise ValueError(f'the load must hold numbers and lists of them: {error}') from error


def _numbers(value: Any) -> Any:
    """Return a list as a tuple of float, and a number as float."""
    if isinstance(value, (list, tuple)):
        return tuple(_numbers(one) for one in value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f'{value!r} is not a number')
    return float(value)


# Response to a current: its shares at once and after each of LAGS, and their prior deviations.
CURRENT_SHARES = np.array([1.0, 0.1, 0.05, 0.2, 0.3])
CURRENT_SHARE_STD = np.array([0.3, 0.3, 0.1, 0.1, 0.15])
# Sag at full throttle, relative to the voltage: median, and deviation of its logarithm.
SAG, SAG_SD = 0.12, 0.6


def usual_shares() -> tuple[FloatArray, FloatArray]:
    """Return the coefficients' shares of the sag: prior mean, and a root of their covariance."""
    # - x after 60 ms: beta(0.5, 1); x after 0.35 s: normal(0.05, 0.1);
    # - u and u^3: normal(0, 0.2); u after a lag: normal(0, 0.1); the others: log-normal;
    # - x: 1, less the parts of x after 60 ms and 0.35 s, less 0.7 times the parts of u and u^3.
    # The coefficient of x after a lag includes -0.7 times the part of u after that lag.
    # The deviations were chosen among six sets (0.1 to 0.3 for 0.35 s, 0.07 to 0.2 for u after a
    # lag) on twelve recorded flights, where prediction errors one second ahead differ by < 1 %.
    parts = [(0.0, 0.2 ** 2), (0.0, 0.2 ** 2), (1.0 / 3.0, 4.0 / 45.0), (0.05, 0.1 ** 2),
             _lognormal(0.2, 0.5), _lognormal(0.3, 0.5), *[(0.0, 0.1 ** 2)] * len(LINEAR_LAGS),
             _lognormal(1.5, 1.0)]
    means, variances = np.array(parts).T
    mix = np.eye(SIZE)[:, 1:]
    mix[0, :4] = -0.7, -0.7, -1.0, -1.0
    for k, tau in enumerate(LINEAR_LAGS):
        mix[3 + LAGS.index(tau), 2 + len(LAGS) + k] = -0.7
    mean = mix @ means
    mean[0] += 1.0
    return mean, mix * np.sqrt(variances)


def _lognormal(median: float, deviation: float) -> tuple[float, float]:
    """Return mean and variance."""
    mean = median * math.exp(0.5 * deviation ** 2)
    return mean, mean ** 2 * math.expm1(deviation ** 2)


def usual_coefficients() -> tuple[FloatArray, FloatArray, float]:
    """Return prior mean and covariance of the coefficients, and mean sag, each per volt."""
    (size, size_var), (mean, root) = _lognormal(SAG, SAG_SD), usual_shares()
    square = np.outer(mean, mean)
    return size * mean, (size ** 2 + size_var) * (root @ root.T + square) - size**2 * square, size
