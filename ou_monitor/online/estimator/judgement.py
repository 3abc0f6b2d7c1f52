"""
From a fit to what is published: bias corrections, honest errors, status, flags.

Small-sample correction.  The restricted likelihood leaves 2/T of the bias of
alpha (Tang & Chen, J. Econometrics 149 (2009) 65: 4/T with unknown mean, half
of it from the mean).  Var_inf = sigma^2 / (2 alpha) is convex in alpha and
unbiased already at alpha - 1/T.  Both are published, and users divide one by
the other, so one correction serves both: 1.5/T, which leaves each high by
0.5/(alpha T), a thirtieth of its standard error at alpha T = 126.
"""

from __future__ import annotations

import math
from typing import Any

from ou_monitor.online.estimator.fitted import Fitted, Outcome
from ou_monitor.online.estimator.load import load_at, slope_at
from ou_monitor.online.estimator.quality import Quality
from ou_monitor.records import Counters, Estimate, Flag, NAN, Status

# What alpha is high by, in 1/T (see above).
_HIGH_BY = 1.5
# Relaxation times in the window from which alpha is told at all, and from
# which it is told to a quarter (doc/estimation.md).
MIN_RELAXATIONS = 5.0
GOOD_RELAXATIONS = 25.0
# Standard error of ln(alpha), before it is widened, beyond which alpha is not known to a factor.
_BURIED = 0.5
# ... provided that noise, and not the length of the window, is the cause: the
# error is this many times that without noise.
_BURIED_BY = 2.0
# In short windows ln(alpha) has wider tails than its information says: its
# standard error grows by 1 + 1.5/x + 70/x^2, x = alpha T, which brings the
# coverage of 95 % intervals to 94 % at x = 12 (and 88 % at x = 5, where windows
# that look longer than they are get published); doc/estimation.md.
_WIDER, _MUCH_WIDER = 1.5, 70.0
# Width of the zone beside "no noise" in which errors of sigma shrink (measured).
_NEAR = 0.75
# Throttle that moves less than this (standard deviation) cannot tell sag.
MIN_THROTTLE_STD = 0.005
# Correlation of neighbouring increments, above that of an OU, from which a
# low-pass upstream is suspected, and in standard errors.
_SMOOTH, _SMOOTH_SCORE = 0.05, 5.0


def log_errors(fit: Fitted, duration: float) -> tuple[float, float, float]:
    """
    Return the standard errors of ln(alpha), ln(sigma), ln(Var_inf).

    Where no noise was found, theta sits on its bound or near it and the
    information overstates the error of sigma: it shrinks by the width of a
    half-normal there (its variance with one side cut is 0.68 of the whole,
    and theta makes up most of the variance of sigma), within `_NEAR` standard
    errors of the bound.

    duration in s.
    """
    relaxations = fit.alpha * duration
    wider = 1.0 + _WIDER / relaxations + _MUCH_WIDER / relaxations ** 2
    near = math.exp(-0.5 * (fit.noise_score / _NEAR) ** 2)
    return (math.sqrt(fit.log_var[0]) * wider,
            math.sqrt(fit.log_var[1] * (1.0 - 0.32 * near)),
            math.sqrt(fit.log_var[2]) * wider)


def judge(fit: Fitted, base: Estimate, quality: Quality, throttle_std: float,
          smoothness: float) -> Estimate:
    """Return the published estimate."""
    flags = input_flags(base.counters, quality, throttle_std)
    if fit.trend:
        flags.append(Flag.TREND)
    moves = bool(fit.beta.size > 1) and throttle_std > MIN_THROTTLE_STD
    level, sag = _level(fit, base.throttle, moves)
    noise = math.sqrt(max(fit.noise_var, 0.0))
    known = {'u0': level, 'sag': sag, 'noise_std': noise}
    if fit.outcome is Outcome.UNCORRELATED:
        return _with(base, Status.NO_RELAXATION, flags, **known)
    duration = base.duration
    se = log_errors(fit, duration)
    if fit.alpha_step > 1.0:
        flags.append(Flag.SLOW_RATE)
    if math.isfinite(smoothness) and smoothness > max(
            _SMOOTH, _SMOOTH_SCORE / math.sqrt(fit.n)):
        flags.append(Flag.LOWPASS_UPSTREAM)
    known.update(sigma=fit.sigma, sigma_se=se[1])
    relaxations = fit.alpha * duration - _HIGH_BY
    if fit.outcome is Outcome.UNBOUND or relaxations < MIN_RELAXATIONS:
        unbound = relaxations < 0.5
        return _with(base, Status.UNBOUND if unbound else Status.TOO_SHORT, flags, **known)
    floor = 2.0 / max(relaxations, MIN_RELAXATIONS)
    if fit.log_var[0] > max(_BURIED ** 2, _BURIED_BY ** 2 * floor):
        return _with(base, Status.BURIED, flags, **known)
    # A short window often looks longer than it is: one standard error is granted.
    surely = relaxations * math.exp(-se[0])
    alpha = fit.alpha - _HIGH_BY / duration
    var_inf = fit.sigma ** 2 / (2.0 * alpha)
    # The mean of an OU over a long window has variance 2 Var_inf / (alpha T).
    level_var = 2.0 * var_inf / (alpha * duration)
    if moves:
        x = load_at(base.throttle) - fit.level[1:5]
        level_var += float(x @ fit.beta_cov[:4, :4] @ x)
    return _with(
        base, Status.OK if surely >= GOOD_RELAXATIONS else Status.SHORT_WINDOW, flags,
        alpha=alpha, alpha_se=se[0], var_inf=var_inf, var_inf_se=se[2],
        u0_se=math.sqrt(max(level_var, 0.0)), **known)


def input_flags(counters: Counters, quality: Quality, throttle_std: float) -> list[Flag]:
    """Return the cautions that need no fit."""
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


def recount(estimate: Estimate, counters: Counters) -> Estimate:
    """Return the same estimate with newer counters, and the flag that goes with them."""
    flags = estimate.flags
    if (counters.late or counters.non_finite) and Flag.IRREGULAR not in flags:
        flags = (*flags, Flag.IRREGULAR)
    return made(estimate, counters=counters, flags=flags)


def _level(fit: Fitted, throttle: float, moves: bool) -> tuple[float, float]:
    """Return the mean at the present throttle, V, and its slope, V per unit throttle."""
    if not moves or math.isnan(throttle):
        return float(fit.level[0]), NAN
    shift = (load_at(throttle) - fit.level[1:5]) @ fit.beta[:4]
    return float(fit.level[0] + shift), slope_at(throttle, fit.beta)


def _with(base: Estimate, status: Status, flags: list[Flag], **values: Any) -> Estimate:
    return made(base, status=status, flags=tuple(flags), **values)


def made(base: Estimate, **values: Any) -> Estimate:
    """Return a copy with some values changed, for a quarter of what `replace` takes."""
    copy = object.__new__(Estimate)
    # Frozen records set each field through a call; these are all known to be fields.
    copy.__dict__.update(base.__dict__, **values)
    return copy
