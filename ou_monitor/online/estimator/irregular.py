"""
The fit for windows whose stamps are not evenly spaced.

Exact likelihood at the stamps as they are (model/exact_fit.py); dearer than
the sums over lags, so only for windows that need it: irregular sources, and
windows with many holes.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.model import arma
from ou_monitor.model.exact_fit import ExactFit, fit_exact
from ou_monitor.online.estimator.fit import Fitted, independent, Outcome, TREND_SCORE
from ou_monitor.online.estimator.series import FAST, SLOW, T, U, Y
from ou_monitor.records import FloatArray

# Samples up to which the exact likelihood is used (some 50 ms).
MOST = 4096


def fit_irregular(columns: FloatArray, moves: bool) -> Fitted:
    """Fit the OU, the noise and the mean at the stamps as they are."""
    t, y = columns[T] - columns[T, 0], columns[Y]
    load = np.empty((0, t.size))
    if moves:
        u, fast, slow = columns[[U, FAST, SLOW]]
        load = np.stack([u, u * u, fast, slow])
    time = t / t[-1] - 0.5
    fit, basis, level = _fit(t, y, load)
    trend = False
    with_time, wide, wide_level = _fit(t, y, np.concatenate([load, [time]]))
    slope = float((wide @ with_time.beta[1:])[-1])
    spread = float((wide @ with_time.beta_cov[1:, 1:] @ wide.T)[-1, -1])
    if slope * slope > TREND_SCORE ** 2 * spread:
        fit, basis, level, trend = with_time, wide, wide_level, True
    beta = basis @ fit.beta[1:]
    cov = basis @ fit.beta_cov[1:, 1:] @ basis.T
    means = np.concatenate(([fit.beta[0]], level))
    variance = fit.sigma ** 2 / (2.0 * fit.alpha) + fit.noise_var
    outcome = {-1: Outcome.UNBOUND, 0: Outcome.FOUND, 1: Outcome.UNCORRELATED}[fit.edge]
    step = float(t[-1]) / (t.size - 1)
    a = fit.alpha * step
    share = fit.noise_var / (fit.sigma ** 2 * step) if fit.sigma > 0.0 else math.inf
    theta = arma.theta_at(a, 1, share)
    return Fitted(outcome, fit.alpha, fit.sigma, fit.noise_var, math.inf if share else 0.0,
                  arma.log_covariance(a, theta, 1, t.size), variance, means, beta, cov, trend,
                  t.size, a)


def _fit(t: FloatArray, y: FloatArray, load: FloatArray
         ) -> tuple[ExactFit, FloatArray, FloatArray]:
    """Fit with independent combinations of the load, centred."""
    mean = load.mean(axis=1)
    centred = load - mean[:, None]
    basis = independent(centred @ centred.T / t.size)
    regressors = np.column_stack([np.ones(t.size), centred.T @ basis])
    return fit_exact(t, y, regressors), basis, mean
