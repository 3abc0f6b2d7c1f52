"""
First-passage risk: the probability that the supply goes below a voltage within a horizon.

The risk is averaged over the errors of alpha, sigma, the level and the present voltage.  It refers
not to samples, but to the continuous path, which affects the hardware.  Limits: throttle, alpha
and sigma are assumed constant.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.passage import passage_probability
from ou_monitor.records import Estimate, FloatArray, NAN

# Number of quadrature nodes over the present voltage; `_MANY` and `_FEW` are for other averages.
_START_NODES = 3


@dataclass(frozen=True)
class Supply:
    """Input of a risk: the OU at one throttle, and its errors."""

    # Level and its standard error, V.
    u0: float
    u0_se: float
    # Logarithm of the relaxation rate (1/s) and its standard error.
    ln_alpha: float
    ln_alpha_se: float
    # Logarithm of the intensity (V/sqrt(s)) and its standard error.
    ln_sigma: float
    ln_sigma_se: float
    covariance: float = 0.0  # Covariance of the errors of `ln_alpha` and `ln_sigma`.

    @classmethod
    def of(cls, e: Estimate) -> Supply:
        """Return the OU of an estimate; unknown errors count as zero."""
        alpha_se, sigma_se = _error(e.alpha_se), _error(e.sigma_se)
        # The covariance follows from var_inf = sigma^2 / (2 alpha).
        both = 0.25 * (4.0 * sigma_se**2 + alpha_se**2 - _error(e.var_inf_se)**2)
        most = alpha_se * sigma_se
        u0_se = e.u0_se if math.isfinite(e.u0_se) else 0.0
        return cls(e.u0, u0_se, math.log(e.alpha), alpha_se, math.log(e.sigma), sigma_se,
                   min(max(both, -most), most) if math.isfinite(e.var_inf_se) else 0.0)


def brownout_probability(e: Estimate, voltage: float, horizon: float,
                         now: float | None = None) -> float:
    """
    Return the probability of going below `voltage` within `horizon`.

    Parameters
    ----------
    e : Estimate
        The estimate.  The risk is averaged over its standard errors.
    voltage : float
        Brown-out level, V.
    horizon : float
        Time ahead, s, > 0.
    now : float, optional
        Present voltage, V, a reading with noise of `e.noise_std`; by default,
        the mean level.

    Returns
    -------
    float
        Probability, 0..1; 1 if the present voltage is at or below `voltage`;
        otherwise NaN if the estimate is not usable.

    Raises
    ------
    ValueError
        When the horizon is not positive, or the voltage not finite.

    Examples
    --------
    >>> from ou_monitor import brownout_probability, read_recording, SlidingEstimator
    >>> recording = read_recording('bags/load_40')
    >>> estimator = SlidingEstimator(window=2.0)
    >>> estimator.push(recording.t, recording.voltage, recording.throttle)
    >>> estimate = estimator.estimate()
    >>> near, far = (brownout_probability(estimate, voltage=v, horizon=1.0) for v in (4.9, 4.7))
    >>> near > 0.9 and far < 0.01
    True

    """
    if not (math.isfinite(horizon) and horizon > 0.0):
        raise ValueError(f'horizon must be a positive number of seconds, got {horizon}')
    if not math.isfinite(voltage):
        raise ValueError(f'brown-out voltage must be finite, got {voltage} V')
    if now is not None and now <= voltage:
        return 1.0
    if not e.usable:
        return NAN
    if now is not None and math.isnan(now):
        now = None
    return float(risk_of(Supply.of(e), voltage, horizon, now, e.noise_std))


def risk_of(supply: Supply, voltage: npt.ArrayLike, horizon: float, now: float | None = None,
            noise_std: float = 0.0) -> FloatArray:
    """Return P(the continuous path goes below `voltage`, V, of any shape, within `horizon`, s)."""
    return Passage(supply, now, noise_std, _MANY).risk(voltage, horizon)


class Passage:
    """Distribution of the lowest voltage from now on, V, by quadrature over errors."""

    def __init__(self, supply: Supply, now: float | None, noise_std: float,
                 nodes: tuple[FloatArray, FloatArray] | None = None) -> None:
        grid, weight = nodes or _FEW
        self._half = max(noise_std, 0.1 * math.exp(
            supply.ln_sigma - 0.5 * supply.ln_alpha) / math.sqrt(2.0))
        self._now = -math.inf if now is None else now
        # One axis is ln Var_inf = 2 ln sigma - ln alpha, another is ln alpha given ln Var_inf.
        alpha_variance = supply.ln_alpha_se**2
        variance = max(
            4.0 * supply.ln_sigma_se**2 + alpha_variance - 4.0 * supply.covariance, 0.0)
        shared = (2.0 * supply.covariance - alpha_variance) / variance if variance else 0.0
        by_variance = math.sqrt(variance) * grid[0]
        more_alpha = shared * by_variance + math.sqrt(
            max(alpha_variance - shared**2 * variance, 0.0)) * grid[1]
        u0 = supply.u0 + supply.u0_se * grid[2]
        ln_alpha = supply.ln_alpha + more_alpha
        ln_sigma = supply.ln_sigma + 0.5 * (by_variance + more_alpha)
        sd, alpha = np.exp(ln_sigma - 0.5 * ln_alpha) / math.sqrt(2.0), np.exp(ln_alpha)
        start = np.zeros_like(u0) if now is None else (u0 - now) / sd
        if now is not None and noise_std > 0.0:
            # Distribution of the present voltage, given one noisy reading.
            keep = 1.0 / (1.0 + (noise_std / sd) ** 2)
            points, shares = _hermite(_START_NODES)
            u0, sd, alpha = (np.repeat(x, points.size) for x in (u0, sd, alpha))
            start = ((keep * start)[:, None] + np.sqrt(1.0 - keep)[:, None] * points).ravel()
            weight = (weight[:, None] * shares).ravel()
        self._u0, self._sd, self._alpha, self._start, self._weight = u0, sd, alpha, start, weight

    def risk(self, voltage: npt.ArrayLike, horizon: float) -> FloatArray:
        """Return the probability of going below voltages, V, within a horizon, s."""
        barrier = (self._u0 - np.asarray(voltage, dtype=np.float64)[..., None]) / self._sd
        chance: FloatArray = self._weight * passage_probability(
            self._start, barrier, self._alpha * horizon)
        return np.clip(chance.sum(axis=-1), 0.0, 1.0)

    def density(self, low: float, horizon: float) -> float:
        """Return the density, 1/V, at a lowest voltage, averaged over the width of the noise."""
        levels = np.array([low + self._half, low - self._half])
        above, below = np.where(levels >= self._now, 1.0, self.risk(levels, horizon)).tolist()
        return float((above - below) / (2.0 * self._half))


def _error(value: float) -> float:
    return value if math.isfinite(value) else 0.0


@functools.cache
def _hermite(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of averages over N(0, 1)."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    return nodes, weights / weights.sum()


def _grid(*counts: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes, shape (3, k), and weights, shape (k,)."""
    rules = [_hermite(count) for count in counts]
    nodes = np.meshgrid(*(rule[0] for rule in rules), indexing='ij')
    weights = np.meshgrid(*(rule[1] for rule in rules), indexing='ij')
    return (np.array([axis.ravel() for axis in nodes]),
            np.prod([axis.ravel() for axis in weights], axis=0))


# Nodes over ln Var_inf (which matters most), over ln alpha given ln Var_inf, and over the level.
_MANY = _grid(7, 3, 3)
_FEW = _grid(5, 1, 3)
