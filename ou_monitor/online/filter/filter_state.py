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

Many samples at once: a step of any cutoff turns a state z into F z + g, so that all states solve
one triangular system with three bands below the diagonal.  Samples are worked on together while
they are finite and their intervals even to a factor of five; the others go one by one.  The output
is that of the samples one by one, to rounding.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from ou_monitor.online.filter.cutoff_control import INTERVALS, ODD
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


def filter_sequence(state: LowPassState, order: int, angle: FloatArray, start: FloatArray,
                    end: FloatArray) -> FloatArray:
    """Return the output at each sample (all of shape (n,)); the state goes on from the last."""
    # Imported here, because a node that filters one by one does not need it: SciPy takes 35 MB.
    from scipy.linalg.lapack import dtbtrs
    n, rise = angle.size, end - start
    bands, right = np.zeros((n, 2, 4)), np.zeros((n, 2))
    # As in `LowPassState.advance`; columns of F go with the sample before.
    if order == 1:
        lost = np.expm1(-angle)
        step = np.stack([[1.0 + lost, np.zeros(n)], np.zeros((2, n))])
        right[:, 0] = rise * (1.0 + lost / angle) - lost * start
    else:
        p = angle / _ROOT2
        s = np.exp(-p) * np.sin(p)
        c = np.expm1(-p) * np.cos(p) - 2.0 * np.sin(0.5 * p) ** 2
        step = np.stack([[1.0 + c + s, _ROOT2 * s], [-_ROOT2 * s, 1.0 + c - s]])
        right[:, 0] = rise * (1.0 + c / p) - (c + s) * start
        right[:, 1] = _ROOT2 * s * start - rise * (c + s) / angle
    right[0] += step[:, :, 0] @ (state.y, state.slope)
    bands[:, :, 0] = 1.0
    bands[:-1, 0, 2:] = -step[:, 0, 1:].T
    bands[:-1, 1, 1:3] = -step[:, 1, 1:].T
    found = dtbtrs(bands.reshape(2 * n, 4).T, right.reshape(2 * n, 1), uplo='L', diag='U')[0]
    state.y, state.slope = found[-2:, 0].tolist()
    return np.asarray(found[::2, 0])


# Minimum number of samples for a piece.
WORTH = 48


class Piece(NamedTuple):
    """Samples that are processed together."""

    size: int  # Number
    # Interval before each, and mean interval at each, s; shape (size,).
    dt: FloatArray
    mean: FloatArray


def sound_piece(t: FloatArray, x: FloatArray, before: float, mean: float,
                limits: tuple[float, float, float]) -> Piece:
    """Return the leading samples without an odd one (before in s, mean in s)."""
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
    """Return the starts of runs in which all inputs are constant, the first at 0."""
    moved = np.zeros(size - 1, dtype=np.bool_)
    for one in heard:
        moved |= (one[1:] != one[:-1]) & ~(np.isnan(one[1:]) & np.isnan(one[:-1]))
    return [0, *(np.flatnonzero(moved) + 1).tolist()]
