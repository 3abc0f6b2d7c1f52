"""
Phase lag of the low-passes, and the cutoff for a given lag.

With r = f / fc, the continuous filter of order 1 lags by atan r, the second-order
Butterworth by atan2(sqrt(2) r, 1 - r^2).  The filter of this package takes its
input as linear between samples, which adds no phase, so its lags are the same.
The lag of a derivative is relative to the true derivative.
"""

from __future__ import annotations

import cmath
import math

_ROOT2 = math.sqrt(2.0)


def phase_lag(order: int, cutoff: float, frequency: float) -> float:
    """Return the phase lag of a low-pass (cutoff in Hz, frequency in Hz)."""
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
    """Return the share of the unfiltered signal that reduces a lag to a limit, rad."""
    # A mixture (1 - m) H + m R has the lag p where (1 - m) H e^(ip) + m R e^(ip) has the imaginary
    # part 0.
    if -cmath.phase(response) <= most:
        return 0.0
    turned, straight = (one * cmath.exp(1j * most) for one in (response, raw))
    if straight.imag <= 0.0:
        return 1.0
    return turned.imag / (turned.imag - straight.imag)
