"""What a fit says of a window, whichever likelihood it came from."""

from __future__ import annotations

from dataclasses import dataclass
import enum
import math

from ou_monitor.online.estimator.window_fit import WindowFit
from ou_monitor.records import FloatArray


class Outcome(enum.Enum):
    """How a fit ended."""

    FOUND = 'alpha found'
    UNCORRELATED = 'neighbouring samples are uncorrelated'
    UNBOUND = 'no restoring force visible'


@dataclass(slots=True)
class Fitted:
    """
    Parameters before correction for the length of the window.

    Attributes
    ----------
    outcome : Outcome
        How it ended; other than FOUND the numbers may be NaN.
    alpha, sigma : float
        1/s and V/sqrt(s), as maximised.
    noise_var : float
        Variance of the white noise of one raw sample, V^2.
    noise_score : float
        How many standard errors the noise is from none.
    log_var : tuple of float
        Variances of ln(alpha), ln(sigma), ln(Var_inf).
    variance : float
        Variance about the mean, V^2.
    level : ndarray, shape (c,)
        Means of voltage and load variables.
    beta, beta_cov : ndarray
        Load coefficients, V per unit, and covariance, V^2.
    trend : bool
        Whether the mean drifts.
    n : int
        Samples, or block means, fitted.
    alpha_step : float
        alpha times the step between them.

    """

    outcome: Outcome
    alpha: float
    sigma: float
    noise_var: float
    noise_score: float
    log_var: tuple[float, float, float]
    variance: float
    level: FloatArray
    beta: FloatArray
    beta_cov: FloatArray
    trend: bool
    n: int
    alpha_step: float


def from_window(fit: WindowFit, step: float, m: int, n: int, reference: float) -> Fitted:
    """Return a window's fit in physical units (step in s, reference in V)."""
    level = fit.level.copy()
    level[0] += reference
    if not fit.correlated:
        return Fitted(Outcome.UNCORRELATED, math.nan, math.nan, fit.variance * m, math.nan,
                      (math.nan,) * 3, fit.variance, level, fit.beta, fit.beta_cov, fit.trend, n,
                      math.nan)
    return Fitted(
        Outcome.FOUND, fit.a / step, math.sqrt(fit.scale / step),
        fit.noise_share * fit.scale * m, fit.noise_score, fit.log_var, fit.variance, level,
        fit.beta, fit.beta_cov, fit.trend, n, fit.a)
