"""
Times of messages that carry no stamp: when sent, when sampled, and in simulated time.

`SendClock`: when samples were taken, told from when they were sent.

A message without a stamp is known only by its source timestamp.  A driver
samples by a timer, but what sends is scheduled: after a pause of 10 ms ten
messages leave within 0.2 ms, and an increment that took 1 ms seems to have
taken 20 us.  Half a per cent of such intervals doubles sigma.  So, as long as
the source is steady, its samples are put on an even time line that leans
slowly towards the source timestamps.

A steady source can be late, never early: the lower convex hull of source
timestamp against message number is a straight line, its slope the period, and
many messages lie near it (the way clock skew is told from delays: Zhang, Liu &
Xia 2002, "Clock synchronization algorithms for network measurements").  The
hull must span many pauses, whatever the rate: a burst of 400 messages sent
10 us apart is a straight line, too.

Limits: a constant delay stays; a source that is not steady is left as it is, and `in_bursts` says
so where its intervals cannot be those of samples, as of a driver that empties a buffer.

`SimClockMap`: the middleware stamps every message with the wall clock of its sender.  When a
bag is replayed at four times its speed, those stamps lie four times too close
and alpha would come out four times too large.  The messages on `/clock` carry
both times, so they give the map from one to the other.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.records import FloatArray

# Looked at: so many messages, and so many seconds of them, whichever is more.
KEEP, SPAN = 400, 1.0
# Never more messages than that: a second at 30 kHz.
MOST = 30_000
# The first judgement is made with so many, over so long, s: pauses of 50 ms, each caught up
# in a burst, tilt a line over 0.2 s by a quarter at most.
LEAST, FIRST_SPAN = 200, 0.2
# Messages and seconds between judgements (a judgement takes 0.2 ms for 400 messages, 0.6 ms for
# 10 000).
JUDGE, JUDGE_SPAN = 100, 0.1
# A message is near the line within NEAR sqrt(n) periods, n the messages looked at: the distance
# of a source without a timer from its line grows as sqrt(n), so the share of it that is near is
# one for all n.  Measured: near are 14 % of a Poisson source at most (99th percentile, n = 200;
# 12 % from 400 on), 23 % or more of a 10 kHz timer whose process pauses 30 times a second for
# 5..50 ms, 21 % when one message in a hundred is lost besides.
NEAR, ON_LINE = 0.1, 0.2
# A source sends in bursts when half of its intervals are below this share of their mean (of a
# Poisson source: below 0.69).
SHORT = 0.25
# Messages of a burst behind which there is a gap.
LUMP = 8
IN_BURSTS = (
    'The messages come in bursts and carry no stamps, and no steady source is seen behind '
    'them: no estimate can be made of them; stamp them in the driver, or send blocks of samples '
    'with adc.sample_rate.')
# The line follows the source with this time constant, s: 50 ms of delay, made up within 50 ms,
# move it by 1.2 ms.
FOLLOW = 1.0
# Later than this, s, is no delay but a gap; earlier than this, a clock that went back.
GAP, BACK = 0.25, 0.5
# Points from which the hull is made; of more messages, the lowest of each group.
_POINTS = 400


def line_under(times: Sequence[float] | FloatArray) -> tuple[float, float]:
    """Return the period of a source, and how steady it is (times in s)."""
    stamps = np.asarray(times, dtype=np.float64)
    stamps = stamps - stamps[0]
    n = stamps.size
    numbers = np.arange(n)
    group = -(-n // _POINTS)
    at, period = 0, float(stamps[-1]) / (n - 1)
    # Which message of a group is the lowest depends on the slope: three rounds settle it.
    for _ in range(3 if group > 1 else 1):
        lowest = numbers
        if group > 1:
            above = stamps - period * numbers
            whole = n - n % group
            lowest = above[:whole].reshape(-1, group).argmin(axis=1) + numbers[:whole:group]
            if whole < n:
                lowest = np.append(lowest, whole + int(above[whole:].argmin()))
        at, period = _hull_edge(lowest.tolist(), stamps[lowest].tolist())
    above = stamps - (stamps[at] + period * (numbers - at))
    near = above <= max(1.0, NEAR * math.sqrt(n)) * period
    return period, float(near.mean())


def _hull_edge(numbers: list[int], times: list[float]) -> tuple[int, float]:
    """
    Return where the middle edge of the lower convex hull starts, and its slope.

    The middle in time: a burst holds many messages, but lasts no time.
    """
    hull: list[tuple[int, float]] = []
    for k, time in zip(numbers, times):
        while len(hull) >= 2:
            (i, a), (j, b) = hull[-2:]
            if (b - a) * (k - i) < (time - a) * (j - i):
                break
            hull.pop()
        hull.append((k, time))
    middle = 0.5 * (times[0] + times[-1])
    right = next((m for m, (_, time) in enumerate(hull) if m and time >= middle), len(hull) - 1)
    (i, a), (j, b) = hull[right - 1:right + 1]
    return i, (b - a) / (j - i)


class SendClock:
    """
    Turn source timestamps of single samples into stamps.

    `in_bursts`: the messages show no steady source, and their times are worth nothing; `settled`:
    how often a line was found after such times had been given.
    """

    def __init__(self) -> None:
        self.in_bursts = False
        self.settled = 0
        self._lumps = 0
        self._times = array('d')
        self._fresh = self._doubts = 0
        self._judged = -math.inf
        self._last = math.nan
        self._period = math.nan

    @property
    def rate(self) -> float:
        """Rate of the even time line, Hz; NaN while the source is not known to be steady."""
        return 1.0 / self._period

    def __call__(self, source: float) -> float:
        """Return the stamp of the next sample (source in s)."""
        times = self._times
        if times and not -BACK < source - times[-1] < self._gap:
            self._take_gap(source - times[-1])
            del times[:]
            self._last = math.nan
        times.append(source)
        self._fresh += 1
        if self._fresh >= JUDGE and len(times) >= LEAST and (
                source - self._judged >= JUDGE_SPAN or self._judged > source):
            self._judge()
        self._last = self._next(source)
        return self._last

    def _take_gap(self, gap: float) -> None:
        """Notice bursts so far apart, s, that nothing can be told of what they are made of."""
        times = self._times
        lump = len(times) >= LUMP and times[-1] - times[0] < SHORT * gap
        self._lumps = self._lumps + 1 if lump else 0
        if self._lumps > 1:
            self._tell(True)

    @property
    def _gap(self) -> float:
        # Of a slow source an interval is no gap.
        return GAP if math.isnan(self._period) else max(GAP, 5.0 * self._period)

    def _judge(self) -> None:
        """Learn the period; give it up when all messages looked at have not shown it."""
        times = self._times
        looked = np.array(times)
        end = float(looked[-1])
        if end - float(looked[0]) < FIRST_SPAN and len(times) < MOST:
            return
        begin = min(int(np.searchsorted(looked, end - SPAN)), max(len(times) - KEEP, 0))
        period, share = line_under(looked[begin:])
        bursts = False
        if share < ON_LINE:
            steps = np.diff(looked)
            bursts = bool(np.median(steps) < SHORT * steps.mean())
        del times[:max(begin, len(times) - MOST)]
        self._doubts += self._fresh
        self._fresh, self._judged = 0, end
        if share >= ON_LINE and period > 0.0:
            self._period, self._doubts = period, 0
        elif self._doubts > len(times):
            self._period = math.nan
        if not self._tell(bursts and math.isnan(self._period)):
            self._last = end - self._period

    def _tell(self, in_bursts: bool) -> bool:
        """Note whether times are worth nothing; return false when they begin to be worth more."""
        settled = self.in_bursts and not in_bursts
        self.settled += settled
        self.in_bursts = in_bursts
        return not settled

    def _next(self, source: float) -> float:
        if math.isnan(self._period) or math.isnan(self._last):
            return source
        expected = self._last + self._period
        error = source - expected
        if not -BACK < error < self._gap:
            return source
        return expected - math.expm1(-self._period / FOLLOW) * error


# Half a second at the usual 100 Hz: averages the jitter of single publications away, and still
# follows a change of the replay rate within that half second.
PAIRS = 50
# A clock off the line by more than this, s of the sender's time, was stepped (next pass, seek):
# no publication is that late.
STEP = 0.25
# A clock of which nothing has come for so many s of the sender's time, and so many of its own
# intervals, has stopped: what is sent after that has no simulated time.
STOPPED, MISSED = 1.0, 5.0


class SimClockMap:
    """
    Straight line through the last pairs (source time, clock), by least squares.

    Limits: nothing is known before two pairs have come, and nothing `STOPPED` after the last
    one; between pairs and shortly after the last the line is continued.
    """

    def __init__(self) -> None:
        self._pairs: deque[tuple[float, float]] = deque(maxlen=PAIRS)
        self._origin = 0.0
        self._zero = 0.0
        self._rate = 0.0

    @property
    def ready(self) -> bool:
        """Whether a source time can be mapped."""
        return len(self._pairs) >= 2

    @property
    def patience(self) -> float:
        """Return the silence of the clock, s, after which it has stopped."""
        span = self._pairs[-1][0] - self._pairs[0][0] if self.ready else 0.0
        return max(STOPPED, MISSED * span / max(len(self._pairs) - 1, 1))

    @property
    def rate(self) -> float:
        """Seconds of simulated time per second of the sender's clock."""
        return self._rate

    def add(self, source: float, clock: float) -> bool:
        """Take one message of `/clock` (source in s, clock in s)."""
        stepped = False
        if self._pairs:
            last_source, last_clock = self._pairs[-1]
            expected = self._line(source) if self.ready else clock
            off = abs(clock - expected) > STEP * max(1.0, self._rate)
            if off or clock < last_clock or source < last_source:
                self._pairs.clear()
                stepped = True
            elif source == last_source:
                return False
        self._pairs.append((source, clock))
        self._fit()
        return stepped

    def _fit(self) -> None:
        """Fit the line; sums are taken about the means, so nanoseconds survive in floats."""
        n = len(self._pairs)
        first_source, first_clock = self._pairs[0]
        mean_x = sum(x - first_source for x, _ in self._pairs) / n
        mean_y = sum(y - first_clock for _, y in self._pairs) / n
        sxx = sxy = 0.0
        for source, clock in self._pairs:
            x = source - first_source - mean_x
            sxx += x * x
            sxy += x * (clock - first_clock - mean_y)
        self._rate = sxy / sxx if sxx > 0.0 else 0.0
        self._origin = first_source + mean_x
        self._zero = first_clock + mean_y

    def __call__(self, source: float) -> float:
        """Return the simulated time, s, at which a message was sent; NaN when not known yet."""
        if not self.ready or source - self._pairs[-1][0] > self.patience:
            return math.nan
        return self._line(source)

    def _line(self, source: float) -> float:
        return self._zero + self._rate * (source - self._origin)
