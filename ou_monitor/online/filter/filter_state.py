"""
The low-pass itself: two states, advanced by steps of any length; its phase lag.

With w = 2 pi fc, input x, output y:

    order 1:  y' = w (x - y)
    order 2:  y' = w s,  s' = w (x - y - sqrt(2) s)     (Butterworth)

A change of the cutoff only stretches time (dtau = w dt), so for *any* sequence of
cutoffs, y is the response of one fixed filter to the input in stretched time.  So y
is continuous, and at most the largest input times the integral of the absolute
impulse response: 1 for order 1, coth(pi / 2) = 1.0903 for order 2.

Between samples the input is linear.  An input held at its newest value would lead by
half a sample (18 degrees at a tenth of the sample rate); a linear one has no phase
error, and its amplitude is too small by (pi f dt)^2 / 3.  So with r = f / fc the lag is that of
the continuous filter: atan r for order 1, atan2(sqrt(2) r, 1 - r^2) for order 2.  The lag of a
derivative is relative to the true derivative.
"""

from __future__ import annotations

import cmath
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


def phase_lag(order: int, cutoff: float, frequency: float) -> float:
    """Return the phase lag of a low-pass, degrees (cutoff in Hz, frequency in Hz)."""
    ratio = frequency / cutoff
    if order == 1:
        return math.degrees(math.atan(ratio))
    return math.degrees(math.atan2(_ROOT2 * ratio, 1.0 - ratio * ratio))


def delay(lag: float, frequency: float) -> float:
    """Return the phase delay, s, of a `lag` in degrees at `frequency`, Hz."""
    return lag / (360.0 * frequency)


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
    """Return the share of the raw signal in a mixture whose lag is at most `most`, rad."""
    # A mixture (1 - m) H + m R has the lag p where (1 - m) H e^(ip) + m R e^(ip) has the imaginary
    # part 0.
    if -cmath.phase(response) <= most:
        return 0.0
    turned, straight = (one * cmath.exp(1j * most) for one in (response, raw))
    if straight.imag <= 0.0:
        return 1.0
    return turned.imag / (turned.imag - straight.imag)
