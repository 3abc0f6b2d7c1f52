"""
Stamps for samples that travel in blocks: one continuous time line.

A block of ADC samples carries one stamp, that of its LAST sample, and that
stamp is an *arrival* time: it comes late by whatever the bus and the scheduler
took, some milliseconds, different for every block.  The samples themselves
were taken by a quartz at a steady rate.  So the time line runs at the stated
rate and only leans slowly towards the stamps.

Limits first: a constant delay of arrival stays in the time line; one lost
block (within `max(2 blocks, 0.25 s)`) cannot be told from jitter, is not
counted as a gap, and is made up slowly.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

# The time line leans towards the stamps with this time constant.  5 ms of
# jitter then changes the spacing by at most 5e-4 (0.05 us at 10 kHz), and a
# clock that is wrong by 100 ppm is followed 1 ms behind.
FOLLOW = 10.0  # s

# A difference beyond this, and beyond two blocks, is a real gap: a busy
# companion computer holds blocks back by some 100 ms and then sends them all.
GAP_LEAST = 0.25  # s


class BlockClock:
    """
    Turns the stamps of blocks into stamps of samples of a rate, Hz.

    `gaps` counts when the time line was started anew, because a stamp was further than
    max(2 blocks, 0.25 s) from where it was expected.
    """

    def __init__(self, sample_rate: float) -> None:
        """Start without a time line: the first block sets it."""
        if not (math.isfinite(sample_rate) and sample_rate > 0.0):
            raise ValueError(f'sample_rate must be positive and finite, got {sample_rate} Hz')
        self.gaps = 0
        self._dt = 1.0 / sample_rate
        # The time line as seconds since an anchor: added up on a clock that
        # counts from 1970 they would be rounded to 0.24 us at every block, always
        # the same way.
        self._anchor: float | None = None
        self._elapsed = 0.0

    def reset(self) -> None:
        """Forget the time line, as after a clock that jumped back; not a gap."""
        self._anchor = None

    def stamps(self, end_stamp: float, n: int) -> FloatArray:
        """Return the stamps of the samples of the next block (end_stamp in s)."""
        start, first, step = self._next(end_stamp, n)
        if n == 0:
            return np.empty(0)
        assert self._anchor is not None
        return self._anchor + (start + np.arange(first, first + n, dtype=np.float64) * step)

    def stamps_of_many(self, end_stamps: FloatArray, n: npt.NDArray[np.int64]) -> FloatArray:
        """
        Return the stamps of the samples of many blocks, as `stamps` would one by one.

        end_stamps in s.
        """
        lines = []
        for end, count in zip(end_stamps.tolist(), n.tolist()):
            line = self._next(end, count)
            lines.append((self._anchor or 0.0, *line))
        anchor, start, first, step = np.array(lines, dtype=np.float64).reshape(-1, 4).T
        if n.size and (n == n[0]).all():
            steps = (first[:, None] + np.arange(int(n[0]))) * step[:, None]
            steps += start[:, None]
            steps += anchor[:, None]
            return steps.reshape(-1)
        place = np.arange(int(n.sum())) - np.repeat(np.cumsum(n) - n - first, n)
        return np.repeat(anchor, n) + (np.repeat(start, n) + place * np.repeat(step, n))

    def _next(self, end_stamp: float, n: int) -> tuple[float, int, float]:
        """Advance the time line by a block (result in s)."""
        if not math.isfinite(end_stamp):
            raise ValueError(f'the stamp of a block must be finite, got {end_stamp} s')
        if n < 0:
            raise ValueError(f'a block cannot hold {n} samples')
        if n == 0:
            return 0.0, 0, 0.0
        length = n * self._dt
        if self._anchor is not None:
            start = self._elapsed
            error = (end_stamp - self._anchor) - (start + length)
            if abs(error) <= max(2.0 * length, GAP_LEAST):
                # The correction is spread over the block, so that no step
                # shows where two blocks meet.
                lean = error * -math.expm1(-length / FOLLOW)
                self._elapsed = start + length + lean
                return start, 1, (length + lean) / n
            self.gaps += 1
        self._anchor, self._elapsed = end_stamp, 0.0
        return 0.0, 1 - n, self._dt
