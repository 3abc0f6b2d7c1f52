"""
A model of one flight, fitted to a part of it, that can be simulated over any throttle.

The load is fitted first, and kept if it has clearly more evidence than a level alone.  The
residual is an OU in white noise; the size of both follows the load and its changes (`NoiseSize`).

Limits: errors are estimated from four held-out parts, so a lasting change after the fitted part is
not covered; one OU describes all correlated noise; the sizes of OU and white noise follow the load
in the same way; readings are treated as evenly spaced.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.criticism.adc import find_step
from ou_monitor.model.arma import theta_at
from ou_monitor.model.innovations import Filter, StateSpace
from ou_monitor.model.load import lowpass
from ou_monitor.model.load_fit import fit_load, LoadFit, LoadInput, SLOW_TIME
from ou_monitor.model.ou import simulate
from ou_monitor.model.ou_fit import (
    fit_pieces, load_signs, NoiseSize, stretches, usual_walk, white_variance)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.reading import Quantization
from ou_monitor.records import FloatArray
from scipy.signal import lfilter
from scipy.special import softmax


@dataclass(frozen=True, eq=False)
class Readings:
    """The readings of a recording, without repeats."""

    # Stamps, s, and readings, V; shape (n,).
    t: FloatArray
    voltage: FloatArray
    # Throttle, 0..1, and current, A; None if not recorded; shape (n,).
    throttle: FloatArray | None
    current: FloatArray | None = None

    def part(self, which: slice) -> Readings:
        """Return some of the samples."""
        def of(x: FloatArray | None) -> FloatArray | None:
            return None if x is None else x[which]

        return Readings(self.t[which], self.voltage[which], of(self.throttle), of(self.current))

    @property
    def spacing(self) -> float:
        """Return the median step, s."""
        return float(np.median(np.diff(self.t)))

    @property
    def lsb(self) -> float:
        """Return the step of the ADC, V; 0 if none is found."""
        return find_step(self.voltage)


@dataclass(frozen=True)
class Damping:
    """The share of fast changes of a path that the voltage does not follow."""

    # Throttle jitters, is not synchronous with the voltage, and is not a current; without damping,
    # its fast changes would count twice, in the path and in the noise.
    share: float = 0.0  # Share of the fast part that is missing, 0..1
    time: float = 0.02  # Time constant below which changes are fast, s

    def of(self, path: FloatArray, t: FloatArray) -> FloatArray:
        """Return a path, V, at stamps, s, damped."""
        return np.asarray(path - self.share * (path - lowpass(path, t, self.time)))


# Errors are drawn from the readings of the nearest noise sizes: share of all readings, and minimum
# number, on either side; difference of ln(size) up to which sizes count as equal.
_ALIKE, _FEWEST, _ROUNDING = 0.02, 50, 1e-9
# Minimum share of white noise in the variance, which the filter needs.
_LEAST_WHITE = 1e-3


@dataclass(frozen=True, eq=False)
class FlightNoise:
    """An OU in white noise, as independent errors coloured by a filter."""

    sizes: NoiseSize  # Size of the errors over the load and its changes
    logs: FloatArray  # ln of the size, V, at the readings of the fit, increasing; shape (n,)
    errors: FloatArray  # Errors at these readings, V, for simulations to draw; shape (n,)
    # Autoregressive and moving-average coefficient of the filter; 0 if no OU is visible.
    phi: float
    theta: float
    spacing: float  # Step between readings, s

    def draw(self, n: int, load: FloatArray | None, rng: np.random.Generator) -> FloatArray:
        """Return n samples of noise, V, under a throttle or current."""
        wanted = np.log(self.sizes.of(load_signs(n, self.spacing, load)))
        # Draw a reading of the same noise size (within rounding), then one of its neighbours by
        # size; the number of neighbours is the same near the ends.
        first = np.searchsorted(self.logs, wanted - _ROUNDING, side='left')
        last = np.searchsorted(self.logs, wanted + _ROUNDING, side='right')
        at = first + (rng.random(wanted.size) * (last - first)).astype(np.int64)
        most = self.errors.size - 1
        reach = min(max(_FEWEST, int(_ALIKE * self.errors.size)), most // 2)
        near = np.clip(at, reach, most - reach) + rng.integers(-reach, reach + 1, at.size)
        # Errors are not scaled: an outlier at low noise would become a larger one at high noise.
        return np.asarray(lfilter([1.0, -self.theta], [1.0, -self.phi], self.errors[near]))

    def mean_error(self, duration: float) -> float:
        """Return the standard error of a mean over a duration, s, in V."""
        variance = float(np.mean(self.errors ** 2)) * self.spacing / duration
        return (1.0 - self.theta) / (1.0 - self.phi) * math.sqrt(variance)


def fit_noise(samples: Readings, left: FloatArray, load: FloatArray | None, slow: float
              ) -> FlightNoise:
    """Fit the noise to residuals, V, under a load (slow: variance of the slow process, V^2)."""
    dt, lsb = samples.spacing, samples.lsb
    left = left - left.mean()
    ou = fit_pieces([(left[part], np.ones(part.stop - part.start))
                     for part in stretches(samples.t)], dt, usual_walk(samples.voltage))
    alpha, variance = (ou.alpha, ou.var_inf) if ou.status == 'ok' else (1.0 / dt, 0.0)
    white = max(white_variance(ou, float(np.mean(np.diff(left) ** 2)), dt),
                _LEAST_WHITE * float(left @ left) / left.size, 1e-18)
    errors, predicted = _predicted(
        left, dt, white, {alpha: variance, 1.0 / SLOW_TIME: slow})
    # Rounding by the ADC is simulated separately.
    own, phi, theta = max(white - lsb * lsb / 12.0, _LEAST_WHITE * white), 0.0, 0.0
    if variance > 0.0:
        phi = math.exp(-alpha * dt)
        theta = theta_at(alpha * dt, 1, 0.5 * own / (variance * alpha * dt))
        own *= phi / theta
    signs = load_signs(left.size, dt, load)
    sizes = NoiseSize(signs)
    sizes.fit(errors)
    size = sizes.of(signs)
    order = np.argsort(size, kind='stable')
    other = max(0.0, predicted - own)
    share = np.maximum(0.0, 1.0 - other / np.maximum(size * size, 1e-300))
    return FlightNoise(sizes, np.log(size[order]), (errors * np.sqrt(share))[order],
                       phi, theta, dt)


def _predicted(x: FloatArray, dt: float, white: float, parts: dict[float, float]
               ) -> tuple[FloatArray, float]:
    """Return one-step errors, V, and their variance, V^2, for a sum of OUs (rate: variance)."""
    rates = np.array([rate for rate, variance in parts.items() if variance > 0.0])
    if not rates.size:
        return x, white
    variances = np.array([parts[rate] for rate in rates])
    # After `SLOW_TIME` the gain is constant.
    n = min(x.size, max(3, math.ceil(SLOW_TIME / dt)))
    keep = np.exp(-rates * dt)
    f, q = (np.tile(np.diag(row), (n, 1, 1)) for row in (keep, variances * (1.0 - keep ** 2)))
    q[0] = np.diag(variances)
    run = Filter(StateSpace(f, q, np.ones(rates.size), np.full(n, white)), x.size)
    return run.innovations(x), float(run.variance[-1])


@dataclass(frozen=True, eq=False)
class FlightModel:
    """Load model, slow process, OU and white noise, as fitted to a part of a recording."""

    # A level alone, or the load model with either kind of level; their probabilities, the larger
    # first.
    fits: tuple[LoadFit, ...]
    odds: FloatArray
    damping: Damping  # Damping of the load's path
    sag_error: float  # Relative error of the sag, from held-out parts
    noise: FlightNoise  # The residual
    until: float  # End of the fitted part, s

    @property
    def names(self) -> list[str]:
        """Return the names of its terms, as in a model file."""
        fit = self.fits[0]
        return ['ou', *(['load_sag', 'load_transient'] if fit.load is not LoadInput.NONE else []),
                *(['drift'] if fit.falls else []), 'measurement_noise',
                *(['load_dependent_noise'] if self.noise.sizes.follows else [])]

    def path(self, samples: Readings) -> FloatArray:
        """Return the mean voltage, V."""
        return self.damping.of(_mean_path(self.fits, self.odds, samples), samples.t)

    def simulator(self, samples: Readings) -> Callable[[np.random.Generator], FloatArray]:
        """Return a function that draws one simulated voltage, V, with errors of the parameters."""
        t, fitted = samples.t, samples.t <= self.until
        load = _load(self.fits[0].load, samples)
        rows = self.fits[0].regressors(t, load)

        def draw(rng: np.random.Generator) -> FloatArray:
            fit = self.fits[int(rng.random() >= self.odds[0])].draw(rng)
            path = fit.voltage(fit.values, rows)
            larger = fit.resized(math.exp(self.sag_error * rng.standard_normal()))
            resized = larger.voltage(larger.values, rows)
            # The mean over the fitted part is known, so with a larger sag the level is higher.
            level = float((path - resized)[fitted].mean()) + self.noise.mean_error(
                self.until) * rng.standard_normal()
            slow = simulate(t, 1.0 / SLOW_TIME, fit.slow_std * math.sqrt(2.0 / SLOW_TIME), rng)
            return np.asarray(level + self.damping.of(resized, t) + slow
                              + self.noise.draw(t.size, load, rng))

        return draw


def _load(kind: LoadInput, samples: Readings) -> FloatArray | None:
    return samples.current if kind is LoadInput.CURRENT else samples.throttle


def _mean_path(fits: tuple[LoadFit, ...], odds: FloatArray, samples: Readings) -> FloatArray:
    load = _load(fits[0].load, samples)
    return np.asarray(odds @ np.array([fit.path(samples.t, load) for fit in fits]))


def file_simulator(model: SupplyModel, samples: Readings
                   ) -> Callable[[np.random.Generator], FloatArray]:
    """Return a function that draws a voltage, V, of a model, without repeats and ADC steps."""
    analogue = SupplyModel(tuple(
        term for term in model.terms if term.NAME not in ('held_samples', Quantization.NAME)))
    full, load = model.full_current, samples.throttle
    if full:
        load = None if samples.current is None else samples.current / full
    return lambda rng: analogue.simulate(samples.t, rng, load)


# Number of parts that are held out in turn.
_PARTS = 4
# Minimum range of throttle; if it moves less, it is not used.
MOVES = 0.01
# Minimum advantage in log evidence of the more complex of two loads, nats: odds of e to 1.
_CLEAR = 1.0
# Time constants tried for the damping, s.
_FAST = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)


def fit_flight(samples: Readings) -> FlightModel:
    """Fit a model to samples: at least 100, over several seconds."""
    fits, odds = _best(samples)
    kind, n = fits[0].load, samples.t.size
    held_out = []
    for j in range(_PARTS if kind is not LoadInput.NONE else 0):
        part = slice(j * n // _PARTS, (j + 1) * n // _PARTS)
        fit = _fit(samples, kind, fits[0].falls, part)
        path = fit.path(samples.t, _load(kind, samples))
        held_out.append((path[part], samples.voltage[part]))
    path = _mean_path(fits, odds, samples)
    damped = damping(samples, path)
    noise = fit_noise(samples, samples.voltage - damped.of(path, samples.t),
                      _load(kind, samples), fits[0].slow_std ** 2)
    return FlightModel(fits, odds, damped, _sag_error(held_out), noise, float(samples.t[-1]))


def _fit(samples: Readings, load: LoadInput, falls: bool, left_out: slice = slice(0)) -> LoadFit:
    return fit_load(load, samples.t, samples.voltage, _load(load, samples), falls=falls,
                    left_out=left_out)


def _best(samples: Readings) -> tuple[tuple[LoadFit, ...], FloatArray]:
    """Return the fits of the best load, with both kinds of level, and their probabilities."""
    # The simpler comes first: no load, throttle, current.
    fits: tuple[LoadFit, ...] = (_fit(samples, LoadInput.NONE, falls=False),)
    odds = np.ones(1)
    most = fits[0].evidence
    for load, x, least in ((LoadInput.THROTTLE, samples.throttle, MOVES),
                           (LoadInput.CURRENT, samples.current, 1e-300)):
        if x is None or not np.ptp(x) >= least:
            continue
        pair = sorted((_fit(samples, load, falls) for falls in (False, True)),
                      key=lambda fit: -fit.evidence)
        evidence = np.array([fit.evidence for fit in pair])
        total = float(np.logaddexp(*evidence)) - math.log(2.0)
        if total > most + _CLEAR:
            fits, odds, most = tuple(pair), softmax(evidence), total
    return fits, odds


def damping(samples: Readings, path: FloatArray) -> Damping:
    """Return the damping of a path, V, by least squares."""
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


def _sag_error(held_out: list[tuple[FloatArray, FloatArray]]) -> float:
    """Return the relative error of a sag over a time as long as the fitted part."""
    # In each part, the voltage is regressed on the path, V, predicted from the other parts.
    # Temperature, wind and simplifications of the load model make the slope differ from 1.  Parts
    # in which the path moves more have more weight.
    squares = weights = 0.0
    for path, voltage in held_out:
        moved = path - path.mean()
        weight = float(moved @ moved)
        squares += float(moved @ (voltage - path)) ** 2 / max(weight, 1e-300)
        weights += weight
    # If parts scatter by s, one differs from the mean of three by s sqrt(1 + 1/3), and a mean of
    # four from another by s sqrt(1/4 + 1/4).
    return math.sqrt(3.0 / 8.0 * squares / max(weights, 1e-300))
