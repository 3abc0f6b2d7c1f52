"""
The samples of a bag: batches of messages -> stamps, voltage and throttle in order.

Limits first: stamps are put in order among the samples held; one that comes
later than that is dropped, counted and noted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
import math
from pathlib import Path
import re

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagReader, batches, last_before
from ou_monitor.recordings.cdr import Column, IntArray, TimeArray
from ou_monitor.recordings.mcap_file import moment
from ou_monitor.recordings.topic_choice import choose
from ou_monitor.records import FloatArray, Recording
from ou_monitor.stream.blocks import BlockClock
from ou_monitor.stream.config import FieldSpec
from ou_monitor.stream.samples import BoolArray, ThrottleHold
from ou_monitor.text import counted, printable
from ou_monitor.timeline.line import MOST_CURRENT, MOST_THROTTLE, MOST_VOLTAGE, plausible

VOLTAGE, THROTTLE, CURRENT = 'voltage', 'throttle', 'current'
# So many samples behind for each step back are not a few that came late.
_STRETCH = 20
# Share of implausible throttles up to which they are errors of single samples.
_WILD = 0.05


def usable_voltage(t: FloatArray, voltage: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which samples are finite, and of a voltage that there is."""
    usable: npt.NDArray[np.bool_] = np.isfinite(t) & (np.abs(voltage) <= MOST_VOLTAGE)
    return usable


def dropped_words(count: int, voltage: FloatArray) -> str:
    """Return the note on samples that are not usable; `voltage`: theirs."""
    beyond = bool((np.isfinite(voltage) & (np.abs(voltage) > MOST_VOLTAGE)).any())
    return (f'{counted(count)} dropped: not a finite number'
            + (f', or beyond {MOST_VOLTAGE:g} V.' if beyond else '.'))


def check_throttle(name: str, throttle: FloatArray, voltage: FloatArray | None = None) -> None:
    """Refuse a throttle in percent, microseconds or counts, or one that is the voltage."""
    known = throttle[np.isfinite(throttle)]
    # A few wild values are no unit: they are unknown, here as in the node.
    if float(np.count_nonzero(np.abs(known) > MOST_THROTTLE)) <= _WILD * known.size:
        return
    if voltage is not None and float(np.nanmax(np.abs(voltage), initial=0.0)) <= 1.0 \
            and float(np.median(known)) < 100.0:
        raise InputError(
            f'{name}: the voltage stays within 0 to 1 and throttle runs from '
            f'{known.min():g} to {known.max():g}: are the two columns swapped?')
    raise InputError(
        f'{name}: throttle runs from {known.min():g} to {known.max():g}, and 0 to 1 is '
        'expected: divide a percentage by 100 (of a bag: unit_factor of a msg config), turn '
        'a pulse of w microseconds into (w - 1000) / 1000')


def known_current(current: FloatArray) -> FloatArray | None:
    """Return a current with NaN for what is not finite; None where none is known."""
    known = np.abs(current) <= MOST_CURRENT
    return np.where(known, current, np.nan) if known.any() else None


def overlap(t: FloatArray, highest: float = -math.inf) -> tuple[int, float]:
    """
    Return how many samples lie before one that came earlier, and how far at most, s.

    t in s, highest in s.
    """
    ahead = np.maximum(np.maximum.accumulate(t), highest) - t
    behind = ahead > 0.0
    return int(np.count_nonzero(behind)), float(ahead[behind].max(initial=0.0))


def late_words(count: int, mixed: int, back: float) -> str:
    """Return the note on samples out of order: steps back, samples behind, and how far, s."""
    if mixed < _STRETCH * count:
        return f'{counted(count)} came before the stamp ahead of them: sorted by stamp.'
    times = 'once' if count == 1 else f'{count} times'
    return (f'The clock went back {times}, by {back:.3g} s at most: {counted(mixed)} lie where '
            'others were before, and were mixed with them; take a part before or after, or mend '
            'the stamps.')


def repeated_words(count: int) -> str:
    """Return the note on stamps that are there twice."""
    return (f'{counted(count)} dropped: the stamp was there before; the first of each was '
            'kept.')


def span_words(start: float | None, end: float | None) -> str:
    """Return 'from 2 s to 5 s'."""
    return f"from {start or 0.0:g} s to {'the end' if end is None else f'{end:g} s'}"


def part_words(start: float | None, end: float | None) -> str:
    """Return the note on a part."""
    return f'Only the part {span_words(start, end)} of the recording was read.'


class _Series:
    """Stamps and values of one field, as its messages come."""

    def __init__(self, spec: FieldSpec) -> None:
        self.clock = None if spec.sample_rate is None else BlockClock(spec.sample_rate)

    def samples(self, column: Column) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return stamps (s), values (NaN where a message holds none), and samples a message."""
        if self.clock is not None:
            return (self.clock.stamps_of_many(column.stamp, column.count), column.values,
                    column.count)
        values = np.full(column.n, np.nan)
        values[column.count > 0] = column.values
        return column.stamp, values, np.ones(column.n, np.int64)


def _has_field(bag: BagReader, spec: FieldSpec) -> bool:
    """Whether messages of a type, as the bag defines it, have a field of that name."""
    own = re.split(r'^=+$', bag.definition(spec.type), maxsplit=1, flags=re.M)[0]
    return re.search(rf'^\s*\S+\s+{re.escape(spec.field)}\b', own, re.M) is not None


class SampleReader:
    """
    Reads voltage and throttle of a bag, keeping only what has not been taken.

    Topics as in `read_recording`, `start` and `end` in s after the first message.  `duration`, s,
    is that of the whole bag, `source` topics, types, files and what the bag says of itself, `held`
    samples read and not taken.  InputError: the topics cannot be told, or there is no voltage.
    """

    def __init__(
        self, bag: BagReader, *, msg_config: str | Path | None, voltage_topic: str | None,
        throttle_topic: str | None, start: float | None, end: float | None,
    ) -> None:
        """Choose the topics; nothing is read yet but the throttle before the part."""
        choice = choose(bag.path, bag.topics, msg_config=msg_config, voltage_topic=voltage_topic,
                        throttle_topic=throttle_topic)
        self._bag = bag
        self._notes = [*bag.notes, *choice.notes]
        if bag.damage is not None:
            self._notes.append(
                f'The bag is damaged; what it still holds was read: {bag.damage}.')
        if start is not None or end is not None:
            self._notes.append(part_words(start, end))
        self.name = printable(bag.path.name)
        self.duration = (bag.end_ns - bag.start_ns) * 1e-9
        self.source = {
            **bag.about, 'file': self.name, 'format': 'mcap', 'msg_config': choice.config.name,
            'voltage_topic': choice.voltage.topic, 'voltage_type': choice.voltage.type,
            'voltage_field': choice.voltage.field,
            **bag.origins.get(choice.voltage.topic, {})}
        spec = choice.voltage
        stated = bag.sample_rates.get(spec.topic)
        if spec.sample_rate is not None and stated is not None:
            # The bag knows better than a config that is made for many.
            spec = replace(spec, sample_rate=stated)
        self._specs = {VOLTAGE: spec}
        # Throttle and current hold until the next value.
        self._holds = {THROTTLE: ThrottleHold(spec.sample_rate)}
        self._series = {VOLTAGE: _Series(spec)}
        if choice.throttle is not None:
            self.source |= {'throttle_topic': choice.throttle.topic,
                            'throttle_type': choice.throttle.type,
                            'throttle_field': choice.throttle.field,
                            **bag.origins.get(choice.throttle.topic, {})}
            self._specs[THROTTLE] = choice.throttle
            self._series[THROTTLE] = _Series(choice.throttle)
        if choice.current is not None and _has_field(bag, choice.current):
            self._specs[CURRENT] = choice.current
            self._holds[CURRENT] = ThrottleHold(spec.sample_rate)
            self._series[CURRENT] = _Series(choice.current)
        # `ou-monitor convert` keeps what the log says apart from what people say of the bag.
        vehicle = self.source.get('vehicle') or self.source.get('log_vehicle')
        if vehicle:
            self.source['vehicle'] = vehicle
        self._start_ns, self._end_ns = self._limits(start), self._limits(end)
        self._t: list[FloatArray] = []
        self._voltage: list[FloatArray] = []
        self.held = 0
        self._newest = self._highest = self._taken = -math.inf
        self._largest = self._back = 0.0
        # What no voltage has followed yet: stamps, values, whether stamped, log times.
        self._waiting: dict[str, list[tuple[FloatArray, FloatArray, BoolArray, TimeArray]]] = {
            name: [] for name in self._holds}
        self._tally = dict.fromkeys((
            'dropped', 'late', 'mixed', 'repeated', 'too_late', 'throttle', 'undecodable'), 0)
        self._undecodable = ''
        self._broken = self._leave_out if bag.partial else None
        if self._start_ns is not None:
            for name in self._holds:
                # The current of a message of the voltage comes with it.
                if name in self._specs and self._specs[name].topic != spec.topic:
                    self._add_held(name, last_before(bag, self._specs[name], self._start_ns,
                                                     self._broken))
                    self._series[name] = _Series(self._specs[name])
            self._tally['throttle'] = 0

    def _limits(self, at: float | None) -> int | None:
        """Return a time of the recording as log time, ns."""
        if at is None:
            return None
        # Beyond the bag every time is the same.
        after = min(at * 1e9, float(self._bag.end_ns - self._bag.start_ns + 1))
        return self._bag.start_ns + round(after)

    def batches(self, progress: Callable[[float], None] | None) -> Iterator[int]:
        """Read on; yield the number of samples held after each batch (progress 0..1)."""
        for batch in batches(self._bag, self._specs, start_ns=self._start_ns,
                             end_ns=self._end_ns, progress=progress,
                             broken=self._broken):
            for name in self._holds:
                if name in batch:
                    self._add_held(name, batch[name])
            if VOLTAGE in batch:
                self._add_voltage(batch[VOLTAGE])
            yield self.held

    def _leave_out(self, log_time: int, error: InputError) -> None:
        """Count a message that cannot be decoded."""
        self._tally['undecodable'] += 1
        self._undecodable = self._undecodable or (
            f'{error} ({moment(log_time, self._bag.start_ns)})')

    def _add_voltage(self, column: Column) -> None:
        t, voltage, sizes = self._series[VOLTAGE].samples(column)
        for name in self._holds:
            self._place(name, t[np.cumsum(sizes)[sizes > 0] - 1], column.stamped[sizes > 0],
                        column.log_time[sizes > 0])
        good = usable_voltage(t, voltage)
        if not good.all():
            self._tally['dropped'] += t.size - int(good.sum())
            lost = np.abs(voltage[~good])
            self._largest = max(self._largest, float(lost[np.isfinite(lost)].max(initial=0.0)))
            t, voltage = t[good], voltage[good]
        if not t.size:
            return
        self._tally['late'] += int(np.count_nonzero(np.diff(t) < 0.0)) + int(t[0] < self._newest)
        mixed, back = overlap(t, self._highest)
        self._tally['mixed'] += mixed
        self._back = max(self._back, back)
        self._newest, self._highest = float(t[-1]), max(self._highest, float(t.max()))
        self._t.append(t)
        self._voltage.append(voltage)
        self.held += t.size

    def _add_held(self, name: str, column: Column) -> None:
        t, values, sizes = self._series[name].samples(column)
        known = np.isfinite(t)
        if self._specs[name].nan == 'drop':
            finite = np.isfinite(values)
            known &= finite
            if name == THROTTLE:
                self._tally['throttle'] += int(np.count_nonzero(~finite))
        if name == THROTTLE:
            check_throttle(self.name, values[known])
        self._waiting[name].append((
            t[known], values[known], np.repeat(column.stamped, sizes)[known],
            np.repeat(column.log_time, sizes)[known]))

    def _place(self, name: str, stamps: FloatArray, stamped: BoolArray, log_time: TimeArray
               ) -> None:
        """Place what waits beside voltage messages (stamps in s)."""
        waiting, hold = self._waiting[name], self._holds[name]
        if not (waiting and (stamps.size or self._newest > -math.inf)):
            # Nothing to place, or no voltage to place it beside.
            none = np.empty(0)
            hold.take(none, none, none > 0.0, stamps, stamped, none.astype(np.int64))
            return
        own, values, carried, logged = (
            np.concatenate([part[k] for part in waiting]) for k in range(4))
        self._waiting[name] = []
        # Of a voltage and a throttle logged at one time, the throttle counts as first.
        hold.take(own, values, carried, stamps, stamped,
                  np.searchsorted(log_time, logged, 'left'))

    def take(self, most: int | None = None) -> Recording:
        """Return the first samples held, in order, each stamp once; they are held no longer."""
        t = np.concatenate([np.empty(0), *self._t])
        voltage = np.concatenate([np.empty(0), *self._voltage])
        if (np.diff(t) < 0.0).any():
            order = np.argsort(t, kind='stable')
            t, voltage = t[order], voltage[order]
        cut = t.size
        if most is not None and most < cut:
            cut = int(np.searchsorted(t, t[most - 1], 'right'))
        self._t, self._voltage, self.held = [t[cut:]], [voltage[cut:]], t.size - cut
        t, voltage = t[:cut], voltage[:cut]
        fresh = np.ones(t.size, dtype=bool)
        fresh[1:] = np.diff(t) > 0.0
        old = t < self._taken
        fresh &= t > self._taken
        self._tally['too_late'] += int(np.count_nonzero(old))
        self._tally['repeated'] += int(np.count_nonzero(~fresh & ~old))
        t, voltage = t[fresh], voltage[fresh]
        if t.size:
            self._taken = float(t[-1])
        held = {}
        for name, hold in self._holds.items():
            self._place(name, np.empty(0), np.empty(0, np.bool_), np.empty(0, np.uint64))
            held[name] = hold.at(t)
            if t.size:
                hold.forget_before(self._taken)
        current = known_current(held[CURRENT]) if CURRENT in held else None
        return Recording(t, voltage, plausible(held[THROTTLE], MOST_THROTTLE), self.name, dict(self.source),
                         current=current)

    def bag_notes(self) -> tuple[str, ...]:
        """Return what is to be said before any sample is read."""
        return tuple(self._notes)

    def sample_notes(self) -> tuple[str, ...]:
        """Return what was dropped or mended so far, one sentence each."""
        notes = []
        tally = self._tally
        if tally['undecodable']:
            notes.append(f"{counted(tally['undecodable'], 'message')} dropped, the first: "
                         f'{self._undecodable}.')
        if tally['dropped']:
            notes.append(dropped_words(tally['dropped'], np.array([self._largest])))
        if tally['throttle']:
            notes.append(f"{counted(tally['throttle'], 'throttle value')} dropped: not a finite "
                         'number.')
        clock = self._series[VOLTAGE].clock
        if clock is not None and clock.gaps:
            notes.append(f'{counted(clock.gaps, "gap")} between blocks of samples.')
        if tally['late']:
            notes.append(late_words(tally['late'], tally['mixed'], self._back))
        if tally['too_late']:
            notes.append(f"{counted(tally['too_late'])} dropped: they came more than a piece "
                         'late.')
        if tally['repeated']:
            notes.append(repeated_words(tally['repeated']))
        return tuple(notes)
