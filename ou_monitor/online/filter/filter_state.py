"""
The low-pass itself: two numbers of state, over a step of any length, and over many samples.

With w = 2 pi fc, input x, output y:

    order 1:  y' = w (x - y)
    order 2:  y' = w s,  s' = w (x - y - sqrt(2) s)     (Butterworth)

A cutoff that moves only stretches time (dtau = w dt), so with *any* sequence
of cutoffs y is what the one fixed filter makes of the input in another time:
it is continuous, and bounded by the bound of the input times the integral of
the absolute impulse response: 1 for order 1, coth(pi / 2) = 1.0903 for order 2.

Between samples the input is linear.  Held at the newest value instead, it
would lead by half a sample (18 degrees at a tenth of the sample rate); linear
it has no phase error and an amplitude that falls short by (pi f dt)^2 / 3.

Many samples at once: a cutoff that moves only stretches time, and an input that is linear in a
step has the steady response x - sqrt(2) r (order 1: x - r) with r its rise over the angle of the
step.  What is left of a state beside that turns and decays by exp(lambda theta), whatever the
cutoff, and jumps only where r or x does.  With Theta the sum of the angles so far

    z_k = exp(lambda Theta_k) (z_0 + sum_j exp(-lambda Theta_(j-1)) jump_j),

lambda = (-1 + i) / sqrt(2), or -1: a sum over a block, in which the exponential stays finite, and
one step from block to block.  Coefficients that change with every sample cost no more than fixed
ones.  Rounding: r is large where the angle is small, so that below `_LEAST` samples go one by one.

Samples are worked on together while they are finite and their intervals even to a factor of
five; the others go one by one.  The output is that of the samples one by one, to rounding.
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import numpy as np
from ou_monitor.online.filter.cutoff_control import INTERVALS, ODD, OF_RATE
from ou_monitor.records import FloatArray

_ROOT2 = math.sqrt(2.0)


class LowPassState:
    """A low-pass: output `y` and, of order 2, `slope` = y' / w, in the unit of the input."""

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
        # over the ramp; written in what is small for a short step, so that nothing cancels.
        p = angle / _ROOT2
        decay, sin = math.exp(-p), math.sin(p)
        c = math.expm1(-p) * math.cos(p) - 2.0 * math.sin(0.5 * p) ** 2
        s = decay * sin
        slope = self.slope
        self.y += (c + s) * off + _ROOT2 * s * slope + rise * (1.0 + c / p)
        self.slope += (c - s) * slope - _ROOT2 * s * off - rise * (c + s) / angle
        return self.y


# Samples that are worked on together: the arrays stay in the cache.
_CHUNK = 16384
# Angle of a block: exp(100) is far from the largest number, and 100 rounds by 1e-14.
_SPAN = 100.0
_LEAST = 1e-4
# Angle of a step, above which only fmin holds the cutoff above 0.45 of the sample rate: so much
# of the state decays that sums over many lose it.
_MOST = 2.0 * math.pi * OF_RATE * ODD


def filter_sequence(state: LowPassState, order: int, angle: FloatArray, start: FloatArray,
                    end: FloatArray) -> FloatArray:
    """
    Return the output at each sample (all of shape (n,)); the state goes on from the last.

    `start` is `end` of the sample before, or each its own `end` (the slopes of a derivative).
    """
    out: FloatArray = np.empty_like(angle)
    for k in range(0, angle.size, _CHUNK):
        at = slice(k, k + _CHUNK)
        lowest, highest = float(angle[at].min()), float(angle[at].max())
        if lowest < _LEAST or highest > _MOST:
            out[at] = [state.advance(order, *one) for one in zip(
                angle[at].tolist(), start[at].tolist(), end[at].tolist(), strict=True)]
        else:
            out[at] = _summed(state, order, angle[at], start[at], end[at])
    return out


def _summed(state: LowPassState, order: int, angle: FloatArray, start: FloatArray,
            end: FloatArray) -> FloatArray:
    """Filter by sums, in blocks of an angle of `_SPAN` at most, one block a row."""
    n = angle.size
    length = min(max(int(_SPAN / float(angle.max())), 1), n)
    count = -(-n // length)
    late = _ROOT2 if order == 2 else 1.0
    held = np.array_equal(start, end)
    slope = None if held else (end - start) / angle
    steady = end if slope is None else end - late * slope
    source = -end if slope is None else slope
    last = 0.0 if slope is None else float(slope[-1])
    # What is beyond the end does not move.
    p, jump = np.zeros((2, count, length))
    np.divide(angle, late, out=p.reshape(-1)[:n])
    np.subtract(source[1:], source[:-1], out=jump.reshape(-1)[1:n])
    np.cumsum(p, axis=1, out=p)
    grow = np.exp(p)
    off = state.y - (float(end[0]) if slope is None else
                     float(start[0]) - late * float(slope[0]))
    if order == 1:
        a = _sums(jump, grow)
        left = off
        for row, (total, angle_) in enumerate(zip(
                a[:, -1].tolist(), p[:, -1].tolist(), strict=True)):
            a[row] += left
            left = math.exp(-angle_) * (left + total)
        a /= grow
        out = a.reshape(-1)[:n] + steady
        state.y, state.slope = float(out[-1]), 0.0
        return np.asarray(out)
    cos, sin = np.cos(p), np.sin(p)
    a, b = _sums(jump, grow * cos), _sums(jump, grow * sin, 0.0)
    turn = state.slope - (0.0 if slope is None else float(slope[0]))
    # The frame in which the jumps are real: d = u + v, s = -sqrt2 v; turned by pi / 4 for slopes.
    z = complex(off + turn / _ROOT2, -turn / _ROOT2) if slope is None else complex(
        off / _ROOT2, -turn - off / _ROOT2)
    for row, (total, other, angle_) in enumerate(zip(
            a[:, -1].tolist(), b[:, -1].tolist(), p[:, -1].tolist(), strict=True)):
        a[row] += z.real
        b[row] -= z.imag
        z = cmath.exp(complex(-angle_, angle_)) * (z + complex(total, -other))
    if slope is None:
        along, across = cos + sin, sin - cos
        size, state.slope = 1.0, -_ROOT2 * z.imag
    else:
        along, across = cos, sin
        size, state.slope = _ROOT2, last - z.real - z.imag
    a *= along
    b *= across
    a += b
    a /= grow
    a *= size
    out = a.reshape(-1)[:n] + steady
    state.y = float(out[-1])
    return np.asarray(out)


def _sums(jump: FloatArray, weight: FloatArray, first: float = 1.0) -> FloatArray:
    """Return the sums along the rows of jumps, each by the weight before it."""
    found = np.empty_like(jump)
    found[:, 0] = first * jump[:, 0]
    np.multiply(jump[:, 1:], weight[:, :-1], out=found[:, 1:])
    np.cumsum(found, axis=1, out=found)
    return found


# Samples of a piece from which it is worth it.
WORTH = 48


class Piece(NamedTuple):
    """Samples that can be worked on together."""

    size: int  # Number
    # Interval before each, and mean interval at each, s; shape (size,).
    dt: FloatArray
    mean: FloatArray


def sound_piece(t: FloatArray, x: FloatArray, before: float, mean: float,
                limits: tuple[float, float, float]) -> Piece:
    """Return the samples from the first on of which none is odd (before in s, mean in s)."""
    from scipy.signal import lfilter
    largest, latest, shortest = limits
    # NaN is neither.
    if not (-latest < t.min() and t.max() < latest and -largest < x.min() and x.max() < largest):
        good = (np.abs(x) < largest) & (np.abs(t) < latest)
        n = int(np.argmin(good)) if not good.all() else t.size
        t, x = t[:n], x[:n]
    dt = np.diff(t, prepend=before)
    keep = 1.0 - 1.0 / INTERVALS
    means = np.asarray(lfilter([1.0 - keep], [1.0, -keep], dt, zi=[keep * mean])[0])
    n = dt.size
    if n and not (dt.min() >= shortest and dt.max() <= ODD * min(mean, means.min())
                  and max(mean, means.max()) <= ODD * dt.min()):
        past = np.concatenate(([mean], means[:-1]))
        odd = (dt < shortest) | (dt > ODD * past) | (past > ODD * dt)
        if odd.any():
            n = int(np.argmax(odd))
    return Piece(n, dt[:n], means[:n])


def changes(heard: list[FloatArray], size: int) -> list[int]:
    """Return where a run of one value of all that is heard begins, the first at 0."""
    moved = np.zeros(size - 1, dtype=np.bool_)
    for one in heard:
        moved |= (one[1:] != one[:-1]) & ~(np.isnan(one[1:]) & np.isnan(one[:-1]))
    return [0, *(np.flatnonzero(moved) + 1).tolist()]
