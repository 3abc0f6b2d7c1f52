"""
What a flight knows of the next one: the answer to throttle at take-off.

Limits first: it is that of one craft and one pack on one day; who takes it doubts it by what
packs differ.  The level is not in it: a pack comes charged or not.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
import math
from typing import Any

import numpy as np
from ou_monitor.records import FloatArray

# Coefficients of x, u, u^3, x after three lags, and inrush, with x = u^1.8 (load/load_filter.py).
SIZE = 7
_COLUMNS = ('coefficients', 'covariance', 'log_variance', 'flown')


@dataclass(frozen=True)
class LoadStart:
    """
    The answer to throttle, as `LoadFilter` learned it.

    Attributes
    ----------
    cells : float
        Cells in series.
    volts : float
        Open-circuit voltage when it was learned, V.
    coefficients : tuple of 7 float
        Fall of the voltage at full throttle by x, u, u^3, x after 0.06, 2 and 15 s, and inrush, V.
    covariance : tuple of 7 tuples of 7 float
        Of the coefficients, V^2.
    discharge : float
        Charge drawn per time at full load, 1/s.
    log_variance : tuple of 3 float
        ln of the variance, V^2, of white noise: constant, ripple, and by sqrt|du|.
    flown : tuple of 2 float
        Throttles between which 80 % were flown.
    delay : float
        How late throttle was heard, s.

    Raises
    ------
    ValueError
        When a number is not finite, or the covariance is none.

    """

    cells: float
    volts: float
    coefficients: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    discharge: float
    log_variance: tuple[float, float, float]
    flown: tuple[float, float]
    delay: float = 0.0

    def __post_init__(self) -> None:
        """Check shapes and signs."""
        P = np.array(self.covariance, dtype=np.float64)
        if len(self.coefficients) != SIZE or P.shape != (SIZE, SIZE):
            raise ValueError(f'the load needs {SIZE} coefficients and {SIZE} rows of {SIZE} '
                             'covariances')
        if len(self.log_variance) != 3 or len(self.flown) != 2:
            raise ValueError('the load needs 3 numbers of log_variance and 2 of flown')
        numbers = (*self.coefficients, *P.ravel().tolist(), *self.log_variance, *self.flown,
                   self.cells, self.volts, self.discharge, self.delay)
        if not all(map(math.isfinite, numbers)):
            raise ValueError('the numbers of the load must be finite')
        if not np.allclose(P, P.T, rtol=1e-6, atol=1e-9 * float(np.abs(P.diagonal()).max())):
            raise ValueError('the covariance of the load must be symmetric')
        if np.linalg.eigvalsh(P)[0] < -1e-9 * float(P.diagonal().max()):
            raise ValueError('the covariance of the load must not be negative')
        if not (self.cells > 0.0 and self.volts > 0.0 and self.discharge >= 0.0
                and 0.0 <= self.flown[0] <= self.flown[1] <= 1.0 and 0.0 <= self.delay <= 1.0):
            raise ValueError('the load needs cells and volts above 0, discharge from 0 on, flown '
                             'within 0..1, and delay within 0..1 s')

    def values(self) -> dict[str, Any]:
        """Return the entries of a model file."""
        return {f.name: [list(row) if isinstance(row, tuple) else row
                         for row in getattr(self, f.name)]
                if f.name in _COLUMNS else getattr(self, f.name) for f in fields(self)}

    @classmethod
    def read(cls, values: dict[str, Any]) -> LoadStart:
        """Return what the entries of a model file say."""
        names = [f.name for f in fields(cls)]
        for name in values:
            if name not in names:
                raise ValueError(f"the load has no entry '{name}': {', '.join(names)}")
        missing = [name for name in names[:-1] if name not in values]
        if missing:
            raise ValueError(f"the load lacks '{missing[0]}'")
        try:
            return cls(**{name: _numbers(value) for name, value in values.items()})
        except TypeError as error:
            raise ValueError(f'the load must hold numbers and lists of them: {error}') from error


def _numbers(value: Any) -> Any:
    """Return lists as tuples of float; numbers as float."""
    if isinstance(value, (list, tuple)):
        return tuple(_numbers(one) for one in value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f'{value!r} is no number')
    return float(value)


def usual_coefficients() -> tuple[FloatArray, FloatArray, float]:
    """
    Return mean and covariance of the coefficients, and mean sag, per volt of pack: the prior.

    a = S b: S is log-normal about 0.12; of b, beta(0.5, 1) lags by 60 ms, two shapes are
    normal(0, 0.2) and take 0.7 of themselves from the first, and the rest is log-normal.
    """
    def lognormal(median: float, deviation: float) -> tuple[float, float]:
        mean = median * math.exp(0.5 * deviation ** 2)
        return mean, mean ** 2 * math.expm1(deviation ** 2)

    size, size_var = lognormal(0.12, 0.6)
    parts = [(0.0, 0.2 ** 2), (0.0, 0.2 ** 2), (1.0 / 3.0, 4.0 / 45.0),
             lognormal(0.2, 0.5), lognormal(0.3, 0.5), lognormal(1.5, 1.0)]
    means, variances = np.array(parts).T
    mix = np.vstack([(-0.7, -0.7, -1.0, 0.0, 0.0, 0.0), np.eye(6)])
    mean = mix @ means
    mean[0] += 1.0
    square = np.outer(mean, mean)
    cov = (size ** 2 + size_var) * (mix @ np.diag(variances) @ mix.T + square) - size**2 * square
    return size * mean, cov, size
