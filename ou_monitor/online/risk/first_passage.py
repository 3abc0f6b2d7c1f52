"""
First-passage risk: the probability that the supply goes below a voltage within a horizon.

Limits: throttle is taken to stay as it is, and so are alpha and sigma; their
errors, that of the level and that of the present voltage are averaged over.
`watch` says what is meant: the continuous path (what the hardware feels, the
default), or what is seen of it at the rate of the samples, which misses
passages between them and adds the noise of the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools
import math
import threading
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from ou_monitor.model.passage.law import passage_probability
from ou_monitor.model.passage.sampled import sampled_passage_probability
from ou_monitor.records import Estimate, FloatArray, NAN

if TYPE_CHECKING:
    from ou_monitor.model.supply import SupplyModel

# Nodes over where the supply is now; those of the other averages are below.
_START_NODES = 3
WATCHES = ('continuous', 'sampled')
# Probabilities this near to 0 or 1 are not told apart from them where laws are combined.
_TINY = 1e-15


@dataclass(frozen=True)
class Supply:
    """
    What a risk is computed from: the OU at one throttle, and how well it is known.

    Fields are floats or arrays of one shape.

    Attributes
    ----------
    u0, u0_se : float or ndarray
        Level and its standard error, V.
    ln_alpha, ln_alpha_se : float or ndarray
        Logarithm of the relaxation rate (1/s) and its standard error.
    ln_sigma, ln_sigma_se : float or ndarray
        Logarithm of the intensity (V/sqrt(s)) and its standard error.
    covariance : float or ndarray
        Of the errors of `ln_alpha` and `ln_sigma`.

    """

    u0: npt.ArrayLike
    u0_se: npt.ArrayLike
    ln_alpha: npt.ArrayLike
    ln_alpha_se: npt.ArrayLike
    ln_sigma: npt.ArrayLike
    ln_sigma_se: npt.ArrayLike
    covariance: npt.ArrayLike = 0.0

    @classmethod
    def of(cls, e: Estimate) -> Supply:
        """Return what an estimate knows; errors that it does not give count as none."""
        alpha_se, sigma_se = _error(e.alpha_se), _error(e.sigma_se)
        # From var_inf = sigma^2 / (2 alpha).
        both = 0.25 * (4.0 * sigma_se**2 + alpha_se**2 - _error(e.var_inf_se)**2)
        most = alpha_se * sigma_se
        u0_se = e.u0_se if math.isfinite(e.u0_se) else 0.0
        return cls(e.u0, u0_se, math.log(e.alpha), alpha_se, math.log(e.sigma), sigma_se,
                   min(max(both, -most), most) if math.isfinite(e.var_inf_se) else 0.0)


def brownout_probability(e: Estimate, voltage: float, horizon: float,
                         now: float | None = None, *, watch: str = 'continuous') -> float:
    """
    Return the probability of going below `voltage` within `horizon`.

    Parameters
    ----------
    e : Estimate
        The estimate; unless it is usable the risk is unknown.  Its standard
        errors are averaged over.
    voltage : float
        Brown-out level, V.
    horizon : float
        Time ahead, s, > 0.
    now : float, optional
        Present voltage, V, with the noise of `e.noise_std` on it; the mean
        level when left out.
    watch : {'continuous', 'sampled'}
        Whether the path itself is meant, or its samples at `e.rate`, each
        with noise of `e.noise_std`.

    Returns
    -------
    float
        Probability 0..1; NaN when the estimate is not usable and the present
        voltage does not decide; 1 when the present voltage is at or below
        `voltage`.

    Raises
    ------
    ValueError
        When the horizon is not positive, the voltage not finite, or `watch`
        unknown.

    """
    if not (math.isfinite(horizon) and horizon > 0.0):
        raise ValueError(f'horizon must be a positive number of seconds, got {horizon}')
    if not math.isfinite(voltage):
        raise ValueError(f'brown-out voltage must be finite, got {voltage} V')
    if watch not in WATCHES:
        raise ValueError(f"watch must be 'continuous' or 'sampled', got '{watch}'")
    if now is not None and now <= voltage:
        return 1.0
    if not e.usable:
        return NAN
    if now is not None and math.isnan(now):
        now = None
    supply = Supply.of(e)
    risk = float(risk_of(supply, voltage, horizon, now, e.noise_std))
    if watch == 'continuous':
        return risk
    return as_sampled(e, supply, voltage, horizon, now, risk)


def risk_of(supply: Supply, voltage: npt.ArrayLike, horizon: float, now: float | None = None,
            noise_std: float = 0.0, *, coarse: bool = False) -> FloatArray:
    """
    Return the probability that the continuous path goes below `voltage` within `horizon`.

    voltage in V, of the shape of the supply or, of one supply, any; horizon in s, now in V,
    noise_std in V.
    """
    u0, ln_alpha, ln_sigma, weight = _nodes(supply, *(_FEW if coarse else _MANY))
    sd = np.exp(ln_sigma - 0.5 * ln_alpha) / math.sqrt(2.0)
    barrier = (u0 - np.asarray(voltage, dtype=np.float64)[..., None]) / sd
    span = np.exp(ln_alpha) * horizon
    if now is None:
        start = np.zeros_like(barrier)
    elif not noise_std > 0.0:
        start = (u0 - now) / sd
    else:
        start, nodes = _start(u0, sd, now, noise_std)
        barrier, span = barrier[..., None], span[..., None]
        weight = weight[..., None] * nodes
        return _averaged(start, barrier, span, weight, 2)
    return _averaged(start, barrier, span, weight, 1)


@dataclass(frozen=True)
class Passage:
    """The law of the lowest voltage within a horizon, from one instant on; V."""

    supply: Supply
    now: float
    noise_std: float

    def density(self, low: float, horizon: float) -> float:
        """Return the density, 1/V, at a lowest voltage, over what noise or a tenth of it hides."""
        sd = math.exp(float(np.asarray(self.supply.ln_sigma)) - 0.5 * float(
            np.asarray(self.supply.ln_alpha))) / math.sqrt(2.0)
        half = max(self.noise_std, 0.1 * sd)
        levels = np.array([low + half, low - half])
        above, below = np.where(levels >= self.now, 1.0, risk_of(
            self.supply, levels, horizon, self.now, self.noise_std, coarse=True)).tolist()
        return float((above - below) / (2.0 * half))


def as_sampled(e: Estimate, supply: Supply, voltage: float, horizon: float,
               now: float | None, risk: float) -> float:
    """Return the risk of being seen below, errors counted as for the continuous path."""
    if not e.rate > 0.0:
        return NAN
    alpha = math.exp(float(np.asarray(supply.ln_alpha)))
    sd = math.exp(float(np.asarray(supply.ln_sigma))) / math.sqrt(2.0 * alpha)
    u0 = float(np.asarray(supply.u0))
    barrier, noise = (u0 - voltage) / sd, (e.noise_std if e.noise_std > 0.0 else 0.0) / sd
    start = 0.0
    if now is not None:
        start = (u0 - now) / sd / (1.0 + noise**2)
    seen = sampled_passage_probability(
        start, barrier, alpha / e.rate, max(int(horizon * e.rate), 1), noise)
    certain = float(passage_probability(start, barrier, alpha * horizon))
    chances = np.clip([seen, risk, certain], _TINY, 1.0 - _TINY)
    odds = (chances / (1.0 - chances)).tolist()
    # What errors do to the odds they do to both.
    both = odds[0] * odds[1] / odds[2]
    return both / (1.0 + both) if 0.0 < seen < 1.0 else float(seen)


def _averaged(start: FloatArray, barrier: FloatArray, span: FloatArray, weight: FloatArray,
              axes: int) -> FloatArray:
    chance: FloatArray = passage_probability(start, barrier, span) * weight
    total: FloatArray = chance.sum(axis=tuple(range(-axes, 0)))
    return np.clip(total, 0.0, 1.0)


def _nodes(supply: Supply, grid: FloatArray, weights: FloatArray
           ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return levels, ln alpha, ln sigma at the nodes (last axis), and their weights."""
    u0, u0_se, ln_alpha, ln_alpha_se, ln_sigma, ln_sigma_se, covariance = (
        np.asarray(value, dtype=np.float64)[..., None] for value in (
            supply.u0, supply.u0_se, supply.ln_alpha, supply.ln_alpha_se, supply.ln_sigma,
            supply.ln_sigma_se, supply.covariance))
    # Along ln Var_inf = 2 ln sigma - ln alpha, and along ln alpha given that.
    variance = np.maximum(4.0 * ln_sigma_se**2 + ln_alpha_se**2 - 4.0 * covariance, 0.0)
    shared = np.divide(2.0 * covariance - ln_alpha_se**2, variance, out=np.zeros_like(variance),
                       where=variance > 0.0)
    left = np.sqrt(np.maximum(ln_alpha_se**2 - shared**2 * variance, 0.0))
    by_variance = np.sqrt(variance) * grid[0]
    more_alpha = shared * by_variance + left * grid[1]
    more_sigma = 0.5 * (by_variance + more_alpha)
    return (u0 + u0_se * grid[2], ln_alpha + more_alpha, ln_sigma + more_sigma,
            np.broadcast_to(weights, np.broadcast_shapes(u0.shape, weights.shape)))


def _start(u0: FloatArray, sd: FloatArray, now: float, noise_std: float
           ) -> tuple[FloatArray, FloatArray]:
    """Return where the path may be, given one noisy look at it, and the weights."""
    keep = 1.0 / (1.0 + (noise_std / sd)**2)
    middle = keep * (u0 - now) / sd
    nodes, weights = _hermite(_START_NODES)
    return middle[..., None] + np.sqrt(1.0 - keep)[..., None] * nodes, weights


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


# Nodes over ln Var_inf, which counts most, over ln alpha given that, and over the level.
_MANY = _grid(7, 3, 3)
_FEW = _grid(5, 1, 3)

# The live parameters may be so far from those prepared, in logarithms; further ones are
# taken as if they were there.
_NEAR = 0.1
_NEARLY_ONE = 1.0 - 1e-12


class EventRisk:
    """
    Risk that jumps and switching of a model add, kept ready beside the live parameters.

    Tables for the present alpha and sigma are made in a thread of their own, a few tenths of a
    second each, or waited for, and only looked up when a risk is asked for.  Limits: the state of
    a regime is not followed, its stationary law is taken; sigma of the window is that of all
    regimes together.
    """

    def __init__(self, model: SupplyModel, *, background: bool = True) -> None:
        # Here, for without a model the nodes need none of it: it costs them 60 MB.
        from ou_monitor.model.passage.extended import ExtendedPassage
        from ou_monitor.model.supply import SupplyModel
        from ou_monitor.model.terms.term import Live
        kept = SupplyModel(tuple(term for term in model.terms if term.LIVE is not Live.BY_TIME))
        self._passage = ExtendedPassage(kept)
        self._background = background
        self._thread: threading.Thread | None = None
        self._at: tuple[float, float] | None = None
        self._wanted: tuple[float, float] | None = None

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the terms that change the risk."""
        return self._passage.used

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the terms that move the supply and that the risk does not know of."""
        return self._passage.left_out

    def follow(self, ln_alpha: float, ln_sigma: float) -> None:
        """Have tables ready for parameters like these."""
        if not (self.used and math.isfinite(ln_alpha) and math.isfinite(ln_sigma)):
            return
        at = self._at
        if at is not None and max(abs(at[0] - ln_alpha), abs(at[1] - ln_sigma)) < 0.5 * _NEAR:
            return
        self._wanted = ln_alpha, ln_sigma
        if not self._background:
            self._make()
        elif self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._make, name='risk tables', daemon=True)
            self._thread.start()

    def _make(self) -> None:
        wanted = self._wanted
        if wanted is not None:
            self._passage.prepare(math.exp(wanted[0]), math.exp(wanted[1]))
            self._at = wanted

    def survival(self, start: npt.ArrayLike, level: float, horizon: float, *,
                 ln_alpha: npt.ArrayLike, ln_sigma: npt.ArrayLike, u0: npt.ArrayLike
                 ) -> FloatArray:
        """
        Return by what factor events lower the chance to get through the horizon.

        start in V, level in V, horizon in s.
        """
        a, e, v, mean = np.broadcast_arrays(*(
            np.asarray(x, dtype=np.float64) for x in (ln_alpha, ln_sigma, start, u0)))
        if not self.used:
            return np.zeros(a.shape)
        if self._at is None:
            return np.full(a.shape, math.nan)
        alpha = np.exp(np.clip(a, self._at[0] - _NEAR, self._at[0] + _NEAR))
        sigma = np.exp(np.clip(e, self._at[1] - _NEAR, self._at[1] + _NEAR))
        with_events = self._passage.probability(v, level, horizon, alpha=alpha, sigma=sigma,
                                                u0=mean)
        sd = sigma / np.sqrt(2.0 * alpha)
        without = passage_probability((mean - v) / sd, (mean - level) / sd, alpha * horizon)
        found: FloatArray = np.log1p(-np.minimum(with_events, _NEARLY_ONE)) - np.log1p(
            -np.minimum(without, _NEARLY_ONE))
        return np.minimum(found, 0.0)
