"""One level, several segments: fit each with the onboard estimator, then pool."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.online.estimator.estimator import SlidingEstimator
from ou_monitor.records import Estimate, Flag, FloatArray, NAN, Recording, Status
from scipy import stats

# Standard error of ln(alpha) beyond which a segment has no say.
_MAX_SE = 1.0
_LOG_NAMES = ('alpha', 'sigma', 'var_inf')


def fit_stretch(recording: Recording, start: int, stop: int) -> Estimate:
    """Fit one stretch of samples with the estimator that flies."""
    t = recording.t[start:stop]
    # A hair longer than the stretch, so that rounding loses no sample.
    estimator = SlidingEstimator(window=1.001 * float(t[-1] - t[0]) + 1e-6)
    throttle = recording.throttle[start:stop]
    known = bool(np.isfinite(throttle).any())
    estimator.push(t, recording.voltage[start:stop], throttle if known else None)
    return estimator.estimate()


def pool(estimates: Sequence[Estimate]) -> tuple[Estimate, float]:
    """
    Combine the estimates of segments that share one set of parameters.

    The logarithms of alpha, sigma and Var_inf are averaged with the duration
    of each segment as weight.  That is the inverse variance when the segments
    do share their parameters; weights from each segment's own standard error
    would favour the segments whose alpha came out high by chance.
    """
    if not estimates:
        raise ValueError('nothing to pool: no estimates')
    if len(estimates) == 1:
        return estimates[0], 1.0
    sorted_out = [_doubted(e) for e in estimates]
    good = [e for e in sorted_out if e.usable]
    if sum(e.duration for e in good) < 0.5 * sum(e.duration for e in sorted_out) or not good:
        return _majority(sorted_out), 1.0
    if len(good) == 1:
        return good[0], 1.0
    weight = np.array([e.duration for e in good])
    weight /= weight.sum()
    values: dict[str, float] = {}
    scatter = 1.0
    for name in _LOG_NAMES:
        logs = np.log([getattr(e, name) for e in good])
        se = np.array([getattr(e, name + '_se') for e in good])
        mean = float(weight @ logs)
        values[name] = math.exp(mean)
        values[name + '_se'] = float(np.sqrt(weight ** 2 @ se ** 2))
        chi2 = float(np.sum(((logs - mean) / se) ** 2))
        scatter = max(scatter, math.sqrt(chi2 / (len(good) - 1)))
    n = sum(e.n for e in good)
    duration = float(sum(e.duration for e in good))
    flags = tuple(f for f in Flag if any(f in e.flags for e in good))
    long_enough = any(e.status is Status.OK for e in good)
    return Estimate(
        t=good[-1].t, alpha=values['alpha'], sigma=values['sigma'], var_inf=values['var_inf'],
        u0=float(weight @ [e.u0 for e in good]), noise_std=_rms([e.noise_std for e in good]),
        alpha_se=scatter * values['alpha_se'], sigma_se=scatter * values['sigma_se'],
        var_inf_se=scatter * values['var_inf_se'], u0_se=_mean_se(weight, good),
        throttle=good[-1].throttle,
        status=Status.OK if long_enough else Status.SHORT_WINDOW,
        flags=flags, n=n, duration=duration,
        rate=float(np.median([e.rate for e in good]))), scatter


def disagreement(estimates: Sequence[Estimate]) -> float:
    """
    Test whether segments share one set of parameters.

    chi^2 of the logarithms of alpha, sigma and Var_inf about their weighted means, each of the
    three against its own standard errors; the error of alpha is carried over to the common alpha,
    for a segment whose alpha came out low shows too small a one.
    """
    good = [e for e in map(_doubted, estimates) if e.usable]
    if len(good) < 2:
        return NAN
    least = 1.0
    for name in _LOG_NAMES:
        logs = np.log([getattr(e, name) for e in good])
        own = np.array([getattr(e, name + '_se') for e in good])
        alphas = np.log([e.alpha for e in good])
        se = own
        for _ in range(20):
            weight = 1.0 / se ** 2
            common = float(weight @ alphas / weight.sum())
            # A relative error goes with 1/sqrt(alpha T) for alpha and Var_inf.
            se = own * (np.exp(0.5 * (alphas - common)) if name != 'sigma' else 1.0)
        weight = 1.0 / se ** 2
        chi2 = float(weight @ (logs - float(weight @ logs / weight.sum())) ** 2)
        least = min(least, float(stats.chi2.sf(chi2, len(good) - 1)))
    return min(1.0, len(_LOG_NAMES) * least)


def _doubted(e: Estimate) -> Estimate:
    """Return the estimate without its numbers when they say nothing of alpha."""
    if not e.usable or e.alpha_se <= _MAX_SE:
        return e
    status = Status.NO_RELAXATION if e.alpha > e.rate else Status.TOO_SHORT
    return Estimate(t=e.t, status=status, u0=e.u0, throttle=e.throttle, flags=e.flags, n=e.n,
                    duration=e.duration, rate=e.rate, counters=e.counters)


def _majority(estimates: Sequence[Estimate]) -> Estimate:
    """Return the longest of the unusable estimates whose status held longest."""
    bad = [e for e in estimates if not e.usable]
    time: dict[Status, float] = {}
    for e in bad:
        time[e.status] = time.get(e.status, 0.0) + e.duration
    most = max(time, key=lambda status: time[status])
    return max((e for e in bad if e.status is most), key=lambda e: (e.duration, e.n))


def _rms(values: Sequence[float]) -> float:
    known = [v for v in values if math.isfinite(v)]
    return math.sqrt(sum(v * v for v in known) / len(known)) if known else NAN


def _mean_se(weight: FloatArray, good: Sequence[Estimate]) -> float:
    return float(np.sqrt(weight ** 2 @ np.array([e.u0_se for e in good]) ** 2))
