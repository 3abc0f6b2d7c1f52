r"""
The low-pass over many samples at once: the arithmetic of `filter_state`, in blocks.

A cutoff that moves only stretches time, so that what a state at the beginning of a block makes of
the rest of it depends on nothing but the sum of the angles since: exp(A theta), closed.  So
every block is run from rest at its first sample, all blocks side by side, and what the block
before leaves over is added.  The result is that of the samples one by one, to rounding.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.online.filter.filter_state import LowPassState
from ou_monitor.records import FloatArray

_ROOT2 = math.sqrt(2.0)
# Samples that are worked on together, and those of one block: the arrays stay in the cache.
_CHUNK, _BLOCK = 65536, 256
# After so much angle nothing of a state is left: exp(-53) < 1e-23.
_FORGOTTEN = {1: 53.0, 2: 75.0}
# Angles that differ by less, as a share, count as one; a biquad of less angle would round more.
_SAME, _SMALL = 1e-9, 0.02


def filter_sequence(state: LowPassState, order: int, angle: FloatArray, start: FloatArray,
                    end: FloatArray) -> FloatArray:
    """Return the output at each sample (all of shape (n,)); the state goes on from the last."""
    out: FloatArray = np.empty_like(angle)
    for k in range(0, angle.size, _CHUNK):
        at = slice(k, k + _CHUNK)
        lowest, highest = float(angle[at].min()), float(angle[at].max())
        if order == 2 and lowest > _SMALL and highest - lowest < _SAME * lowest:
            out[at] = _even(state, 0.5 * (lowest + highest), start[at], end[at])
        else:
            out[at] = _uneven(state, order, angle[at], start[at], end[at])
    return out


def _left_over(order: int, a: FloatArray, y: float, slope: float) -> FloatArray:
    """Return what a state makes of the output after angles, without input."""
    if order == 1:
        return np.asarray(np.exp(-a) * y)
    p = a / _ROOT2
    return np.asarray(np.exp(-p) * ((y * np.cos(p)) + (y + _ROOT2 * slope) * np.sin(p)))


def _even(state: LowPassState, angle: float, start: FloatArray, end: FloatArray) -> FloatArray:
    """Filter with one angle: a biquad from rest, and what the state leaves over."""
    from scipy.signal import lfilter

    def step(y: float, slope: float, *ends: float) -> tuple[float, float]:
        one = LowPassState(y)
        one.slope = slope
        one.advance(2, angle, *ends)
        return one.y, one.slope
    (f11, f21), (f12, f22) = step(1.0, 0.0, 0.0, 0.0), step(0.0, 1.0, 0.0, 0.0)
    (a1, a2), (b1, b2) = step(0.0, 0.0, 1.0, 0.0), step(0.0, 0.0, 0.0, 1.0)
    poles = [1.0, -(f11 + f22), f11 * f22 - f12 * f21]
    zeros = [b1, a1 - f22 * b1 + f12 * b2, f12 * a2 - f22 * a1]
    x0 = float(start[0])
    # From rest at x0; `start` of one sample is `end` of the one before but for a derivative.
    if np.array_equal(start[1:], end[:-1]):
        out = np.asarray(lfilter(zeros, poles, end - x0)) + x0
    else:
        out = np.asarray(lfilter([a1, f12 * a2 - f22 * a1], poles, start - x0)
                         + lfilter([b1, f12 * b2 - f22 * b1], poles, end - x0)) + x0
    steps = np.arange(1, min(int(_FORGOTTEN[2] / angle), end.size) + 1)
    left = np.asarray(angle * steps, dtype=np.float64)
    out[:left.size] += _left_over(2, left, state.y - x0, state.slope)
    if end.size > 1:
        # The slope before the last step is what the last step made of it.
        before = LowPassState(float(out[-2]))
        before.advance(2, angle, float(start[-1]), float(end[-1]))
        state.slope = (float(out[-1]) - before.y) / f12
        state.y = float(out[-2])
    state.advance(2, angle, float(start[-1]), float(end[-1]))
    return out


def _uneven(state: LowPassState, order: int, angle: FloatArray, start: FloatArray,
            end: FloatArray) -> FloatArray:
    """Filter in blocks of `_BLOCK`, side by side."""
    n = angle.size
    length = min(_BLOCK, n)
    count = -(-n // length)

    def blocks(values: FloatArray, fill: float) -> FloatArray:
        """Return samples in columns of `length`, one block a column."""
        whole: FloatArray = np.full(count * length, fill)
        whole[:n] = values
        return np.ascontiguousarray(whole.reshape(count, length).T)
    # What is beyond the end does not move.
    theta = blocks(angle, 1.0)
    x0, x1 = blocks(start, float(end[-1])), blocks(end, float(end[-1]))
    out, slopes = (_first if order == 1 else _second)(theta, x0, x1)
    total = np.cumsum(theta, axis=0)
    last = np.full(count, length - 1)
    last[-1] = n - 1 - (count - 1) * length
    y, s = state.y, state.slope if order == 2 else 0.0
    dys, dss = np.empty(count), np.empty(count)
    for b, (first, y1, s1, a) in enumerate(zip(
            x0[0].tolist(), out[last, np.arange(count)].tolist(),
            slopes[last, np.arange(count)].tolist(), total[last, np.arange(count)].tolist())):
        dy, ds = y - first, s
        dys[b], dss[b] = dy, ds
        if order == 1:
            y = y1 + math.exp(-a) * dy
            continue
        p = a / _ROOT2
        decay = math.exp(-p)
        cos, sin = decay * math.cos(p), decay * math.sin(p)
        y = y1 + (cos + sin) * dy + _ROOT2 * sin * ds
        s = s1 + (cos - sin) * ds - _ROOT2 * sin * dy
    rows = int(np.max(np.sum(total <= _FORGOTTEN[order], axis=0)))
    a = np.asarray(total[:rows], dtype=np.float64)
    if order == 1:
        out[:rows] += np.exp(-a) * dys
    else:
        p = a / _ROOT2
        out[:rows] += np.exp(-p) * (np.cos(p) * dys + np.sin(p) * (dys + _ROOT2 * dss))
    state.y, state.slope = y, s
    return np.ascontiguousarray(out.T).reshape(-1)[:n]


def _first(angle: FloatArray, start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Run order 1 down the columns, each from rest at its first sample."""
    lost = np.expm1(-angle)
    push = (end - start) * (1.0 + lost / angle)
    out = np.empty_like(angle)
    y = start[0].copy()
    for k in range(angle.shape[0]):
        y += lost[k] * (y - start[k]) + push[k]
        out[k] = y
    return out, np.zeros_like(angle)


def _second(angle: FloatArray, start: FloatArray, end: FloatArray,
            ) -> tuple[FloatArray, FloatArray]:
    """Run order 2 down the columns, each from rest at its first sample."""
    p = angle / _ROOT2
    lost, h, q = np.expm1(-p), np.sin(0.5 * p), np.cos(0.5 * p)
    decay = 1.0 + lost
    # exp(-p) cos p - 1 and exp(-p) sin p, written in what is small for a short step.
    h2 = 2.0 * h * h
    c, s = lost - decay * h2, 2.0 * decay * h * q
    rise = end - start
    push = rise * (1.0 + c / p)
    add, cross, keep = c + s, _ROOT2 * s, 1.0 + (c - s)
    push_slope = rise * add / angle
    out, slopes = np.empty_like(angle), np.empty_like(angle)
    y, slope = start[0].copy(), np.zeros(angle.shape[1])
    off, part = np.empty_like(y), np.empty_like(y)
    for k in range(angle.shape[0]):
        np.subtract(y, start[k], out=off)
        np.multiply(add[k], off, out=part)
        y += part
        np.multiply(cross[k], slope, out=part)
        y += part
        y += push[k]
        slope *= keep[k]
        off *= cross[k]
        slope -= off
        slope -= push_slope[k]
        out[k], slopes[k] = y, slope
    return out, slopes
