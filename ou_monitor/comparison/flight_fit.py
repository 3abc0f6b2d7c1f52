"""
The fit of a flight's model: the load where it predicts, then the noise of what is left.

Limits first: four parts are left out one after the other, so a flight that changes for good after
the part fitted is not foreseen; what has memory is one OU, whatever made it.
"""

from __future__ import annotations

from collections.abc import Callable
import math

import numpy as np
from ou_monitor.comparison.flight_model import FlightModel, Readings
from ou_monitor.model.load_fit import fit_load, LoadFit
from ou_monitor.model.load_noise import fit_noise_law
from ou_monitor.model.residual_ou import fit_residual_ou, innovations, SLOW_TIME
from ou_monitor.records import FloatArray

# Parts of what is fitted that are left out in turn.
_PARTS = 4
# Throttle that moves less than this says nothing.
MOVES = 0.01
# Readings that a fit of the load looks at: means of neighbours beyond it.
_MOST = 40_000
# Models drawn for the error of a mean.
_DRAWN = 16


def fit_flight(samples: Readings, progress: Callable[[float], None] | None = None) -> FlightModel:
    """Fit a model to samples: at least 100, over more than some seconds."""
    report = progress or (lambda share: None)
    mean = float(samples.voltage.mean())
    lsb = samples.lsb
    candidates = _loads(samples)
    best: tuple[float, FloatArray | None, list[tuple[LoadFit, slice, FloatArray]]] = (
        _sum_of_squares(_left_out_means(samples)), None, [])
    total = float(np.sum((samples.voltage - mean) ** 2))
    load = None
    for k, current in enumerate(candidates):
        parts = []
        whole = _fit(samples, current, None)
        for j, part in enumerate(_parts(samples)):
            fit = _fit(samples, current, part, whole)
            errors = samples.voltage[part] - _path(samples, fit, current)[part]
            parts.append((fit, part, errors))
            report((k + (j + 1.0) / (_PARTS + 1.0)) / (len(candidates) + 0.3))
        found = _sum_of_squares([errors for _, _, errors in parts])
        if found < best[0]:
            best, load = (found, current, parts), whole
    path = np.full(samples.t.size, mean) if load is None else _path(samples, load, best[1])
    slow = 0.0 if load is None else load.slow_std ** 2
    left = samples.voltage - path
    dt = samples.spacing
    ou = fit_residual_ou(left, dt, slow)
    errors, state = innovations(left, dt, ou, slow)
    throttle = np.zeros(samples.t.size) if samples.throttle is None else samples.throttle
    noise = fit_noise_law(samples.t, errors, throttle, state + lsb * lsb / 12.0)
    duration = float(samples.t[-1] - samples.t[0])
    level_var = (ou.white * dt + 2.0 * ou.variance * ou.tau) / duration
    report(1.0)
    return FlightModel(load, mean, math.sqrt(level_var),
                       1.0 if load is None else _spread(samples, best[2]), noise, ou, dt,
                       1.0 - best[0] / total if total > 0.0 else 0.0)


def _loads(samples: Readings) -> list[FloatArray | None]:
    """Return the loads to try: throttle (None) and current; none where throttle stands still."""
    if samples.throttle is None or not np.ptp(samples.throttle) >= MOVES:
        return []
    current = samples.current
    moves = current is not None and np.isfinite(current).all() and bool(np.ptp(current) > 0.0)
    return [None, current] if moves else [None]


def _parts(samples: Readings) -> list[slice]:
    edges = np.linspace(0, samples.t.size, _PARTS + 1).astype(int)
    return [slice(int(a), int(b)) for a, b in zip(edges, edges[1:])]


def _left_out_means(samples: Readings) -> list[FloatArray]:
    """Return the errors of each part, V, about the mean of the others."""
    total, n = float(samples.voltage.sum()), samples.t.size
    errors = []
    for part in _parts(samples):
        own = samples.voltage[part]
        errors.append(own - (total - float(own.sum())) / (n - own.size))
    return errors


def _sum_of_squares(errors: list[FloatArray]) -> float:
    return float(sum(float(e @ e) for e in errors))


def _fit(samples: Readings, current: FloatArray | None, without: slice | None,
         near: LoadFit | None = None) -> LoadFit:
    """Fit the load, to means of neighbours where there are very many."""
    width = -(-samples.t.size // _MOST)
    n = samples.t.size // width * width

    def mean(x: FloatArray | None) -> FloatArray | None:
        return None if x is None else x[:n].reshape(-1, width).mean(axis=1)

    left_out = None if without is None else (
        float(samples.t[without.start]), float(samples.t[without.stop - 1]))
    t, v, u = mean(samples.t), mean(samples.voltage), mean(samples.throttle)
    if t is None or v is None or u is None:
        raise ValueError('a fit of the load needs throttle')
    return fit_load(t, v, u, mean(current), left_out, near)


def _path(samples: Readings, fit: LoadFit, current: FloatArray | None) -> FloatArray:
    if samples.throttle is None:
        raise ValueError('a fit of the load needs throttle')
    return fit.model.path(samples.t, samples.throttle, current)


def _spread(samples: Readings, parts: list[tuple[LoadFit, slice, FloatArray]]) -> float:
    """Return how much larger the squared mean errors of parts left out are than foreseen."""
    rng = np.random.default_rng(0)
    ratios = []
    for fit, part, errors in parts:
        if samples.throttle is None:
            continue
        means = [fit.draw(rng).path(samples.t, samples.throttle, samples.current)[part].mean()
                 for _ in range(_DRAWN)]
        # The mean of an OU over so many relaxation times.
        times = float(samples.t[part.stop - 1] - samples.t[part.start]) / SLOW_TIME
        slow = fit.slow_std ** 2 * 2.0 / times * (1.0 + math.expm1(-times) / times)
        ratios.append(float(errors.mean()) ** 2 / (float(np.var(means, ddof=1)) + slow))
    return max(1.0, float(np.mean(ratios)))
