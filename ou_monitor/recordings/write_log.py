"""
Write what was taken from a log as a bag: voltage, throttle, current, and what else travels.

Every series keeps its own stamps, counted from the start of the log, to 10 ns of a
day.  Gyros are sensor_msgs/Imu, motor speeds sensor_msgs/JointState (velocity, rad/s), named
series std_msgs/Float64; the unit of each is in the metadata of its topic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
import heapq
from pathlib import Path
import tempfile

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.importers.choose import choose, Chosen, drop_held
from ou_monitor.recordings.importers.extras import Extras, SPEEDS
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import Request, Series
from ou_monitor.recordings.importers.motion import Inertial, MotorSpeeds
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_block, encode_imu, encode_joints, encode_scalars,
    FLOAT32, FLOAT32_ARRAY, FLOAT64, IMU, JOINT_STATE)
from ou_monitor.recordings.write import (
    as_nanoseconds, BLOCK, BLOCK_RATE, check_steady, LAST_HEADER_NS, SLICE, Timed, TYPES)
from ou_monitor.records import FloatArray, Recording

Stamps = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Stream:
    """One topic: stamps (s), messages of a part of them, and where they come from."""

    topic: str
    kind: str
    t: FloatArray
    encode: Callable[[Stamps, slice], list[bytes]]
    origin: dict[str, str]


def write_log(
    chosen: Chosen, path: Path, about: Mapping[str, str], *, kind: str = 'battery_state',
    extras: Extras | None = None, progress: Callable[[float], None] | None = None,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Write a bag (progress 0..1)."""
    # At one instant what holds for the sample goes before it, the voltage last.
    streams = [_of_series(name, FLOAT32, series) for name, series in (
        ('throttle', chosen.throttle), ('current', chosen.current)) if series is not None]
    if extras is not None:
        streams += [_of_inertial(name, one) for name, one in extras.inertial.items()]
        if extras.speeds is not None:
            streams.append(_of_speeds(extras.speeds))
        streams += [_of_series(name, FLOAT64, one) for name, one in extras.signals.items()]
    streams.append(_of_series('voltage', TYPES[kind], chosen.voltage))
    first = min(float(stream.t[0]) for stream in streams)
    shift = max(0, -round(first * 1e9))
    notes = (f'Stamps were moved by {shift * 1e-9:.9f} s: a bag cannot hold negative ones.',
             ) if shift else ()
    total = sum(stream.t.size for stream in streams)
    topics: dict[str, str] = {}
    # Refused before anything is on disk.
    stamps = [as_nanoseconds(stream.t, stream.origin[f'{stream.topic}_field']) + shift
              for stream in streams]
    if kind == 'adc_block':
        check_steady(chosen.voltage.name, stamps[-1] - stamps[-1][0], 0, BLOCK_RATE)
    for stream, own in zip(streams, stamps):
        if stream.kind in (BATTERY_STATE, IMU, JOINT_STATE) and own[-1] > LAST_HEADER_NS:
            raise InputError(f"'{stream.origin[f'{stream.topic}_field']}' has stamps after 2^31 "
                             's, which a header cannot hold'
                             + (': use another type' if stream.kind == BATTERY_STATE else ''))
    whole = {**about}
    for stream in streams:
        whole |= stream.origin
    with BagWriter(path, about=whole) as bag:
        # The order of the table of contents: the voltage first.
        for stream in reversed(streams):
            rate = BLOCK_RATE if stream.kind == FLOAT32_ARRAY else None
            topics[bag.add_topic(stream.topic, stream.kind, sample_rate=rate,
                                 origin={**about, **stream.origin})] = stream.kind
        parts = [_messages(k, own, stream) for k, (own, stream) in enumerate(zip(stamps, streams))]
        for done, (t, k, data) in enumerate(heapq.merge(*parts)):
            bag.write('/' + streams[k].topic, t, data)
            if progress is not None and done % SLICE == 0:
                progress(done / total)
    return topics, notes


def _origin(topic: str, name: str, unit: str, scale: str, words: str) -> dict[str, str]:
    """Return where a topic came from, by keys that are its own."""
    return {f'{topic}_field': name, f'{topic}_unit': unit, f'{topic}_scale': scale,
            f'{topic}_what': words}


def _of_series(topic: str, kind: str, series: Series) -> _Stream:
    def encode(stamps: Stamps, part: slice) -> list[bytes]:
        values = series.values[part]
        return (encode_battery(stamps, values) if kind == BATTERY_STATE
                else [encode_block(values)] if kind == FLOAT32_ARRAY
                else encode_scalars(kind, values))
    return _Stream(topic, kind, series.t, encode, _origin(
        topic, series.name, series.unit, series.scale, series.words))


def _of_inertial(topic: str, one: Inertial) -> _Stream:
    def encode(stamps: Stamps, part: slice) -> list[bytes]:
        gyro, force = (None if values is None else values[part]
                       for values in (one.angular_velocity, one.acceleration))
        return encode_imu(stamps, gyro, force)
    return _Stream(topic, IMU, one.t, encode, _origin(
        topic, one.name, 'rad/s, m/s^2', one.scale, one.words))


def _of_speeds(speeds: MotorSpeeds) -> _Stream:
    def encode(stamps: Stamps, part: slice) -> list[bytes]:
        return encode_joints(stamps, speeds.names, speeds.values[part])
    return _Stream(SPEEDS, JOINT_STATE, speeds.t, encode, _origin(
        SPEEDS, ', '.join(speeds.names), 'rad/s', speeds.scale, speeds.words))


def _messages(place: int, stamps: Stamps, stream: _Stream) -> Iterator[Timed]:
    if stream.kind == FLOAT32_ARRAY:
        for first in range(0, stamps.size, BLOCK):
            part = slice(first, first + BLOCK)
            yield int(stamps[part][-1]), place, stream.encode(stamps[part], part)[0]
        return
    for first in range(0, stamps.size, SLICE):
        part = slice(first, first + SLICE)
        for t, message in zip(stamps[part].tolist(), stream.encode(stamps[part], part),
                              strict=True):
            yield t, place, message


@contextmanager
def log_as_bag(path: Path, *, flight: int | None = None, voltage: str | None = None,
               throttle: str | None = None,
               progress: Callable[[float], None] | None = None,
               ) -> Iterator[tuple[Path, Callable[[Recording], Recording]]]:
    """Yield the bag of a log, and what gives a recording of it the name and notes of the log."""
    log = import_log(path, Request(
        flight, frozenset(one for one in (voltage, throttle) if one), progress=progress))
    chosen = choose(path, log, voltage=voltage, throttle=throttle, option='--{}-column')
    volts, held = drop_held(chosen.voltage)
    chosen = replace(chosen, voltage=volts)

    def named(recording: Recording) -> Recording:
        source = {'file': path.name, 'format': log.format, 'voltage': volts.name}
        if chosen.throttle is not None:
            source['throttle'] = chosen.throttle.name
        return replace(recording, name=path.name, source={**source, **log.facts},
                       notes=(*log.notes, *chosen.notes, held, *recording.notes))

    with tempfile.TemporaryDirectory(prefix='ou_monitor_') as folder:
        bag = Path(folder) / 'log.mcap'
        write_log(chosen, bag, {})
        yield bag, named
