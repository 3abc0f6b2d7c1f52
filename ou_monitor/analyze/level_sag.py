"""
Sag at the load levels: how far the mean lies below that of the lowest throttle.

Weighted least squares of the segment means: a mean for each level, and a polynomial of time that
all levels share, for a battery discharges while it is flown.  The errors of the segment means
follow from the noise; where the segments scatter more than that about the fit, all errors are
widened.

Limits: slow recovery after a load is not in a polynomial; with one stay at each level the
polynomial and the levels cannot be told apart, and then no time is taken out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.analyze.levels import Segment
from ou_monitor.records import Estimate, FloatArray, NAN, Recording
from ou_monitor.text import Z95

# Highest power of time, and segments needed for each.
_DEGREE, _SEGMENTS = 3, 4


@dataclass(frozen=True)
class LevelSag:
    """
    Sag of one level.

    Attributes
    ----------
    sag, sag_se : float
        How far the mean lies below that of the lowest throttle, and its standard error, V.

    """

    sag: float = NAN
    sag_se: float = NAN

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval, V."""
        return self.sag - Z95 * self.sag_se, self.sag + Z95 * self.sag_se


def mean_variance(time: float, n: int, estimate: Estimate, rms: float) -> float:
    """
    Return the variance of the mean of a stretch of OU in white noise.

    time in s, rms in V, result in V^2.
    """
    if not estimate.usable:
        return rms * rms / max(n, 1)
    at = max(estimate.alpha * time, 1e-9)
    # Papoulis, Probability, Random Variables and Stochastic Processes, ch. 9.
    of_ou = 2.0 * estimate.var_inf * (at + math.expm1(-at)) / (at * at)
    noise = estimate.noise_std if estimate.noise_std > 0.0 else 0.0
    return of_ou + noise * noise / max(n, 1)


def level_sags(recording: Recording, throttles: Sequence[float],
               segments: Sequence[Sequence[Segment]], estimates: Sequence[Estimate],
               rms: Sequence[float]) -> tuple[LevelSag, ...]:
    """Return the sag of each level (rms in V)."""
    rows = [(k, s) for k, stays in enumerate(segments) for s in stays]
    flown = sorted({k for k, _ in rows})
    unknown = [LevelSag()] * len(throttles)
    if len(flown) < 2 or not all(rms[k] > 0.0 for k in flown):
        return tuple(unknown)
    t = recording.t
    y = np.array([recording.voltage[s.start:s.stop].mean() for _, s in rows])
    when = np.array([0.5 * (t[s.start] + t[s.stop - 1]) for _, s in rows])
    variance = np.array([mean_variance(float(t[s.stop - 1] - t[s.start]), s.stop - s.start,
                                       estimates[k], rms[k]) for k, s in rows])
    spare = len(rows) - len(flown)
    degree = min(_DEGREE, spare // _SEGMENTS)
    span = max(float(np.ptp(when)), 1e-9)
    age = (when - when.mean()) / span
    columns = [np.array([float(k == j) for k, _ in rows]) for j in flown]
    columns += [age ** power for power in range(1, degree + 1)]
    x = np.column_stack(columns) / np.sqrt(variance)[:, None]
    values, covariance, widen = _least_squares(x, y / np.sqrt(variance))
    for place, k in enumerate(flown):
        contrast = np.zeros(values.size)
        contrast[0] += 1.0
        contrast[place] -= 1.0
        error = math.sqrt(max(0.0, float(contrast @ covariance @ contrast)) * widen)
        unknown[k] = LevelSag(float(contrast @ values), error)
    return tuple(unknown)


def _least_squares(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return coefficients, covariance, and the factor by which the residuals widen it."""
    values = np.linalg.lstsq(x, y, rcond=None)[0]
    covariance = np.linalg.pinv(x.T @ x)
    freedom = y.size - values.size
    rest = y - x @ values
    widen = max(1.0, float(rest @ rest) / freedom) if freedom > 0 else 1.0
    return np.asarray(values), np.asarray(covariance), widen
