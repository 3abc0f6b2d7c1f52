"""
The fit of a flight's model: the load where it predicts, then the noise of what is left.

Limits first: four parts are left out one after the other, so a flight that changes for good after
the part fitted is not foreseen; what has memory is one OU, whatever made it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.comparison.flight_model import Damping, FlightModel, Readings
from ou_monitor.model.load import lowpass
from ou_monitor.model.load_fit import fit_load, LoadFit
from ou_monitor.model.residual import fit_noise_law, fit_residual_ou, innovations, SLOW_TIME
from ou_monitor.records import FloatArray

# Parts of what is fitted that are left out in turn.
_PARTS = 4
# Throttle that moves less than this says nothing.
MOVES = 0.01
# Readings that a fit of the load looks at: means of neighbours beyond it.
_MOST = 40_000
# Time constants below which changes of the path may be damped, s.
_FAST = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)
# Models drawn for the error of a mean.
_DRAWN = 16


def fit_flight(samples: Readings, progress: Callable[[float], None] | None = None) -> FlightModel:
    """Fit a model to samples: at least 100, over more than some seconds."""
    report = progress or (lambda share: None)
    mean, lsb = float(samples.voltage.mean()), samples.lsb
    total = float(np.sum((samples.voltage - mean) ** 2))
    candidates = _loads(samples)
    tried: list[_Load] = []
    for k, current in enumerate(candidates):
        whole, parts = _fit(samples, current, None), []
        for j, part in enumerate(_parts(samples)):
            fit = _fit(samples, current, part, whole)
            parts.append((fit, samples.voltage[part] - _path(samples, fit, current)[part]))
            report((k + (j + 2.0) / (_PARTS + 1.0)) / (len(candidates) + 0.3))
        tried.append(_Load(whole, current, tuple(parts)))
    level = _sum_of_squares(_left_out_means(samples))
    best = _better(tried)
    if best is not None and not best.left < level:
        best = None
    load = None if best is None else best.fit
    path = np.full(samples.t.size, mean) if best is None else _path(
        samples, best.fit, best.current)
    damped = Damping() if load is None else damping(samples, path)
    slow = 0.0 if load is None else load.slow_std ** 2
    left = samples.voltage - damped.of(path, samples.t)
    dt = samples.spacing
    ou = fit_residual_ou(left, dt, slow)
    errors, state = innovations(left, dt, ou, slow)
    throttle = np.zeros(samples.t.size) if samples.throttle is None else samples.throttle
    noise = fit_noise_law(samples.t, errors, throttle, state + lsb * lsb / 12.0)
    duration = float(samples.t[-1] - samples.t[0])
    level_var = (ou.white * dt + 2.0 * ou.variance * ou.tau) / duration
    report(1.0)
    spread, sag_error = (1.0, 0.0) if best is None else (
        _spread(samples, best), _sag_error(samples, best))
    return FlightModel(
        load, mean, math.sqrt(level_var), damped, spread, sag_error, noise, ou,
        float(samples.t[-1]), 1.0 - (level if best is None else best.left) / max(total, 1e-300))


@dataclass(frozen=True, eq=False)
class _Load:
    """A load, its fit, and the fits without each part with their errors there, V."""

    fit: LoadFit
    current: FloatArray | None
    parts: tuple[tuple[LoadFit, FloatArray], ...]

    @property
    def left(self) -> float:
        """Return the sum of squares of all parts, V^2."""
        return _sum_of_squares([errors for _, errors in self.parts])


def _better(tried: list[_Load]) -> _Load | None:
    """Return throttle, or current where that predicts better by more than a standard error."""
    if not tried:
        return None
    for other in tried[1:]:
        # Relative, so that the part that moves most does not decide alone.
        ratios = np.array([math.log(float(e @ e) / float(own @ own)) for (_, e), (_, own) in zip(
            other.parts, tried[0].parts)])
        if ratios.mean() < -float(ratios.std(ddof=1)) / math.sqrt(ratios.size):
            return other
    return tried[0]


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


def damping(samples: Readings, path: FloatArray) -> Damping:
    """Return what is missing of the fast changes of the path, V, by least squares."""
    left = samples.voltage - path
    best, most = Damping(), 0.0
    for time in _FAST:
        fast = path - lowpass(path, samples.t, time)
        square = float(fast @ fast)
        share = min(1.0, max(0.0, -float(left @ fast) / max(square, 1e-300)))
        saved = share * (-2.0 * float(left @ fast) - share * square)
        if saved > most:
            best, most = Damping(share, time), saved
    return best


def _sag_error(samples: Readings, load: _Load) -> float:
    """
    Return the relative error of the sag over a stretch as long as two of the parts.

    In each part left out, the voltage is so many times the predicted path; parts that move more
    count more.  Warmth, wind and what a motor law leaves out change it from part to part.
    """
    squares, weights = [], []
    for (fit, errors), part in zip(load.parts, _parts(samples)):
        path = _path(samples, fit, load.current)[part]
        moved = path - path.mean()
        weights.append(float(moved @ moved))
        squares.append((float(moved @ errors) / max(weights[-1], 1e-300)) ** 2)
    return math.sqrt(float(np.dot(squares, weights)) / max(sum(weights), 1e-300) / 2.0)


def _spread(samples: Readings, load: _Load) -> float:
    """Return how much larger the variance of slow errors is than the fit says."""
    if samples.throttle is None:
        return 1.0
    rng = np.random.default_rng(0)
    ratios = []
    for (fit, errors), part in zip(load.parts, _parts(samples)):
        means = [fit.draw(rng).path(samples.t, samples.throttle, load.current)[part].mean()
                 for _ in range(_DRAWN)]
        # The mean of an OU over so many relaxation times.
        times = float(samples.t[part.stop - 1] - samples.t[part.start]) / SLOW_TIME
        slow = fit.slow_std ** 2 * 2.0 / times * (1.0 + math.expm1(-times) / times)
        ratios.append((float(errors.mean()) ** 2 - float(np.var(means, ddof=1))) / slow)
    return max(1.0, float(np.mean(ratios)))
