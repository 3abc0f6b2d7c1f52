"""
What the estimator is compared with: the exact likelihood, and what users would pick instead.

Restricted likelihood by the Kalman filter, written from the state-space form
and sharing nothing with the package.  The level is integrated out (its flat
prior gives the term in `by_level`), the scale is profiled out, and the noise
variance is bounded at 0: the bound is searched by itself, and the interior from
several starts, so the global maximum is found.

Standard errors are the method's own (its covariance, by the delta method to
the logarithms, so that all intervals have one form).  celerite2 gives a
likelihood and no errors: it gets a numerical Hessian, which is not timed.
statsmodels' state-space methods get standardised data, as a careful user would
give them: on volts their optimisers stop early.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import importlib.util
import math
from typing import Any
import warnings

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from windows import Array, Fit

Method = Callable[[Array, float], Fit]


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


def kalman_fit(y: Array, dt: float) -> Fit:
    """Return the restricted maximum-likelihood fit."""
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


def kalman_corrected(plain: Fit, duration: float) -> Fit:
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


def _delta(p: Array, covariance: Array, logs: Callable[[Array], Array], status: str = 'ok'
           ) -> Fit:
    """Return a fit from parameters, their covariance, and ln(alpha, sigma, Var_inf) of them."""
    with np.errstate(invalid='ignore', divide='ignore'):
        values = logs(p)
        jacobian = np.empty((3, p.size))
        for i in range(p.size):
            step = 1e-5 * max(abs(p[i]), 1e-8)
            up, down = p.copy(), p.copy()
            up[i] += step
            down[i] -= step
            jacobian[:, i] = (logs(up) - logs(down)) / (2.0 * step)
        variances = np.einsum('ij,jk,ik->i', jacobian, covariance, jacobian)
        errors = np.sqrt(np.where(variances > 0.0, variances, np.nan))
    if not np.isfinite(values).all():
        return Fit.failed('no relaxation')
    alpha, sigma, var_inf = np.exp(values).tolist()
    return Fit(alpha, sigma, var_inf, tuple(errors.tolist()), status)


def _scaled(fit: Fit, scale: float) -> Fit:
    """Return a fit of standardised data in volts."""
    return replace(fit, sigma=fit.sigma * scale, var_inf=fit.var_inf * scale ** 2)


def autoreg(y: Array, dt: float) -> Fit:
    """Return the fit of statsmodels AutoReg(1), carried to continuous time exactly."""
    from statsmodels.tsa.ar_model import AutoReg
    found = AutoReg(y, 1, trend='c').fit()
    phi, shock = float(found.params[1]), float(found.sigma2)
    covariance = np.diag([float(found.bse[1]) ** 2, 2.0 * shock ** 2 / y.size])

    def logs(p: Array) -> Array:
        log_phi = np.log(p[0])
        var_inf = p[1] / (1.0 - p[0] ** 2)
        return np.array([np.log(-log_phi / dt), 0.5 * np.log(-2.0 * log_phi / dt * var_inf),
                         np.log(var_inf)])

    return _delta(np.array([phi, shock]), covariance, logs)


def arma(y: Array, dt: float) -> Fit:
    """Return the fit of statsmodels ARIMA(1,0,1): an OU in noise is an ARMA(1,1)."""
    from statsmodels.tsa.arima.model import ARIMA
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        found = ARIMA((y - y.mean()) / y.std(), order=(1, 0, 1), trend='c').fit()
        covariance = np.asarray(found.cov_params())[1:, 1:]

    def logs(p: Array) -> Array:
        phi, theta, shock = p
        lag_one = shock * (1.0 + phi * theta) * (phi + theta) / (1.0 - phi ** 2)
        var_inf = lag_one / phi
        log_phi = np.log(phi)
        return np.array([np.log(-log_phi / dt), 0.5 * np.log(-2.0 * log_phi / dt * var_inf),
                         np.log(var_inf)])

    return _scaled(_delta(np.asarray(found.params)[1:], covariance, logs), float(y.std()))


def celerite(y: Array, dt: float) -> tuple[Fit, Callable[[], Fit]]:
    """Return the fit of a celerite2 RealTerm with jitter, and how to get its errors."""
    import celerite2
    from celerite2 import terms
    t = np.arange(y.size) * dt
    variance = float(np.var(y))
    least = 1e-8 * variance

    def cost(p: Array) -> float:
        try:
            process = celerite2.GaussianProcess(
                terms.RealTerm(a=math.exp(p[1]), c=math.exp(p[0])), mean=p[3])
            process.compute(t, diag=np.full(y.size, math.exp(p[2])), quiet=True)
            value = -float(process.log_likelihood(y))
        except (OverflowError, np.linalg.LinAlgError):
            return 1e25
        return value if math.isfinite(value) else 1e25

    lag_one = float(np.corrcoef(y[1:], y[:-1])[0, 1])
    begin = np.array([math.log(-math.log(min(max(lag_one, 0.05), 0.999)) / dt),
                      math.log(variance), math.log(0.01 * variance), float(y.mean())])
    found = minimize(cost, begin, method='L-BFGS-B', bounds=(
        (math.log(1e-2 / (y.size * dt)), math.log(10.0 / dt)),
        (math.log(1e-4 * variance), math.log(1e4 * variance)),
        (math.log(least), math.log(10.0 * variance)), (float(y.min()), float(y.max()))))

    def logs(p: Array) -> Array:
        return np.array([p[0], 0.5 * (math.log(2.0) + p[0] + p[1]), p[1]])

    def with_errors() -> Fit:
        steps = np.array([1e-2, 1e-2, 1e-2, 1e-2 * math.sqrt(variance)])
        hessian = np.empty((4, 4))
        for i in range(4):
            for j in range(i + 1):
                one, other = np.eye(4)[i] * steps, np.eye(4)[j] * steps
                hessian[i, j] = hessian[j, i] = (
                    cost(found.x + one + other) - cost(found.x + one - other)
                    - cost(found.x - one + other) + cost(found.x - one - other)
                ) / (4.0 * steps[i] * steps[j])
        if found.x[2] < math.log(least) + 1.0:
            # No jitter: nothing changes along its logarithm.
            hessian[2, :] = hessian[:, 2] = 0.0
            hessian[2, 2] = 1.0
        return _delta(found.x, np.asarray(np.linalg.pinv(hessian), dtype=np.float64), logs)

    return _delta(found.x, np.zeros((4, 4)), logs), with_errors


def rolling(y: Array, dt: float) -> Fit:
    """Return pandas' rolling lag-1 correlation and standard deviation, as a user would."""
    import pandas as pd
    series = pd.Series(y)
    lag_one = float(series.rolling(y.size - 1).corr(series.shift()).iloc[-1])
    std = float(series.rolling(y.size).std().iloc[-1])
    if not 0.0 < lag_one < 1.0:
        return Fit.failed('no relaxation')
    alpha = -math.log(lag_one) / dt
    return Fit(alpha, std * math.sqrt(2.0 * alpha), std * std)


# Name, package, method, whether it is slow (fewer windows).
PEERS: tuple[tuple[str, str, Callable[[Array, float], object], bool], ...] = (
    ('Kalman, restricted likelihood', 'scipy', kalman_fit, False),
    ('celerite2 RealTerm + jitter', 'celerite2', celerite, False),
    ('statsmodels ARMA(1,1)', 'statsmodels', arma, True),
    ('statsmodels AutoReg(1)', 'statsmodels', autoreg, False),
    ('pandas rolling', 'pandas', rolling, False),
)


def installed(package: str) -> bool:
    """Whether a package can be imported."""
    return importlib.util.find_spec(package) is not None
