"""
Times of messages without a stamp: sampling time from sending time, and simulated time.

`SendClock`: a message without a stamp has only its source timestamp, i.e. its sending time.  A
driver samples by a timer, but the scheduler may delay the sending: after a pause of 10 ms, ten
messages of a 1 kHz source leave within 0.2 ms, and a change over 1 ms seems to take 20 us.  If
0.5 % of the intervals are like this, sigma doubles.  The samples of a steady source are therefore
put on an even time line that slowly follows the source timestamps.

A message can be late, but not early: the lower convex hull of source timestamp against message
number is a straight line with the period as its slope (Zhang, Liu & Xia 2002, "Clock
synchronization algorithms for network measurements").  The hull must span many pauses, because a
burst of 400 messages sent 10 us apart is a straight line too.

Limits: a constant delay remains.  The times of an unsteady source are not changed; if its
intervals cannot be sampling intervals, as when a driver empties a buffer, `in_bursts` is true.

`SimClockMap`: the middleware stamps every message with the wall clock of its sender, which a
replay at four times the speed makes four times too close.  Messages on `/clock` contain simulated
time too, and so determine the map to it.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Sequence
import math
from statistics import linear_regression

import numpy as np
from ou_monitor.records import FloatArray

# Minimum number of messages examined, and minimum time that they span, s.
KEEP, SPAN = 400, 1.0
# Maximum number of messages examined: one second at 30 kHz.
MOST = 30_000
# Minimum number of messages, and minimum time, s, for the first judgement: over 0.2 s, pauses of
# 50 ms followed by bursts tilt the line by at most a quarter.
LEAST, FIRST_SPAN = 200, 0.2
# Minimum number of messages, and minimum time, s, between judgements (a judgement takes 0.2 ms for
# 400 messages, and 0.6 ms for 10 000).
JUDGE, JUDGE_SPAN = 100, 0.1
# Maximum distance of a near message from the line, in sqrt(n) periods, where n is the number of
# messages examined, and minimum share of near messages from a steady source.  A source without a
# timer drifts from its line as sqrt(n), so its share of near messages does not depend on n.
# Measured shares: Poisson source, at most 14 % (99th percentile, n = 200; 12 % from 400 on);
# 10 kHz timer whose process pauses 30 times a second for 5..50 ms, at least 23 %, or 21 % if one
# message in a hundred is also lost.
NEAR, ON_LINE = 0.1, 0.2
# A source sends in bursts if half of its intervals are below this fraction of their mean (of a
# Poisson source, half are below 0.69).
SHORT = 0.25
# Minimum number of messages in a burst before a gap.
LUMP = 8
IN_BURSTS = (
    'The messages come in bursts without stamps, and no steady source was detected behind '
    'them, so nothing can be estimated: stamp them in the driver, or send blocks of samples '
    'with adc.sample_rate.')
# Time constant with which the time line follows the source, s: a delay that grows to 50 ms and
# vanishes within 50 ms shifts the time line by 1.2 ms.
FOLLOW = 1.0
# Minimum gap, as opposed to a delay, s; minimum step back of a clock, s.
GAP, BACK = 0.25, 0.5
# Maximum number of points for the hull; of more messages, the earliest of each group is used.
_POINTS = 400


def line_under(times: Sequence[float] | FloatArray) -> tuple[float, float]:
    """Return a source's period, s, and the share of its messages near the line (times in s)."""
    stamps = np.asarray(times, dtype=np.float64)
    stamps = stamps - stamps[0]
    n = stamps.size
    numbers = np.arange(n)
    group = -(-n // _POINTS)
    at, period = 0, float(stamps[-1]) / (n - 1)
    # Which message of a group is the earliest depends on the slope; three rounds suffice.
    for _ in range(3 if group > 1 else 1):
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
    """Return where the middle edge of the lower convex hull starts, and its slope."""
    # Take the middle in time, because a burst has many messages but takes hardly any time.
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
    """Turn source timestamps of single samples into stamps."""

    def __init__(self) -> None:
        # Whether times are unusable, because messages come in bursts and no steady source is
        # detected; how often `in_bursts` has ended.
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
        """Rate of the even time line, Hz; NaN until the source is found to be steady."""
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
        """Declare the times unusable after two bursts followed by gaps (gap in s)."""
        times = self._times
        lump = len(times) >= LUMP and times[-1] - times[0] < SHORT * gap
        self._lumps = self._lumps + 1 if lump else 0
        if self._lumps > 1:
            self._record_bursts(True)

    @property
    def _gap(self) -> float:
        # A gap is longer than the intervals of a slow source.
        return GAP if math.isnan(self._period) else max(GAP, 5.0 * self._period)

    def _judge(self) -> None:
        """Learn the period; forget it if the messages examined no longer show one."""
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
        if not self._record_bursts(bursts and math.isnan(self._period)):
            self._last = end - self._period

    def _record_bursts(self, in_bursts: bool) -> bool:
        """Record whether times are unusable; return False when they become usable."""
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


# Number of pairs fitted: half a second at the usual 100 Hz, which averages the jitter of single
# publications, and follows a change of the replay rate within half a second.
PAIRS = 50
# Deviation from the line, s of the sender's time, above which the clock has jumped (next pass of a
# bag, seek), because no publication is that late.
STEP = 0.25
# Silence after which the clock counts as stopped, so that later messages have no simulated time:
# s of the sender's time, and number of the clock's intervals (the longer of the two applies).
STOPPED, MISSED = 1.0, 5.0


class SimClockMap:
    """Straight line through the last pairs (source time, clock), by least squares."""

    def __init__(self) -> None:
        self._pairs: deque[tuple[float, float]] = deque(maxlen=PAIRS)
        # Slope of the line, and its value at the first pair less the clock of that pair, s.
        self._rate = self._off = 0.0

    @property
    def ready(self) -> bool:
        """Whether a source time can be mapped."""
        return len(self._pairs) >= 2

    @property
    def patience(self) -> float:
        """Return the silence, s, after which the clock counts as stopped."""
        span = self._pairs[-1][0] - self._pairs[0][0] if self.ready else 0.0
        return max(STOPPED, MISSED * span / max(len(self._pairs) - 1, 1))

    def add(self, source: float, clock: float) -> bool:
        """Take a message of `/clock`, both times in s; return whether the clock has jumped."""
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
        if self.ready:
            # Fit relative to the first pair, so that floats resolve nanoseconds.
            first_source, first_clock = self._pairs[0]
            self._rate, self._off = linear_regression(
                *zip(*((x - first_source, y - first_clock) for x, y in self._pairs)))
        return stepped

    def __call__(self, source: float) -> float:
        """Return the simulated time, s, at which a message was sent; NaN while undefined."""
        # The line is used between pairs, and for a short time after the last pair.
        if not self.ready or source - self._pairs[-1][0] > self.patience:
            return math.nan
        return self._line(source)

    def _line(self, source: float) -> float:
        first_source, first_clock = self._pairs[0]
        return first_clock + (self._off + self._rate * (source - first_source))
