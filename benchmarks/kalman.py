"""
The reference: exact likelihood of an OU in white noise with unknown level.

Restricted likelihood by the Kalman filter, written from the state-space form
and sharing nothing with the package.  The level is integrated out (its flat
prior gives the term in `by_level`), the scale is profiled out, and the noise
variance is bounded at 0: the bound is searched by itself, and the interior from
several starts, so the global maximum is found.
"""

from __future__ import annotations

from collections.abc import Callable
import importlib.util
import math
from typing import Any

from data import Array
import numpy as np
from records import Fit
from scipy.optimize import minimize, minimize_scalar

_LOW, _HIGH = math.log(1e-5), math.log(8.0)
# Noise variances, in units of sigma^2 dt, from which the search starts.
_STARTS = (0.02, 0.2, 2.0)
_LEAST_NOISE, _MOST_NOISE = math.log(1e-6), math.log(1e4)


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    if importlib.util.find_spec('numba') is None:
        return function
    import numba
    compiled: Callable[..., Any] = numba.njit(function)
    return compiled


@_compiled
def _filtered(y: Array, a: float, noise: float) -> tuple[float, float, float]:
    """Return quadratic form, log-determinant, and information on the level."""
    phi = math.exp(-a)
    stationary = 0.5 / a
    drive = -stationary * math.expm1(-2.0 * a)
    variance = stationary
    state = 0.0
    unit = 0.0
    by_data = 0.0
    crossed = 0.0
    by_level = 0.0
    log_det = 0.0
    for value in y:
        total = variance + noise
        gain = variance / total
        error = value - state
        left = 1.0 - unit
        by_data += error * error / total
        crossed += error * left / total
        by_level += left * left / total
        log_det += math.log(total)
        state = phi * (state + gain * error)
        unit = phi * (unit + gain * left)
        variance = phi * phi * variance * (1.0 - gain) + drive
    return by_data - crossed * crossed / by_level, log_det, by_level


def _deviance(y: Array, log_a: float, noise: float) -> float:
    """Return minus twice the restricted log-likelihood with the scale profiled out."""
    form, log_det, by_level = _filtered(y, math.exp(log_a), noise)
    return float((y.size - 1) * math.log(form) + log_det + math.log(by_level))


def _log_errors(y: Array, log_a: float, log_scale: float, noise: float) -> Array:
    """
    Return standard errors of ln(alpha), ln(sigma), ln(Var_inf).

    Observed information by central differences.  The noise variance counts as
    unknown on its bound too, where that is on the careful side.
    """
    def value(p: Array) -> float:
        form, log_det, by_level = _filtered(y, math.exp(p[0]), p[2])
        return float(0.5 * ((y.size - 1) * p[1] + form * math.exp(-p[1]) + log_det
                            + math.log(by_level)))

    at = np.array([log_a, log_scale, noise])
    steps = np.array([1e-2, 1e-3, 3e-3 * max(noise, 0.1)])
    hessian = np.empty((3, 3))
    for i in range(3):
        for j in range(i + 1):
            one, other = np.eye(3)[i] * steps, np.eye(3)[j] * steps
            hessian[i, j] = hessian[j, i] = (
                value(at + one + other) - value(at + one - other) - value(at - one + other)
                + value(at - one - other)) / (4.0 * steps[i] * steps[j])
    try:
        covariance = np.linalg.inv(hessian)
    except np.linalg.LinAlgError:
        return np.full(3, np.nan)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.0], [-1.0, 1.0, 0.0]])
    variances = (turn @ covariance @ turn.T).diagonal()
    return np.sqrt(np.where(variances > 0.0, variances, np.nan))


def fit(y: Array, dt: float) -> Fit:
    """
    Return the restricted maximum-likelihood fit.

    Parameters
    ----------
    y : ndarray, shape (n,)
        Voltage, V.
    dt : float
        Step, s.

    Returns
    -------
    Fit
        Not corrected for the length of the window, see `corrected`.

    """
    centred = y - y.mean()

    edge = minimize_scalar(lambda x: _deviance(centred, x, 0.0), bounds=(_LOW, _HIGH),
                           method='bounded', options={'xatol': 1e-7})
    best, log_a, noise = float(edge.fun), float(edge.x), 0.0
    for start in _STARTS:
        # With noise the slope of the variogram at the edge is too steep.
        begin = np.array([max(log_a - 0.5 * math.log1p(start), _LOW + 1.0), math.log(start)])
        found = minimize(
            lambda p: _deviance(centred, p[0], math.exp(p[1])), begin, method='Nelder-Mead',
            bounds=((_LOW, _HIGH), (_LEAST_NOISE, _MOST_NOISE)),
            options={'xatol': 1e-5, 'fatol': 1e-8})
        if found.fun < best - 1e-9:
            best, log_a, noise = float(found.fun), float(found.x[0]), math.exp(found.x[1])
    form = _filtered(centred, math.exp(log_a), noise)[0]
    scale = form / (y.size - 1)
    alpha = math.exp(log_a) / dt
    sigma2 = scale / dt
    return Fit(alpha, math.sqrt(sigma2), sigma2 / (2.0 * alpha),
               tuple(_log_errors(centred, log_a, math.log(scale), noise).tolist()),
               'edge' if log_a < _LOW + 0.1 else 'ok')


def corrected(plain: Fit, duration: float) -> Fit:
    """
    Return a fit less its small-sample bias.

    2/T of alpha remain in a restricted likelihood (Tang & Chen 2009, less the
    half that comes from the level); Var_inf, convex in alpha, is taken at
    alpha - 1/T.
    """
    alpha = plain.alpha - 2.0 / duration
    if alpha <= 0.0:
        return Fit.failed('edge')
    var_inf = plain.sigma ** 2 / (2.0 * (plain.alpha - 1.0 / duration))
    return Fit(alpha, plain.sigma, var_inf, plain.log_se, plain.status)
