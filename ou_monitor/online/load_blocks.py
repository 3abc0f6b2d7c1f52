"""
Samples averaged for the load filter: at most some 50 Hz, in blocks of equal throttle.

Limits first: a block that still fills is not given out, so a fast source is followed 20 ms
late; of several changes of throttle within 20 ms the first three are told apart.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.records import FloatArray, NAN

# Width, s, of the bins: the motors and the pack answer more slowly than that.
WIDTH = 0.02
# Samples further apart than this, s, stand alone.
_APART = 0.75 * WIDTH
# Throttles that differ by less are equal: the sag's difference is below the ADC's step.
_EQUAL = 0.01
# So many changes of throttle within a bin end a block.
_CHANGES = 3


@dataclass(frozen=True, slots=True)
class Block:
    """
    Samples in a row with one throttle.

    Attributes
    ----------
    t, last : float
        Mean and last stamp, s.
    voltage : float
        Mean voltage, V.
    throttle : float
        Mean throttle, 0..1; NaN where unknown.
    current : float
        Mean of the currents that are known, A; NaN without one.
    n : int
        Samples.
    within : float
        Variance of one sample about the mean, V^2; NaN of a single one.

    """

    t: float
    last: float
    voltage: float
    throttle: float
    current: float
    n: int
    within: float


class LoadBlocks:
    """
    Collects samples into blocks.

    A sample that follows 15 ms or more after the last is a block at once: a slow source waits
    for nothing.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Take the next sample as the first one; the block that fills is left out."""
        self._sums: FloatArray | None = None
        # Of the last sample: stamp, throttle, step to it, changes in its bin so far.
        self._last = (-math.inf, NAN, math.inf, 0)
        self._zero = NAN

    def push(self, columns: FloatArray) -> list[Block]:
        """
        Return the blocks that samples complete.

        Columns of shape (4, n): t, s, and voltage, V, finite, t rising; throttle, 0..1; A.
        """
        t, voltage, throttle, current = columns
        if not t.size:
            return []
        if math.isnan(self._zero):
            # Squares are taken from here, so that they lose no digits.
            self._zero = float(voltage[0])
        before, held, step, changes = self._last
        dt = np.diff(t, prepend=before)
        bins = np.floor(np.concatenate(([t[0] if before == -math.inf else before], t)) / WIDTH)
        alone = dt >= _APART
        fresh = alone | (np.concatenate(([step], dt[:-1])) >= _APART) | (np.diff(bins) != 0.0)
        u = np.concatenate(([held], throttle))
        differs = ~((np.abs(np.diff(u)) <= _EQUAL) | (np.isnan(u[1:]) & np.isnan(u[:-1])))
        # Changes since the bin began.
        total = np.cumsum(differs & ~fresh) + changes
        base = np.maximum.accumulate(np.where(fresh, total, 0))
        count = total - base
        starts = np.flatnonzero(fresh | differs & (count <= _CHANGES))
        self._last = float(t[-1]), float(throttle[-1]), float(dt[-1]), int(count[-1])
        known = np.isfinite(current)
        off = voltage - self._zero
        rows = np.stack((np.ones(t.size), t, off, off * off, throttle,
                         np.where(known, current, 0.0), known, t))
        cuts = starts if starts.size and starts[0] == 0 else np.concatenate(([0], starts))
        sums = np.add.reduceat(rows, cuts, axis=1)
        sums[-1] = t[np.append(cuts[1:], t.size) - 1]
        done = []
        if self._sums is not None:
            if starts.size and starts[0] == 0:
                done.append(self._block(self._sums))
            else:
                sums[:-1, 0] += self._sums[:-1]
        done += [self._block(column) for column in sums.T[:-1]]
        self._sums = sums[:, -1]
        if alone[-1]:
            done.append(self._block(self._sums))
            self._sums = None
        return done

    def _block(self, sums: FloatArray) -> Block:
        n, t, off, square, throttle, current, known, last = sums.tolist()
        within = max(0.0, square - off * off / n) / (n - 1.0) if n > 1.0 else NAN
        return Block(t / n, last, self._zero + off / n, throttle / n,
                     current / known if known else NAN, int(n), within)
