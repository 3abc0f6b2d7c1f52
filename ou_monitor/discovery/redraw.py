"""
Redraw readings that the ADC clips, or rounds to codes wider than the rail's moves.

Omitting clipped samples would truncate the distribution and bias every statistic of the rest.  So
a path of the rail is drawn given all readings, then each affected reading given the path.

Rounding errors of wide codes are neither normal nor white; modelled as white noise, they look like
heavy tails or switching.  Readings redrawn within their codes follow the model exactly if it is
right.  On average, a further cause gains at most as much from redrawn readings as from the
probability of the codes (Jensen's inequality).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import driven, white_noise
from ou_monitor.model.terms.reading import Saturation
from ou_monitor.model.terms.term import Term
from ou_monitor.records import FloatArray
from scipy.special import ndtr, ndtri

# Sweeps over clipped samples: a run of k of them is forgotten after about k^2 / 20 sweeps.
_SWEEPS = 200
# Maximum ADC step, in moves of the rail between readings, whose rounding counts as white noise.
# Rounding errors of neighbours correlate by exp(-2 (pi / step)^2): 11 % here, 73 % at 8.  In
# simulations, steps of 2.3 to 4 moves gave no false names (8 recordings each), and steps of 8.3
# gave false names in 9 of 20 recordings.
_COARSE = 3.0
# Grid across a code: points per move of the rail (with two, sums are exact to 1e-9), minimum and
# maximum points; margin beyond the code, in standard deviations of the white noise.
_EACH, _FEWEST, _MOST, _BEYOND = 2.0, 16, 128, 3.0
# Minimum probability, and minimum white noise in codes, which avoid 0/0.
_NONE, _LEAST = 1e-300, 1e-9


def _process(samples: Samples, terms: Sequence[Term]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return phi, variance of the noise in each step, V^2, and of the white noise, V^2."""
    s = driven(samples, terms)
    return s.phi, s.added, white_noise(samples, terms, s)


def redraw_clipped(samples: Samples, model: Composite, ends: Saturation,
                   clipped: npt.NDArray[np.bool_], rng: np.random.Generator) -> Samples:
    """Return samples whose clipped readings, shape (n,), are redrawn beyond the limits."""
    # Gibbs sampling: each clipped reading and each point of the path in turn is drawn given the
    # points beside it, even and odd ones alternately.
    phi, added, white = _process(samples, model.gaussian.terms)
    mean, v = model.gaussian.mean, samples.voltage
    top = samples.logged >= ends.high
    side = np.where(top, 1.0, -1.0)
    end = np.where(top, ends.high - 0.5 * samples.cell, ends.low + 0.5 * samples.cell) - mean
    # Weights of the neighbours, and variance of a point that they leave.
    before, after = phi / added, np.append(phi[1:] / added[1:], 0.0)
    variance = 1.0 / (1.0 / added + np.append(phi[1:], 0.0) * after)
    gain, spread = variance / (variance + white), np.sqrt(variance + white)
    y = v - mean
    # A point of the path on either side, which has no weight.
    path = np.pad(y, 1)
    for turn in range(2 * _SWEEPS):
        at = np.arange(turn % 2, samples.n, 2)
        near = variance[at] * (before[at] * path[at] + after[at] * path[at + 2])
        k = np.flatnonzero(clipped[at])
        j = at[k]
        least = side[j] * (end[j] - near[k]) / spread[j]
        share = np.maximum(ndtr(-least) * (1.0 - rng.random(k.size)), _NONE)
        y[j] = near[k] + side[j] * spread[j] * np.maximum(least, -ndtri(share))
        path[at + 1] = near + gain[at] * (y[at] - near) + np.sqrt(
            variance[at] * (1.0 - gain[at])) * rng.standard_normal(at.size)
    at = np.flatnonzero(clipped)
    return samples.redrawn(at, y[at] + mean[at])


def redraw_within_codes(samples: Samples, model: Composite, rng: np.random.Generator) -> Samples:
    """Return samples redrawn within their codes, or unchanged if rounding is white noise."""
    terms = [term for term in model.gaussian.terms if term.NAME != 'quantization']
    phi, added, white = _process(samples, terms)
    white -= samples.blur
    if samples.cell <= _COARSE * math.sqrt(float(np.median(added + white))):
        return samples
    mean, noise = model.gaussian.mean, np.sqrt(np.maximum(white, 0.0))
    low = samples.logged - 0.5 * samples.cell - mean
    x = _path_within(low, samples.cell, noise, phi, np.sqrt(added), rng)
    noise = np.maximum(noise, _LEAST * samples.cell)
    below, above = ndtr((low - x) / noise), ndtr((low + samples.cell - x) / noise)
    share = below + (above - below) * rng.random(samples.n)
    drawn = x + noise * ndtri(np.clip(share, _NONE, 1.0 - 1e-16))
    return replace(samples, voltage=mean + np.clip(drawn, low, low + samples.cell),
                   longer=samples.longer or samples, codes=samples.logged, cell=0.0)


def _path_within(low: FloatArray, cell: float, noise: FloatArray, phi: FloatArray,
                 move: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw a path of the OU, V, by forward filtering and backward sampling on a grid."""
    first, wide = low - _BEYOND * noise, cell + 2.0 * _BEYOND * noise
    count = int(np.clip(_EACH * float(np.median(wide)) / float(np.median(move)), _FEWEST, _MOST))
    places = (first[:, None] + wide[:, None] * ((np.arange(count) + 0.5) / count)) / move[:, None]
    least = np.maximum(noise, _LEAST * cell)[:, None]
    edge = (places * move[:, None] - low[:, None]) / least
    likely = np.maximum(ndtr(edge) - ndtr(edge - cell / least), _NONE)
    # Each sample's grid is in units of `move`; the first `move` is the stationary deviation.
    keep = phi[1:] * move[:-1] / move[1:]
    known = likely
    known[0] *= np.exp(-0.5 * np.square(places[0]))
    known[0] /= known[0].sum()
    for k, ratio in enumerate(keep.tolist(), 1):
        far = places[k][:, None] - ratio * places[k - 1]
        known[k] *= np.exp(-0.5 * far * far) @ known[k - 1] + _NONE
        known[k] /= known[k].sum()
    draws, jitter = rng.random(low.size), rng.random(low.size) - 0.5
    x = np.empty(low.size)
    weight = known[-1]
    for k in range(low.size - 1, -1, -1):
        total = np.cumsum(weight)
        at = min(int(np.searchsorted(total, draws[k] * total[-1])), count - 1)
        x[k] = places[k, at] * move[k] + wide[k] / count * jitter[k]
        if k:
            far = x[k] / move[k] - keep[k - 1] * places[k - 1]
            weight = known[k - 1] * np.exp(-0.5 * (far * far - np.min(far * far)))
    return x
