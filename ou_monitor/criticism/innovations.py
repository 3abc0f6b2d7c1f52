"""
One-step innovations of an OU in white noise, and a test of their spectrum for a second one.

Under the right model the innovations are independent and standard normal, and the ordinates of
their periodogram are independent and exponential.

A second OU, slower or faster by a known factor, raises the ordinates in a known pattern.  The part
of the pattern that the fit absorbs (alpha, sigma, white noise) is projected out, and the rest is
compared with the ordinates.  For small deviations this score test is the most powerful one;
correlations at single lags would miss a second OU ten times slower, which is correlated over
hundreds of samples.

Limits: only the rates in `FACTORS`, one at a time; linear drifts are removed; samples are treated
as evenly spaced.
"""

from __future__ import annotations

from collections.abc import Sequence
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
# Relative difference up to which steps count as equal.
ALIKE = 0.3
# Minimum measurement noise, as a share of the variance of a step: keeps the filter nonsingular.
NO_NOISE = 1e-6


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
    r = np.full(t.size, max(noise_var, NO_NOISE * float(q.min())))
    run = Filter(StateSpace(f[:, None, None], q[:, None, None], np.ones(1), r))
    return np.asarray(run.innovations(deviation) / np.sqrt(run.variance))


def join(parts: Sequence[FloatArray]) -> FloatArray:
    """Concatenate parts; empty if there are none."""
    return np.concatenate(parts) if parts else np.zeros(0)


def second_relaxation(parts: Sequence[FloatArray], rate: float, alpha: float, var_inf: float,
                      noise_var: float, above: float = 0.0) -> tuple[float, float]:
    """Test innovations (rate, above in Hz); return p-value and share of Var_inf, NaN if few."""
    both = [periodogram(part, rate, detrend='linear') for part in parts if part.size >= _SHORTEST]
    # The ordinates at 0 and at half the rate have a different distribution.
    frequency = join([f[1:-1] if f[-1] == 0.5 * rate else f[1:] for f, _ in both])
    power = join([p[1:-1] if f[-1] == 0.5 * rate else p[1:] for f, p in both])
    frequency, power = frequency[frequency > above], power[frequency > above]
    if frequency.size < _FEWEST:
        return NAN, NAN
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
    more, share = 1.0, NAN
    for factor in FACTORS:
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
    return min(1.0, len(FACTORS) * more), share


def sampled_spectrum(omega: FloatArray, step: float) -> FloatArray:
    """Return the spectrum of a sampled OU of variance 1 (step: alpha times the time step)."""
    phi = math.exp(-step)
    found: FloatArray = -math.expm1(-2.0 * step) / (1.0 - 2.0 * phi * np.cos(omega) + phi * phi)
    return found
