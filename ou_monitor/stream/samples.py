"""
Turn messages into ordered samples, each with its throttle, for the monitor.

Publishers: rclpy does not report the sender, so publishers are distinguished by the sequence
numbers of their messages; two with equal numbers and times cannot be distinguished.

Throttle: one rule for the node and offline.  A throttle holds from its own stamp on if its clock
is the same as the voltage's, otherwise from the next voltage message on.  The clocks are compared
at each throttle message, with the newest voltage stamp received by then.  A throttle has no
maximum age: the caller, who knows the present time, decides when it is too old.  Samples handed to
the monitor are final: a throttle that arrives later applies to later samples only.

Blocks: the stamp of a block of ADC samples is the *arrival* time of its last sample, which bus and
scheduler delay by some milliseconds that vary from block to block. The samples themselves are
timed by a quartz, so their time line runs at the stated rate and follows the stamps only slowly. A
constant delay is not corrected; one lost block (within max(2 blocks, 0.25 s)) looks like jitter:
it is not counted as a gap, and the time line catches up slowly.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from ou_monitor.stream.config import FieldSpec
from ou_monitor.timeline import BATCH

if TYPE_CHECKING:
    from ou_monitor.online.monitor import SupplyMonitor


# Maximum lead (unsynchronized clocks) and lag (queues) of a stamp of the receiver's clock, s;
# beyond them, the stamp is from another clock.
AHEAD, BEHIND = 0.25, 5.0
# Largest delay once the clock is known, s: no queue delays messages by ten minutes.
MOST_DELAY = 600.0
# Silence of the followed publisher, s, after which another one is followed.
GIVE_UP = 1.0
# Minimum silence, in message intervals, that may be a pause of the publisher rather than a loss.
PAUSE = 10.0
# Maximum number of tracks within a batch, in excess of the number of publishers.
_MORE = 4
# Weight of a new interval in the mean interval of a publisher.
_LEARN = 0.05


class SourceClock:
    """Computes the age of the newest sample; `name`: its clock, 'ros', 'foreign' or 'unknown'."""

    def __init__(self) -> None:
        self.name = 'unknown'
        self._delay = 0.0
        self._arrived = -math.inf

    def take(self, stamps: FloatArray, received: FloatArray, arrived: float) -> None:
        """Register stamps and arrivals, s (arrived: the last arrival on the monotonic clock)."""
        newest = int(np.argmax(stamps))
        delay = float(received[newest] - stamps[newest])
        least = float(np.min(received - stamps))
        still = self.name == 'ros' and -AHEAD <= delay <= MOST_DELAY
        self.name = 'ros' if still or -AHEAD <= least <= BEHIND else 'foreign'
        self._delay = max(delay, 0.0) if self.name == 'ros' else 0.0
        self._arrived = arrived

    def age(self, now: float) -> float | None:
        """Return the age of the newest sample, s (now on the monotonic clock); None: no sample."""
        if self._arrived == -math.inf:
            return None
        return max(now - self._arrived, 0.0) + self._delay


@dataclass
class _Track:
    """One publisher: number, time and arrival of its last message, and its mean interval."""

    number: int
    time: float
    arrived: float
    interval: float = math.nan

    def deviation(self, number: int, time: float) -> float:
        """Return how far a message's number is from the one expected of this publisher."""
        if number <= self.number or time < self.time:
            return math.inf
        step = number - self.number
        if math.isnan(self.interval) or self.interval <= 0.0:
            return float(step - 1)
        expected = (time - self.time) / self.interval
        # A silence means lost messages or a pause; assume a pause only if it fits better by half a
        # message.
        return min(abs(step - expected), step - 0.5 if expected > PAUSE else math.inf)

    def take(self, number: int, time: float, arrived: float) -> None:
        if number > self.number:
            interval = (time - self.time) / (number - self.number)
            self.interval = interval if math.isnan(self.interval) else (
                self.interval + _LEARN * (interval - self.interval))
        self.number, self.time, self.arrived = number, time, arrived


class Publishers:
    """
    Follows the first of several publishers of one topic, and counts its lost messages.

    `lost`: messages missing from its sequence numbers; `foreign`: messages of others; `numbered`:
    whether the middleware numbers messages (if not, both counts are unknown).
    """

    def __init__(self) -> None:
        self.lost = self.foreign = 0
        self.numbered = True
        self._tracks: list[_Track] = []

    def follow(self, numbers: list[int | None], times: FloatArray, arrived: FloatArray,
               publishers: int) -> npt.NDArray[np.bool_]:
        """Return which messages, at least one, to keep (times of sending and arrival, s)."""
        kept = np.ones(len(numbers), dtype=np.bool_)
        whole = [number for number in numbers if number is not None]
        if len(whole) < len(numbers):
            self.numbered = False
            return kept
        if publishers <= 1 and self._tracks and (
                arrived[0] - max(track.arrived for track in self._tracks) > GIVE_UP):
            # Only one publisher is left after a silence: drop the tracks of the others.
            del self._tracks[1:]
        for k, (number, time, at) in enumerate(zip(whole, times.tolist(), arrived.tolist())):
            kept[k] = self._take_one(number, time, at, publishers)
        self._give_up(publishers)
        return kept

    def _give_up(self, publishers: int) -> None:
        """After a whole batch, forget publishers that are gone, and if need be follow another."""
        while len(self._tracks) > max(publishers, 2):
            # A publisher has restarted: drop the track that has been silent longest.
            gone = min(range(len(self._tracks)), key=lambda k: self._tracks[k].arrived)
            del self._tracks[gone]
            if gone == 0:
                self._tracks.insert(0, self._tracks.pop())
        last = max(range(len(self._tracks)), key=lambda k: self._tracks[k].arrived)
        if self._tracks[last].arrived - self._tracks[0].arrived > GIVE_UP:
            self._tracks[0] = self._tracks.pop(last)

    def _take_one(self, number: int, time: float, arrived: float, publishers: int) -> bool:
        """Assign one message to a publisher; return whether it is the followed one."""
        off = [track.deviation(number, time) for track in self._tracks]
        best = min(range(len(off)), key=off.__getitem__, default=-1)
        # A number that fits no track well belongs to a publisher not seen yet, if there is one.
        new = best < 0 or off[best] == math.inf or (
            len(self._tracks) < publishers and off[best] > 0.5 * max(
                10, self._tracks[best].number))
        if new and publishers <= 1 and len(self._tracks) == 1:
            # The only publisher has restarted.
            self._tracks = [_Track(number, time, arrived, self._tracks[0].interval)]
            return True
        if new:
            self._tracks.append(_Track(number, time, arrived))
            best = len(self._tracks) - 1
            if len(self._tracks) > max(publishers, 2) + _MORE:
                del self._tracks[min(range(1, best), key=lambda k: self._tracks[k].arrived)]
                best -= 1
        elif best == 0:
            self.lost += number - self._tracks[0].number - 1
        track = self._tracks[best]
        track.take(number, time, arrived)
        self.foreign += best > 0
        return best == 0


BoolArray = npt.NDArray[np.bool_]

# Time constant with which the time line follows the stamps, s.  5 ms of jitter then changes the
# spacing by at most 5e-4 (0.05 us at 10 kHz); a clock error of 100 ppm leaves a lag of 1 ms.
FOLLOW = 10.0

# A stamp that differs from the time line by more than this, and by more than two blocks, reveals a
# gap; a busy companion computer delays blocks by about 100 ms and then sends them all.
GAP_LEAST = 0.25  # s


class BlockClock:
    """Turns stamps of blocks into stamps of samples; `gaps` counts restarts of its time line."""

    def __init__(self, sample_rate: float) -> None:
        """Start without a time line: the first block sets it."""
        if not (math.isfinite(sample_rate) and sample_rate > 0.0):
            raise ValueError(f'sample_rate must be positive and finite, got {sample_rate} Hz')
        self.gaps = 0
        self._dt = 1.0 / sample_rate
        # Seconds since an anchor: sums on a clock from 1970 would be rounded to 0.24 us at every
        # block, always the same way.
        self._anchor: float | None = None
        self._elapsed = 0.0

    def reset(self) -> None:
        """Forget the time line, as after a clock that jumped back; this is not a gap."""
        self._anchor = None

    def stamps(self, end_stamps: FloatArray, n: npt.NDArray[np.int64]) -> FloatArray:
        """Return the stamps of the n samples of each of the next blocks (end_stamps in s)."""
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
                # Spread the correction over the block, so that blocks join without a step.
                lean = error * -math.expm1(-length / FOLLOW)
                self._elapsed = start + length + lean
                return start, 1, (length + lean) / n
            self.gaps += 1
        self._anchor, self._elapsed = end_stamp, 0.0
        return 0.0, 1 - n, self._dt


def clock_of(spec: FieldSpec) -> BlockClock | None:
    """Return the time line of a field of blocks; None for single values."""
    return None if spec.sample_rate is None else BlockClock(spec.sample_rate)


# Difference of voltage and throttle stamps, s, above which they are from different clocks (an
# autopilot's boot time and a wall clock differ by years).
APART = 5.0
# The same limit, s, if one of the two has its own stamp, and the other only its time of sending or
# logging: transmission takes milliseconds, and unsynchronized clocks may differ by little.
APART_MIXED = 0.25
# Tolerance between the stamps of a sample and of a throttle, as a share of a step: stamps within a
# block are computed, and may be too early by a rounding error.
SLACK = 0.1


class ThrottleHold:
    """Throttle on the time line of the voltage (sample_rate of blocks, Hz)."""

    def __init__(self, sample_rate: float | None = None) -> None:
        self._slack = 0.0 if sample_rate is None else SLACK / sample_rate
        # Stamps from which values hold, and the values: one array for each call, until they are
        # joined in order into one.
        self._places, self._values = [np.empty(0)], [np.empty(0)]
        self._latest, self._newest, self._own = -math.inf, -math.inf, False

    def take(self, stamps: FloatArray, values: FloatArray, own: BoolArray,
             voltage_stamps: FloatArray, voltage_own: BoolArray,
             before: npt.NDArray[np.int64]) -> None:
        """
        Register the throttle values and voltage messages received since the last call.

        Each kind is in order of arrival: stamps in s (NaN: unknown), `own` whether a message
        carries its stamp, `before` the number of these voltage messages that came before each
        throttle value.  At least one voltage message must have arrived, now or earlier.
        """
        newest = np.maximum.accumulate(np.concatenate([[self._newest], voltage_stamps]))
        owns = np.concatenate([[self._own], voltage_own])
        if stamps.size:
            after, after_own = newest[before], owns[before]
            compared = after
            if self._newest == -math.inf:
                # No voltage had arrived: compare with the first one that does.
                early = before == 0
                compared = np.where(early, voltage_stamps[0], after)
                after_own = np.where(early, voltage_own[0], after_own)
            apart = np.where(own == after_own, APART, APART_MIXED)
            one_clock = np.abs(stamps - compared) <= apart
            # With another clock, place by arrival: after the newest voltage and earlier throttles.
            latest = np.maximum.accumulate(np.concatenate([[self._latest], np.where(
                one_clock, stamps, np.nextafter(after + 2.0 * self._slack, math.inf))]))[1:]
            self._places.append(np.where(one_clock, stamps, latest))
            self._values.append(values)
            self._latest = float(latest[-1])
        self._newest, self._own = float(newest[-1]), bool(owns[-1])

    def held(self) -> tuple[FloatArray, FloatArray]:
        """Return the stamps, s, from which values hold, in order, and the values."""
        if len(self._places) > 1:
            places, values = np.concatenate(self._places), np.concatenate(self._values)
            order = np.argsort(places, kind='stable')
            self._places, self._values = [places[order]], [values[order]]
        return self._places[0], self._values[0]

    def at(self, t: FloatArray) -> FloatArray:
        """Return the throttle at each stamp, s; NaN before the first one."""
        places, values = self.held()
        values = np.append(np.nan, values)
        found = np.empty(t.size)
        # In parts: the indices of all samples at once would take as much memory as the samples.
        for k in range(0, t.size, BATCH):
            part = slice(k, k + BATCH)
            found[part] = values[np.searchsorted(places, t[part] + self._slack, 'right')]
        return found

    def forget_before(self, t: float) -> None:
        """Drop the values that samples from `t`, s, on do not need."""
        places, values = self.held()
        past = max(int(np.searchsorted(places, t + self._slack, 'right')) - 1, 0)
        self._places, self._values = [places[past:]], [values[past:]]

    def restart(self, value: float = math.nan) -> None:
        """Start a new time line of the voltage, in which `value` holds from the start."""
        self._places, self._values = [np.array([-math.inf])], [np.array([value])]
        self._latest, self._newest, self._own = -math.inf, -math.inf, False


# Backward step of a stamp, s, above which the clock or the bag went back.  Messages of a publisher
# arrive in order; interleaved publishers differ by milliseconds.
BACK = 0.1
# Throttle values kept until the next voltage: 20 s of a 50 Hz stick, or 1 s at 1 kHz.
KEEP = 1024


class SampleStream:
    """
    Collects samples between two reports for the monitor; `flush` pairs them with the throttle.

    `messages`: number of voltage messages; `unplaced`: number without a time (`/clock` has not
    started), checked against the voltage floor only; one in `thin` samples enters the estimate.
    """

    def __init__(self, monitor: SupplyMonitor) -> None:
        self._monitor = monitor
        self._block: BlockClock | None = None
        # Whether throttles that are not finite are transmission errors.
        self._drop = True
        self._hold = ThrottleHold()
        # Stamps, voltages, arrivals and currents (NaN: unknown) since the last flush.
        self._samples: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = []
        # Stamp of each voltage message since then, and whether the message carries it.
        self._ends: list[FloatArray] = []
        self._own: list[BoolArray] = []
        self._count = 0
        # Throttles since then: stamp, value, whether the stamp is the message's own, number of
        # voltage messages before it.
        self._loads: deque[tuple[float, float, bool, int]] = deque(maxlen=KEEP)
        self._empty = True
        self._newest = self._newest_throttle = -math.inf
        self._last_throttle = math.nan
        self.thin = 1
        self.messages = self.unplaced = 0

    def open_voltage(self, spec: FieldSpec) -> None:
        """Set the field of the voltage's messages."""
        self._block = clock_of(spec)
        self._hold = ThrottleHold(spec.sample_rate)

    def open_throttle(self, spec: FieldSpec) -> None:
        """Set the field of the throttle's messages."""
        self._drop = spec.nan == 'drop'

    @property
    def throttle(self) -> float:
        """Newest throttle, 0..1; NaN when unknown."""
        return self._last_throttle

    def take_voltages(self, ends: FloatArray, own: BoolArray, counts: npt.NDArray[np.int64],
                      values: FloatArray, arrived: FloatArray | None = None,
                      current: FloatArray | None = None) -> BoolArray:
        """
        Add voltage messages in order of arrival; return which held a voltage.

        For each message: ends, the stamp (of the last sample of a block), s, NaN if unknown; own,
        whether the message carries it; counts, its number of values, V; arrived, its arrival on a
        monotonic clock, s; current, A.
        """
        self.messages += ends.size
        unknown = np.full(ends.size, math.nan)
        arrived = unknown if arrived is None else arrived
        current = unknown if current is None else current
        placed = np.isfinite(ends)
        self.unplaced += ends.size - int(np.count_nonzero(placed))
        placed &= counts > 0
        held = placed & (np.add.reduceat(np.append(np.isfinite(values), False).astype(np.int64),
                                         np.cumsum(counts) - counts) * (counts > 0) > 0)
        if not placed.all():
            lost = np.repeat(~placed, counts)
            if lost.any():
                # Check them against the voltage floor, after the earlier samples.
                self.flush()
                self._monitor.watch(values[lost], np.repeat(arrived, counts)[lost])
            values = values[np.repeat(placed, counts)]
            ends, own, counts = ends[placed], own[placed], counts[placed]
            arrived, current = arrived[placed], current[placed]
        if not ends.size:
            return held
        stamps = ends if self._block is None else self._block.stamps(ends, counts)
        last = np.cumsum(counts) - 1
        firsts, ends = stamps[last + 1 - counts], stamps[last]
        columns = stamps, values, np.repeat(arrived, counts), np.repeat(current, counts)
        # Late blocks are stamped along the time line: stamps go back only when it restarts.
        before = np.concatenate(([self._newest], ends[:-1]))
        back = np.flatnonzero(firsts < before - BACK)
        # The last of several backward steps in one call counts.
        begin = int(back[-1]) if back.size else 0
        at = int(counts[:begin].sum())
        if back.size:
            self._add(ends[:begin], own[:begin], *(column[:at] for column in columns))
            self._begin_anew(f'stamps went back by {before[begin] - firsts[begin]:.3g} s')
        self._add(ends[begin:], own[begin:], *(column[at:] for column in columns))
        return held

    def _add(self, ends: FloatArray, own: BoolArray, stamps: FloatArray, values: FloatArray,
             arrived: FloatArray, current: FloatArray) -> None:
        """Add messages whose stamps do not go back, with the columns of their samples."""
        if not ends.size:
            return
        self._samples.append((stamps, values, arrived, current))
        self._ends.append(ends)
        self._own.append(own)
        self._count += ends.size
        self._newest = max(self._newest, float(ends.max()))

    def add_throttle(self, end: float, own: bool, value: float) -> bool:
        """Add one throttle message (end: its stamp, s; own: whether the stamp is its own)."""
        if end < self._newest_throttle - BACK:
            self.flush()
            self._hold.restart(self._last_throttle)
        if math.isfinite(end):
            self._newest_throttle = end
        if math.isfinite(value) or not self._drop:
            self._loads.append((end, value, own, self._count))
            self._last_throttle = value
        return math.isfinite(self._last_throttle)

    def lose_throttle(self) -> None:
        """Set the throttle to unknown from here on: its source is silent."""
        self._last_throttle = math.nan
        self._loads.append((math.nan, math.nan, False, self._count))

    def flush(self) -> None:
        """Hand the samples collected to the monitor."""
        if not self._samples:
            return
        t, v, arrived, current = (np.concatenate(column) for column in zip(*self._samples))
        ends, owns = np.concatenate(self._ends), np.concatenate(self._own)
        stamps, values, own, before = np.array(self._loads, dtype=np.float64).reshape(-1, 4).T
        # Clear first: after an error of the monitor these samples must not be pushed again.
        self._samples, self._ends, self._own, self._count = [], [], [], 0
        self._loads.clear()
        self._empty = False
        self._hold.take(stamps, values, own > 0.0, ends, owns, before.astype(np.int64))
        self._monitor.push(t, v, self._hold.at(t), None if np.isnan(arrived).any() else arrived,
                           current=current if np.isfinite(current).any() else None,
                           thin=self.thin)
        self._hold.forget_before(self._newest - BACK)

    def reset(self, reason: str) -> None:
        """Clear the window and start a new time line."""
        self._begin_anew(reason)
        if self._block is not None:
            self._block.reset()

    def _begin_anew(self, reason: str) -> None:
        """Clear the window, and restart the throttle's time line, but not the block clock's."""
        self.flush()
        if not self._empty:
            self._monitor.reset(reason)
            self._empty = True
        self._newest = -math.inf
        self._hold.restart(self._last_throttle)
