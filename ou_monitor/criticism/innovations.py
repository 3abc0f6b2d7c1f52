"""
One-step innovations of an OU in white noise, and what their spectrum shows of another pole.

Both verbs whiten by `ou_monitor.model.innovations.Filter`: `analyze` what level and load leave of
a load level by the OU and the white noise found there, `discover` a whole recording by all terms
of its model.

Under the right model the innovations are independent and standard normal, and the ordinates of
their periodogram independent and exponential.  A second OU, slower or faster by a known factor,
lifts them in a known pattern; what the fit can absorb of it (alpha, sigma, white noise) is
projected out of the pattern, and what is left is compared with the ordinates.  Near the model
this score test is the most powerful one, where lags of innovations see nothing: a wander ten
times slower is correlated over hundreds of them.  An AC-coupled instrument takes out what a
second OU of the rate of its corner would add,

    S r^2 / (w^2 + r^2) = (S - S_r) a^2 r^2 / (a^2 - r^2) up to factors,  S = 1 / (a^2 + w^2),

so the same score with the other sign is the test of it.

Limits: `FACTORS` only, each alone; a corner at the rate of the OU itself bends nothing that the
fit does not absorb; straight drifts are taken out; samples of the spectrum count as even.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model.innovations import Filter, StateSpace
from ou_monitor.records import FloatArray, NAN
from scipy import stats
from scipy.signal import periodogram

# Probability that tests of what is as modelled reject: those of all levels of a recording
# together in `analyze`, those of a whole recording in `discover`.  One in a hundred, as for lines.
FAMILY_WISE = 0.01
# Least variance of a second relaxation that is of consequence, over Var_inf.
LEAST_SHARE = 0.1
# Rates of the other pole that are looked for, in those of the first.
FACTORS = (1.0 / 30.0, 1.0 / 10.0, 1.0 / 3.0, 3.0, 10.0)
# Fewer ordinates than this are not tested; shorter segments give none.
_FEWEST, _SHORTEST = 64, 64
# Steps that differ by less than this share count as alike.
ALIKE = 0.3
# White noise that stands for none, as a share of what a step adds.
_NO_NOISE = 1e-6


@dataclass(frozen=True)
class OtherPole:
    """What the spectrum of innovations shows of a pole beside the fitted one."""

    # Probability that noise looks as much like a second relaxation; NaN without enough samples.
    second_p: float = NAN
    second_share: float = NAN  # Its variance, over Var_inf
    coupling_p: float = NAN  # Probability that noise looks as much like an AC-coupled instrument


def steps_before(t: FloatArray) -> FloatArray:
    """Return the time before each sample, s; infinite before the first."""
    step = np.diff(t, prepend=-np.inf)
    usual = float(np.median(step[1:]))
    # A step a little off moves a prediction by much less than its error, and an even
    # spacing saves most of the time.
    step[np.abs(step - usual) < ALIKE * usual] = usual
    return step


def ou_filter(t: FloatArray, alpha: float, var_inf: float, noise_var: float,
              first: float = NAN) -> Filter:
    """
    Return the filter of a sampled OU in white noise.

    t in s; first is the variance of the OU at the first sample, V^2, of itself Var_inf.
    """
    dt = steps_before(t)[1:]
    q = np.append(var_inf if math.isnan(first) else first,
                  -var_inf * np.expm1(-2.0 * alpha * dt))
    f = np.append(0.0, np.exp(-alpha * dt))
    r = np.full(t.size, max(noise_var, _NO_NOISE * float(q.min())))
    return Filter(StateSpace(f[:, None, None], q[:, None, None], np.ones(1), r))


def innovations(t: FloatArray, deviation: FloatArray, alpha: float, var_inf: float,
                noise_var: float) -> FloatArray:
    """
    Return the standardised one-step innovations of a sampled OU in white noise.

    t in s, deviation in V.
    """
    if deviation.size < 2 or not math.isfinite(alpha):
        return deviation / math.sqrt(var_inf + noise_var)
    run = ou_filter(t, alpha, var_inf, noise_var)
    return np.asarray(run.innovations(deviation) / np.sqrt(run.variance))


def join(parts: Sequence[FloatArray]) -> FloatArray:
    """Return the parts one after the other; empty for none."""
    return np.concatenate(parts) if parts else np.zeros(0)


def other_pole(parts: Sequence[FloatArray], rate: float, alpha: float, var_inf: float,
               noise_var: float, above: float = 0.0) -> OtherPole:
    """Test innovations for a second relaxation and for an AC coupling (rate, above in Hz)."""
    # The first innovation of a part has no past, and the trend is that of the rest.
    both = [periodogram(part, rate, detrend='linear') for part in parts if part.size >= _SHORTEST]
    # The ordinates at 0 and at half the rate are of another law.
    frequency = join([f[1:-1] if f[-1] == 0.5 * rate else f[1:] for f, _ in both])
    power = join([p[1:-1] if f[-1] == 0.5 * rate else p[1:] for f, p in both])
    frequency, power = frequency[frequency > above], power[frequency > above]
    if frequency.size < _FEWEST:
        return OtherPole()
    power = power / power.mean() - 1.0
    omega = 2.0 * np.pi * frequency / rate
    step = alpha / rate
    fitted = var_inf * _shape(omega, step) + noise_var
    # What the fit absorbs: a factor of all, a change of alpha, a change of the white noise.
    nudge = 1e-3
    slope = (_shape(omega, step * (1.0 + nudge)) - _shape(omega, step * (1.0 - nudge))) / nudge
    absorbed = np.linalg.qr(np.column_stack((
        np.ones(omega.size), var_inf * slope / fitted, 1.0 / fitted)))[0]
    more, share, less = 1.0, NAN, 1.0
    for factor in FACTORS:
        pattern = var_inf * _shape(omega, factor * step) / fitted
        full = float(pattern @ pattern)
        pattern = pattern - absorbed @ (absorbed.T @ pattern)
        left = float(pattern @ pattern)
        if not left > 1e-6 * full:
            continue
        score = float(pattern @ power)
        # A weighted sum of exponentials is skewed as few of them carry it.
        law = stats.pearson3(2.0 * float(np.sum(pattern ** 3)) / left ** 1.5)
        p = float(law.sf(score / math.sqrt(left)))
        if p < more:
            more, share = p, score / left
        if factor < 1.0:
            less = min(less, float(law.cdf(score / math.sqrt(left))))
    slower = sum(factor < 1.0 for factor in FACTORS)
    return OtherPole(min(1.0, len(FACTORS) * more), share, min(1.0, slower * less))


def _shape(omega: FloatArray, step: float) -> FloatArray:
    """Return the spectrum of a sampled OU of variance 1; `step` is alpha times the step."""
    phi = math.exp(-step)
    found: FloatArray = -math.expm1(-2.0 * step) / (1.0 - 2.0 * phi * np.cos(omega) + phi * phi)
    return found
