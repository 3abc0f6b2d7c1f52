"""
Draw clipped readings from a model of the other samples.

Neighbouring samples, throttle and noise together determine the distribution of a clipped value.  A
path of the rail is drawn given all readings, then each clipped reading given the path.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import driven, white_noise
from ou_monitor.model.terms.reading import Saturation
from ou_monitor.records import FloatArray
from scipy.special import log_ndtr, ndtr, ndtri

# Minimum white noise, as a share of the noise of a step; 0 would make path and reading equal.
_LEAST = 0.1
# Sweeps of expectation propagation; factor on the white noise of a reading without information.
_SWEEPS, _NOTHING = 8, 1e6


def redrawn(samples: Samples, model: Composite, ends: Saturation,
            clipped: npt.NDArray[np.bool_], rng: np.random.Generator) -> Samples:
    """
    Return samples with clipped readings, shape (n,), drawn again beyond their limits.

    The model provides mean, `ou` and white noise.
    """
    s = driven(samples, model.gaussian.terms)
    phi = np.exp(-s.alpha * s.step)
    added = s.sigma * s.sigma * -np.expm1(-2.0 * s.alpha * s.step) / (2.0 * s.alpha)
    white = white_noise(samples, model.gaussian.terms, s)
    white = np.maximum(white, _LEAST * added)
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
    """
    Draw the path at clipped readings, given their limits and the other readings, V.

    Each clipped reading is replaced by a pseudo-reading with its own mean and white noise, which
    gives the path the same moments as the limit (expectation propagation, Minka 2001).
    """
    white = white.copy()
    own = white[at]
    y[at], white[at] = end, _NOTHING * own
    for _ in range(_SWEEPS):
        path = _Path(phi, added, white)
        mean, variance = path.drawn(y)[at], path.variance()[at]
        # Without its own pseudo-reading (cavity distribution).
        less = np.maximum(1.0 / variance - 1.0 / white[at], 1.0 / (_NOTHING * own))
        mean = (mean / variance - y[at] / white[at]) / less
        variance = 1.0 / less
        wide = np.sqrt(own + variance)
        z = side * (mean - end) / wide
        slope = np.exp(-0.5 * z * z - log_ndtr(z)) / math.sqrt(2.0 * math.pi)
        bend = np.clip(slope * (slope + z), 1.0 / _NOTHING, 1.0)
        y[at] = mean + side * slope * wide / bend
        white[at] = wide * wide / bend - variance
    return _Path(phi, added, white).drawn(y, rng)[at]


class _Path:
    """Paths of an OU in white noise, given readings less their mean, V."""

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

    def drawn(self, y: FloatArray, rng: np.random.Generator | None = None) -> FloatArray:
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
