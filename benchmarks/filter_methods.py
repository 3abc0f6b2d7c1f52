"""
The filters that are compared: ours, fixed cutoffs in hindsight, Betaflight's curve.

Many cutoffs at once are run by an implementation of its own, vectorized over
them; `agrees` holds it against the package.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

from filter_signals import BODY, Case, Flights, RATE, SPREAD
import numpy as np
from ou_monitor import AdaptiveLowPass, SlidingEstimator

# Seconds between estimates, and those at the beginning that are not scored.
EVERY, SETTLE = 0.05, 3.0
_ROOT2 = math.sqrt(2.0)


def estimates(flights: Flights, window: float) -> np.ndarray:
    """Return sigma, its error, alpha, u0 and its error at each sample, shape (5, flights, n)."""
    count, n = flights.voltage.shape
    block = int(EVERY * RATE)
    out = np.full((5, count, n), np.nan)
    for f in range(count):
        estimator = SlidingEstimator(window=window)
        for at in range(0, n, block):
            piece = slice(at, at + block)
            estimator.push(flights.t[piece], flights.voltage[f, piece],
                           flights.throttle[f, piece])
            e = estimator.estimate()
            if e.usable:
                # Known from the next sample on.
                out[:, f, at + block:at + 2 * block] = np.array(
                    [e.sigma, e.sigma_se, e.alpha, e.u0, e.u0_se])[:, None]
    return out


def adaptive(options: Mapping[str, Any], flights: Flights, seen: np.ndarray,
             x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return output and cutoff of the package's filter, shape (flights, n) each."""
    out, cutoff = np.empty(x.shape), np.empty(x.shape)
    for f in range(x.shape[0]):
        one = AdaptiveLowPass(**options)
        sigma, error, alpha, level, level_se = (s[f].tolist() for s in seen)
        rows = zip(flights.t.tolist(), x[f].tolist(), sigma, error, alpha,
                   flights.throttle[f].tolist(), level, level_se)
        for k, row in enumerate(rows):
            out[f, k] = one.step(*row)
            cutoff[f, k] = one.cutoff
    return out, cutoff


def sweep(x: np.ndarray, cutoff: np.ndarray, order: int, derivative: bool = False,
          ) -> np.ndarray:
    """
    Filter with given cutoffs, exactly for an input that is linear between samples.

    Parameters
    ----------
    x : ndarray, shape (flights, n)
        Signal.
    cutoff : ndarray, shape (candidates, flights, n) or (candidates, 1, 1)
        Hz.
    order : {1, 2}
        Order.
    derivative : bool
        Whether the filtered derivative comes out.

    Returns
    -------
    ndarray, shape (candidates, flights, n)
        Output.

    """
    count, n = x.shape
    shape = (cutoff.shape[0], count)
    out = np.empty((*shape, n))
    y = np.zeros(shape) if derivative else np.broadcast_to(x[:, 0], shape).copy()
    slope = np.zeros(shape)
    out[:, :, 0] = y
    fixed = cutoff.shape[2] == 1
    parts = _parts(cutoff[:, :, 0], order) if fixed else ()
    for k in range(1, n):
        if not fixed:
            parts = _parts(cutoff[:, :, k], order)
        a, b, c, d, e, g = parts
        if derivative:
            now = (x[:, k] - x[:, k - 1]) * RATE
            off, rise = y - now, 0.0
        else:
            now = x[:, k]
            off, rise = y - x[:, k - 1], x[:, k] - x[:, k - 1]
        y = now + a * off + b * slope + c * rise
        slope = d * slope + e * off + g * rise
        out[:, :, k] = y
    return out


def _parts(cutoff: np.ndarray, order: int) -> tuple[np.ndarray, ...]:
    """Return the coefficients of a step."""
    angle = 2.0 * math.pi * np.minimum(cutoff, 0.45 * RATE) / RATE
    zero = np.zeros_like(angle)
    if order == 1:
        lost = np.expm1(-angle)
        return 1.0 + lost, zero, lost / angle, zero, zero, zero
    p = angle / _ROOT2
    s, c = np.exp(-p) * np.sin(p), np.exp(-p) * np.cos(p)
    return (c + s, _ROOT2 * s, (c - 1.0) / p, c - s, -_ROOT2 * s, -(c - 1.0 + s) / angle)


def agrees(case: Case, flights: Flights) -> float:
    """Return the largest difference of the sweep to the package at one cutoff."""
    x, off = flights.measured[:1, :3000], []
    for mode in ('lowpass', 'derivative'):
        ours = AdaptiveLowPass(order=case.order, fmin=1.0, fmax=30.0, fallback=20.0, mode=mode)
        y = np.array([ours.step(t, v, math.nan)
                      for t, v in zip(flights.t.tolist(), x[0].tolist())])
        theirs = sweep(x, np.full((1, 1, 1), 20.0), case.order, mode == 'derivative')[0, 0]
        off.append(float(np.abs(theirs - y).max() / np.abs(y).max()))
    return max(off)


def error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the mean square error of each flight behind `SETTLE`."""
    first = int(SETTLE * RATE)
    found: np.ndarray = np.mean((estimate[..., first:] - truth[..., first:])**2, axis=-1)
    return found


def lag_ms(output: np.ndarray, truth: np.ndarray) -> float:
    """Return the delay of the output behind the truth by their cross-correlation, ms."""
    first = int(SETTLE * RATE)
    lags = []
    for y, s in zip(output[:, first:], truth[:, first:]):
        size = 1 << (2 * y.size - 1).bit_length()
        both = np.fft.irfft(np.fft.rfft(y - y.mean(), size)
                            * np.conj(np.fft.rfft(s - s.mean(), size)), size)
        around = np.concatenate((both[-300:], both[:300]))
        k = int(np.argmax(around[1:-1])) + 1
        a, b, c = around[k - 1:k + 2]
        lags.append(k - 300 + 0.5 * (a - c) / (a - 2.0 * b + c))
    return float(np.mean(lags)) * 1e3 / RATE


def laws(case: Case) -> dict[str, list[dict[str, Any]]]:
    """
    Return the options of each law for a case.

    The first of a list is what one would set who knows the case; the others
    are tried with it in hindsight.
    """
    fmin, fmax = case.limits
    base = {'order': case.order, 'fmin': fmin, 'fmax': fmax, 'alpha': case.alpha,
            'n0': case.white**2 / RATE}
    wiener = {**base, 'law': 'wiener'}
    constant = {**base, 'law': 'constant_noise'}
    if case.kind == 'voltage':
        middle = SPREAD * math.sqrt(2.0 * case.alpha)
        return {'kalman': [{**base, 'law': 'kalman'}], 'wiener': [wiener], 'constant_noise': [
            {**constant, 'sigma_ref': share * middle} for share in (0.5, 0.25, 1.0)]}
    wiener |= {'signal_rms': BODY, 'coupling': case.coupling,
               'signal_poles': 2 if case.kind == 'smooth' else 1}
    constant |= {'coupling': case.coupling}
    return {
        'kalman': [{**base, 'law': 'kalman', 'coupling': case.coupling}],
        'wiener': [{**wiener, 'signal_bandwidth': share * case.bandwidth}
                   for share in (1.0, 0.5, 0.25, 0.1, 0.03)],
        'constant_noise': [{**constant, 'noise_wanted': share * BODY}
                           for share in (0.2, 0.1, 0.3, 0.4, 0.6)]}


def mistaken(case: Case) -> dict[str, dict[str, Any]]:
    """Return the options of `kalman` with each of what it is told wrong by a factor of 2."""
    right = laws(case)['kalman'][0]
    found = {}
    for name in ('n0', 'coupling'):
        for factor, word in ((0.5, 'half'), (2.0, 'twice')):
            # The gyro's own noise is next to nothing beside the supply's.
            if right.get(name) and not (name == 'n0' and case.kind != 'voltage'):
                found[f'kalman, {name} {word} the true one'] = {
                    **right, name: factor * right[name]}
    return found


def threshold(case: Case, best: float) -> dict[str, Any]:
    """Return the paper's switch at the sigma of half throttle, an octave to both sides."""
    return {'order': case.order, 'law': 'threshold',
            'fmin': max(0.5 * best, case.limits[0]), 'fmax': min(2.0 * best, 450.0),
            'sigma_ref': SPREAD * math.sqrt(2.0 * case.alpha)}


def curve(throttle: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Return Betaflight's curve from `low` to twice that, expo 5, shape (candidates, ...)."""
    share = throttle + 0.5 * throttle * (1.0 - throttle)
    found: np.ndarray = low[:, None, None] * (1.0 + share[None])
    return found
