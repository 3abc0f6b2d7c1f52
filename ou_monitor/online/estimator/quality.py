"""
Quality of the input and the fit: ADC steps, bias, corrected errors, status, flags.

In a diffusion, equal adjacent values have probability zero.  So repeats, ADC grids and clipped
values are detected without a model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from ou_monitor.online.estimator.fit import FitEnd, WindowFit
from ou_monitor.records import Counters, Estimate, Flag, FloatArray, NAN, Status

# Minimum number of samples for any finding.
_ENOUGH = 64
# Minimum number of different increments, all multiples of one step, that prove the grid of an ADC;
# fewer may be chance.
_FEWEST_STEPS = 3
# The ADC counts as coarse if less than this share of adjacent samples differ.
_TIED = 0.9
# Minimum share of samples at an extreme value that counts as clipping, and minimum ratio of their
# number to the number of samples at the adjacent code.
_CLIPPED_SHARE = 0.01
_CLIPPED_EXCESS = 3.0


@dataclass(frozen=True)
class Quality:
    """Findings about readings."""

    step: float = 0.0  # ADC step, V; 0 if the values lie on no grid
    held: float = 1.0  # Samples per reading of a source that repeats readings; 1: no repeats
    saturated: bool = False  # Whether many samples are at an extreme value
    rms_increment: float = math.nan  # Root mean square of the steps between samples, V


def examine(y: FloatArray, held: float = 1.0) -> Quality:
    """Return the findings about readings, V (held: samples per reading, if repeated)."""
    if y.size < _ENOUGH:
        return Quality(held=held)
    steps = np.diff(y)
    changes = np.flatnonzero(steps)
    if changes.size < _FEWEST_STEPS:
        return Quality(held=held)
    # If many adjacent samples are equal, a single step size suffices to prove a grid.
    tied = changes.size < _TIED * steps.size
    rms = float(np.sqrt(np.mean(steps * steps)))
    # If the squares underflow to zero, there is no step.
    step = lattice(np.abs(steps[changes]), 1 if tied else _FEWEST_STEPS) if rms > 0.0 else 0.0
    return Quality(step, held, _piles_up(y), rms)


def lattice(sizes: FloatArray, fewest: int = _FEWEST_STEPS) -> float:
    """Return the common divisor of increments, V; 0 if none is above 1e-3 of the largest."""
    ordered = np.unique(sizes)
    least = float(ordered[0])
    # Rounding splits one step into several: average the steps within 1e-3 of the smallest.
    near = ordered[ordered < 1.001 * least]
    unit = float(near.mean())
    multiples = np.rint(ordered / unit)
    if multiples[-1] > 1000.0 or np.unique(multiples).size < fewest:
        return 0.0
    unit = float((ordered @ multiples) / (multiples @ multiples))
    return unit if bool((np.abs(ordered - multiples * unit) < 0.02 * unit).all()) else 0.0


def _piles_up(y: FloatArray) -> bool:
    """Whether one extreme is far more common than the value next to it."""
    values, counts = np.unique(y, return_counts=True)
    if values.size < _FEWEST_STEPS:
        return False
    least = max(10.0, _CLIPPED_SHARE * y.size)
    for edge, beside in ((0, 1), (-1, -2)):
        if counts[edge] >= least and counts[edge] > _CLIPPED_EXCESS * counts[beside]:
            return True
    return False


# Minimum number of relaxation times in the window for the status OK; with fewer, SHORT_WINDOW.
GOOD_RELAXATIONS = 25.0
# Alpha counts as buried in noise if the standard error of ln(alpha), before it is widened, exceeds
# the first value, and also the second value times the error without noise (otherwise the short
# window is the cause).
_BURIED, _BURIED_BY = 0.5, 2.0
# In short windows, ln(alpha) has wider tails than its Fisher information implies.  So its standard
# error is multiplied by 1 + 1.5/x + 70/x^2, x = alpha T + 1.5, with which the coverage of 95 %
# intervals is 94 % at x = 12.
_WIDER, _MUCH_WIDER, _AS_FITTED = 1.5, 70.0, 1.5
# Distance of the noise from zero, in standard errors, within which the error of sigma is reduced.
_NEAR = 0.75
# Minimum standard deviation of throttle to estimate the sag.
MIN_THROTTLE_STD = 0.005
# Excess of the correlation of neighbouring increments over an OU's, absolute and in standard
# errors, above which a low-pass upstream is suspected.
_SMOOTH, _SMOOTH_SCORE = 0.05, 5.0


def log_errors(fit: WindowFit, duration: float) -> tuple[float, float, float]:
    """Return the standard errors of ln(alpha), ln(sigma), ln(Var_inf) (duration in s)."""
    # At least a thousandth, to avoid a division by zero.
    relaxations = max(fit.alpha * duration - fit.high + _AS_FITTED, 1e-3)
    wider = 1.0 + (_WIDER + _MUCH_WIDER / relaxations) / relaxations
    # If no noise was found, the MA coefficient theta is at or near its bound, and the error of
    # sigma from the information is too large.  Within about `_NEAR` standard errors of the bound,
    # this error is therefore reduced as for a normal distribution truncated on one side (to 0.68
    # of the variance, because theta causes most of the variance of sigma).
    near = math.exp(-0.5 * math.pow(min(fit.noise_score / _NEAR, 1e3), 2))
    return (_se(fit.log_var[0]) * wider, _se(fit.log_var[1]) * math.sqrt(1.0 - 0.32 * near),
            _se(fit.log_var[2]) * wider)


def _se(variance: float) -> float:
    """Return a standard error; infinite if the information is singular."""
    return math.sqrt(variance) if variance >= 0.0 else math.inf


def judge(fit: WindowFit, measured: Mapping[str, Any], quality: Quality, throttle_std: float,
          smoothness: float) -> Estimate:
    """Return the published estimate; `measured`: its fields that do not depend on the fit."""
    flags = input_flags(measured['counters'], quality, throttle_std)
    if fit.trend:
        flags.append(Flag.TREND)
    moves = bool(fit.beta.size > 1) and throttle_std > MIN_THROTTLE_STD
    level, sag = _level(fit, measured['throttle'], moves)
    noise = math.sqrt(max(fit.noise_var, 0.0))
    known = {**measured, 'u0': level, 'sag': sag, 'noise_std': noise}
    if fit.outcome is FitEnd.UNCORRELATED:
        return Estimate(status=Status.NO_RELAXATION, flags=tuple(flags), **known)
    duration = measured['duration']
    se = log_errors(fit, duration)
    if fit.alpha_step > 1.0:
        flags.append(Flag.SLOW_RATE)
    if math.isfinite(smoothness) and smoothness > max(
            _SMOOTH, _SMOOTH_SCORE / math.sqrt(fit.n)):
        flags.append(Flag.LOWPASS_UPSTREAM)
    known.update(sigma=fit.sigma, sigma_se=se[1])
    relaxations = fit.alpha * duration - fit.high
    if fit.outcome is FitEnd.UNBOUND or relaxations < 0.5:
        return Estimate(status=Status.UNBOUND, flags=tuple(flags), **known)
    if fit.log_var[0] > max(_BURIED ** 2, _BURIED_BY ** 2 * 2.0 / relaxations):
        return Estimate(status=Status.BURIED, flags=tuple(flags), **known)
    # In a short window alpha may be overestimated, so reduce `relaxations` by one standard error.
    surely = relaxations * math.exp(-se[0])
    alpha = fit.alpha - fit.high / duration
    var_inf = fit.sigma ** 2 / (2.0 * alpha)
    # The mean of an OU over a long window has variance 2 Var_inf / (alpha T).
    level_var = 2.0 * var_inf / (alpha * duration)
    if moves:
        x = load_at(measured['throttle']) - fit.level[1:5]
        level_var += float(x @ fit.beta_cov[:4, :4] @ x)
    status = Status.OK if surely >= GOOD_RELAXATIONS else Status.SHORT_WINDOW
    return Estimate(status=status, flags=tuple(flags), alpha=alpha, alpha_se=se[0],
                    var_inf=var_inf, var_inf_se=se[2], u0_se=math.sqrt(max(level_var, 0.0)),
                    **known)


def input_flags(counters: Counters, quality: Quality, throttle_std: float) -> list[Flag]:
    """Return the flags that do not depend on the fit."""
    flags: list[Flag] = []
    if quality.step > quality.rms_increment:
        flags.append(Flag.QUANTIZED)
    if quality.held > 1:
        flags.append(Flag.HELD_SAMPLES)
    if quality.saturated:
        flags.append(Flag.SATURATED)
    if throttle_std <= MIN_THROTTLE_STD:
        flags.append(Flag.NO_EXCITATION)
    if counters.late or counters.non_finite:
        flags.append(Flag.IRREGULAR)
    return flags


def _level(fit: WindowFit, throttle: float, moves: bool) -> tuple[float, float]:
    """Return the mean at the present throttle, V, and its fall, V per unit throttle."""
    if not moves or math.isnan(throttle):
        return float(fit.level[0]), NAN
    shift = (load_at(throttle) - fit.level[1:5]) @ fit.beta[:4]
    # d(mean)/d(throttle), at a steady throttle.
    slope = fit.beta[0] + 2.0 * throttle * fit.beta[1] + fit.beta[2] + fit.beta[3]
    return float(fit.level[0] + shift), -float(slope)


def load_at(throttle: float) -> FloatArray:
    """Return the load variables for a throttle at which all lags have settled."""
    return np.array([throttle, throttle * throttle, throttle, throttle])
