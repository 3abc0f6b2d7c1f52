"""Dips below a low level and the fall under load, in the samples and in a model of them."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.analysis.noise import dip_begins
from ou_monitor.criticism.adc import find_step
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.finding import LoadFall, LowDips
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.reading import Quantization
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import FloatArray, NAN

# Level of the dips, in standard deviations below the mean: start, step and end of the search, and
# the minimum number of dips.
_DEEP, _LOWER, _SHALLOW, _OFTEN = 2.5, 0.25, 0.5, 10
# Significant digits of a level: minimum, and maximum as printed by `:g`.
_DIGITS = (4, 6)
# Simulations of each model.
_DRAWS = 8
# Quantiles of the load between which a fall is measured.
_FLOWN = (0.01, 0.99)
# Maximum time between a dip and its predicted minimum, s.
_NEAR = 0.05


def low_dips(samples: Samples, rise: FloatArray, baseline: Sequence[Term],
             extended: Sequence[Term], rng: np.random.Generator) -> LowDips:
    """Count dips below a low level in the samples and in simulations (rise: hysteresis, V)."""
    level, t = dip_level(samples.logged, rise), samples.t
    begins = dip_begins(samples.logged, level, rise)
    minutes = float(t[-1] - t[0]) / 60.0
    rates = []
    for terms in (baseline, extended):
        try:
            # Simulate without the ADC: the model does not know the offset of its codes, and below
            # a level halfway between codes, a voltage dips as often as its readings.
            model = SupplyModel(tuple(term for term in terms if term.NAME != Quantization.NAME))
            found = [dip_begins(model.simulate(t, rng, samples.throttle), level, rise).size
                     / minutes for _ in range(_DRAWS)]
        except ValueError:
            found = [NAN, NAN]
        rates.append((float(np.mean(found)), float(np.std(found, ddof=1)) / math.sqrt(len(found))))
    responses = _responses(samples, extended)
    # Poisson error, at least the error of one dip.
    return LowDips(level, int(begins.size),
                   _made(samples, _path(samples, [
                       term for term in responses if term.NEEDS_THROTTLE]), level, begins)
                   if responses else None,
                   begins.size / minutes, rates[0][0], rates[1][0],
                   math.sqrt(max(begins.size, 1.0)) / minutes, rates[0][1], rates[1][1])


def dip_level(v: FloatArray, rise: FloatArray) -> float:
    """Return a low level below which there are enough dips, V."""
    mean, spread = float(v.mean()), float(v.std())
    depth = _DEEP
    while depth > _SHALLOW and dip_begins(v, mean - depth * spread, rise).size < _OFTEN:
        depth -= _LOWER
    level = mean - depth * spread
    below, above = v[v < level], v[v >= level]
    if not (below.size and above.size):
        return level
    # Halfway between ADC codes, so that rounding changes no dip, in as few digits as possible.
    low, high = float(below.max()), float(above.min())
    middle = 0.5 * (low + high)
    rounded = [float(f'{middle:.{digits}g}') for digits in range(_DIGITS[0], _DIGITS[1] + 1)]
    return next((one for one in rounded if abs(one - middle) < 0.25 * (high - low)), rounded[-1])


def load_fall(samples: Samples, terms: Sequence[Term]) -> LoadFall:
    """Compare the fall under load with the model's."""
    u, v, responses = samples.throttle, samples.logged, _responses(samples, terms)
    if u is None or not responses:
        return LoadFall()
    low, high = np.quantile(u, _FLOWN).tolist()
    mean, ends = _path(samples, responses), (u <= low, u >= high)
    measured, explained = (float(np.median(y[ends[0]]) - np.median(y[ends[1]]))
                           for y in (v, mean))
    # Stays at a load are independent, their readings are not; both medians are rounded to codes.
    stays = [1 + int((end[1:] & ~end[:-1])[1:].sum()) for end in ends]
    error = math.hypot(float(np.std(v - mean)) * math.sqrt(sum(1.0 / count for count in stays)),
                       find_step(v) / math.sqrt(6.0))
    return LoadFall(low, high, measured, explained, error)


def _responses(samples: Samples, terms: Sequence[Term]) -> list[Term]:
    """Return the responses of the mean to measured inputs; empty if none is to the load."""
    found = [term for term in terms if term.ROLE is Role.MEAN and term.MEASURED]
    known = samples.throttle is not None and any(term.NEEDS_THROTTLE for term in found)
    return found if known else []


def _path(samples: Samples, responses: Sequence[Term]) -> FloatArray:
    """Return the effect of load and time on the mean, V."""
    s = samples.segment(1.0, 0.0)
    path = np.zeros(samples.n)
    for term in responses:
        path += term.columns(s) @ np.array(term.linear_values())
    return path


def _made(samples: Samples, path: FloatArray, level: float, begins: npt.NDArray[np.intp]) -> int:
    """Return the number of dips that would not have happened at the lowest load."""
    v, t, made = samples.logged, samples.t, 0
    assert samples.throttle is not None
    idle = float(np.median(path[samples.throttle <= np.quantile(samples.throttle, _FLOWN[0])]))
    for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), v.size]):
        bottom = begin + int(np.argmin(v[begin:end]))
        first, last = np.searchsorted(t, [t[bottom] - _NEAR, t[bottom] + _NEAR])
        made += float(v[bottom]) + idle - float(path[first:last + 1].min()) >= level
    return made
