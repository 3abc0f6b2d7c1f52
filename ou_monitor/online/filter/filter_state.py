"""
The low-pass itself: two states, advanced by steps of any length; and its phase lag.

With w = 2 pi fc, input x, output y:

    order 1:  y' = w (x - y)
    order 2:  y' = w s,  s' = w (x - y - sqrt(2) s)     (Butterworth)

A change of the cutoff only stretches time (dtau = w dt).  So for *any* sequence of
cutoffs, y is the response of one fixed filter to the input in stretched time.  It is
continuous, and at most the largest input times the integral of the absolute impulse
response: 1 for order 1, coth(pi / 2) = 1.0903 for order 2.

The input is taken as linear between samples.  If it were held at the newest sample, the
output would lead by half a sample (18 degrees at a tenth of the sample rate).  Linear
interpolation has no phase error, and makes the amplitude too small by (pi f dt)^2 / 3.  So the
lag equals the continuous filter's: with r = f / fc, it is atan r for order 1, and
atan2(sqrt(2) r, 1 - r^2) for order 2.  The lag of a derivative is relative to the true
derivative.
"""

from __future__ import annotations

import cmath
import math

import numpy as np
from ou_monitor.records import FloatArray

_ROOT2 = math.sqrt(2.0)


class LowPassState:
    """A low-pass: output `y` and, for order 2, `slope` = y' / w, in the unit of the input."""

    __slots__ = ('slope', 'y')

    def __init__(self, y: float = 0.0) -> None:
        self.y = y
        self.slope = 0.0

    def advance(self, order: int, angle: float, start: float, end: float) -> float:
        """Advance over one step, with input from `start` to `end`; angle: w dt; return y."""
        rise = end - start
        off = self.y - start
        if order == 1:
            lost = math.expm1(-angle)
            self.slope = 0.0
            self.y += lost * off + rise * (1.0 + lost / angle)
            return self.y
        # Poles at w exp(+-3i pi/4): closed form of the 2 x 2 matrix exponential, and of its
        # integral over the ramp, with terms that are small for a short step, to avoid
        # cancellation.
        p = angle / _ROOT2
        decay, sin = math.exp(-p), math.sin(p)
        c = math.expm1(-p) * math.cos(p) - 2.0 * math.sin(0.5 * p) ** 2
        s = decay * sin
        slope = self.slope
        self.y += (c + s) * off + _ROOT2 * s * slope + rise * (1.0 + c / p)
        self.slope += (c - s) * slope - _ROOT2 * s * off - rise * (c + s) / angle
        return self.y


def transition(order: int, angle: float) -> FloatArray:
    """Return [F a b], (2, 4): y and slope after a step are F (y, slope) + a start + b end."""
    found = np.empty((2, 4))
    for k, (y, slope, start, end) in enumerate(np.eye(4).tolist()):
        one = LowPassState(y)
        one.slope = slope
        one.advance(order, angle, start, end)
        found[:, k] = one.y, one.slope
    return found


def phase_lag(order: int, cutoff: float, frequency: float) -> float:
    """Return the phase lag of a low-pass, degrees (cutoff in Hz, frequency in Hz)."""
    ratio = frequency / cutoff
    if order == 1:
        return math.degrees(math.atan(ratio))
    return math.degrees(math.atan2(_ROOT2 * ratio, 1.0 - ratio * ratio))


def most_lag(order: int) -> float:
    """Return the limit that the lag of a low-pass approaches, degrees."""
    return 90.0 * order


def cutoff_for_lag(order: int, lag: float, frequency: float) -> float:
    """Return the cutoff, Hz, whose lag at a frequency, Hz, is `lag`: inverse of `phase_lag`."""
    # Order 1: fc = f / tan(lag).  Order 2: with c = cot(lag), r^2 + sqrt(2) c r - 1 = 0, so fc = f
    # / r = f (c + sqrt(c^2 + 2)) / sqrt(2).
    if not 0.0 < lag < most_lag(order):
        raise ValueError(
            f'a low-pass of order {order} lags by more than 0 and less than '
            f'{most_lag(order):g} degrees, got {lag:g}')
    angle = math.radians(lag)
    cot = math.cos(angle) / math.sin(angle)
    if order == 1:
        return frequency * cot
    return frequency * (cot + math.hypot(cot, _ROOT2)) / _ROOT2


def share_for_lag(response: complex, raw: complex, most: float) -> float:
    """Return the share of the raw signal with which a mixture lags by at most `most`, rad."""
    # A mixture (1 - m) H + m R has the lag p if the imaginary part of ((1 - m) H + m R) e^(ip) is
    # zero.
    if -cmath.phase(response) <= most:
        return 0.0
    turned, straight = (one * cmath.exp(1j * most) for one in (response, raw))
    if straight.imag <= 0.0:
        return 1.0
    return turned.imag / (turned.imag - straight.imag)
