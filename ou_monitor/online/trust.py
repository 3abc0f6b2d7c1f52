"""
Decide whether an input can be trusted, from its stamps, its unit, and whether it is stuck.

`SupplyMonitor` uses `InputTrust`, in the node and offline; the adaptive filter checks its messages
with the same `StampWatch`, and falls back to arrival times (`InputClock`).

Limits: stamps count as good while at most a tenth of them are late; repeated messages do not count
as late. Until the reading first changes, a stuck sensor looks like a coarse one, so both count as
stuck.
"""

from __future__ import annotations

from collections import deque
import enum
import math

import numpy as np
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import FloatArray, NAN

# Silence after which a fast source is stale, even if `stale_after` is longer: this number of
# sample intervals, but at least this time, s, because a busy computer may pause that long.
MISSED, LEAST_PATIENCE = 300, 0.3
# Minimum number of samples for the rate of a source.
_MEASURED = 20
# Number of intervals after which a slow source is stale: two missed messages, and half an
# interval of jitter.
SLOW_MISSED = 2.5
# Minimum step between arrivals of a slow source, s; LEAST_PATIENCE covers shorter steps.
_SLOW_STEP = LEAST_PATIENCE / SLOW_MISSED
# The interval is the median of this number of latest slow steps; minimum number of them; minimum
# share of the time that they must cover.
_SLOW_KEPT, _SLOW_FEWEST, _SLOW_SHARE = 5, 2, 0.5
# Number of latest messages among which late ones are counted; minimum number for a decision.
_LOOK, _FEWEST = 200, 20
_IRREGULAR = 0.1  # Share of late messages above which a source is irregular
# A stamp this far behind the newest, s, starts a new time line (as in `stream.samples`).
BACK = 0.1
# Time without a newer stamp after which the stamps of the filter's input count as frozen, s: 10
# ticks of a clock of 10 ms.
FROZEN_AFTER = 0.1


def patience(settings: MonitorSettings, rate: float, n: int, interval: float = 0.0) -> float:
    """Return the silence after which a source is stale, s (interval between arrivals, s)."""
    limit = settings.stale_after
    if n >= _MEASURED and rate > 0.0:
        limit = min(limit, max(LEAST_PATIENCE, MISSED / rate))
    return max(limit, SLOW_MISSED * interval)


class SourceInterval:
    """Interval between arrivals of a slow source, s; 0 if unknown or at most 0.12 s."""

    def __init__(self) -> None:
        self.value = 0.0
        self._last = NAN
        # Start and length of each of the last slow steps, s.
        self._steps: deque[tuple[float, float]] = deque(maxlen=_SLOW_KEPT)

    def push(self, times: FloatArray) -> None:
        """Take times in order of arrival, s; a step back discards earlier steps."""
        now = float(times[-1])
        if not 0.0 <= now - self._last <= _SLOW_STEP:
            steps = np.diff(times, prepend=self._last)
            for k in np.flatnonzero(steps > _SLOW_STEP)[-_SLOW_KEPT:].tolist():
                self._steps.append((float(times[k] - steps[k]), float(steps[k])))
        self._end(now)

    def push_one(self, time: float) -> None:
        """Take one time, s."""
        if time - self._last > _SLOW_STEP:
            self._steps.append((self._last, time - self._last))
        self._end(time)

    def _end(self, now: float) -> None:
        if now < self._last:
            self._steps.clear()
        self._last = now
        if not self._steps:
            self.value = 0.0
            return
        lengths = sorted(length for _, length in self._steps)
        slow = len(lengths) >= _SLOW_FEWEST and (
            sum(lengths) >= _SLOW_SHARE * (now - self._steps[0][0]))
        self.value = lengths[(len(lengths) - 1) // 2] if slow else 0.0


class StampOrder(enum.Enum):
    """Quality of the stamps; the value is the defect and the remedy, in words."""

    GOOD = 'The stamps increase', ''
    FROZEN = ('Samples arrive, but their stamps do not advance',
              'the driver must set header.stamp for every message')
    IRREGULAR = ('The stamps of the samples go back and forth',
                 'look for a second source of the topic, or a driver with two clocks')

    def sentence(self, effect: str) -> str:
        """Return a sentence for the pilot, with the effect of the defect."""
        defect, remedy = self.value
        return f'{defect}: {effect}; {remedy}.'


class StampWatch:
    """Checks that stamps of arriving samples advance; `newest`: newest of this time line, s."""

    def __init__(self) -> None:
        self.newest = -math.inf
        # For each recent batch: number of samples, and number of those that were late or started a
        # new time line.
        self._batches: deque[tuple[int, int]] = deque()
        self._looked = self._late = 0
        # Number of samples since the newest stamp; arrival of that stamp, and of the last sample.
        self._since = 0
        self._advanced = self._arrived = NAN

    def push(self, t: FloatArray, arrival: FloatArray | None = None) -> None:
        """Take stamps in order of arrival (t in s, arrival in s on a monotonic clock)."""
        good = np.isfinite(t)
        if not good.all():
            t, arrival = t[good], None if arrival is None else arrival[good]
        if not t.size:
            return
        highest = np.maximum.accumulate(np.concatenate(([self.newest], t)))
        late = t <= highest[:-1]
        # Repeats of the newest message are not disorder.
        self._count(t.size, int(np.count_nonzero(t < highest[:-1])))
        fresh = np.flatnonzero(~late)
        if fresh.size:
            self._since = t.size - 1 - int(fresh[-1])
            self._advanced = NAN if arrival is None else float(arrival[fresh[-1]])
        else:
            self._since += t.size
        self._arrived = NAN if arrival is None else float(arrival[-1])
        self.newest = float(highest[-1])

    def push_one(self, t: float, arrival: float) -> None:
        """Take one stamp, as `push`."""
        self._count(1, int(t < self.newest))
        self._arrived = arrival
        if t <= self.newest:
            self._since += 1
        else:
            self._since, self._advanced, self.newest = 0, arrival, t

    def _count(self, n: int, late: int) -> None:
        self._batches.append((n, late))
        self._looked += n
        self._late += late
        while self._looked - self._batches[0][0] >= _LOOK:
            n, late = self._batches.popleft()
            self._looked -= n
            self._late -= late

    def start_anew(self) -> None:
        """Start a new time line; a step back counts as one late sample."""
        self.newest = -math.inf
        self._count(1, 1)

    def judge(self, limit: float, interval: float) -> StampOrder:
        """Return the quality of the stamps (age limit and interval in s)."""
        if self._since >= _FEWEST:
            stopped = self._arrived - self._advanced
            if math.isnan(stopped):
                stopped = self._since * interval
            # An unknown interval (NaN) means that the stamps never advanced.
            if not stopped <= limit:
                return StampOrder.FROZEN
        if self._looked >= _FEWEST and self._late > _IRREGULAR * self._looked:
            return StampOrder.IRREGULAR
        return StampOrder.GOOD


class InputClock:
    """Times of messages: stamps, or arrival times if stamps are bad; no message is dropped."""

    def __init__(self) -> None:
        self.stamps = StampOrder.GOOD
        # Number of messages whose arrival time was used.
        self.by_arrival = 0
        self._watch = StampWatch()
        self._arrived = self._time = NAN  # Of the last message, s
        self._shift = 0.0  # Time less stamp, s

    def time_of(self, stamp: float, arrived: float) -> float:
        """Return the time of a message, s (stamp in s, arrived in s on a monotonic clock)."""
        if stamp < self._watch.newest - BACK:
            self._watch.start_anew()
        self._watch.push_one(stamp, arrived)
        before, self.stamps = self.stamps, self._watch.judge(FROZEN_AFTER, NAN)
        if self.stamps is not StampOrder.GOOD:
            self.by_arrival += 1
        if StampOrder.GOOD is before is self.stamps or math.isnan(self._time):
            self._time = stamp + self._shift
        else:
            # Once the stamps are good again, they continue from this time.
            self._time += max(arrived - self._arrived, 0.0)
            self._shift = self._time - stamp
        self._arrived = arrived
        return self._time


# A sensor is stuck if its reading is constant for more than this time, s, and at least this number
# of readings; if it has never changed, the number suffices.  Longest constant readings of working
# sources: 2.81 s (139 readings) on the ground (in_xr_141340); in flight 1.70 s (172 readings,
# cf_solo_large), or 3 readings at 1 Hz (ac_jd_2004).
_STUCK, _STUCK_READINGS = 5.0, 10
# While throttle is constant, the limit is at least this factor times the longest constant run that
# ended with one ADC step: a coarse ADC repeats its reading during a slow discharge.
_QUIET = 4.0
# Range within which throttle counts as constant (cf_solo_large: 0.019 within 1.06 s of hover).
_STILL = 0.05
# Maximum size of one ADC step, in smallest changes: printed digits round steps (5 or 6 mV).
_ONE_STEP = 1.5
# Maximum time, s, that one sample interval adds to a constant run: most of a gap is not counted.
_COUNTED = 1.0
# Minimum change, as a share of the reading: float32 rounds by 6e-8.
_CHANGE = 1e-6


class ConstantReading:
    """Measures for how long the reading has been constant, and how long earlier runs lasted."""

    def __init__(self) -> None:
        self.value = NAN
        self.changed = False
        # The present run: readings, time in s, lowest and highest throttle (NaN: unknown).
        self._n, self._time = 0, 0.0
        self._throttle = (NAN, NAN)
        # Smallest change, V, and longest run that ended with one ADC step, s.
        self._step, self._quiet = math.inf, 0.0
        self._at = NAN

    def push(self, t: FloatArray, voltage: FloatArray, throttle: FloatArray | None) -> None:
        """Take finite readings in order of arrival (t in s, of arrival where it is known)."""
        if not voltage.size:
            return
        # Indices at which the reading changes; the first readings may continue the present run.
        before = np.concatenate(([self.value], voltage))
        size = np.abs(before[1:] - before[:-1])
        moved = (size > _CHANGE * np.abs(voltage)).nonzero()[0]
        times = np.concatenate(([self._at], t))
        steps = times[1:] - times[:-1]
        # The step before the first reading is NaN, and counts as 0.
        elapsed = np.fmin(np.fmax(steps, 0.0), _COUNTED).cumsum()
        self._at, self.value = float(t[-1]), float(voltage[-1])
        begin = 0
        if moved.size:
            self.changed = True
            size = size[moved]
            self._step = min(self._step, float(size.min()))
            ends = np.concatenate(([-self._time], elapsed[moved]))
            lasted = (ends[1:] - ends[:-1])[size <= _ONE_STEP * self._step]
            if lasted.size:
                self._quiet = max(self._quiet, float(lasted.max()))
            begin = int(moved[-1])
            self._n, self._time, self._throttle = 0, -float(elapsed[begin]), (NAN, NAN)
        self._n += voltage.size - begin
        self._time += float(elapsed[-1])
        if throttle is not None:
            load = throttle[begin:]
            self._throttle = (float(np.fmin.reduce(load, initial=self._throttle[0])),
                              float(np.fmax.reduce(load, initial=self._throttle[1])))

    @property
    def why(self) -> str:
        """Return why the reading may be stuck; empty if it is not."""
        if self._n < _STUCK_READINGS:
            return ''
        if not self.changed:
            return (f'The voltage has been {self.value:g} V in all {self._n} readings since the '
                    'start: the sensor is stuck, or its step is larger than the changes of the '
                    'supply; move the throttle, or check the sensor.')
        limit = _STUCK
        low, high = self._throttle
        if high - low <= _STILL:
            limit = max(limit, _QUIET * self._quiet)
        if self._time <= limit:
            return ''
        return (f'The sensor is stuck: the voltage has been {self.value:g} V for '
                f'{self._time:.1f} s ({self._n} readings); up to {limit:.1f} s is accepted.')


# Number of readings whose median is compared with unit and limit.
_RECENT = 21
# Highest plausible voltage, V: the largest brownout.voltage that can be set.
MOST_SUPPLY = 1000.0
# Ratio of readings to the limit above which the unit or the limit is wrong: more than for a full
# pack of 24 cells with the default limit (22), less than for hundredths of a volt (100).
_UNIT = 50.0


class Doubt(enum.Enum):
    """Why the input is not trusted."""

    NONE = ''
    STAMPS = 'stamps'
    STUCK = 'stuck'
    UNIT = 'unit'
    LIMIT = 'limit'
    OTHER = 'other'


class InputTrust:
    """Decides whether the input is trusted, and for which reason it is not."""

    def __init__(self) -> None:
        self._stamps = StampWatch()
        self._interval = SourceInterval()
        self._still = ConstantReading()
        self._recent = np.empty(0)
        # Reason set by the caller; empty: none.
        self.outside = ''

    def push(self, t: FloatArray, voltage: FloatArray, throttle: FloatArray | None,
             arrival: FloatArray | None) -> None:
        """Take samples in order of arrival (t in s, V, 0..1, arrival in s); NaN: unknown."""
        if not t.size:
            return
        self._stamps.push(t, arrival)
        times = t if arrival is None else arrival
        placed = np.isfinite(times)
        if placed.all():
            self._interval.push(times)
        elif placed.any():
            self._interval.push(times[placed])
        self.push_readings(times, voltage, throttle)

    def push_readings(self, times: FloatArray, voltage: FloatArray,
                      throttle: FloatArray | None = None) -> None:
        """Take readings without stamps (times in s, by arrival where it is known)."""
        good = np.isfinite(voltage + times)
        if not good.all():
            times, voltage = times[good], voltage[good]
            throttle = None if throttle is None else throttle[good]
        self._still.push(times, voltage, throttle)
        self._recent = (voltage[-_RECENT:].copy() if voltage.size >= _RECENT else
                        np.concatenate((self._recent, voltage))[-_RECENT:])

    def start_anew(self) -> None:
        """Start a new time line."""
        self._stamps.start_anew()

    @property
    def interval(self) -> float:
        """Interval between arrivals of a slow source, s; 0 for a fast one."""
        return self._interval.value

    def stamps(self, limit: float, interval: float) -> StampOrder:
        """Return the quality of the stamps; see `StampWatch.judge`."""
        return self._stamps.judge(limit, interval)

    def doubt(self, stamps: StampOrder, limit: float) -> tuple[Doubt, str]:
        """Return why the input is not trusted, and a sentence (limit: brownout.voltage, V)."""
        if self.outside:
            return Doubt.OTHER, self.outside
        if stamps is not StampOrder.GOOD:
            return Doubt.STAMPS, stamps.sentence('they allow no estimate')
        if limit <= 0.0:
            return Doubt.LIMIT, (
                f'brownout.voltage is {limit:g} V: no voltage is below it, and the floor is off; '
                'set the lowest voltage that the load tolerates.')
        usual = float(np.median(np.abs(self._recent))) if self._recent.size else NAN
        if usual > MOST_SUPPLY or usual > _UNIT * limit:
            ratio = usual / limit
            unit = ', as hundredths of a volt would' if ratio < 5.0 * _UNIT else (
                ', as millivolts would' if ratio < 1e4 else '')
            return Doubt.UNIT, (
                f'The voltage reads {usual:.4g} V, {ratio:.3g} times brownout.voltage '
                f'({limit:g} V){unit}: set unit_factor in the msg_config, or brownout.voltage.')
        why = self._still.why
        return (Doubt.STUCK, why) if why else (Doubt.NONE, '')
