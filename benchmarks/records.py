"""What travels in the benchmark: one fit, and the fits of many windows."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
import math

from data import Array
import numpy as np
import numpy.typing as npt

NAMES = ('alpha', 'sigma', 'var_inf')
# Two-sided 95 % point of the normal distribution.
Z95 = 1.959963984540054
_RESAMPLES = 400


@dataclass(frozen=True)
class Fit:
    """
    One fit.

    Attributes
    ----------
    alpha, sigma, var_inf : float
        1/s, V/sqrt(s), V^2; NaN when the method gave none.
    log_se : tuple of float
        Standard errors of the logarithms; NaN when the method gives none.
    status : str
        What the method says of it.

    """

    alpha: float
    sigma: float
    var_inf: float
    log_se: tuple[float, ...] = (math.nan, math.nan, math.nan)
    status: str = 'ok'

    @staticmethod
    def failed(status: str) -> Fit:
        """Return a fit without numbers."""
        return Fit(math.nan, math.nan, math.nan, status=status)


@dataclass
class Fits:
    """
    Fits of one method to many windows.

    Attributes
    ----------
    fits : list of Fit
        One per window, in order.
    seconds : list of float
        CPU time of each.

    """

    fits: list[Fit] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def relative(self, truth: dict[str, float]) -> Array:
        """Return relative errors, shape (windows, 3)."""
        values = np.array([[f.alpha, f.sigma, f.var_inf] for f in self.fits])
        return np.asarray(values / np.array([truth[name] for name in NAMES]) - 1.0)

    def summary(self, truth: dict[str, float], only: npt.NDArray[np.bool_] | None = None
                ) -> dict[str, object]:
        """
        Return bias, its Monte Carlo error, RMSE, coverage, time and outcomes.

        Parameters
        ----------
        truth : dict
            True parameters.
        only : ndarray of bool, optional
            Windows to count; default all with numbers.

        Returns
        -------
        dict
            Percentages; NaN where there is nothing to tell.

        """
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
    """
    Return the ratio of two root mean squares and its bootstrap error.

    Parameters
    ----------
    one, other : ndarray, shape (n,)
        Errors; NaN is left out.
    paired : bool
        Whether they are of the same windows, and are to be resampled together.

    Returns
    -------
    ratio, error : float
        Dimensionless.

    """
    both = np.isfinite(one) & np.isfinite(other)
    a, b = one[both] ** 2, other[both] ** 2
    if a.size < 2:
        return math.nan, math.nan
    rng = np.random.default_rng(1)
    pick = rng.integers(0, a.size, (_RESAMPLES, a.size))
    again = pick if paired else rng.integers(0, a.size, (_RESAMPLES, a.size))
    spread = np.sqrt(a[pick].mean(axis=1) / b[again].mean(axis=1))
    return math.sqrt(float(a.mean() / b.mean())), float(spread.std())
