"""
Exact Gaussian likelihood of an OU seen without measurement noise.

Stamps may be irregular.  For each alpha the level, the regressors and the
variance have closed forms, so the search is over ln(alpha) alone.  Restricted
(REML) likelihood: half of the small-sample bias of alpha comes from the
unknown mean, and this form does not have it (Tang & Chen, J. Econometrics 149
(2009) 65; Yu, J. Econometrics 169 (2012) 114).
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.records import FloatArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar


@dataclass(frozen=True)
class ExactFit:
    """
    Result of `fit_exact`.

    Attributes
    ----------
    alpha : float
        Relaxation rate, 1/s, as maximised (no bias correction).
    var_inf : float
        Stationary variance, V^2.
    beta, beta_cov : ndarray
        Coefficients of the regressors (V per unit of each) and covariance.
    at_low, at_high : bool
        Whether alpha ran into the end of the search: no restoring force
        visible, or no correlation visible.

    """

    alpha: float
    var_inf: float
    beta: FloatArray
    beta_cov: FloatArray
    at_low: bool
    at_high: bool


def _whiten(columns: FloatArray, dt: FloatArray, alpha: float) -> tuple[FloatArray, float]:
    """Return columns made white by the OU of rate alpha, and log-determinant."""
    phi = np.exp(-alpha * dt)
    scale = -np.expm1(-2.0 * alpha * dt)
    out = np.empty_like(columns)
    out[0] = columns[0]
    out[1:] = (columns[1:] - phi[:, None] * columns[:-1]) / np.sqrt(scale)[:, None]
    return out, float(np.log(scale).sum())


def fit_exact(t: FloatArray, y: FloatArray, regressors: FloatArray) -> ExactFit:
    """
    Fit alpha, Var_inf and the mean by restricted maximum likelihood.

    Parameters
    ----------
    t : ndarray, shape (n,)
        Strictly increasing stamps, s.
    y : ndarray, shape (n,)
        Voltage, V.
    regressors : ndarray, shape (n, p)
        Columns of the mean, of full rank, n > p + 1.

    Returns
    -------
    ExactFit
        The fit.

    """
    dt = np.diff(t)
    n, p = regressors.shape
    table = np.column_stack([regressors, y - y.mean()])

    def profile(log_alpha: float) -> tuple[float, float, FloatArray, FloatArray]:
        white, log_det = _whiten(table, dt, math.exp(log_alpha))
        x, z = white[:, :p], white[:, p]
        gram = x.T @ x
        factor = cho_factor(gram)
        beta = cho_solve(factor, x.T @ z)
        rss = float(((z - x @ beta) ** 2).sum())
        var = max(rss / (n - p), np.finfo(float).tiny)
        log_gram = 2.0 * float(np.log(np.diag(factor[0])).sum())
        value = 0.5 * ((n - p) * math.log(var) + log_det + log_gram)
        return value, var, beta, cho_solve(factor, np.eye(p)) * var

    # Slowest rate worth a name: one relaxation in ten windows; fastest: the
    # correlation of neighbours is below 1e-4.
    low = math.log(0.1 / (t[-1] - t[0]))
    high = math.log(9.2 / float(np.median(dt)))
    grid = np.linspace(low, high, 12)
    best = int(np.argmin([profile(a)[0] for a in grid]))
    left, right = grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]
    found = minimize_scalar(lambda a: profile(a)[0], bounds=(left, right), method='bounded',
                            options={'xatol': 1e-6})
    _, var, beta, cov = profile(float(found.x))
    beta = beta.copy()
    beta[0] += y.mean()
    return ExactFit(math.exp(float(found.x)), var, beta, cov,
                    at_low=found.x < low + 1e-3, at_high=found.x > high - 1e-3)
