"""
A model of one flight, fitted to a part of it, that can be drawn over any throttle.

Fitted first is the load where it predicts, then the noise of what is left.

Limits: four parts are left out one after the other, so a flight that changes for good after
the part fitted is not foreseen; what has memory is one OU, whatever made it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from typing import Protocol

import numpy as np
from ou_monitor.criticism.adc import find_step
from ou_monitor.model.load import lowpass
from ou_monitor.model.load_fit import fit_load, level_evidence, LoadFit
from ou_monitor.model.residual import (
    fit_noise_law, fit_residual_ou, innovations, NoiseLaw, ResidualOU, SLOW_TIME)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.reading import Quantization
from ou_monitor.records import FloatArray
from scipy.signal import lfilter


@dataclass(frozen=True, eq=False)
class Readings:
    """What a comparison is about: each reading of the ADC once."""

    # Stamps, s, and readings, V; shape (n,).
    t: FloatArray
    voltage: FloatArray
    # 0..1, and A; None where not recorded; shape (n,).
    throttle: FloatArray | None
    current: FloatArray | None = None

    def part(self, which: slice) -> Readings:
        """Return some of the samples."""
        def of(x: FloatArray | None) -> FloatArray | None:
            return None if x is None else x[which]

        return Readings(self.t[which], self.voltage[which], of(self.throttle), of(self.current))

    @property
    def spacing(self) -> float:
        """Return the usual time from one sample to the next, s."""
        return float(np.median(np.diff(self.t)))

    @property
    def lsb(self) -> float:
        """Return the step of the ADC, V; 0 where none is seen."""
        return find_step(self.voltage)


class Drawn(Protocol):
    """What can be simulated over the stamps, throttle and current of a recording."""

    @property
    def names(self) -> list[str]:
        """Return the names of its terms."""

    @property
    def alone(self) -> bool:
        """Return whether it tells its own level, so that none is taken from the recording."""

    def draw(self, samples: Readings, rng: np.random.Generator) -> FloatArray:
        """Return one simulated voltage, V, before the ADC."""


@dataclass(frozen=True)
class Damping:
    """
    How much of the fast changes of a path the voltage does not follow.

    Throttle jitters, arrives at other moments than the voltage, and is no current: what is fast in
    the path is partly not in the voltage, and would be counted twice, in the path and as noise.
    """

    share: float = 0.0  # Share of the fast part that is missing, 0..1
    time: float = 0.02  # What is faster than this time constant, s

    def of(self, path: FloatArray, t: FloatArray) -> FloatArray:
        """Return a path, V, at stamps, s, damped."""
        if not self.share > 0.0:
            return path
        return np.asarray(path - self.share * (path - lowpass(path, t, self.time)))


@dataclass(frozen=True, eq=False)
class FlightModel:
    """Load model, slow process, OU and white noise, as fitted to a part of a recording."""

    load: LoadFit | None  # The answer to the load; None where the level is all there is
    # Level, V, without a load model, and its standard error.
    level: float
    level_se: float
    damping: Damping  # Of its path
    # Factor on the variance of the slow process: how much farther parts that were left out lay
    # from their prediction than the fit says.
    spread: float
    sag_error: float  # Relative error of the sag, as parts that were left out show it
    noise: NoiseLaw  # White noise
    ou: ResidualOU  # What has memory in the residuals
    until: float  # End of the part fitted, s

    @property
    def names(self) -> list[str]:
        """Return the names of its terms, as in a model file."""
        found = ['ou']
        if self.load is not None:
            found += ['load_sag', 'load_transient',
                      *(['drift'] if math.isnan(self.load.model.stands) else [])]
        follows = self.noise.limits[0] < self.noise.limits[1]
        return [*found, 'measurement_noise', *(['load_dependent_noise'] if follows else [])]

    @property
    def alone(self) -> bool:
        """Return that it tells its own level."""
        return True

    def path(self, samples: Readings) -> FloatArray:
        """Return the mean voltage, V."""
        if self.load is None:
            return np.full(samples.t.size, self.level)
        return self.damping.of(
            self.load.model.path(samples.t, samples.throttle, samples.current), samples.t)

    def draw(self, samples: Readings, rng: np.random.Generator) -> FloatArray:
        """Return one simulated voltage, V; the errors of the parameters are drawn too."""
        n = samples.t.size
        throttle = np.zeros(n) if samples.throttle is None else samples.throttle
        slow = 0.0
        if self.load is None:
            voltage = np.full(n, self.level + self.level_se * rng.standard_normal())
        else:
            load = self.load.draw(rng)
            path = load.path(samples.t, samples.throttle, samples.current)
            size = load.size * math.exp(self.sag_error * float(rng.standard_normal()))
            other = replace(load, size=size).path(
                samples.t, samples.throttle, samples.current)
            # Over the part fitted the mean is known: a larger sag goes with a higher level.
            path = other - float((other - path)[samples.t <= self.until].mean())
            voltage = self.damping.of(path, samples.t)
            slow = self.spread * self.load.slow_std ** 2
        dt = np.diff(samples.t, prepend=samples.t[0])
        white, variance, tau = self.ou.draw(rng)
        for var, time in ((slow, SLOW_TIME), (variance, tau)):
            if var > 0.0:
                voltage = voltage + math.sqrt(var) * _ou(dt, time, rng)
        factor = math.sqrt(white / self.ou.white) if self.ou.white > 0.0 else 1.0
        return np.asarray(voltage + factor * self.noise.draw(samples.t, throttle, rng))


def _ou(dt: FloatArray, tau: float, rng: np.random.Generator) -> FloatArray:
    """Return an OU of variance 1; steps are taken as even, but for gaps."""
    usual = float(np.median(dt))
    keep = math.exp(-usual / tau)
    kicks = math.sqrt(1.0 - keep * keep) * rng.standard_normal(dt.size)
    begins = [0, *np.flatnonzero(dt > 3.0 * usual).tolist(), dt.size]
    out, state = np.empty(dt.size), float(rng.standard_normal())
    for first, last in zip(begins, begins[1:]):
        over = math.exp(-float(dt[first]) / tau) if first else 1.0
        state = over * state + math.sqrt(1.0 - over * over) * float(rng.standard_normal())
        kicks[first] = state
        out[first:last] = lfilter([1.0], [1.0, -keep], kicks[first:last])
        state = float(out[last - 1])
    return out


@dataclass(frozen=True, eq=False)
class FiledModel:
    """A model from a file, drawn at each reading of the ADC, so that none is held twice."""

    model: SupplyModel  # As in the file

    @property
    def names(self) -> list[str]:
        """Return the names of its terms."""
        return [term.NAME for term in self.model.terms]

    @property
    def alone(self) -> bool:
        """Return that its level is that of another day."""
        return False

    def draw(self, samples: Readings, rng: np.random.Generator) -> FloatArray:
        """Return one simulated voltage, V."""
        analogue = SupplyModel(tuple(
            term for term in self.model.terms
            if term.NAME not in ('held_samples', Quantization.NAME)))
        return analogue.simulate(samples.t, rng, samples.throttle)


# Parts of what is fitted that are left out in turn.
_PARTS = 4
# Throttle that moves less than this says nothing.
MOVES = 0.01
# Log evidence, nat, below which the simpler of two loads is taken: odds of less than e to 1.
_CLEAR = 1.0
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
    best = _best(samples, lambda share: report(0.4 * share))
    if best is not None:
        parts = []
        for j, part in enumerate(_parts(samples)):
            fit = _fit(samples, best.current, best.stands, part, best.fit)
            parts.append((fit, samples.voltage[part] - _path(samples, fit, best.current)[part]))
            report(0.4 + 0.5 * (j + 1.0) / _PARTS)
        best = replace(best, parts=tuple(parts))
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
        float(samples.t[-1]))


@dataclass(frozen=True, eq=False)
class _Load:
    """A load, its fit, and the fits without each part with their errors there, V."""

    fit: LoadFit
    current: FloatArray | None
    stands: bool
    parts: tuple[tuple[LoadFit, FloatArray], ...] = ()


def _best(samples: Readings, report: Callable[[float], None]) -> _Load | None:
    """Return the load, and the law of its level, with most evidence; None: no load has any."""
    found: _Load | None = None
    most = level_evidence(samples.t, samples.voltage)
    # The simpler ones first: throttle before current, a level that stands before a pack's.
    tried = [(current, stands) for current in _loads(samples) for stands in (True, False)]
    for k, (current, stands) in enumerate(tried):
        fit = _fit(samples, current, stands)
        if fit.evidence > most + _CLEAR:
            found, most = _Load(fit, current, stands), fit.evidence
        report((k + 1.0) / len(tried))
    return found


def _loads(samples: Readings) -> list[FloatArray | None]:
    """Return the loads to try that move: throttle (None), and current."""
    found: list[FloatArray | None] = []
    if samples.throttle is not None and np.ptp(samples.throttle) >= MOVES:
        found.append(None)
    if samples.current is not None and np.ptp(samples.current) > 0.0:
        found.append(samples.current)
    return found


def _parts(samples: Readings) -> list[slice]:
    edges = np.linspace(0, samples.t.size, _PARTS + 1).astype(int)
    return [slice(int(a), int(b)) for a, b in zip(edges, edges[1:])]


def _fit(samples: Readings, current: FloatArray | None, stands: bool,
         without: slice | None = None, near: LoadFit | None = None) -> LoadFit:
    """Fit the load, to means of neighbours where there are very many."""
    width = -(-samples.t.size // _MOST)
    n = samples.t.size // width * width

    def mean(x: FloatArray) -> FloatArray:
        return np.asarray(x[:n].reshape(-1, width).mean(axis=1), dtype=np.float64)

    left_out = None if without is None else (
        float(samples.t[without.start]), float(samples.t[without.stop - 1]))
    return fit_load(
        mean(samples.t), mean(samples.voltage),
        None if samples.throttle is None else mean(samples.throttle),
        None if current is None else mean(current), stands=stands, left_out=left_out, near=near)


def _path(samples: Readings, fit: LoadFit, current: FloatArray | None) -> FloatArray:
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
