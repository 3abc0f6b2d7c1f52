"""
Draw readings within their codes if steps of the ADC are wider than the moves of the rail.

Rounding errors are then neither normal nor white, and a likelihood that takes them for white noise
finds heavy tails and switching.  So a path of the rail is drawn given all codes, then each reading
given the path; if the model is right, these readings follow it exactly.  On average, a further
cause gains at most as much in the readings as in the probability of the codes (Jensen's
inequality).
"""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import driven, white_noise
from ou_monitor.records import FloatArray
from scipy.special import ndtr, ndtri

# Step of the ADC, in moves of the rail between readings, up to which rounding passes for white
# noise.  Rounding errors of neighbours correlate by exp(-2 (pi / step)^2): 11 % here, 73 % at 8.
# In simulations, steps of 2.3 to 4 moves gave no false name (8 recordings each), steps of 8.3 in 9
# of 20 recordings.
_COARSE = 3.0
# Grid of the rail across a code: points in each move (with two, sums are exact to 1e-9), minimum
# and maximum points; range of the white noise beyond a code, in standard deviations.
_EACH, _FEWEST, _MOST, _BEYOND = 2.0, 16, 128, 3.0
# Lower limits of a probability, and of the white noise in codes, which only avoid 0/0.
_NONE, _LEAST = 1e-300, 1e-9


def within_codes(samples: Samples, model: Composite, rng: np.random.Generator) -> Samples:
    """
    Return samples drawn within their codes, or unchanged if rounding is white noise.

    The model provides mean, `ou` and white noise.
    """
    terms = [term for term in model.gaussian.terms if term.NAME != 'quantization']
    s = driven(samples, terms)
    phi = np.exp(-s.alpha * s.step)
    added = s.sigma * s.sigma * -np.expm1(-2.0 * s.alpha * s.step) / (2.0 * s.alpha)
    white = white_noise(samples, terms, s) - samples.blur
    if samples.cell <= _COARSE * math.sqrt(float(np.median(added + white))):
        return samples
    mean, noise = model.gaussian.mean, np.sqrt(np.maximum(white, 0.0))
    low = samples.logged - 0.5 * samples.cell - mean
    x = _path(low, samples.cell, noise, phi, np.sqrt(added), rng)
    noise = np.maximum(noise, _LEAST * samples.cell)
    below, above = ndtr((low - x) / noise), ndtr((low + samples.cell - x) / noise)
    share = below + (above - below) * rng.random(samples.n)
    drawn = x + noise * ndtri(np.clip(share, _NONE, 1.0 - 1e-16))
    return replace(samples, voltage=mean + np.clip(drawn, low, low + samples.cell),
                   longer=samples.longer or samples, codes=samples.logged, cell=0.0)


def _path(low: FloatArray, cell: float, noise: FloatArray, phi: FloatArray, move: FloatArray,
          rng: np.random.Generator) -> FloatArray:
    """Draw a path of the OU, V, by forward filtering and backward sampling on a grid."""
    first, wide = low - _BEYOND * noise, cell + 2.0 * _BEYOND * noise
    count = int(np.clip(_EACH * float(np.median(wide)) / float(np.median(move)), _FEWEST, _MOST))
    places = (first[:, None] + wide[:, None] * ((np.arange(count) + 0.5) / count)) / move[:, None]
    least = np.maximum(noise, _LEAST * cell)[:, None]
    edge = (places * move[:, None] - low[:, None]) / least
    likely = np.maximum(ndtr(edge) - ndtr(edge - cell / least), _NONE)
    # The grid is in moves of each sample; for the first, in stationary standard deviations.
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
