"""
Lines too fast for the samples that are used, where samples are left out.

They would show up at other frequencies, and mostly drown in what the noise adds
between the samples used; in all samples together they stand out.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.model.terms.tone import Tone
from ou_monitor.records import FloatArray
from scipy import fft

# Height from which a line is one, beyond the logarithm of the frequencies looked at: by
# chance once in some exp(6) = 400 recordings.
_CLEAR = 6.0
# Samples up to which frequencies between the bins are looked at, too: half way between
# two bins a line loses 60 % of its power.
_FINER = 4_000_000
# Bins that share a level of noise, lines at most, stretches that must agree on one, and
# the share of its power that they must have in common.
_BINS, _MOST, _STRETCHES, _COMMON = 512, 6, 64, 0.5
# Stamps off an even grid by more than this share of a step tell no phase; changes larger
# than this many deviations are events.
_EVEN, _EVENT = 0.1, 5.0
# Samples at once, and samples that tell how large changes are.
_CHUNK, _LOOK = 500_000, 200_000


def lines_lost(t: FloatArray, voltage: FloatArray, which: slice) -> list[Tone]:
    """Find pure lines that are above half of the rate of the samples used."""
    k = which.step or 1
    part = slice(which.start, min(which.stop, voltage.size))
    t, v = t[part], voltage[part]
    n = v.size
    if k == 1 or n < 2 * _BINS * k:
        return []
    dt = float(t[-1] - t[0]) / (n - 1)
    if not all(_even(t[a:a + _CHUNK], t[0] + a * dt, dt) for a in range(0, n, _CHUNK)):
        return []
    e, keep = _whitened(v)
    size = fft.next_fast_len(2 * n if n <= _FINER else n, real=True)
    lowest = math.ceil(0.5 * size / k)
    count = (size // 2 + 1 - lowest) // _BINS
    if count < 1:
        return []
    power = np.abs(fft.rfft(e, size)[lowest:lowest + count * _BINS]).reshape(count, _BINS)
    power *= power
    # The median of exponentials is ln 2 of their mean.
    level = np.median(power, axis=1, keepdims=True) / math.log(2.0)
    power /= np.maximum(level, 1e-300)
    height = power.ravel()
    found = []
    for _ in range(_MOST):
        at = int(np.argmax(height))
        if height[at] < math.log(height.size) + _CLEAR:
            break
        line = _line(e, keep, (lowest + at) / size, float(level[at // _BINS, 0]), dt)
        if line is not None:
            found.append(line)
        height[max(at - 8, 0):at + 9] = 0.0
    return found


def without_lines(t: FloatArray, voltage: FloatArray, origin: float, lines: Sequence[Tone]
                  ) -> FloatArray:
    """Return a voltage less lines (origin in s, result in V)."""
    for line in lines:
        turns = (t - origin) * line.frequency % 1.0
        voltage = voltage - line.amplitude * np.sin(2.0 * math.pi * turns + line.phase)
    return voltage


def _even(t: FloatArray, first: float, dt: float) -> bool:
    """Return whether stamps are where an even grid has them."""
    return float(np.abs(t - first - dt * np.arange(t.size)).max()) < _EVEN * dt


def _whitened(v: FloatArray) -> tuple[FloatArray, float]:
    """Return what the sample before does not tell, events cut, and what it tells."""
    c = v - v.mean()
    keep = float(c[1:] @ c[:-1]) / max(float(c @ c), 1e-300)
    e: FloatArray = c[1:] - keep * c[:-1]
    del c
    limit = _EVENT * float(np.median(np.abs(e[::max(e.size // _LOOK, 1)]))) / 0.6745
    return (np.clip(e, -limit, limit, out=e) if limit > 0.0 else e), keep


def _line(e: FloatArray, keep: float, cycles: float, level: float, dt: float) -> Tone | None:
    """Return the line near a frequency, cycles a sample; None where its phase does not last."""
    size = e.size // _STRETCHES
    parts = e[:size * _STRETCHES].reshape(_STRETCHES, size)
    used = parts.size

    def turned(at: float) -> FloatArray:
        """Return the sum of each stretch in a frame that turns along."""
        within = np.exp(-2j * math.pi * (at * np.arange(1, size + 1) % 1.0))
        sums: FloatArray = (parts @ within) * np.exp(
            -2j * math.pi * (at * size * np.arange(_STRETCHES) % 1.0))
        return sums

    sums = turned(cycles)
    fine = 32 * _STRETCHES
    spectrum = np.fft.fft(sums, fine)
    best = int(np.argmax(np.abs(spectrum)))
    power = float(np.abs(spectrum[best])) ** 2
    # Beside what noise adds to the power of each stretch.
    apart = _STRETCHES * (float((np.abs(sums) ** 2).sum()) - level * used / e.size)
    if power < _COMMON * apart:
        return None
    shift = (best if best < fine // 2 else best - fine) / (fine * size)
    cycles += shift
    seen = 2.0 / used * complex(turned(cycles).sum())
    seen /= 1.0 - keep * np.exp(-2j * math.pi * cycles)
    return Tone(abs(seen), cycles / dt, math.atan2(seen.imag, seen.real) + 0.5 * math.pi, 0.0)
