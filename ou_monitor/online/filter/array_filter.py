"""
Arrays through the adaptive low-pass: what `step` does sample by sample, for many at once.

Samples are worked on together while they are finite, their intervals even to a factor of five, and
what the law hears changes seldom; the others go one by one.  The output is that of the samples one
by one, to rounding (angles within 1e-9 of each other count as one).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from ou_monitor.online.filter.cutoff_control import INTERVALS, ODD, OF_RATE
from ou_monitor.records import FloatArray

# Samples of a piece with one sigma from which it is worth it.
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
    good = (np.abs(x) < largest) & (np.abs(t) < latest)
    n = int(np.argmin(good)) if not good.all() else t.size
    dt = np.diff(t[:n], prepend=before)
    keep = 1.0 - 1.0 / INTERVALS
    means = np.asarray(lfilter([1.0 - keep], [1.0, -keep], dt, zi=[keep * mean])[0])
    past = np.concatenate(([mean], means[:-1]))
    odd = (dt < shortest) | (dt > ODD * past) | (past > ODD * dt)
    if odd.any():
        n = int(np.argmax(odd))
    return Piece(n, dt[:n], means[:n])


def changes(heard: list[FloatArray], rate: npt.NDArray[np.float64]) -> npt.NDArray[np.intp]:
    """Return where a run of one value of all that is heard begins, 0 and the end included."""
    moved = rate[1:] != rate[:-1]
    for one in heard:
        moved |= (one[1:] != one[:-1]) & ~(np.isnan(one[1:]) & np.isnan(one[:-1]))
    return np.concatenate(([0], np.flatnonzero(moved) + 1, [rate.size]))


def within_rate(cutoff: FloatArray, mean: FloatArray) -> FloatArray:
    """Return a cutoff, Hz, below its share of the sample rate."""
    return np.minimum(cutoff, OF_RATE / mean)
