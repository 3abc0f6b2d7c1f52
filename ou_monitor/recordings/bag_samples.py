"""
The voltage samples of a bag with their throttle and current.

A msg config fits if the bag has its topic, possibly in a namespace, with its type. If none fits, a
generic config fits if a topic other than its throttle's has its type. The user must choose if
several configs or topics fit.
Limits: all samples of a bag are held in memory, 145 MB for an hour at 1 kHz.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.bag import BagReader, read_fields
from ou_monitor.recordings.cdr import (
    Field, FieldColumn, short_name, TimeArray, value_path)
from ou_monitor.recordings.importers.log import (
    CURRENT, Series, SIGNAL, THROTTLE, UNKNOWN, unusable_words, VOLTAGE)
from ou_monitor.recordings.standard_types import FLOAT32, FLOAT64, IMU
from ou_monitor.records import Defect, defect_of, FloatArray, Note, Recording
from ou_monitor.stream.config import FieldSpec, list_msg_configs, load_msg_config, MsgConfig
from ou_monitor.stream.samples import clock_of, ThrottleHold
from ou_monitor.text import counted, outside_words, part_words, printable, some
from ou_monitor.timeline import (
    back_words, BATCH, check_throttle, held_words, plausible_stamps)


def choose(
    path: Path, topics: Mapping[str, str], *, msg_config: str | Path | None = None,
    voltage_topic: str | None = None, throttle_topic: str | None = None,
) -> tuple[MsgConfig, dict[str, FieldSpec], tuple[str, ...]]:
    """Return the config, its fields by quantity with this bag's topics, and notes."""
    for topic in (voltage_topic, throttle_topic):
        if topic is not None and _absolute(topic) not in topics:
            raise InputError(f"{path}: no topic '{topic}': {nearest(_absolute(topic), topics)}")
    if msg_config is not None:
        config = load_msg_config(msg_config)
    else:
        config = _detect(path, topics, voltage_topic)
    wanted = _absolute(config.voltage.topic if voltage_topic is None else voltage_topic)
    if voltage_topic is None:
        found = _by_name(config.voltage, topics) or _only_of_type(config, topics)
    else:
        found = [wanted] if topics[wanted] == config.voltage.type else []
    if not found and wanted in topics:
        raise InputError(f"{path}: topic '{wanted}' is {topics[wanted]}, but msg config "
                         f"'{config.name}' expects {config.voltage.type}: choose another with "
                         '--msg-config')
    if not found:
        raise InputError(f"{path}: msg config '{config.name}' needs topic '{wanted}' "
                         f'({config.voltage.type}), which is not in the bag; topics: '
                         f'{listed(topics)}')
    if len(found) > 1:
        raise InputError(f'{path}: several topics fit: {some(found)}; choose with '
                         '--voltage-topic')
    topic = found[0]
    throttle, notes = _throttle(path, config, topics, topic, throttle_topic)
    others = [name for name in _by_suffix(config.voltage, topics) if name != topic]
    if voltage_topic is None and others:
        notes = (*notes, f'{topic} was used as the voltage; {some(others)} would fit too: '
                         'choose with --voltage-topic.')
    specs = {VOLTAGE: replace(config.voltage, topic=topic), THROTTLE: throttle,
             CURRENT: _current(config, topics, topic)}
    return config, {name: spec for name, spec in specs.items() if spec is not None}, notes


def listed(topics: Mapping[str, str]) -> str:
    """Return topics with their types in one line."""
    return some(f'{name} ({kind})' for name, kind in sorted(topics.items()))


def _absolute(topic: str) -> str:
    return '/' + topic.lstrip('/')


def _by_name(spec: FieldSpec, topics: Mapping[str, str]) -> list[str]:
    exact = _absolute(spec.topic)
    if topics.get(exact) == spec.type:
        return [exact]
    return _by_suffix(spec, topics)


def _by_suffix(spec: FieldSpec, topics: Mapping[str, str]) -> list[str]:
    """Return the topics of a spec's type that end with its name."""
    return sorted(name for name, kind in topics.items()
                  if kind == spec.type and name.endswith(_absolute(spec.topic)))


def _only_of_type(config: MsgConfig, topics: Mapping[str, str]) -> list[str]:
    """Return the topics with the voltage's type, except the topic named as the throttle."""
    taken = set() if config.throttle is None else set(_by_name(config.throttle, topics))
    return sorted(name for name, kind in topics.items()
                  if kind == config.voltage.type and name not in taken)


def _detect(path: Path, topics: Mapping[str, str], voltage_topic: str | None) -> MsgConfig:
    configs = list(list_msg_configs().values())
    considered = topics if voltage_topic is None else {
        _absolute(voltage_topic): topics[_absolute(voltage_topic)]}
    fitting = [config for config in configs if _by_name(config.voltage, considered)]
    if not fitting:
        fitting = [config for config in configs
                   if config.generic and _only_of_type(config, considered)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise InputError(
            f"{path}: several msg configs fit ({', '.join(c.name for c in fitting)}); choose "
            f'with --msg-config; topics: {listed(topics)}')
    raise InputError(
        f'{path}: no topic looks like a supply voltage; topics: {listed(topics)}; choose with '
        f"--msg-config one of {', '.join(c.name for c in configs)}, or a YAML file of your own")


def _current(config: MsgConfig, topics: Mapping[str, str], voltage: str) -> FieldSpec | None:
    """Return the field of the current: a topic `current` beside the voltage, or as configured."""
    beside = voltage.rsplit('/', 1)[0] + '/current'
    if topics.get(beside) in _SCALARS:
        return FieldSpec(beside, topics[beside], 'data', nan='unknown')
    spec = config.current
    if spec is None or spec.topic != config.voltage.topic:
        return None
    return replace(spec, topic=voltage)


def _throttle(
    path: Path, config: MsgConfig, topics: Mapping[str, str], voltage: str,
    throttle_topic: str | None,
) -> tuple[FieldSpec | None, tuple[str, ...]]:
    spec = config.throttle
    if throttle_topic is not None:
        topic = _absolute(throttle_topic)
        # Read a topic that the user names with the first of these specs whose type matches.
        for one in (spec, *(c.throttle for c in list_msg_configs().values()),
                    FieldSpec(topic, FLOAT64, 'data')):
            if one is not None and one.type == topics[topic]:
                return replace(one, topic=topic), ()
        raise InputError(f"{path}: throttle topic '{topic}' is {topics[topic]}, which no msg "
                         'config reads: describe it in a YAML file of your own')
    if spec is None:
        return None, (f"Msg config '{config.name}' has no throttle, so throttle is unknown.",)
    found = _by_name(spec, topics)
    if not found and not config.generic:
        found = [name for name, kind in topics.items() if kind == spec.type and name != voltage]
    # In a bag of several vehicles take the one beside the voltage.
    beside = [name for name in found if name.rsplit('/', 1)[0] == voltage.rsplit('/', 1)[0]]
    found = beside or found
    if len(found) == 1:
        return replace(spec, topic=found[0]), ()
    wanted = _absolute(spec.topic)
    if not found and topics.get(wanted) == FLOAT64 and config.generic:
        return replace(spec, topic=wanted, type=topics[wanted]), ()
    if wanted in topics and not found:
        why = f"topic '{wanted}' is {topics[wanted]}, not {spec.type}"
    else:
        why = f'several topics fit ({some(found)})' if found else f"no topic '{wanted}'"
    return None, (f'The throttle is unknown: {why}; name one with --throttle-topic.',)


# Types with a single number, whose field need not be named.
_SCALARS = (FLOAT32, FLOAT64)


def read_bag(
    path: Path, *, partial: bool, start: float | None, end: float | None,
    progress: Callable[[float], None] | None, **of_bags: Any,
) -> Recording:
    """Read voltage, throttle and current of a bag, start and end in s; see `read_recording`."""
    bag = BagReader(path, partial=partial)
    config, specs, said = choose(bag.path, bag.topics, **of_bags)
    stated = bag.sample_rates.get(specs[VOLTAGE].topic)
    if specs[VOLTAGE].sample_rate is not None and stated is not None:
        # The rate stated in the bag overrides the config's.
        specs[VOLTAGE] = replace(specs[VOLTAGE], sample_rate=stated)
    if CURRENT in specs:
        try:
            value_path(specs[CURRENT], bag.definitions(specs[CURRENT].type))
        except InputError:
            # Older types of a battery have no current.
            del specs[CURRENT]
    notes = [*bag.notes, *said]
    if bag.damage is not None:
        notes.append(Note(f'The bag is damaged; its intact part was read: {bag.damage}.',
                          Defect.DAMAGED_FILE))
    if start is not None or end is not None:
        notes.append(part_words(start, end))
    broken: list[str] = []
    first = 0 if start is None else _limit(bag, start)
    last = None if end is None else _limit(bag, end)
    # A current in the same messages as the voltage is paired with it message by message.
    own = CURRENT in specs and specs[CURRENT].topic == specs[VOLTAGE].topic
    beside = {VOLTAGE: specs.pop(CURRENT)} if own else {}
    columns = read_fields(bag, specs, end_ns=last, progress=progress, beside=beside,
                          broken=broken if partial else None)
    written = columns[VOLTAGE]
    columns = {which: one.in_time_order() for which, one in columns.items()}
    if columns[VOLTAGE] is not written:
        # Check the stamps as written: sorting by log time hides that the clock went back.
        part = (written.log_time >= first) & np.isfinite(written.stamp)
        if words := back_words(written.stamp[
                part if last is None else part & (written.log_time < last)]):
            notes.append(Note(words, Defect.UNORDERED))
    del written
    if last is not None:
        columns = {which: one.split(one.place(last))[0] for which, one in columns.items()}
    if broken:
        notes.append(Note(f"{counted(len(broken), 'message')} dropped, the first: {broken[0]}.",
                          Defect.DAMAGED_FILE))
    name = printable(bag.path.name)
    supply = columns[VOLTAGE].split(columns.pop(VOLTAGE).place(first))[1]
    if not supply.values.size:
        whole = start is None and end is None
        if whole or any(defect_of(note).drops for note in notes):
            raise InputError(unusable_words(name, notes))
        raise InputError(outside_words(name, start, end, (bag.end_ns - bag.start_ns) * 1e-9))
    clock = clock_of(specs[VOLTAGE])
    t = supply.stamp if clock is None else clock.stamps(supply.stamp, supply.counts)
    if clock is not None and clock.gaps:
        notes.append(Note(f'{counted(clock.gaps, "gap")} between blocks of samples.',
                          Defect.GAPS))
    log_time, ends, stamped = supply.log_time, t, supply.stamped
    if clock is not None:
        filled = supply.counts > 0
        log_time, stamped = log_time[filled], stamped[filled]
        ends = t[(np.cumsum(supply.counts) - 1)[filled]]
    holds: dict[str, ThrottleHold] = {}
    for which, column in columns.items():
        holds[which], unknown = _hold_of(column, specs[which], first, log_time, ends, stamped,
                                         specs[VOLTAGE].sample_rate)
        if which == THROTTLE:
            if unknown:
                notes.append(Note(f"{counted(unknown, 'throttle value')} dropped: not a finite "
                                  'number.', Defect.NON_FINITE))
            check_throttle(name, holds[which].held()[1])
            notes += filter(None, [held_words(t, holds[which].held()[0])])
    volts, current = supply.values, None
    if np.isfinite(supply.beside).any():
        current = np.repeat(supply.beside, supply.counts)
    # Free memory: the log times alone take 30 MB for an hour at 1 kHz.
    del columns, supply, log_time
    if CURRENT in holds:
        current = holds[CURRENT].at(t)
    throttle = holds[THROTTLE].at(t) if THROTTLE in holds else np.full(t.size, np.nan)
    return Recording(plausible_stamps(name, t), volts, throttle, name,
                     _source(bag, specs, config, name), tuple(notes), current)


def _hold_of(column: FieldColumn, spec: FieldSpec, first: int, log_time: TimeArray,
             ends: FloatArray, own: npt.NDArray[np.bool_], sample_rate: float | None,
             ) -> tuple[ThrottleHold, int]:
    """Return what holds throttle or current, and the number of dropped NaN."""
    # ends: stamp of the last sample of each voltage message, s.
    # Before `first` (ns), the start of the part, only the last known value is needed.
    known = np.flatnonzero(np.isfinite(column.values[:column.place(first)]))
    _, column = column.split(int(known[-1]) if known.size else 0)
    usable, unknown = np.isfinite(column.stamp), 0
    if spec.nan == 'drop':
        finite = np.isfinite(column.values)
        usable, unknown = usable & finite, int(np.count_nonzero(~finite))
    if not usable.all():
        column = column.take(np.flatnonzero(usable))
    hold = ThrottleHold(sample_rate)
    # At equal log times the throttle counts as earlier than the voltage.
    before = np.searchsorted(log_time, column.log_time, 'left')
    for k in range(0, ends.size + 1, BATCH):
        mine = slice(*np.searchsorted(before, (k, k + BATCH)))
        hold.take(column.stamp[mine], column.values[mine], column.stamped[mine],
                  ends[k:k + BATCH], own[k:k + BATCH], before[mine] - k)
    return hold, unknown


def _source(bag: BagReader, specs: Mapping[str, FieldSpec], config: MsgConfig, name: str,
            ) -> dict[str, str]:
    source = {**bag.about, 'file': name, 'format': 'mcap', 'msg_config': config.name}
    for which in (VOLTAGE, THROTTLE):
        spec = specs.get(which)
        if spec is not None:
            # A converted bag names the field of the log that became the topic.
            field = bag.about.get(f'{spec.topic[1:]}_field', spec.field)
            source |= {f'{which}_topic': spec.topic, f'{which}_type': spec.type,
                       f'{which}_field': field}
    # `ou-monitor convert` stores the log's own vehicle apart from the user's.
    vehicle = source.get('vehicle') or source.get('log_vehicle')
    return {**source, 'vehicle': vehicle} if vehicle else source


def _limit(bag: BagReader, at: float) -> int:
    """Return a time of the recording, s, as log time, ns."""
    # Clip times beyond the end of the bag.
    return bag.start_ns + round(min(at * 1e9, float(bag.end_ns - bag.start_ns + 1)))


def read_bag_signal(path: Path, signal: str, partial: bool) -> Series:
    """Read one scalar of a bag over time."""
    bag = BagReader(path, partial=partial)
    topic, field = _split(path, signal, bag.topics)
    kind = bag.topics[topic]
    stamped = Field('header', 'std_msgs/Header') in bag.definitions(kind)[short_name(kind)]
    spec = FieldSpec(topic, kind, field, nan='unknown',
                     stamp_field='header.stamp' if stamped else None)
    column = read_fields(bag, {SIGNAL: spec})[SIGNAL].in_time_order()
    if not column.n:
        raise InputError(f"{path}: topic '{topic}' holds no message")
    unit = bag.about.get(f'{topic[1:]}_unit', UNKNOWN)
    if spec.type == IMU:
        unit = {'angular_velocity': 'rad/s', 'linear_acceleration': 'm/s^2'}.get(
            field.partition('.')[0], UNKNOWN)
    return Series(signal, SIGNAL, column.stamp, column.values, '1', own_unit=unit)


def _split(path: Path, signal: str, topics: Mapping[str, str]) -> tuple[str, str]:
    wanted = _absolute(signal)
    if topics.get(wanted) in _SCALARS:
        return wanted, 'data'
    topic, _, field = wanted.rpartition('/')
    if topic in topics:
        return topic, field
    if wanted in topics:
        raise InputError(f"{path}: topic '{wanted}' is {topics[wanted]}: name the field too, "
                         f'{wanted}/FIELD')
    raise InputError(f"{path}: no topic '{topic or wanted}' for the signal '{signal}': "
                     f'{nearest(topic or wanted, topics)}')
