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
from ou_monitor.errors import InputError
from ou_monitor.model.arma import theta_at
from ou_monitor.model.load import lowpass
from ou_monitor.model.load_fit import fit_load, LoadFit, LoadInput, SLOW_TIME
from ou_monitor.model.ou import simulate
from ou_monitor.model.ou_fit import (
    fit_pieces, load_signs, NoiseSize, stretches, usual_walk, white_variance)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.reading import Quantization
from ou_monitor.records import FloatArray, Recording
from scipy.signal import lfilter
from scipy.special import softmax

# Errors are drawn from the readings of the nearest noise sizes: share of all readings, and minimum
# number, on either side; difference of ln(size) up to which sizes count as equal.
_ALIKE, _FEWEST, _ROUNDING = 0.02, 50, 1e-9
# Time constant below which changes of a path may be damped, s (0.02 or the best of 0.01 to 0.64:
# the same verdicts on gecko, roma, hiro, erle, nazgul, bf3s, cf_takeoff, cf_pair, frc_ol_1, euc_1,
# hebi_x, js_11t, as_f60, px_tg1, mm_bench_1, xt_pico, regbot_28, regbot_81 and bags/flight).
_FAST_TIME = 0.02
# Number of parts that are held out in turn.
_PARTS = 4
# Minimum range of throttle; if it moves less, it is not used.
MOVES = 0.01
# Minimum advantage in log evidence of the more complex of two loads, nats: odds of e to 1.
_CLEAR = 1.0


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


def fit_noise(samples: Recording, left: FloatArray, load: FloatArray | None, slow: float
              ) -> FlightNoise:
    """Fit the noise to residuals, V, under a load (slow: variance of the slow process, V^2)."""
    dt, rounding = float(np.median(np.diff(samples.t))), find_step(samples.voltage) ** 2 / 12.0
    left = left - left.mean()
    steps = float(np.mean(np.diff(left) ** 2))
    ou = fit_pieces([(left[part], np.ones(part.stop - part.start))
                     for part in stretches(samples.t)], dt, usual_walk(samples.voltage))
    # The slow process and the rounding by the ADC are simulated separately.
    phi, theta = _colour(dt / SLOW_TIME, slow, 0.5 * steps)
    errors = lfilter([1.0, -phi], [1.0, -theta], left)
    alpha, variance = (ou.alpha, ou.var_inf) if ou.status == 'ok' else (1.0, 0.0)
    phi, theta = _colour(alpha * dt, variance, white_variance(ou, steps, dt) - rounding)
    errors = lfilter([1.0, -phi], [1.0, -theta], errors)
    signs = load_signs(left.size, dt, load)
    sizes = NoiseSize(signs)
    sizes.fit(errors)
    size = sizes.of(signs)
    order = np.argsort(size, kind='stable')
    rounding *= 1.0 + (phi - theta) ** 2 / (1.0 - theta ** 2)
    share = np.maximum(0.0, 1.0 - rounding / np.maximum(size * size, 1e-300))
    return FlightNoise(sizes, np.log(size[order]), (errors * np.sqrt(share))[order],
                       phi, theta, dt)


def _colour(step: float, variance: float, white: float) -> tuple[float, float]:
    """Return the coefficients of a filter from errors to an OU (step: alpha dt) in white noise."""
    return (math.exp(-step), theta_at(step, 1, 0.5 * max(0.0, white) / (variance * step))
            ) if variance > 0.0 else (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class FlightModel:
    """Load model, slow process, OU and white noise, as fitted to a part of a recording."""

    # A level alone, or the load model with either kind of level; their probabilities, the larger
    # first.
    fits: tuple[LoadFit, ...]
    odds: FloatArray
    damping: float  # Share of the fast changes of the load's path that is missing, 0..1
    sag_error: float  # Relative error of the sag, from held-out parts
    noise: FlightNoise  # The residual
    until: float  # End of the fitted part, s

    @property
    def names(self) -> list[str]:
        """Return the names of its terms, as in a model file."""
        fit = self.fits[0]
        return ['ou', *(['load_sag', 'load_transient'] * (fit.load is not LoadInput.NONE)),
                *(['drift'] * fit.falls), 'measurement_noise',
                *(['load_dependent_noise'] * self.noise.sizes.follows)]

    def path(self, samples: Recording) -> FloatArray:
        """Return the mean voltage, V."""
        path = _mean_path(self.fits, self.odds, samples)
        return path - self.damping * _fast(path, samples.t)

    def simulator(self, samples: Recording) -> Callable[[np.random.Generator], FloatArray]:
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
            return np.asarray(level + resized - self.damping * _fast(resized, t) + slow
                              + self.noise.draw(t.size, load, rng))

        return draw


def _load(kind: LoadInput, samples: Recording) -> FloatArray | None:
    if kind is LoadInput.CURRENT:
        return samples.current
    return samples.throttle if samples.has_throttle else None


def _mean_path(fits: tuple[LoadFit, ...], odds: FloatArray, samples: Recording) -> FloatArray:
    load = _load(fits[0].load, samples)
    return np.asarray(odds @ np.array([fit.path(samples.t, load) for fit in fits]))


def file_simulator(model: SupplyModel, samples: Recording
                   ) -> Callable[[np.random.Generator], FloatArray]:
    """Return a function that draws a voltage, V, of a model, without repeats and ADC steps."""
    full, needs = model.full_current, model.needs_throttle
    load = _load(LoadInput.CURRENT if full else LoadInput.THROTTLE, samples)
    if needs and load is None:
        raise InputError(f"the model's term '{needs[0]}' needs "
                         f'{"a current" if full else "throttle"}, and the recording has none')
    analogue = SupplyModel(tuple(
        term for term in model.terms if term.NAME not in ('held_samples', Quantization.NAME)))
    load = load if load is None else load / (full or 1.0)
    return lambda rng: analogue.simulate(samples.t, rng, load)


def fit_flight(samples: Recording) -> FlightModel:
    """Fit a model to samples: at least 100, over several seconds."""
    fits, odds = _best(samples)
    best, n = fits[0], samples.n
    load = _load(best.load, samples)
    held_out = []
    for j in range(_PARTS if best.load is not LoadInput.NONE else 0):
        part = slice(j * n // _PARTS, (j + 1) * n // _PARTS)
        path = _fit(samples, best.load, best.falls, part).path(samples.t, load)
        held_out.append((path[part], samples.voltage[part]))
    path = _mean_path(fits, odds, samples)
    share = damping(samples, path)
    left = samples.voltage - path + share * _fast(path, samples.t)
    return FlightModel(fits, odds, share, _sag_error(held_out), fit_noise(
        samples, left, load, best.slow_std ** 2), float(samples.t[-1]))


def _fit(samples: Recording, load: LoadInput, falls: bool, left_out: slice = slice(0)) -> LoadFit:
    return fit_load(load, samples.t, samples.voltage, _load(load, samples), falls=falls,
                    left_out=left_out)


def _best(samples: Recording) -> tuple[tuple[LoadFit, ...], FloatArray]:
    """Return the fits of the best load, with both kinds of level, and their probabilities."""
    # The simpler comes first: no load, throttle, current.
    fits: tuple[LoadFit, ...] = (_fit(samples, LoadInput.NONE, falls=False),)
    for load, x, least in ((LoadInput.THROTTLE, samples.throttle, MOVES),
                           (LoadInput.CURRENT, samples.current, 1e-300)):
        if x is not None and np.ptp(x) >= least:
            pair = sorted((_fit(samples, load, falls) for falls in (False, True)),
                          key=lambda fit: -fit.evidence)
            fits = tuple(pair) if pair[0].evidence > fits[0].evidence + _CLEAR else fits
    return fits, softmax([fit.evidence for fit in fits])


def damping(samples: Recording, path: FloatArray) -> float:
    """Return the share of a path's fast changes, V, that the voltage lacks, by least squares."""
    # Throttle jitters, is not synchronous with the voltage, and is not a current; without damping,
    # its fast changes would count twice, in the path and in the noise.
    fast = _fast(path, samples.t)
    share = float((path - samples.voltage) @ fast) / max(float(fast @ fast), 1e-300)
    return min(1.0, max(0.0, share))


def _fast(path: FloatArray, t: FloatArray) -> FloatArray:
    return path - lowpass(path, t, _FAST_TIME)


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
