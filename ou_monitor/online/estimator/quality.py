"""
What the input and the fit are good for: repeats, ADC steps, bias, honest errors, status, flags.

In a diffusion equal neighbours have probability zero, so repeats, lattices and mass at the
extremes are exact findings, told from the samples before any model.

Repeats: a source of 100 Hz logged at 1 kHz gives each value ten times.  Taken as samples the
repeats look like increments of zero.  They are told by the distances between changes: all equal,
or of two neighbouring lengths where the rates have no whole ratio (3, 3, 4).  A coarse ADC makes
ties as well, but at irregular distances; a ramp, a square wave or a ripple through a coarse ADC
changes regularly, but by one code each time.

Small-sample correction.  The restricted likelihood leaves 2/T of the bias of alpha (Tang & Chen,
J. Econometrics 149 (2009) 65: 4/T with unknown mean, half of it from the mean).  Var_inf =
sigma^2 / (2 alpha) is convex in alpha and unbiased already at alpha - 1/T.  Both are published,
and users divide one by the other, so one correction serves both: 1.5/T, which leaves each high by
0.5/(alpha T), a thirtieth of its standard error at alpha T = 126.

Limits: at least two samples a refresh; where the ADC step is larger than 1.3 times the increment
between refreshes, repeats are not told from the ADC's own ties (the flag QUANTIZED is raised
there); nor is a source whose refreshes come early or late by more than a tenth of a period
(standard deviation).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.online.estimator.fit import Fitted, Outcome
from ou_monitor.online.estimator.series import Batch
from ou_monitor.records import Counters, Estimate, Flag, FloatArray, NAN, Status

# Gaps that may differ from the pattern: lost samples, a logger that was late.
_ODD = 0.05
# Widest pattern, in periods: gaps of 7..13 where 10 is meant.
_WIDEST = 0.35
# Evidence against gaps of independent changes, nats: by chance once in 5e8.
_EVIDENCE = 20.0
# Share of changes that must be of another size than the commonest.
_SIZES = 0.1
# Least share of regular gaps with which a known period is kept.
_KEEP = 0.8
# Fewest gaps from which a known period is given up.
_FEWEST = 8
# Sizes of steps that differ by less than this share are one (rounding of float32).
_SAME = 1e-3


def refresh_period(y: FloatArray, known: float = 1.0) -> float:
    """Return samples per refresh of the source (y in V)."""
    steps = np.diff(y)
    changes = np.flatnonzero(steps)
    gaps = np.diff(changes).astype(np.float64)
    if known > 1.0:
        if gaps.size < _FEWEST:
            return known
        allowed = max(1.0, _WIDEST * known)
        if (np.abs(_excess(gaps, known)) <= allowed).mean() >= _KEEP:
            return _period(gaps, known)
    if gaps.size < 2:
        return 1.0
    usual = float(np.median(gaps))
    if usual < 2.0:
        return 1.0
    # Two neighbouring lengths, but not the double ones of refreshes that gave the same value.
    period = _period(gaps, float(gaps[gaps <= 1.5 * usual].mean()))
    distance = np.sort(np.abs(_excess(gaps, period)))
    width = float(distance[math.ceil((1.0 - _ODD) * gaps.size) - 1])
    # Whole samples: less than one is one of two neighbouring lengths.
    if width >= 1.0 and width > _WIDEST * period:
        return 1.0
    chance = _chance(period, width, int(gaps.max()))
    if gaps.size * _divergence(1.0 - _ODD, chance) < _EVIDENCE:
        return 1.0
    return period if _several_sizes(np.abs(steps[changes])) else 1.0


def _period(gaps: FloatArray, near: float) -> float:
    """Return the mean period of the gaps, given one close to it; outliers are left out."""
    number = np.maximum(1.0, np.rint(gaps / near))
    good = np.abs(gaps - near * number) <= max(1.0, _WIDEST * near)
    return float(gaps[good].sum() / number[good].sum()) if good.any() else near


def _excess(gaps: FloatArray, period: float) -> FloatArray:
    """Return gaps less the nearest whole number, at least one, of periods."""
    excess: FloatArray = gaps - period * np.maximum(1.0, np.rint(gaps / period))
    return excess


def _chance(period: float, width: float, longest: int) -> float:
    """Return how many gaps of independent changes would fit the pattern (geometric law)."""
    gaps = np.arange(1.0, max(longest, 20.0 * period) + 1.0)
    law = np.power(1.0 - 1.0 / period, gaps - 1.0) / period
    return float(law[np.abs(_excess(gaps, period)) <= width + 1e-9].sum())


def _divergence(share: float, chance: float) -> float:
    """Return the Kullback-Leibler divergence of two Bernoulli laws, nats; 0 when not above."""
    if chance >= share:
        return 0.0
    return (share * math.log(share / max(chance, 1e-12))
            + (1.0 - share) * math.log((1.0 - share) / (1.0 - chance)))


def _several_sizes(sizes: FloatArray) -> bool:
    """Whether a tenth of the steps are of another size than the commonest."""
    ordered = np.sort(sizes)
    # A new size begins where the next step is larger by more than rounding.
    begins = np.flatnonzero(np.diff(ordered) > _SAME * ordered[1:]) + 1
    counts = np.diff(np.concatenate(([0], begins, [ordered.size])))
    return bool(counts.max() <= (1.0 - _SIZES) * ordered.size)


class Repeats:
    """
    Drops repeats from a stream, in batches of any size; `period`: samples per refresh.

    A refresh may happen to give the value of the one before: in a run that is longer than a period
    it is put where it belongs, so that dropping repeats does not select changes.  It is passed on
    when half a period after it has been seen.
    """

    def __init__(self) -> None:
        self.period = 1.0
        self.forget()

    def forget(self) -> None:
        """Take the next sample as the first one; the period stays known."""
        self._waiting = np.empty((3, 0))
        self._value = math.nan
        self._place = 0
        self._last = -math.inf

    def drop(self, batch: Batch) -> Batch | None:
        """Return the refreshes among samples; None when there are none."""
        u = np.full(batch.t.size, NAN) if batch.u is None else batch.u
        columns = np.concatenate([self._waiting, np.stack([batch.t, batch.y, u])], axis=1)
        t, y, u = columns[:, self._fresh(columns)]
        if not t.size:
            return None
        steps = np.diff(t, prepend=self._last)
        self._last = float(t[-1])
        # The first sample of all follows nothing: no pause lies before it.
        rest = steps if steps[0] < math.inf or t.size == 1 else steps[1:]
        return Batch(t, y, None if batch.u is None else u, float(steps.min()),
                     float(rest.max()), batch.restart)

    def _fresh(self, columns: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which samples are refreshes; those not known yet are kept waiting."""
        y = columns[1]
        n = y.size
        starts = np.concatenate(([0], np.flatnonzero(y[1:] != y[:-1]) + 1))
        begins = starts.copy()
        if y[0] == self._value:
            # The first run began before these samples.
            begins[0] = -self._place
        sizes = np.diff(np.append(starts, n))
        place = np.arange(n) - np.repeat(begins, sizes)
        length = np.repeat(np.diff(np.append(begins, n)), sizes)
        number = np.rint(place / self.period)
        due = np.rint(number * self.period) == place
        sure = (number == 0.0) | (length >= (number + 0.5) * self.period)
        last = int(starts[-1])
        unsure = np.flatnonzero(due[last:] & ~sure[last:])
        known = last + int(unsure[0]) if unsure.size else n
        fresh: npt.NDArray[np.bool_] = due & sure
        fresh[known:] = False
        self._value = float(y[-1])
        self._place = int(place[-1]) + 1 - (n - known)
        self._waiting = columns[:, known:].copy()
        return fresh


def whole(columns: FloatArray) -> Batch | None:
    """Return a window as one batch; None when it is empty (columns in s)."""
    t, y, u = columns[:3]
    if not t.size:
        return None
    steps = np.diff(t) if t.size > 1 else np.array([math.inf])
    return Batch(t, y, None if np.isnan(u).all() else u, float(steps.min()),
                 float(steps.max()), restart=False)


def refreshes(t: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return a series where its source was read, and samples per reading (t in s)."""
    period = refresh_period(y) if y.size > 1 else 1.0
    batch = whole(np.stack([t, y, np.full(t.size, NAN)]))
    if period > 1.0 and batch is not None:
        repeats = Repeats()
        repeats.period = period
        batch = repeats.drop(batch)
    if period > 1.0 and batch is not None:
        return batch.t, batch.y, period
    return t, y, 1.0


# Raw samples looked at.
TAIL = 1024
# Fewest samples from which anything is told.
_ENOUGH = 64
# A lattice needs this many different steps, all whole multiples of one, and
# at most this many codes: fewer distinct steps are chance, more are a fine ADC.
_FEWEST_STEPS = 3
# Share of samples that change, of those next to each other, below which the
# ADC is coarse.
_TIED = 0.9
# Share of samples at the extreme from which the ADC range counts as left, and
# how many times more often than the code beside it.
_CLIPPED_SHARE = 0.01
_CLIPPED_EXCESS = 3.0


@dataclass(frozen=True)
class Quality:
    """
    Findings about raw samples.

    Attributes
    ----------
    step : float
        ADC step, V; 0 when the values lie on no lattice.
    held : float
        Samples per refresh of a source that repeats its last value; 1: none.
    saturated : bool
        Whether samples pile up at an extreme.
    rms_increment : float
        Root mean square of the steps between fresh samples, V.

    """

    step: float = 0.0
    held: float = 1.0
    saturated: bool = False
    rms_increment: float = math.nan


def examine(y: FloatArray, known: float = 1.0) -> Quality:
    """Return what the raw samples show (y in V)."""
    if y.size < _ENOUGH:
        return Quality(held=known)
    steps = np.diff(y)
    changes = np.flatnonzero(steps)
    if changes.size < _FEWEST_STEPS:
        return Quality(held=known)
    sizes = np.abs(steps[changes])
    held = refresh_period(y, known)
    fresh = sizes if held > 1.0 else steps
    # Where many neighbours are equal, a few different steps are a lattice, too.
    tied = held == 1.0 and changes.size < _TIED * steps.size
    return Quality(lattice(sizes, 1 if tied else _FEWEST_STEPS), held, _piles_up(y, held),
                   float(np.sqrt(np.mean(fresh * fresh))))


def lattice(sizes: FloatArray, fewest: int = _FEWEST_STEPS) -> float:
    """
    Return the common step of increments, V; 0 when there is none.

    Float32 values of a lattice miss it by their rounding, which is allowed
    for; a lattice finer than a thousandth of the largest step is not told.
    """
    ordered = np.unique(sizes)
    least = float(ordered[0])
    # Rounding splits one step into several: join what is within 1e-3 of the least.
    near = ordered[ordered < 1.001 * least]
    unit = float(near.mean())
    multiples = np.rint(ordered / unit)
    if multiples[-1] > 1000.0 or np.unique(multiples).size < fewest:
        return 0.0
    unit = float((ordered @ multiples) / (multiples @ multiples))
    return unit if bool((np.abs(ordered - multiples * unit) < 0.02 * unit).all()) else 0.0


def _piles_up(y: FloatArray, held: float) -> bool:
    """Whether one extreme is far more common than the value next to it."""
    values, counts = np.unique(y, return_counts=True)
    if values.size < _FEWEST_STEPS:
        return False
    least = max(10.0 * held, _CLIPPED_SHARE * y.size)
    for edge, beside in ((0, 1), (-1, -2)):
        if counts[edge] >= least and counts[edge] > _CLIPPED_EXCESS * counts[beside]:
            return True
    return False


# What alpha is high by, in 1/T (see above).
_HIGH_BY = 1.5
# Relaxation times in the window from which alpha is known to a quarter (doc/estimation.md).
GOOD_RELAXATIONS = 25.0
# Standard error of ln(alpha), before it is widened, beyond which alpha is not known to a factor.
_BURIED = 0.5
# ... provided that noise, and not the length of the window, is the cause: the
# error is this many times that without noise.
_BURIED_BY = 2.0
# In short windows ln(alpha) has wider tails than its information says: its
# standard error grows by 1 + 1.5/x + 70/x^2, x = alpha T, which brings the
# coverage of 95 % intervals to 94 % at x = 12; doc/estimation.md.
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
    # Fewer than a thousandth are as good as none.
    relaxations = max(fit.alpha * duration, 1e-3)
    wider = 1.0 + (_WIDER + _MUCH_WIDER / relaxations) / relaxations
    near = math.exp(-0.5 * math.pow(min(fit.noise_score / _NEAR, 1e3), 2))
    return (_root(fit.log_var[0]) * wider, _root(fit.log_var[1]) * math.sqrt(1.0 - 0.32 * near),
            _root(fit.log_var[2]) * wider)


def _root(variance: float) -> float:
    """Return a standard error; infinite where the information is singular."""
    return math.sqrt(variance) if variance >= 0.0 else math.inf


def judge(fit: Fitted, measured: Mapping[str, Any], quality: Quality, throttle_std: float,
          smoothness: float) -> Estimate:
    """Return the published estimate; `measured`: its fields that need no fit."""
    flags = input_flags(measured['counters'], quality, throttle_std)
    if fit.trend:
        flags.append(Flag.TREND)
    moves = bool(fit.beta.size > 1) and throttle_std > MIN_THROTTLE_STD
    level, sag = _level(fit, measured['throttle'], moves)
    noise = math.sqrt(max(fit.noise_var, 0.0))
    known = {**measured, 'u0': level, 'sag': sag, 'noise_std': noise}
    if fit.outcome is Outcome.UNCORRELATED:
        return Estimate(status=Status.NO_RELAXATION, flags=tuple(flags), **known)
    duration = measured['duration']
    se = log_errors(fit, duration)
    if fit.alpha_step > 1.0:
        flags.append(Flag.SLOW_RATE)
    if math.isfinite(smoothness) and smoothness > max(
            _SMOOTH, _SMOOTH_SCORE / math.sqrt(fit.n)):
        flags.append(Flag.LOWPASS_UPSTREAM)
    known.update(sigma=fit.sigma, sigma_se=se[1])
    relaxations = fit.alpha * duration - _HIGH_BY
    if fit.outcome is Outcome.UNBOUND or relaxations < 0.5:
        return Estimate(status=Status.UNBOUND, flags=tuple(flags), **known)
    if fit.log_var[0] > max(_BURIED ** 2, _BURIED_BY ** 2 * 2.0 / relaxations):
        return Estimate(status=Status.BURIED, flags=tuple(flags), **known)
    # A short window often looks longer than it is: one standard error is granted.
    surely = relaxations * math.exp(-se[0])
    alpha = fit.alpha - _HIGH_BY / duration
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
    return replace(estimate, counters=counters, flags=flags)


def _level(fit: Fitted, throttle: float, moves: bool) -> tuple[float, float]:
    """Return the mean at the present throttle, V, and its slope, V per unit throttle."""
    if not moves or math.isnan(throttle):
        return float(fit.level[0]), NAN
    shift = (load_at(throttle) - fit.level[1:5]) @ fit.beta[:4]
    return float(fit.level[0] + shift), slope_at(throttle, fit.beta)


def load_at(throttle: float) -> FloatArray:
    """Return the load variables of a throttle that has long been steady."""
    return np.array([throttle, throttle * throttle, throttle, throttle])


def slope_at(throttle: float, beta: FloatArray) -> float:
    """Return d(mean)/d(throttle), V per unit throttle, at a steady throttle."""
    return float(beta[0] + 2.0 * throttle * beta[1] + beta[2] + beta[3])
