"""
The low-pass itself: two states, advanced by steps of any length.

With w = 2 pi fc, input x, output y:

    order 1:  y' = w (x - y)
    order 2:  y' = w s,  s' = w (x - y - sqrt(2) s)     (Butterworth)

A changing cutoff only stretches time (dtau = w dt), so for *any* sequence of
cutoffs, y is the response of one fixed filter to the input in stretched time.  So y
is continuous, and at most the largest input times the integral of the absolute
impulse response: 1 for order 1, coth(pi / 2) = 1.0903 for order 2.

Between samples the input is linear.  An input held at its newest value would lead by
half a sample (18 degrees at a tenth of the sample rate); a linear one has no phase
error, and its amplitude is too small by (pi f dt)^2 / 3.
"""

from __future__ import annotations

import math

_ROOT2 = math.sqrt(2.0)


class LowPassState:
    """A low-pass: output `y` and, for order 2, `slope` = y' / w, in the unit of the input."""

    __slots__ = ('slope', 'y')

    def __init__(self, y: float = 0.0) -> None:
        self.y = y
        self.slope = 0.0

    def advance(self, order: int, angle: float, start: float, end: float) -> float:
        """Solve the filter over one step."""
        rise = end - start
        off = self.y - start
        if order == 1:
            lost = math.expm1(-angle)
            self.slope = 0.0
            self.y += lost * off + rise * (1.0 + lost / angle)
            return self.y
        # Poles at w exp(+-3i pi/4): closed form of the 2 x 2 exponential, and of its integral
        # over the ramp, in terms that are small for a short step, to avoid cancellation.
        p = angle / _ROOT2
        decay, sin = math.exp(-p), math.sin(p)
        c = math.expm1(-p) * math.cos(p) - 2.0 * math.sin(0.5 * p) ** 2
        s = decay * sin
        slope = self.slope
        self.y += (c + s) * off + _ROOT2 * s * slope + rise * (1.0 + c / p)
        self.slope += (c - s) * slope - _ROOT2 * s * off - rise * (c + s) / angle
        return self.y
