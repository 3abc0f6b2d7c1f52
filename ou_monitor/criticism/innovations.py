"""
One-step innovations of an OU in white noise, and a test of their spectrum for another pole.

`analyze` applies the test to the residual of a load level, `discover` to a whole recording.

Under the right model the innovations are independent and standard normal, and the ordinates of
their periodogram are independent and exponential.

A second OU, slower or faster by a known factor, raises the ordinates in a known pattern.  The part
of the pattern that the fit absorbs (alpha, sigma, white noise) is projected out, and the rest is
compared with the ordinates.  For small deviations this score test is the most powerful one;
correlations at single lags would miss a second OU ten times slower, which is correlated over
hundreds of samples.

An AC-coupled instrument is a high-pass: the ordinates below its corner are too small.  Their sum
is tested by the gamma distribution, which is exact even for few ordinates, unlike the lower tail
of the score.  A detection requires that more than half of the power below the corner is missing,
because the regression of the mean removes some power, too.

Limits: only the rates in `FACTORS`, one at a time; a corner at the rate of the OU itself is
absorbed by the fit; linear drifts are removed; samples are treated as evenly spaced.
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

# Probability that any test rejects a right model: in `analyze`, over all levels of a recording; in
# `discover`, over the whole recording.  The same as for lines.
FAMILY_WISE = 0.01
# Minimum variance of a second relaxation that matters, as a share of Var_inf.
LEAST_SHARE = 0.1
# Tested rates of the other pole, relative to the rate of the first.
FACTORS = (1.0 / 30.0, 1.0 / 10.0, 1.0 / 3.0, 3.0, 10.0)
# Minimum ordinates of a test, and minimum samples of a segment.
_FEWEST, _SHORTEST = 64, 64
# A high-pass is considered only if the mean ordinate below its corner, minus 1, is less than this
# (a high-pass makes it -0.79).
_MISSING = -0.5
# Relative difference up to which steps count as equal.
ALIKE = 0.3
# Minimum measurement noise, as a share of the variance of a step: keeps the filter nonsingular.
_NO_NOISE = 1e-6


@dataclass(frozen=True)
class OtherPole:
    """Tests of the spectrum of innovations for another pole; NaN with too few samples."""

    second_p: float = NAN  # p-value of a second relaxation
    second_share: float = NAN  # Its variance, as a share of Var_inf
    coupling_p: float = NAN  # p-value of an AC-coupled instrument


def steps_before(t: FloatArray) -> FloatArray:
    """Return the time before each sample, s; infinite before the first."""
    step = np.diff(t, prepend=-np.inf)
    usual = float(np.median(step[1:]))
    # Set nearly equal steps equal: that changes predictions by much less than their error, and
    # saves most of the filter's time.
    step[np.abs(step - usual) < ALIKE * usual] = usual
    return step


def innovations(t: FloatArray, deviation: FloatArray, alpha: float, var_inf: float,
                noise_var: float) -> FloatArray:
    """Return the standardised one-step innovations of a sampled OU in white noise (s, V)."""
    if deviation.size < 2 or not math.isfinite(alpha):
        return deviation / math.sqrt(var_inf + noise_var)
    dt = steps_before(t)[1:]
    q = np.append(var_inf, -var_inf * np.expm1(-2.0 * alpha * dt))
    f = np.append(0.0, np.exp(-alpha * dt))
    r = np.full(t.size, max(noise_var, _NO_NOISE * float(q.min())))
    run = Filter(StateSpace(f[:, None, None], q[:, None, None], np.ones(1), r))
    return np.asarray(run.innovations(deviation) / np.sqrt(run.variance))


def join(parts: Sequence[FloatArray]) -> FloatArray:
    """Concatenate parts; empty if there are none."""
    return np.concatenate(parts) if parts else np.zeros(0)


def other_pole(parts: Sequence[FloatArray], rate: float, alpha: float, var_inf: float,
               noise_var: float, above: float = 0.0) -> OtherPole:
    """Test innovations for a second relaxation and for an AC coupling (rate, above in Hz)."""
    both = [periodogram(part, rate, detrend='linear') for part in parts if part.size >= _SHORTEST]
    # The ordinates at 0 and at half the rate have a different distribution.
    frequency = join([f[1:-1] if f[-1] == 0.5 * rate else f[1:] for f, _ in both])
    power = join([p[1:-1] if f[-1] == 0.5 * rate else p[1:] for f, p in both])
    # Removing the trend lowers the first ordinate, as a high-pass would.
    first = np.isin(frequency, [f[1] for f, _ in both])[frequency > above]
    frequency, power = frequency[frequency > above], power[frequency > above]
    if frequency.size < _FEWEST:
        return OtherPole()
    power = power / power.mean() - 1.0
    omega = 2.0 * np.pi * frequency / rate
    step = alpha / rate
    fitted = var_inf * sampled_spectrum(omega, step) + noise_var
    # The fit absorbs a common factor, a change of alpha and a change of the white noise.
    nudge = 1e-3
    slope = (sampled_spectrum(omega, step * (1.0 + nudge))
             - sampled_spectrum(omega, step * (1.0 - nudge))) / nudge
    absorbed = np.linalg.qr(np.column_stack((
        np.ones(omega.size), var_inf * slope / fitted, 1.0 / fitted)))[0]
    more, share, less = 1.0, NAN, 1.0
    for factor in FACTORS:
        slow = power[(omega < factor * step) & ~first]
        if factor < 1.0 and slow.sum() < _MISSING * slow.size:
            less = min(less, float(stats.gamma.cdf(slow.size + slow.sum(), slow.size)))
        pattern = var_inf * sampled_spectrum(omega, factor * step) / fitted
        full = float(pattern @ pattern)
        pattern = pattern - absorbed @ (absorbed.T @ pattern)
        left = float(pattern @ pattern)
        if not left > 1e-6 * full:
            continue
        score = float(pattern @ power)
        # A weighted sum of exponentials is skewed if few of them dominate.
        law = stats.pearson3(2.0 * float(np.sum(pattern ** 3)) / left ** 1.5)
        p = float(law.sf(score / math.sqrt(left)))
        if p < more:
            more, share = p, score / left
    slower = sum(factor < 1.0 for factor in FACTORS)
    return OtherPole(min(1.0, len(FACTORS) * more), share, min(1.0, slower * less))


def sampled_spectrum(omega: FloatArray, step: float) -> FloatArray:
    """Return the spectrum of a sampled OU of variance 1 (step: alpha times the time step)."""
    phi = math.exp(-step)
    found: FloatArray = -math.expm1(-2.0 * step) / (1.0 - 2.0 * phi * np.cos(omega) + phi * phi)
    return found
