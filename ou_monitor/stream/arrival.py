"""
Messages as they arrive: who sent them, how many were lost, and how old their samples are.

Limits: publishers are told apart by the numbers that each gives its messages, for rclpy does
not say who sent one; two whose numbers and times agree to a message cannot be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

# A stamp is of the clock by which messages are received when it lies no further ahead of that
# clock, and no further behind, s: what unsynchronized clocks, and queues, make.
AHEAD, BEHIND = 0.25, 5.0
# Once it was, a delay up to this, s, is one; no queue holds ten minutes.
MOST_DELAY = 600.0
# A publisher that sends nothing for so long, s, while another does is followed no more.
GIVE_UP = 1.0
# Intervals from which on a silence may be a pause of the publisher.
PAUSE = 10.0
# Tracks kept beyond the publishers that there are, until a batch is over.
_MORE = 4
# Share of a new interval in the interval of a publisher.
_LEARN = 0.05


class SourceClock:
    """
    Age of the newest sample, counted from its stamp where that is of our clock.

    `name` is 'ros' for stamps of the node's clock, 'foreign' where only the arrival counts, and
    'unknown' before anything has arrived.
    """

    def __init__(self) -> None:
        self.name = 'unknown'
        self._delay = 0.0
        self._arrived = -math.inf

    def take(self, stamps: FloatArray, received: FloatArray, arrived: float) -> None:
        """
        Take samples.

        Stamps, and when they were received on the node's clock, s; arrived: when the last of
        them was, on the monotonic clock, s.
        """
        newest = int(np.argmax(stamps))
        delay = float(received[newest] - stamps[newest])
        least = float(np.min(received - stamps))
        if self.name == 'ros' and -AHEAD <= delay <= MOST_DELAY:
            pass
        elif -AHEAD <= least <= BEHIND:
            self.name = 'ros'
        else:
            self.name = 'foreign'
        self._delay = max(delay, 0.0) if self.name == 'ros' else 0.0
        self._arrived = arrived

    def age(self, now: float) -> float | None:
        """Return the age of the newest sample, s (now on the monotonic clock); None: no sample."""
        if self._arrived == -math.inf:
            return None
        return max(now - self._arrived, 0.0) + self._delay


@dataclass
class _Track:
    """The messages of one publisher: number, time and arrival of the last, and the interval."""

    number: int
    time: float
    arrived: float
    interval: float = math.nan

    def off(self, number: int, time: float) -> float:
        """Return how many messages a message lies off what is expected of this publisher."""
        if number <= self.number or time < self.time:
            return math.inf
        step = number - self.number
        if math.isnan(self.interval) or self.interval <= 0.0:
            return float(step - 1)
        expected = (time - self.time) / self.interval
        # Behind a silence either messages were lost, or (less likely by half a message) none was
        # sent.
        return min(abs(step - expected), step - 0.5 if expected > PAUSE else math.inf)

    def take(self, number: int, time: float, arrived: float) -> None:
        """Take a message."""
        if number > self.number:
            interval = (time - self.time) / (number - self.number)
            self.interval = interval if math.isnan(self.interval) else (
                self.interval + _LEARN * (interval - self.interval))
        self.number, self.time, self.arrived = number, time, arrived


class Publishers:
    """
    Follows the first of several publishers of one topic, and counts what is lost of it.

    `lost`: its messages that never came, by their numbers; `foreign`: those of others; `numbered`:
    whether the middleware numbers messages: without, nothing is known of either.
    """

    def __init__(self) -> None:
        self.lost = self.foreign = 0
        self.numbered = True
        self._tracks: list[_Track] = []

    def follow(self, numbers: list[int | None], times: FloatArray, arrived: FloatArray,
               publishers: int) -> npt.NDArray[np.bool_]:
        """
        Return which messages are those of the publisher followed.

        Numbers of the messages, when they were sent and when they arrived, s; `publishers`: how
        many there are just now.
        """
        kept = np.ones(len(numbers), dtype=np.bool_)
        if not numbers:
            return kept
        if any(number is None for number in numbers):
            self.numbered = False
            return kept
        whole = np.array(numbers, dtype=np.int64)
        if publishers <= 1 and self._tracks and (
                arrived[0] - max(track.arrived for track in self._tracks) > GIVE_UP):
            # The only one begins anew behind a silence: whoever else was here is gone.
            del self._tracks[1:]
        if publishers <= 1 and len(self._tracks) <= 1:
            self._alone(whole, times, arrived)
            return kept
        for k, (number, time, at) in enumerate(
                zip(whole.tolist(), times.tolist(), arrived.tolist())):
            kept[k] = self._one(number, time, at, publishers)
        self._give_up(publishers)
        return kept

    def _give_up(self, publishers: int) -> None:
        """
        Forget who is gone, and follow another where the one followed sends nothing.

        Only after all that came: behind a stall, when nobody was heard, the first message may be
        anybody's.
        """
        while len(self._tracks) > max(publishers, 2):
            # Somebody began anew: who has been silent for longest is gone.
            gone = min(range(len(self._tracks)), key=lambda k: self._tracks[k].arrived)
            del self._tracks[gone]
            if gone == 0:
                self._tracks.insert(0, self._tracks.pop())
        last = max(range(len(self._tracks)), key=lambda k: self._tracks[k].arrived)
        if self._tracks[last].arrived - self._tracks[0].arrived > GIVE_UP:
            self._tracks[0] = self._tracks.pop(last)

    def _alone(self, numbers: npt.NDArray[np.int64], times: FloatArray, arrived: FloatArray
               ) -> None:
        """Take messages of the only publisher; numbers that begin anew are a new one."""
        if self._tracks:
            steps = np.diff(numbers, prepend=self._tracks[0].number)
            self.lost += int(np.sum(steps[steps > 0] - 1))
        else:
            self._tracks = [_Track(int(numbers[0]), float(times[0]), float(arrived[0]))]
            steps = np.diff(numbers)
            self.lost += int(np.sum(steps[steps > 0] - 1))
        track = self._tracks[0]
        step = int(numbers[-1]) - track.number
        if step > 0 and times[-1] > track.time:
            track.take(int(numbers[-1]), float(times[-1]), float(arrived[-1]))
        else:
            self._tracks[0] = _Track(int(numbers[-1]), float(times[-1]), float(arrived[-1]),
                                     track.interval)

    def _one(self, number: int, time: float, arrived: float, publishers: int) -> bool:
        """Assign one message; return whether it is of the publisher followed."""
        off = [track.off(number, time) for track in self._tracks]
        best = min(range(len(off)), key=off.__getitem__, default=-1)
        # A number that fits nobody well is a newcomer's, as long as not all have been heard.
        new = best < 0 or off[best] == math.inf or (
            len(self._tracks) < publishers and off[best] > 0.5 * max(
                10, self._tracks[best].number))
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
