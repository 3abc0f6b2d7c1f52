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
from scipy.special import log_ndtr, ndtr, ndtri

# Minimum white noise, as a share of the noise of a step; 0 would make path and reading equal.
_LEAST_WHITE = 0.1
# Sweeps of expectation propagation; factor on the white noise of a reading without information.
_SWEEPS, _NOTHING = 8, 1e6
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
    phi, added, white = _process(samples, model.gaussian.terms)
    white = np.maximum(white, _LEAST_WHITE * added)
    at = np.flatnonzero(clipped)
    top = samples.logged[at] >= ends.high
    side = np.where(top, 1.0, -1.0)
    mean, spread = model.gaussian.mean, np.sqrt(white[at])
    end = np.where(top, ends.high - 0.5 * samples.cell, ends.low + 0.5 * samples.cell) - mean[at]
    y = samples.voltage - mean
    x = _path_at(y, at, side, end, phi, added, white, rng)
    # Probability of the side beyond the limit, then a draw there.
    room = ndtr(side * (x - end) / spread)
    draw = -ndtri(np.maximum(room * (1.0 - rng.random(at.size)), 1e-300))
    beyond = np.where(room > 1e-12, x + side * spread * draw, end)
    return samples.redrawn(at, beyond + mean[at])


def _path_at(y: FloatArray, at: npt.NDArray[np.int64], side: FloatArray, end: FloatArray,
             phi: FloatArray, added: FloatArray, white: FloatArray, rng: np.random.Generator
             ) -> FloatArray:
    """Draw the path at clipped readings, given their limits and the other readings, V."""
    # Expectation propagation (Minka 2001): a clipped reading is replaced by a pseudo-reading whose
    # mean and white noise give the path the same moments as the limit does.
    white = white.copy()
    own = white[at]
    y[at], white[at] = end, _NOTHING * own
    for _ in range(_SWEEPS):
        path = _Path(phi, added, white)
        mean, variance = path.draw(y)[at], path.variance()[at]
        # Cavity distribution, without its own pseudo-reading.
        less = np.maximum(1.0 / variance - 1.0 / white[at], 1.0 / (_NOTHING * own))
        mean = (mean / variance - y[at] / white[at]) / less
        variance = 1.0 / less
        wide = np.sqrt(own + variance)
        z = side * (mean - end) / wide
        slope = np.exp(-0.5 * z * z - log_ndtr(z)) / math.sqrt(2.0 * math.pi)
        bend = np.clip(slope * (slope + z), 1.0 / _NOTHING, 1.0)
        y[at] = mean + side * slope * wide / bend
        white[at] = wide * wide / bend - variance
    return _Path(phi, added, white).draw(y, rng)[at]


class _Path:
    """Paths of an OU, given readings with white noise; mean subtracted, V."""

    def __init__(self, phi: FloatArray, added: FloatArray, white: FloatArray) -> None:
        before, known = np.empty(phi.size), np.empty(phi.size)
        last = 0.0
        for k, (keep, more, noise) in enumerate(zip(
                phi.tolist(), added.tolist(), white.tolist(), strict=True)):
            ahead = keep * keep * last + more
            last = ahead * noise / (ahead + noise)
            before[k], known[k] = ahead, last
        self._phi = phi.tolist()
        self._gain = (before / (before + white)).tolist()
        # Backward gain.
        back = known[:-1] * phi[1:] / before[1:]
        self._back = back.tolist()
        rest = np.append(known[:-1] - back * back * before[1:], known[-1])
        self._spread = np.sqrt(np.maximum(rest, 0.0))

    def variance(self) -> FloatArray:
        """Return the variance of paths at each reading."""
        last = float(self._spread[-1] ** 2)
        out = [last]
        for back, rest in zip(self._back[::-1], np.square(self._spread[-2::-1]).tolist(),
                              strict=True):
            last = rest + back * back * last
            out.append(last)
        return np.asarray(out[::-1])

    def draw(self, y: FloatArray, rng: np.random.Generator | None = None) -> FloatArray:
        """Return a random path, or without `rng` the mean of all paths."""
        means, last = [], 0.0
        for keep, gain, value in zip(self._phi, self._gain, y.tolist(), strict=True):
            last = keep * last
            last += gain * (value - last)
            means.append(last)
        some = np.zeros(y.size) if rng is None else rng.standard_normal(y.size)
        noise = (self._spread * some).tolist()
        found = means[-1] + noise[-1]
        out = [found]
        for mean, keep, back, more in zip(means[-2::-1], self._phi[:0:-1], self._back[::-1],
                                          noise[-2::-1], strict=True):
            found = mean + back * (found - keep * mean) + more
            out.append(found)
        return np.asarray(out[::-1])


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
