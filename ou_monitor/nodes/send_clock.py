"""
When samples were taken, told from when they were sent.

A message without a stamp is known only by its source timestamp.  A driver
samples by a timer, but what sends is scheduled: after a pause of 10 ms ten
messages leave within 0.2 ms, and an increment that took 1 ms seems to have
taken 20 us.  Half a per cent of such intervals doubles sigma.  So, as long as
the source is steady, its samples are put on an even time line that leans
slowly towards the source timestamps.

A steady source can be late, never early: the lower convex hull of source
timestamp against message number is a straight line, its slope the period, and
many messages lie on it (the way clock skew is told from delays: Zhang, Liu &
Xia 2002, "Clock synchronization algorithms for network measurements").

Limits: a constant delay stays; a source that is not steady is left as it is.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
import math

# Messages looked at.  Measured: of a 1 kHz timer on two cores with four busy processes 29 % or
# more of 400 lie within one period of the hull, of a Poisson source 7 % at most.
KEEP = 400
ON_LINE = 0.2
# The first judgement is made with so many: of a Poisson source 9 % (95th percentile) of 200.
LEAST = 200
# Messages between judgements (a judgement takes 0.1 ms).
JUDGE = 100
# The line follows the source with this time constant, s: 50 ms of delay, made up within 50 ms,
# move it by 1.2 ms.
FOLLOW = 1.0
# Later than this, s, is no delay but a gap; earlier than this, a clock that went back.
GAP, BACK = 0.25, 0.5


def line_under(times: Sequence[float]) -> tuple[float, float]:
    """
    Return the period of a source, and how steady it is.

    Parameters
    ----------
    times : sequence of float, length n >= 2
        Source timestamps in order, s.

    Returns
    -------
    period : float
        Slope of the lower convex hull at its middle, s a message.
    share : float
        Share of the messages within one period of that line.

    """
    hull: list[tuple[int, float]] = []
    for k, time in enumerate(times):
        while len(hull) >= 2:
            (i, a), (j, b) = hull[-2:]
            if (b - a) * (k - i) < (time - a) * (j - i):
                break
            hull.pop()
        hull.append((k, time))
    right = next(m for m, (k, _) in enumerate(hull) if 2 * k >= len(times) - 1)
    (i, a), (j, b) = hull[right - 1:right + 1]
    period = (b - a) / (j - i)
    near = sum(time - (a + period * (k - i)) <= period for k, time in enumerate(times))
    return period, near / len(times)


class SendClock:
    """Turn source timestamps of single samples into stamps."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=KEEP)
        self._seen = self._doubts = 0
        self._last = math.nan
        self._period = math.nan

    @property
    def rate(self) -> float:
        """Rate of the even time line, Hz; NaN while the source is not known to be steady."""
        return 1.0 / self._period

    def __call__(self, source: float) -> float:
        """
        Return the stamp of the next sample.

        Parameters
        ----------
        source : float
            When it was sent, s.

        Returns
        -------
        float
            When it was taken, s, but for a constant delay.

        """
        if self._times and not -BACK < source - self._times[-1] < self._gap:
            self._times.clear()
            self._last = math.nan
        self._times.append(source)
        self._seen += 1
        if self._seen % JUDGE == 0 and len(self._times) >= LEAST:
            self._judge()
        self._last = self._next(source)
        return self._last

    @property
    def _gap(self) -> float:
        # Of a slow source an interval is no gap.
        return GAP if math.isnan(self._period) else max(GAP, 5.0 * self._period)

    def _judge(self) -> None:
        """Learn the period; give it up when a whole `KEEP` of messages has not shown it."""
        period, share = line_under(self._times)
        if share >= ON_LINE and period > 0.0:
            self._period, self._doubts = period, 0
        else:
            self._doubts += 1
            if self._doubts * JUDGE > KEEP:
                self._period = math.nan

    def _next(self, source: float) -> float:
        if math.isnan(self._period) or math.isnan(self._last):
            return source
        expected = self._last + self._period
        error = source - expected
        if not -BACK < error < self._gap:
            return source
        return expected - math.expm1(-self._period / FOLLOW) * error
