"""
The voltage of a battery under load, from throttle or current; start values for the next flight.

Limits: the form and its constants were chosen on nine recordings (doc/load.md).  All motors count
as alike.  Charge is computed from the load; from throttle alone, wind and payload cause errors.

v = N E(s0 - q) - S [x + f1 LP(x, t1) + f2 LP(x, t2)] - S K (ul - LP(ul, 20 ms))_+
x = ul^p (E/3.8)^(p-1) exp(-k h), ul = LP(u, lag), dq = x dt / (mean x T),
dh = (sag/V) dq - h dt / 120 s,
with u throttle, E(s) of `open_circuit`, h Ohmic heat, and LP(x, tau) a low-pass of order 1.

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
from ou_monitor.records import FloatArray, NAN

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
# Time constant with which a pack cools, s (60 and 120 fit the nine flights of
# doc/results/compare_flights.md equally well; nazgul and gecko were worse without cooling).
_COOLING = 120.0


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


@dataclass(frozen=True)
class LoadModel:
    """The parameters of the voltage under load."""

    cells: int  # Cells in series, N
    mean_load: float  # Mean of x over the recording, the load to which `endurance` refers
    charge: float = 0.7  # Charge at the first sample, s0, 0..1
    size: float = 0.12  # Immediate relative sag at full throttle, S/(3.8 N)
    power: float = 1.8  # Exponent p of current over throttle
    # Polarisation f1, relative to the sag, and its time constant t1, s.
    fast_share: float = 0.2
    fast_time: float = 1.0
    # Polarisation f2 and its time constant t2, s.
    slow_share: float = 0.3
    slow_time: float = 20.0
    inrush: float = 0.5  # Inrush at a step from rest to full throttle, K, relative to the sag
    lag: float = 0.01  # Lag of the sag behind throttle, s
    endurance: float = 350.0  # Time at the mean load that would empty a full pack, T, s
    before: float = 0.3  # Mean load before the first sample, relative to `mean_load`
    # Current at full load, A, negative if discharge currents are negative; 0: load is throttle.
    full_current: float = 0.0
    delay: float = 0.0  # Delay of the load behind the voltage, s
    # Decrease of ln(resistance) per unit of charge and relative sag; a pack without cooling (150
    # Wh/kg, 1 kJ/kg/K, -1.5 %/K) would have 8.
    heating: float = 2.0
    constant_level: float = NAN  # Constant level, V; NaN: a lithium pack that discharges

    def sag(self, throttle: npt.ArrayLike) -> FloatArray:
        """Return the steady sag, V, at a throttle of 0..1, of cold cells at 3.8 V."""
        if self.full_current:
            raise ValueError('the load of this model is a current, not throttle')
        x = np.asarray(throttle, dtype=np.float64) ** self.power
        return np.asarray(
            self.size * CELL * self.cells * (1.0 + self.fast_share + self.slow_share) * x)

    def path(self, t: FloatArray, throttle: FloatArray | None,
             current: FloatArray | None = None) -> FloatArray:
        """Return the mean voltage, V, at stamps, s, from throttle, 0..1, or current, A."""
        read = current if self.full_current else throttle
        if read is None:
            what = 'a current, A,' if self.full_current else 'throttle'
            raise ValueError(f'the load of this model is {what} and none was given')
        if not (np.isfinite(read).all() and (self.full_current or (
                (read >= 0.0) & (read <= 1.0)).all())):
            raise ValueError('throttle must lie within 0..1, and current be finite, A')
        dt = np.diff(t, prepend=t[0])
        full = self.mean_load * self.endurance
        lagged = lowpass(np.interp(t + self.delay, t, read), t, self.lag)
        x = lagged / (self.full_current or 1.0)
        if not self.full_current:
            # A propeller draws less at a lower voltage: I ~ u (u V)^(p - 1).
            x = lagged ** self.power
            if math.isnan(self.constant_level):
                level = open_circuit(np.clip(self.charge - np.cumsum(x * dt) / full, 0.0, 1.0))
                x = x * (level / CELL) ** (self.power - 1.0)
        rest: FloatArray | float = self.constant_level
        if math.isnan(self.constant_level):
            # Ohmic heat warms the pack, which lowers its resistance.
            total = self.size * (1.0 + self.fast_share + self.slow_share)
            x = x * np.exp(-self.heating * total * _COOLING / full * lowpass(
                x * x, t, _COOLING, 0.0))
            rest = self.cells * open_circuit(np.maximum(
                self.charge - np.cumsum(x * dt) / full, -1.0))
        response = x + self.fast_share * lowpass(x, t, self.fast_time)
        response += self.slow_share * lowpass(x, t, self.slow_time, self.before * self.mean_load)
        if not self.full_current:
            response += self.inrush * np.maximum(lagged - lowpass(lagged, t, INRUSH_TIME), 0.0)
        return np.asarray(rest - self.size * CELL * self.cells * response, dtype=np.float64)


# Time constants of the response in flight, s: motors (0.06), sensors and converters (0.35),
# polarisation (2 and 15, rounded medians of `load_fit`).  They are a factor of 6 to 8 apart, so
# that sums of their responses approximate any time constant up to 10 s.
LAGS = (0.06, 0.35, 2.0, 15.0)
# Those of LAGS after which the response has a part linear in throttle too, s.
LINEAR_LAGS = (0.35, 2.0)
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


def usual_coefficients() -> tuple[FloatArray, FloatArray, float]:
    """Return prior mean and covariance of the coefficients, and mean sag, each per volt."""
    # The coefficients are S b, with a log-normal S of median 0.12.  Priors of the parts of b:
    # - x after 60 ms: beta(0.5, 1); x after 0.35 s: normal(0.05, 0.1);
    # - u and u^3: normal(0, 0.2); u after a lag: normal(0, 0.1); the others: log-normal;
    # - x: 1, less the parts of x after 60 ms and 0.35 s, less 0.7 times the parts of u and u^3.
    # The coefficient of x after a lag includes -0.7 times the part of u after that lag.
    # The deviations were chosen among six sets (0.1 to 0.3 for 0.35 s, 0.07 to 0.2 for u after a
    # lag) on twelve recorded flights, where prediction errors one second ahead differ by < 1 %.
    def lognormal(median: float, deviation: float) -> tuple[float, float]:
        mean = median * math.exp(0.5 * deviation ** 2)
        return mean, mean ** 2 * math.expm1(deviation ** 2)

    size, size_var = lognormal(0.12, 0.6)
    parts = [(0.0, 0.2 ** 2), (0.0, 0.2 ** 2), (1.0 / 3.0, 4.0 / 45.0), (0.05, 0.1 ** 2),
             lognormal(0.2, 0.5), lognormal(0.3, 0.5), *[(0.0, 0.1 ** 2)] * len(LINEAR_LAGS),
             lognormal(1.5, 1.0)]
    means, variances = np.array(parts).T
    mix = np.eye(SIZE)[:, 1:]
    mix[0, :4] = -0.7, -0.7, -1.0, -1.0
    for k, tau in enumerate(LINEAR_LAGS):
        mix[3 + LAGS.index(tau), 2 + len(LAGS) + k] = -0.7
    mean = mix @ means
    mean[0] += 1.0
    square = np.outer(mean, mean)
    cov = (size ** 2 + size_var) * (mix @ np.diag(variances) @ mix.T + square) - size**2 * square
    return size * mean, cov, size
