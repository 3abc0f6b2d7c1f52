"""
Mean square error of a low-pass of gain 1, and the cutoff where it is least.

For a signal of one or two poles in the noise of the supply and white noise, of
the continuous filter; for the voltage itself in white noise, of the sampled one.
"""

from __future__ import annotations

from collections.abc import Callable
import math

from ou_monitor.online.settings import FilterSettings

TWO_PI = 2.0 * math.pi
_ROOT2 = math.sqrt(2.0)
_ROOT8 = 2.0 * _ROOT2
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
# Highest cutoff that a sampled filter gets, as a share of the sample rate.
_OF_RATE = 0.45


def squared_error(order: int, w: float, signal: tuple[float, float],
                  noise: tuple[float, float], n0: float, poles: int = 1) -> float:
    """
    Return the mean square error of a low-pass with a cutoff of `w`.

    What of the signal is lost, with 1 - H: of an OU of intensity a and rate b,
    a^2 / (2 (w + b)) for order 1 and a^2 (3 w + sqrt2 b)
    / (2 sqrt2 (w^2 + sqrt2 w b + b^2)) for order 2; of two poles see
    `_lost_of_two_poles`.  What comes through of the supply's noise: V of
    `cutoff_laws`; of white noise: n0 w / 2 or n0 w / (2 sqrt2).

    w in 1/s, signal in 1/s.
    """
    a, b = signal
    c, d = noise
    if poles == 2:
        lost = a * a * _lost_of_two_poles(order, w, b)
    elif order == 1:
        lost = 0.5 * a * a / (w + b)
    else:
        lost = a * a * (3.0 * w + _ROOT2 * b) / (w * w + _ROOT2 * w * b + b * b) / _ROOT8
    if order == 1:
        return lost + 0.5 * c * c * w / (d * (w + d)) + 0.5 * n0 * w
    through = c * c * w * (_ROOT2 * w + d) / (d * (w * w + _ROOT2 * w * d + d * d))
    return lost + (through + n0 * w) / _ROOT8


def _lost_of_two_poles(order: int, w: float, b: float) -> float:
    r"""
    Return what a low-pass loses of a Butterworth signal of two poles and variance 1.

    The signal has the spectrum 2 sqrt2 b^3 / |s^2 + sqrt2 b s + b^2|^2 at s = i w'.
    The integral of |c / d|^2 is in the table of Newton, Gould & Kaiser
    (Analytical Design of Linear Feedback Controls, 1957, appendix E):

        order 1   c = s,               d = (s + w) (s^2 + sqrt2 b s + b^2)
        order 2   c = s^2 + sqrt2 w s, d = (s^2 + sqrt2 w s + w^2) (s^2 + sqrt2 b s + b^2)

    In units of b: u = w / b.
    """
    u = w / b
    if order == 1:
        # d = s^3 + (u + sqrt2) s^2 + (1 + sqrt2 u) s + u; I = 1 / (2 (d1 d2 - d0)).
        return _ROOT2 / ((1.0 + _ROOT2 * u) * (u + _ROOT2) - u)
    d0, d1 = u * u, _ROOT2 * u * (1.0 + u)
    d2, d3 = 1.0 + 2.0 * u + u * u, _ROOT2 * (1.0 + u)
    top = d0 * d1 + 2.0 * u * u * d0 * d3
    return _ROOT2 * top / (d0 * (d1 * d2 * d3 - d0 * d3 * d3 - d1 * d1))


def sampled_error(w: float, dt: float, alpha: float, var: float, white: float) -> float:
    """
    Return the mean square error of the sampled low-pass of order 1 for an OU in white noise.

    With q = exp(-w dt), b = 1 - (1 - q) / (w dt) and a = 1 - q - b the filter is
    y_k = q y_(k-1) + b x_k + a x_(k-1).  The white noise comes through with
    (a^2 + b^2 + 2 a b q) / (1 - q^2); what is lost of the signal is what
    (b - 1, a + q) over the same pole makes of an AR(1) process.

    w in 1/s, dt in s.
    """
    angle = w * dt
    lost = -math.expm1(-angle)
    q, phi = math.exp(-angle), math.exp(-alpha * dt)
    b = 1.0 - lost / angle
    a = lost - b
    square = lost * (1.0 + q)
    through = (a * a + b * b + 2.0 * a * b * q) / square
    first, second = b - 1.0, a + q
    power = (first * first + second * second + 2.0 * first * second * q) / square
    beside = q * power + first * second
    return var * (power + 2.0 * phi * beside / (1.0 - phi * q)) + white * through


def least_error(settings: FilterSettings, sigma: float, alpha: float) -> float:
    """
    Return the cutoff of the least `squared_error` within the limits, Hz.

    The signal is of rms `signal_rms`, bandwidth `signal_bandwidth` and
    `signal_poles`, the supply's noise of `coupling` times sigma and rate alpha.
    """
    s = settings
    rate = TWO_PI * s.signal_bandwidth
    size = s.signal_rms * (math.sqrt(2.0 * rate) if s.signal_poles == 1 else 1.0)
    return _least(lambda fc: squared_error(
        s.order, TWO_PI * fc, (size, rate), (s.coupling * sigma, alpha), s.n0, s.signal_poles),
        s.lowest, s.fmax)


def least_sampled_error(settings: FilterSettings, sigma: float, alpha: float,
                        interval: float) -> float:
    """Return the cutoff of the least `sampled_error` within the limits, Hz."""
    s = settings
    low, high = s.lowest, min(s.fmax, _OF_RATE / interval)
    if not low < high:
        return low
    var, white = sigma * (sigma / (2.0 * alpha)), s.n0 / interval
    return _least(lambda fc: sampled_error(TWO_PI * fc, interval, alpha, var, white), low, high)


def _least(error: Callable[[float], float], lowest: float, highest: float) -> float:
    """
    Return where an error over the cutoff is least, Hz, to 1e-4 of itself.

    It may have two valleys (let the noise pass, or cut it), so a grid of an
    eighth of an octave comes before the section search over the logarithm.
    """
    def at(level: float) -> float:
        return error(math.exp(level))

    low, high = math.log(lowest), math.log(highest)
    n = max(2, math.ceil((high - low) / (math.log(2.0) / 8.0)))
    width = (high - low) / n
    best = min((low + k * width for k in range(n + 1)), key=at)
    left, right = max(best - width, low), min(best + width, high)
    while right - left > 1e-4:
        inner, outer = right - _GOLDEN * (right - left), left + _GOLDEN * (right - left)
        if at(inner) <= at(outer):
            right = outer
        else:
            left = inner
    # The ends of the range count too: the search only comes near them.
    return math.exp(min((0.5 * (left + right), low, high), key=at))
