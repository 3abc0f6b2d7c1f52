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

from functools import lru_cache
import math

import numpy as np
from ou_monitor.online.filter.filter_state import LowPassState

TWO_PI = 2.0 * math.pi
# Error of the logarithms of noise and cutoff.
_CLOSE = 1e-7


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


# The signals of one message have the same noise and stamps.
@lru_cache(maxsize=64)
def held_cutoff(mode: str, order: int, fmax: float, times: float, interval: float) -> float:
    """
    Return the cutoff at which `times` as much white noise comes out as it did at fmax.

    fmax in Hz, interval in s.
    """
    def level(log: float) -> float:
        return math.log(white_noise(mode, order, TWO_PI * interval * math.exp(log)))

    high = math.log(fmax)
    top = level(high)
    wanted = top - 2.0 * math.log(times)
    # Variance goes with the first power of a cutoff far below the sample rate (a derivative's
    # with the second or third), with less near it: the root lies above this.
    low = high - 2.0 * math.log(times) - 1e-9
    while (bottom := level(low)) > wanted:
        low -= 1.0
    # False position with the end that stays halved (Illinois; Dowell & Jarratt 1971).
    above, below = top - wanted, bottom - wanted
    while high - low > _CLOSE:
        at = (low * above - high * below) / (above - below)
        now = level(at) - wanted
        if abs(now) < _CLOSE:
            return math.exp(at)
        if now > 0.0:
            high, above, below = at, now, 0.5 * below
        else:
            low, below, above = at, now, 0.5 * above
    return math.exp(low)
