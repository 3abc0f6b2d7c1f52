"""
Arrays through the adaptive low-pass: what `step` does sample by sample, for many at once.

Samples are worked on together while they are finite and their intervals even to a factor of
five; the others go one by one.  The output is that of the samples one by one, to rounding
(angles within 1e-9 of each other count as one).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from ou_monitor.online.filter.cutoff_control import INTERVALS, ODD, OF_RATE
from ou_monitor.records import FloatArray

# Samples of a piece from which it is worth it.
WORTH = 48


class Piece(NamedTuple):
    """
    Samples that can be worked on together.

    Attributes
    ----------
    size : int
        Number.
    dt, mean : ndarray, shape (size,)
        Interval before each, and mean interval at each, s.

    """

    size: int
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


def within_rate(cutoff: FloatArray, mean: FloatArray) -> FloatArray:
    """Return a cutoff, Hz, below its share of the sample rate."""
    if float(cutoff.max()) * float(mean.max()) < OF_RATE:
        return cutoff
    return np.minimum(cutoff, OF_RATE / mean)
