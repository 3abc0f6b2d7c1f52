"""
What is wrong with the input: values that are no readings, and stamps that are no time.

Limits: a source with few late samples (below a tenth) is left to the estimator, which sorts and
counts them; so is one that repeats messages.
"""

from __future__ import annotations

from collections import deque
import enum
import math

import numpy as np
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import FloatArray, NAN

# No supply that this monitors comes near it, V; squares and cubes of what is beyond overflow.
MOST_VOLTAGE = 1.0e6
# A throttle beyond this is none in 0..1, however generous its ends (as in recordings).
MOST_THROTTLE = 2.0
# No stamp: a century of nanoseconds since 1970 is 3e9 s.
_MOST_STAMP = 1.0e12
# A source of so many Hz or more that has missed so many samples is silent, whatever
# `stale_after` is; not before so many s: a busy machine pauses that long.
MISSED, LEAST_PATIENCE = 300, 0.3
# Samples from which an interval is known well enough to say that.
_MEASURED = 20
# Messages looked at for the share of late ones; a judgement needs the fewest.
_LOOK, _FEWEST = 200, 20
_IRREGULAR = 0.1


class Stamps(enum.Enum):
    """What the stamps are good for; the value is the sentence for the pilot."""

    GOOD = 'The stamps increase.'
    FROZEN = (
        'Samples arrive, but their stamps do not advance: no estimate can be made of them; the '
        'driver must set header.stamp for every message.')
    IRREGULAR = (
        'The stamps of the samples go back and forth: no estimate can be made of them; look for '
        'a second source of the topic, or a driver with two clocks.')


def readings(t: FloatArray, voltage: FloatArray, throttle: FloatArray | None
             ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return samples with NaN in place of what is no reading (t in s, V, throttle 0..1)."""
    t = _within(t, _MOST_STAMP)
    voltage = _within(voltage, MOST_VOLTAGE)
    return t, voltage, None if throttle is None else _within(throttle, MOST_THROTTLE)


def _within(values: FloatArray, most: float) -> FloatArray:
    # The comparison is false for NaN too, which stays one.
    beyond = ~(np.abs(values) <= most)
    return np.where(beyond, NAN, values) if beyond.any() else values


def patience(settings: MonitorSettings, rate: float, n: int) -> float:
    """Return the silence after which a source is stale, s, given its rate, Hz, in n samples."""
    if n < _MEASURED or not rate > 0.0:
        return settings.stale_after
    return min(settings.stale_after, max(LEAST_PATIENCE, MISSED / rate))


class StampWatch:
    """Whether the stamps of arriving samples advance."""

    def __init__(self) -> None:
        self._newest = -math.inf
        # Of the last batches: samples, and how many of them were late or began anew.
        self._batches: deque[tuple[int, int]] = deque()
        self._looked = self._late = 0
        # Samples since the newest stamp, and since when, by arrival.
        self._since = 0
        self._advanced = self._arrived = NAN

    def push(self, t: FloatArray, arrival: FloatArray | None = None) -> None:
        """Take stamps in order of arrival (t in s, arrival in s on a monotonic clock)."""
        good = np.isfinite(t)
        if not good.all():
            t, arrival = t[good], None if arrival is None else arrival[good]
        if not t.size:
            return
        highest = np.maximum.accumulate(np.concatenate(([self._newest], t)))
        late = t <= highest[:-1]
        # Repeats of the newest message are no disorder.
        self._count(t.size, int(np.count_nonzero(t < highest[:-1])))
        fresh = np.flatnonzero(~late)
        if fresh.size:
            self._since = t.size - 1 - int(fresh[-1])
            self._advanced = NAN if arrival is None else float(arrival[fresh[-1]])
        else:
            self._since += t.size
        self._arrived = NAN if arrival is None else float(arrival[-1])
        self._newest = float(highest[-1])

    def _count(self, n: int, late: int) -> None:
        self._batches.append((n, late))
        self._looked += n
        self._late += late
        while self._looked - self._batches[0][0] >= _LOOK:
            n, late = self._batches.popleft()
            self._looked -= n
            self._late -= late

    def start_anew(self) -> None:
        """Take stamps that start anew: a step back counts as one that is late."""
        self._newest = -math.inf
        self._count(1, 1)

    def judge(self, limit: float, interval: float) -> Stamps:
        """Return what the stamps are good for (limit of what is fresh and interval in s)."""
        if self._since >= _FEWEST:
            stopped = self._arrived - self._advanced
            if math.isnan(stopped):
                stopped = self._since * interval
            # Where no interval was ever known the stamps never advanced.
            if not stopped <= limit:
                return Stamps.FROZEN
        if self._looked >= _FEWEST and self._late > _IRREGULAR * self._looked:
            return Stamps.IRREGULAR
        return Stamps.GOOD
