"""
The node of `replay`: publish the messages of a bag as recorded, and /clock.

The schedule is absolute, so a late message does not delay later ones.  Unpacking a chunk of a bag
takes longer than the spacing of its messages, so a thread reads a limited number of messages
ahead.
"""

from __future__ import annotations

import argparse
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
import gc
import itertools
import math
import sys
import time
from typing import Any

import numpy as np
from ou_monitor.errors import InputError, nearest
from ou_monitor.nodes.base import SWITCH, wait_until
from ou_monitor.nodes.run import one_line
from ou_monitor.nodes.sources import message_class
from ou_monitor.recordings.bag import BagReader
from ou_monitor.recordings.write import LAST_HEADER_NS
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage

# Depth of the publishers' queues, which must hold a burst until the middleware has sent it.
DEPTH = 1000
# Maximum wait at the end until reliable subscribers have received all messages.
FLUSH = Duration(seconds=1)

RCLError = rclpy_implementation.RCLError

Message = tuple[str, str, int, bytes]
# Number of messages in a batch, and maximum number of batches that the thread reads ahead: about
# 20 s at 10 kHz, and 50 MB.
BATCH, AHEAD = 1000, 200


class SpacingError:
    """Deviations of the spacing of events from the intended spacing, in whole microseconds."""

    def __init__(self) -> None:
        # A histogram takes no more memory for days of replay than for minutes.
        self._counts: Counter[int] = Counter()
        self._last: tuple[float, float] | None = None

    def restart(self) -> None:
        """Begin a new pass, without counting the gap before it."""
        self._last = None

    def add(self, due: float, done: float) -> None:
        """Take the due time and the actual time of an event, s."""
        if self._last is not None:
            error = (done - self._last[1]) - (due - self._last[0])
            self._counts[round(abs(error) * 1e6)] += 1
        self._last = (due, done)

    def summary(self) -> dict[str, float]:
        """Return the errors p50, p99 and max, s; empty with fewer than two events."""
        if not self._counts:
            return {}
        errors = np.array(sorted(self._counts.items())).T
        share = np.cumsum(errors[1]) / errors[1].sum()
        return {name: 1e-6 * float(errors[0, np.searchsorted(share, quantile)])
                for name, quantile in (('p50', 0.5), ('p99', 0.99), ('max', 1.0))}


class Prefetch:
    """Iterates over a source; a thread reads up to `ahead` batches ahead, and passes on errors."""

    def __init__(self, source: Iterable[Message], ahead: int = AHEAD, batch: int = BATCH) -> None:
        sys.setswitchinterval(SWITCH)
        self._source, self._size = iter(source), batch
        self._pool = ThreadPoolExecutor(1, 'prefetch')
        self._batches = deque(self._pool.submit(self._read) for _ in range(ahead))

    def fill(self) -> None:
        """Wait until all batches ahead, or the whole source, have been read."""
        wait(self._batches)

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(cancel_futures=True)

    def _read(self) -> tuple[list[Message], BaseException | None]:
        batch: list[Message] = []
        try:
            # `extend` keeps the messages before an error.
            batch.extend(itertools.islice(self._source, self._size))
        except BaseException as error:
            return batch, error
        return batch, None

    def __iter__(self) -> Iterator[Message]:
        while True:
            batch, error = self._batches.popleft().result()
            self._batches.append(self._pool.submit(self._read))
            yield from batch
            if error is not None:
                raise error
            if not batch:
                return


class Player(Node):
    """Publishes one bag with the checked options of `replay`."""

    def __init__(self, name: str, bag: BagReader, options: argparse.Namespace) -> None:
        super().__init__(name, start_parameter_services=False)
        self._bag = bag
        self._options = options
        self._types = self._chosen_topics()
        self._skipped: dict[str, str] = {}
        self._outputs: dict[str, Publisher] = {}
        for topic, kind in self._types.items():
            try:
                self._outputs[topic] = self.create_publisher(message_class(kind), topic, DEPTH)
            except (InputError, InvalidTopicNameException) as error:
                self._skipped[topic] = one_line(f"topic '{topic}' is left out: {error}")
                self.get_logger().warning(self._skipped[topic])
        if not self._outputs:
            raise InputError(f"nothing to play in '{options.bag}': " + (
                '; '.join(self._skipped.values()) or 'it holds no messages'))
        self._clock_output = self.create_publisher(
            ClockMessage, '/clock', 10) if options.clock > 0.0 else None
        if self._clock_output is not None and self._bag.end_ns > LAST_HEADER_NS:
            raise InputError(f"'{options.bag}' has log times after 2^31 s, which /clock cannot "
                             'represent: play it with --clock 0')
        self._sent = dict.fromkeys(self._outputs, 0)
        self._spacing = SpacingError()
        self._passes = 0
        self._span = (math.inf, -math.inf)

    def _chosen_topics(self) -> dict[str, str]:
        topics = dict(self._bag.topics)
        for wanted in self._options.topics or ():
            if wanted not in topics:
                raise InputError(f"topic '{wanted}' is not in '{self._options.bag}': "
                                 + nearest(wanted, topics))
        return {topic: kind for topic, kind in topics.items()
                if topic in (self._options.topics or topics)
                and not (topic == '/clock' and self._options.clock > 0.0)}

    def going(self) -> bool:
        """Return True until a signal arrives."""
        return bool(self.context.ok())

    def play(self) -> dict[str, Any]:
        """Play until the end of the bag or a signal; return a summary."""
        self._wait_for_subscriber()
        # Avoid pauses by the garbage collector, which would disturb the spacing.
        gc.collect()
        gc.freeze()
        began = time.monotonic()
        while self.going():
            self._pass()
            if not self._options.loop:
                break
        summary = self._summary(time.monotonic() - began)
        if self.going():
            # Let reliable subscribers fetch what they missed before the publishers go.
            for output in self._outputs.values():
                output.wait_for_all_acked(FLUSH)
        error = summary['spacing_error_s']
        quality = ', '.join(f'{key} {value * 1e3:.3f} ms' for key, value in error.items())
        print(f"played {summary['messages']} messages in {summary['duration_s']:.2f} s"
              + (f'; spacing error {quality}' if quality else '')
              + (f"; damage: {summary['damage']}" if summary['damage'] else ''), file=sys.stderr)
        return summary

    def _wait_for_subscriber(self) -> None:
        until = time.monotonic() + self._options.wait
        while self.going() and time.monotonic() < until:
            if any(output.get_subscription_count() for output in self._outputs.values()):
                return
            time.sleep(0.01)
        if self._options.wait > 0.0 and self.going():
            self.get_logger().warning(
                f'no subscriber within {self._options.wait:g} s: playing anyway')

    def _pass(self) -> None:
        ahead = Prefetch(self._bag.raw_messages(self._outputs))
        try:
            ahead.fill()
            self._spacing.restart()
            self._schedule(iter(ahead))
        finally:
            ahead.close()

    def _schedule(self, messages: Iterator[Message]) -> None:
        """Send every message at start + (log time - first log time) / rate."""
        first = next(messages, None)
        if first is None:
            raise InputError(f"'{self._options.bag}' holds no message of "
                             + ', '.join(self._outputs))
        origin, rate = first[2], self._options.rate
        start, frequency = time.monotonic(), self._options.clock
        # Number and time of the next /clock; missed ones are skipped, so that they do not pile up.
        ticks, tick = 0, start if frequency > 0.0 else math.inf
        for topic, _, log_time, data in itertools.chain((first,), messages):
            due = start + (log_time - origin) * 1e-9 / rate
            while tick <= due:
                if not wait_until(tick, self.going):
                    return
                self._tick(origin, start)
                ticks = max(ticks, math.floor((time.monotonic() - start) * frequency)) + 1
                tick = start + ticks / frequency
            if not wait_until(due, self.going):
                return
            done = time.monotonic()
            self._send(self._outputs[topic], data)
            self._spacing.add(due, done)
            self._sent[topic] += 1
            self._span = min(self._span[0], log_time), max(self._span[1], log_time)
        self._tick(origin, start)
        self._passes += 1

    def _tick(self, origin: int, start: float) -> None:
        if self._clock_output is None:
            return
        now = origin + round((time.monotonic() - start) * self._options.rate * 1e9)
        # At a high rate, the last tick might exceed the range of a stamp.
        now = min(max(now, 0), LAST_HEADER_NS)
        self._send(self._clock_output, ClockMessage(clock=Time(nanoseconds=now).to_msg()))

    def _send(self, output: Publisher, message: Any) -> None:
        try:
            output.publish(message)
        except RCLError:
            # If a signal has just ended the context, the caller's loop ends too.
            if self.going():
                raise

    def _summary(self, duration: float) -> dict[str, Any]:
        return {
            'bag': str(self._options.bag), 'rate': self._options.rate, 'passes': self._passes,
            'messages': sum(self._sent.values()), 'duration_s': duration,
            'topics': {topic: {'type': self._types[topic], 'messages': n}
                       for topic, n in self._sent.items()},
            'skipped': self._skipped, 'damage': self._bag.damage,
            'span_s': max((self._span[1] - self._span[0]) * 1e-9, 0.0),
            'spacing_error_s': self._spacing.summary(),
            'ended_by': 'end' if self.going() else 'signal'}
