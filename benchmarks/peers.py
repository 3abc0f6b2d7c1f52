"""
What a user would pick instead: each method as `fit(y, dt) -> Fit`.

Standard errors are the method's own (its covariance, by the delta method to
the logarithms, so that all intervals have one form).  celerite2 gives a
likelihood and no errors: it gets a numerical Hessian, which is not timed.
statsmodels' state-space methods get standardised data, as a careful user would
give them: on volts their optimisers stop early.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
from dataclasses import replace
import importlib.util
import io
import math
import warnings

from data import Array
import kalman
import numpy as np
from records import Fit
from scipy.optimize import minimize

Method = Callable[[Array, float], Fit]


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


def components(y: Array, dt: float) -> Fit:
    """Return the fit of statsmodels UnobservedComponents: AR(1) + irregular + fixed level."""
    from statsmodels.tsa.statespace.structural import UnobservedComponents
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        # level as a string ('fixed intercept') would switch `irregular` off.
        model = UnobservedComponents((y - y.mean()) / y.std(), level=True,
                                     stochastic_level=False, irregular=True, autoregressive=1)
        found = model.fit(disp=False, maxiter=200)
        covariance = np.asarray(found.cov_params())
    names = list(model.param_names)
    order = [names.index('sigma2.ar'), names.index('ar.L1')]

    def logs(p: Array) -> Array:
        log_phi = np.log(p[1])
        var_inf = p[0] / (1.0 - p[1] ** 2)
        return np.array([np.log(-log_phi / dt), 0.5 * np.log(-2.0 * log_phi / dt * var_inf),
                         np.log(var_inf)])

    return _scaled(_delta(np.asarray(found.params)[order], covariance[np.ix_(order, order)],
                          logs), float(y.std()))


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


def pymle(y: Array, dt: float) -> Fit:
    """Return the exact OU maximum likelihood of pymle-diffusion (no errors given)."""
    from pymle.core.TransitionDensity import ExactDensity
    from pymle.fit.AnalyticalMLE import AnalyticalMLE
    from pymle.models import OrnsteinUhlenbeck
    bounds = [(0.01, 2.0 / dt), (float(y.min()), float(y.max())), (1e-3, 50.0)]
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter('ignore')
        found = AnalyticalMLE(
            sample=y, param_bounds=bounds, dt=dt, density=ExactDensity(OrnsteinUhlenbeck()),
        ).estimate_params(np.array([50.0, float(y.mean()), 1.0]))
    alpha, _, sigma = (float(p) for p in found.params)
    return Fit(alpha, sigma, sigma ** 2 / (2.0 * alpha))


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
    ('Kalman, restricted likelihood', 'scipy', kalman.fit, False),
    ('celerite2 RealTerm + jitter', 'celerite2', celerite, False),
    ('statsmodels ARMA(1,1)', 'statsmodels', arma, True),
    ('statsmodels UnobservedComponents', 'statsmodels', components, True),
    ('statsmodels AutoReg(1)', 'statsmodels', autoreg, False),
    ('pymle-diffusion exact OU', 'pymle', pymle, True),
    ('pandas rolling', 'pandas', rolling, False),
)


def installed(package: str) -> bool:
    """Whether a package can be imported."""
    return importlib.util.find_spec(package) is not None
