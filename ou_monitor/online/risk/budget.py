"""
What if: the brown-out risk at throttles not flown right now, and the highest that is safe.

Limits: alpha is that of the present estimate at every throttle, as the paper assumes; the supply
is taken to have settled at each throttle, so the dip that follows a step of throttle (inrush,
overshoot) is not in the risk; level and intensity are those of the supply as it is today, without
further discharge.  Throttles that have not been flown are never called safe beyond the range
flown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.online.risk.curves import LearnedCurves
from ou_monitor.records import Estimate, FloatArray, NAN
from ou_monitor.text import Z95

# probability(u0, u0_se, ln_sigma, ln_sigma_se, ln_alpha, ln_alpha_se) -> risk, elementwise.
Probability = Callable[
    [FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]

# Throttles at which the risk is computed, and points between two of them.
_STEPS = 50
_FINE = 9
_GRID = np.linspace(0.0, 1.0, _STEPS + 1)
# Probabilities are kept this far from 0 and 1 for the log-odds.
_TINY = 1e-300
_NEARLY_ONE = 1.0 - 1e-16


def _empty() -> FloatArray:
    return np.empty(0)


def _none() -> npt.NDArray[np.bool_]:
    return np.empty(0, dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class ThrottleBudget:
    """
    The highest throttle that keeps the risk under a limit.

    Attributes
    ----------
    throttle : float
        The budget, 0..1; NaN when unknown; 0 when even idle, flown, is above the limit.
    lowest, highest : float
        Range of throttles with data; NaN when there are none.
    limit : float
        Risk not to be exceeded, 0..1.
    reason : str
        What ends the budget, or why it is unknown, in words.
    throttles : ndarray, shape (k,)
        Throttles of the risk curve; empty when nothing could be computed.
    risks : ndarray, shape (k,)
        Risk at each of them, with the errors of the curves in it.
    known : ndarray of bool, shape (k,)
        Whether data near that throttle weigh more than the prior.

    """

    throttle: float
    lowest: float
    highest: float
    limit: float
    reason: str
    throttles: FloatArray = field(default_factory=_empty)
    risks: FloatArray = field(default_factory=_empty)
    known: npt.NDArray[np.bool_] = field(default_factory=_none)


@dataclass(frozen=True)
class ThrottleRisk:
    """
    The risk at one throttle.

    Attributes
    ----------
    throttle : float
        Throttle, 0..1.
    risk : float
        Probability of a brown-out, with the errors of level, sigma and alpha in it; NaN when
        unknown.
    low, high : float
        95 % interval of the probability that exact knowledge of the supply would give.
    known : bool
        Whether data near that throttle weigh more than the prior.

    """

    throttle: float
    risk: float
    low: float
    high: float
    known: bool


def throttle_budget(estimate: Estimate, curves: LearnedCurves, *, voltage: float,
                    horizon: float, limit: float, probability: Probability) -> ThrottleBudget:
    """
    Return the highest throttle up to which the risk stays within the limit.

    A rail that holds at the lowest throttle flown is taken to hold below it.  Where it does not,
    the budget lies below, and is known as far as the prior is good enough for that.

    voltage in V, horizon in s.
    """
    if not math.isfinite(voltage):
        raise ValueError(f'brown-out voltage must be finite, got {voltage} V')
    if not (math.isfinite(horizon) and horizon > 0.0):
        raise ValueError(f'horizon must be a positive number of seconds, got {horizon}')
    if not 0.0 < limit < 1.0:
        raise ValueError(f'limit of the risk must lie between 0 and 1, got {limit}')
    lowest, highest = curves.extent
    if not estimate.usable:
        return ThrottleBudget(NAN, lowest, highest, limit,
                              'Estimate not usable: ' + estimate.status.value)
    if not curves.throttle_known:
        return ThrottleBudget(NAN, lowest, highest, limit, 'No throttle is known.')
    if math.isnan(highest):
        return ThrottleBudget(NAN, lowest, highest, limit,
                              'No throttle has been held long enough yet to learn from.')
    risks = _risks(_GRID, estimate, curves, probability)
    known = curves.seen_curve(_GRID)
    known.setflags(write=False)
    risks.setflags(write=False)
    throttle, reason = _end(risks, known, lowest, highest, limit,
                            lambda at: _risks(at, estimate, curves, probability))
    if math.isfinite(throttle):
        reason += f' Brown-out: below {voltage:g} V within {horizon:g} s.'
    return ThrottleBudget(throttle, lowest, highest, limit, reason, _GRID, risks, known)


def risk_at(throttle: float, estimate: Estimate, curves: LearnedCurves, *,
            probability: Probability) -> ThrottleRisk:
    """
    Return the risk at one throttle, and how well it is known.

    The interval combines the shifts of the log-odds when level, sigma and alpha go to the ends
    of their own intervals, each side by its own squares (Zou and Donner, Stat. Med. 27 (2008)
    1693).

    throttle 0..1.
    """
    if not 0.0 <= throttle <= 1.0:
        raise ValueError(f'throttle must lie within 0..1, got {throttle}')
    level, level_se = curves.level_at(throttle)
    log_sigma, log_sigma_se = curves.sigma_at(throttle)
    known = curves.seen(throttle)
    if not estimate.usable or math.isnan(level) or math.isnan(log_sigma):
        return ThrottleRisk(throttle, NAN, NAN, NAN, known)
    alpha_se = estimate.alpha_se if math.isfinite(estimate.alpha_se) else 0.0
    center = np.array([level, log_sigma, math.log(estimate.alpha)])
    errors = np.array([level_se, log_sigma_se, alpha_se])
    shifts = np.vstack([np.zeros(3), np.zeros(3), np.diag(Z95 * errors), -np.diag(Z95 * errors)])
    at = center + shifts
    # The first with the errors inside; the others at exactly known parameters.
    given = np.zeros_like(at)
    given[0] = errors
    found = np.asarray(probability(at[:, 0], given[:, 0], at[:, 1], given[:, 1],
                                   at[:, 2], given[:, 2]), dtype=np.float64)
    if not np.isfinite(found).all():
        return ThrottleRisk(throttle, NAN, NAN, NAN, known)
    clipped = np.clip(found[1:], _TINY, _NEARLY_ONE)
    odds = np.log(clipped) - np.log1p(-clipped)
    changes = (odds[1:] - odds[0]).reshape(2, 3)
    up, down = changes.max(axis=0).clip(min=0.0), changes.min(axis=0).clip(max=0.0)
    high = odds.item(0) + math.sqrt(float(up @ up))
    low = odds.item(0) - math.sqrt(float(down @ down))
    risk = min(max(found.item(0), 0.0), 1.0)
    return ThrottleRisk(throttle, risk, _from_odds(low), _from_odds(high), known)


def _risks(throttles: FloatArray, e: Estimate, curves: LearnedCurves,
           probability: Probability) -> FloatArray:
    """Return the risk at throttles of shape (k,)."""
    level, level_se = curves.level_curve(throttles)
    log_sigma, log_sigma_se = curves.sigma_curve(throttles)
    log_alpha = np.full(throttles.shape, math.log(e.alpha))
    alpha_se = np.full(throttles.shape, e.alpha_se if math.isfinite(e.alpha_se) else 0.0)
    # A quadrature may round to just above 1; NaN stays.
    return np.clip(np.asarray(
        probability(level, level_se, log_sigma, log_sigma_se, log_alpha, alpha_se),
        dtype=np.float64), 0.0, 1.0)


def _end(risks: FloatArray, known: npt.NDArray[np.bool_], lowest: float, highest: float,
         limit: float, risks_at: Callable[[FloatArray], FloatArray]) -> tuple[float, str]:
    """Return where the budget ends, and why."""
    first, last = round(lowest * _STEPS), round(highest * _STEPS)
    # NaN is not within the limit.
    within = risks <= limit
    if not within[first]:
        if math.isnan(risks.item(first)):
            return NAN, f'The risk could not be computed at throttle {lowest:.2f}.'
        if first == 0:
            return 0.0, f'Even idle is above the limit: risk {risks.item(0):.2g}.'
        if not within[0]:
            return NAN, (f'Above the limit at {lowest:.2f}, the lowest throttle flown '
                         f'(risk {risks.item(first):.2g}); no data below.')
        first = 0
    beyond = np.flatnonzero(~within[first:last + 1])
    if not beyond.size:
        if last == _STEPS:
            return 1.0, 'Within the limit up to full throttle.'
        return highest, f'No data above {highest:.2f}; within the limit up to there.'
    k = first + beyond.item(0)
    at = np.linspace(_GRID.item(k - 1), _GRID.item(k), _FINE + 2)
    fine = np.concatenate([risks[k - 1:k], risks_at(at[1:-1]), risks[k:k + 1]])
    j = int(np.flatnonzero(~(fine <= limit)).item(0))
    end = at.item(j - 1)
    low, high = fine.item(j - 1), fine.item(j)
    if low > 0.0 and high > limit > low:
        # The logarithm of the risk is nearly straight over so short a way.
        end += (at.item(j) - end) * math.log(limit / low) / math.log(high / low)
    if math.isnan(high):
        return end, f'The risk could not be computed above {end:.2f}.'
    if not known[k]:
        return end, f'No data near {_GRID.item(k):.2f}: the risk there may be above the limit.'
    return end, f'The risk passes the limit of {limit:.2g} at throttle {end:.2f}.'


def _from_odds(odds: float) -> float:
    """Return the probability of log-odds."""
    if odds > 0.0:
        return 1.0 / (1.0 + math.exp(-odds))
    small = math.exp(odds)
    return small / (1.0 + small)
