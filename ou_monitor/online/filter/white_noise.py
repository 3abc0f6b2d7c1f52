r"""
White noise of samples through the low-pass, and the cutoff that holds what comes out.

With the input linear between samples a step of the filter is z' = F z + a x_(k-1)
+ b x_k (its columns are asked of `LowPassState`), so that independent samples of
variance 1 give the stationary covariance

    C = F C F^T + a a^T + b b^T + F b a^T + a b^T F^T,

and the slopes (x_k - x_(k-1)) / dt, whose neighbours are correlated by -1/2,
with g = a + b

    C dt^2 = F C F^T dt^2 + 2 g g^T - F g g^T - g g^T F^T.
"""

from __future__ import annotations

from bisect import bisect_right
from functools import cache, lru_cache
import math

import numpy as np
from ou_monitor.online.filter.filter_state import LowPassState
from ou_monitor.records import FloatArray

TWO_PI = 2.0 * math.pi
# Angles (2 pi cutoff interval) of the table, and the step of their logarithms.
_LEAST_ANGLE, _MOST_ANGLE, _STEP = 1e-4, 300.0, 0.04
_STILL = 1e-6
_LOG_LEAST = math.log(_LEAST_ANGLE)


def white_noise(mode: str, order: int, angle: float) -> float:
    """Return the variance that comes out for independent samples of variance 1."""
    (f11, f21), (f12, f22) = (_step(order, angle, y, s, 0.0, 0.0)
                              for y, s in ((1.0, 0.0), (0.0, 1.0)))
    (a1, a2), (b1, b2) = (_step(order, angle, 0.0, 0.0, *ends)
                          for ends in ((1.0, 0.0), (0.0, 1.0)))
    if mode == 'lowpass':
        m1, m2 = f11 * b1 + f12 * b2, f21 * b1 + f22 * b2
        drive = (a1 * a1 + b1 * b1 + 2.0 * m1 * a1, a1 * a2 + b1 * b2 + m1 * a2 + m2 * a1,
                 a2 * a2 + b2 * b2 + 2.0 * m2 * a2)
    else:
        g1, g2 = a1 + b1, a2 + b2
        m1, m2 = f11 * g1 + f12 * g2, f21 * g1 + f22 * g2
        drive = (2.0 * g1 * (g1 - m1), 2.0 * g1 * g2 - m1 * g2 - m2 * g1, 2.0 * g2 * (g2 - m2))
    # Of the symmetric C: its first, mixed and last element.
    turned = [[1.0 - f11 * f11, -2.0 * f11 * f12, -f12 * f12],
              [-f11 * f21, 1.0 - f11 * f22 - f12 * f21, -f12 * f22],
              [-f21 * f21, -2.0 * f21 * f22, 1.0 - f22 * f22]]
    return float(np.linalg.solve(turned, drive)[0])


@lru_cache(maxsize=256)
def noise_left(order: int, angle: int) -> float:
    """Return what a low-pass leaves of the variance of white samples (log of w dt, in 1 %)."""
    return white_noise('lowpass', order, math.exp(angle / 100.0))


def _step(order: int, angle: float, y: float, slope: float, start: float, end: float,
          ) -> tuple[float, float]:
    state = LowPassState(y)
    state.slope = slope
    state.advance(order, angle, start, end)
    return state.y, state.slope


class _Table:
    """
    Logarithm of the noise over that of the angle, and back: cubics between points of `_STEP`.

    Below its first angle the noise is that power of the angle which it has far below the
    sample rate, times 1 + c angle; with the step of 0.04 the cubics are off by 3e-7.
    """

    def __init__(self, mode: str, order: int) -> None:
        self._of = mode, order
        count = math.ceil(math.log(_MOST_ANGLE / _LEAST_ANGLE) / _STEP) + 1
        self._noise: list[float] = []
        for k in range(count):
            now = math.log(white_noise(mode, order, _LEAST_ANGLE * math.exp(_STEP * k)))
            if self._noise and now - self._noise[-1] < _STILL:
                # Above the sample rate all of it passes, or less than before.
                break
            self._noise.append(now)
        count = len(self._noise)
        n = self._noise
        inner = [(8.0 * (n[k + 1] - n[k - 1]) - n[k + 2] + n[k - 2]) / 12.0
                 for k in range(2, count - 2)]
        self._power = 1.0 if mode == 'lowpass' else 1.0 + order
        # Relative change of noise over angle^power with the angle.
        self._bend = (n[1] - n[0] - self._power * _STEP) / (
            _LEAST_ANGLE * math.expm1(_STEP))
        self._slopes = [n[1] - n[0], n[2] - n[1], *inner, n[-2] - n[-3], n[-1] - n[-2]]

    def noise(self, log: float) -> float:
        """Return the logarithm of the noise at that of an angle."""
        place = (log - _LOG_LEAST) / _STEP
        if place < 0.0:
            return self._noise[0] + self._power * (log - _LOG_LEAST) + self._bend * (
                math.exp(log) - _LEAST_ANGLE)
        if place >= len(self._noise) - 1:
            return math.log(white_noise(*self._of, math.exp(log)))
        k = int(place)
        return self._cubic(k, place - k)[0]

    def angle(self, noise: float) -> float:
        """Return the logarithm of the angle at that of the noise."""
        k = bisect_right(self._noise, noise) - 1
        if k < 0:
            log = _LOG_LEAST
            for _ in range(3):
                bent = self._bend * (math.exp(log) - _LEAST_ANGLE)
                log = _LOG_LEAST + (noise - self._noise[0] - bent) / self._power
            return log
        if k >= len(self._noise) - 1:
            return _LOG_LEAST + _STEP * (len(self._noise) - 1)
        part = (noise - self._noise[k]) / (self._noise[k + 1] - self._noise[k])
        for _ in range(3):
            value, slope = self._cubic(k, part)
            part -= (value - noise) / slope
        return _LOG_LEAST + _STEP * (k + part)

    def angles(self, noise: FloatArray) -> FloatArray:
        """Return `angle` of many."""
        points, slopes = np.array(self._noise), np.array(self._slopes)
        k = np.clip(np.searchsorted(points, noise, side='right') - 1, 0, points.size - 2)
        rise = points[k + 1] - points[k]
        m, n = slopes[k], slopes[k + 1]
        b, c = 3.0 * rise - 2.0 * m - n, m + n - 2.0 * rise
        part = (noise - points[k]) / rise
        for _ in range(3):
            value = points[k] + part * (m + part * (b + part * c))
            part -= (value - noise) / (m + part * (2.0 * b + 3.0 * part * c))
        found: FloatArray = _LOG_LEAST + _STEP * (k + part)
        for at in np.flatnonzero((noise < points[0]) | (noise >= points[-1])).tolist():
            found[at] = self.angle(float(noise[at]))
        return found

    def _cubic(self, k: int, u: float) -> tuple[float, float]:
        """Return value and slope within the k-th interval, u in 0..1."""
        rise = self._noise[k + 1] - self._noise[k]
        m, n = self._slopes[k], self._slopes[k + 1]
        b, c = 3.0 * rise - 2.0 * m - n, m + n - 2.0 * rise
        return (self._noise[k] + u * (m + u * (b + u * c)), m + u * (2.0 * b + 3.0 * u * c))


_table = cache(_Table)


def held_cutoffs(mode: str, order: int, fmax: float, times: FloatArray, interval: float,
                 ) -> FloatArray:
    """Return `held_cutoff` of many, Hz, shape (n,)."""
    table = _table(mode, order)
    scale = math.log(TWO_PI * interval)
    return np.asarray(np.exp(table.angles(
        table.noise(math.log(fmax) + scale) - 2.0 * np.log(times)) - scale))


def held_cutoff(mode: str, order: int, fmax: float, times: float, interval: float) -> float:
    """
    Return the cutoff at which `times` as much white noise comes out as it did at fmax.

    fmax in Hz, interval in s.
    """
    table = _table(mode, order)
    scale = math.log(TWO_PI * interval)
    return math.exp(
        table.angle(table.noise(math.log(fmax) + scale) - 2.0 * math.log(times)) - scale)
