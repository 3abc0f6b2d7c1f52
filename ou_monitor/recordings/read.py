"""
Any recording -> `Recording`: .mcap, rosbag2 directory, CSV; and any scalar beside it.

Limits: stamps of a bag are seconds of its own clock in float64, which for a clock
that counts from 1970 resolves 0.24 us; more than that is not kept.  Stamps of a signal
are those of the message's header where it has one, else the bag's log times; a voltage
with the other kind is off by the delay of the transmission.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
import math
from pathlib import Path

import numpy as np
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.bag import BagReader
from ou_monitor.recordings.columns import batches, join
from ou_monitor.recordings.csv_table import CsvColumns, read_column, read_csv
from ou_monitor.recordings.importers.formats import is_log
from ou_monitor.recordings.importers.log import UNKNOWN
from ou_monitor.recordings.samples import (
    check_throttle, dropped_words, known_current, late_words, overlap, part_words,
    repeated_words, SampleReader, span_words, usable_voltage)
from ou_monitor.recordings.standard_types import IMU
from ou_monitor.records import FloatArray, Recording
from ou_monitor.stream.config import FieldSpec
from ou_monitor.text import printable

# Samples of a piece, where the caller does not say.
PIECE = 1_000_000

# Samples further apart, s, are more likely of another unit of time than of a slow logger.
_SPARSE = 5.0

# Types whose only number need not be named.
_SCALARS = ('std_msgs/msg/Float32', 'std_msgs/msg/Float64')


def read_recording(
    path: str | Path, *, msg_config: str | Path | None = None, voltage_topic: str | None = None,
    throttle_topic: str | None = None, partial: bool = False, start: float | None = None,
    end: float | None = None, flight: int | None = None, columns: CsvColumns | None = None,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """
    Read a recording of a supply.

    Parameters
    ----------
    path : str or path
        An .mcap file, a rosbag2 directory, a CSV with the columns
        ``time_s, voltage_v[, throttle][, current_a]``, or a log of an autopilot that
        `convert` reads (its extra installed).
    msg_config : str or path, optional
        Name of a msg config, or a YAML file; found out when the bag leaves
        one choice.
    voltage_topic, throttle_topic : str, optional
        Topics, where the config's are not meant.
    partial : bool
        Whether a damaged bag is read as far as it holds; a note says so.
    start, end : float, optional
        Part to read, s after the first message of the bag (by log time) or
        the first sample of the CSV: start <= t < end.  Of a bag only the
        chunks in it are read, and those before it back to the last throttle,
        which is held.
    flight : int, optional
        Which flight of a log with several, from 1; the largest when left out.
    columns : CsvColumns, optional
        Names and units of the columns of a CSV; names of the series of a log.
    progress : callable, optional
        Called with the share done, 0..1.

    Returns
    -------
    Recording
        Stamps (s), voltage (V), throttle (0..1) and, where there is one, current (A), each of
        shape (n,), n >= 1; what was dropped or mended is in `notes`.

    Raises
    ------
    InputError
        When it cannot be read, the topics cannot be told, or no sample is
        left.

    """
    path = Path(path)
    _check_part(start, end)
    if path.suffix.lower() == '.csv' and not path.is_dir():
        for option, value in (('--msg-config', msg_config), ('--voltage-topic', voltage_topic),
                              ('--throttle-topic', throttle_topic)):
            if value is not None:
                raise InputError(f'{path} is a CSV: {option} is for bags')
        if flight is not None:
            raise InputError(f'{path} is a CSV: --flight is for logs')
        name = printable(path.name)
        return _cut(tidy(*read_csv(path, columns), name, {'file': name, 'format': 'csv'}, []),
                    start, end)
    if is_log(path):
        if columns is not None and columns != CsvColumns(None, columns.voltage, columns.throttle):
            raise InputError(f'{path} is a log: its time and units are known')
        for option, value in (('--msg-config', msg_config), ('--voltage-topic', voltage_topic),
                              ('--throttle-topic', throttle_topic)):
            if value is not None:
                raise InputError(f'{path} is a log: {option} is for bags; convert chooses among '
                                 'the series of a log')
        named_series = columns or CsvColumns()
        # Here, for bags and CSV need nothing of it.
        from ou_monitor.recordings.write import log_as_bag
        with log_as_bag(path, flight=flight, voltage=named_series.voltage,
                        throttle=named_series.throttle, progress=progress) as (bag, named):
            return named(read_recording(bag, start=start, end=end))
    if flight is not None or columns is not None:
        raise InputError(f'{path} is a bag: --flight is for logs, names and units of columns are '
                         'for logs and CSVs')
    reader = SampleReader(
        BagReader(path, partial=partial), msg_config=msg_config, voltage_topic=voltage_topic,
        throttle_topic=throttle_topic, start=start, end=end)
    for _ in reader.batches(progress):
        pass
    whole = reader.take()
    if not whole.n:
        raise InputError(_nothing(reader, start, end))
    return replace(whole, notes=(*reader.bag_notes(), *reader.sample_notes()))


def read_pieces(
    path: str | Path, *, samples: int = PIECE, msg_config: str | Path | None = None,
    voltage_topic: str | None = None, throttle_topic: str | None = None, partial: bool = False,
    start: float | None = None, end: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Iterator[Recording]:
    """
    Read a recording that need not fit into memory, piece by piece.

    One after another the pieces are what `read_recording` returns, as long as
    no sample comes more than `samples` samples late; one that does is dropped,
    and a note of its piece says so.  A CSV is read whole all the same.

    Parameters
    ----------
    path, msg_config, voltage_topic, throttle_topic, partial, start, end, progress :
        As in `read_recording`.
    samples : int
        Samples of a piece; memory holds about twice as many, and the chunks
        that overlap in time.

    Yields
    ------
    Recording
        Pieces in the order of time, each with its stamps after those of the
        one before, and the throttle held from piece to piece.  Notes on the
        bag are in the first piece, notes on all samples in the last.

    Raises
    ------
    ValueError
        When `samples` is not positive.
    InputError
        As `read_recording`.

    """
    if samples < 1:
        raise ValueError(f'a piece must hold at least 1 sample, got {samples}')
    path = Path(path)
    if path.suffix.lower() == '.csv' and not path.is_dir():
        whole = read_recording(path, msg_config=msg_config, voltage_topic=voltage_topic,
                               throttle_topic=throttle_topic, start=start, end=end)
        for first in range(0, whole.n, samples):
            part = slice(first, first + samples)
            yield replace(whole, t=whole.t[part], voltage=whole.voltage[part],
                          throttle=whole.throttle[part], notes=whole.notes if first == 0 else (),
                          current=None if whole.current is None else whole.current[part])
        return
    _check_part(start, end)
    reader = SampleReader(
        BagReader(path, partial=partial), msg_config=msg_config, voltage_topic=voltage_topic,
        throttle_topic=throttle_topic, start=start, end=end)
    notes = reader.bag_notes()
    # One piece is kept back, so that the last one can carry the notes on all.
    ready: Recording | None = None
    for piece in _taken(reader, samples, progress):
        if ready is not None:
            yield replace(ready, notes=notes)
            notes = ()
        ready = piece
    if ready is None:
        raise InputError(_nothing(reader, start, end))
    yield replace(ready, notes=(*notes, *reader.sample_notes()))


def _taken(
    reader: SampleReader, samples: int, progress: Callable[[float], None] | None,
) -> Iterator[Recording]:
    """Yield pieces that hold something."""
    for _ in reader.batches(progress):
        # As many again stay held, for what comes late.
        while reader.held >= 2 * samples:
            piece = reader.take(samples)
            if piece.n:
                yield piece
    while reader.held:
        piece = reader.take(samples)
        if piece.n:
            yield piece


def tidy(
    t: FloatArray, voltage: FloatArray, throttle: FloatArray, current: FloatArray, name: str,
    source: dict[str, str], notes: list[str],
) -> Recording:
    """Return a `Recording`: finite, in order, each stamp once; notes say what that took."""
    check_throttle(name, throttle, voltage)
    good = usable_voltage(t, voltage)
    if not good.all():
        notes.append(dropped_words(t.size - int(good.sum()), voltage[~good]))
        t, voltage, throttle, current = t[good], voltage[good], throttle[good], current[good]
    late = int(np.count_nonzero(np.diff(t) < 0.0))
    if late:
        notes.append(late_words(late, *overlap(t)))
        order = np.argsort(t, kind='stable')
        t, voltage, throttle, current = t[order], voltage[order], throttle[order], current[order]
    fresh = np.ones(t.size, dtype=bool)
    fresh[1:] = np.diff(t) > 0.0
    if not fresh.all():
        notes.append(repeated_words(t.size - int(fresh.sum())))
        t, voltage, throttle, current = t[fresh], voltage[fresh], throttle[fresh], current[fresh]
    throttle = np.where(np.isfinite(throttle), throttle, np.nan)
    if not t.size:
        raise InputError(_unusable(name, notes))
    if t.size > 2 and (spacing := float(np.median(np.diff(t)))) >= _SPARSE:
        notes.append(f'The samples are {spacing:.4g} s apart: is the time in ms, us or ns? '
                     '--time-unit says so of a CSV.')
    return Recording(t, voltage, throttle, name, source, tuple(notes), known_current(current))


def _unusable(name: str, notes: Sequence[str]) -> str:
    why = ' '.join(note for note in notes if 'dropped' in note)
    return f'{name} holds no usable sample' + (f': {why}' if why else '')


def _nothing(reader: SampleReader, start: float | None, end: float | None) -> str:
    """Return why a bag gave no sample."""
    notes = reader.sample_notes()
    if (start is None and end is None) or any('dropped' in note for note in notes):
        return _unusable(reader.name, notes)
    return _outside(reader.name, start, end, reader.duration)


def _check_part(start: float | None, end: float | None) -> None:
    """Refuse a part that cannot hold anything."""
    for name, value in (('start', start), ('end', end)):
        if value is not None and not (math.isfinite(value) and value >= 0.0):
            raise InputError(f'the {name} of the part to read must be 0 s or later, got {value} s')
    if end is not None and end <= (start or 0.0):
        raise InputError(f'the part to read ends at {end:g} s, not after its start at '
                         f'{start or 0.0:g} s')


def _cut(recording: Recording, start: float | None, end: float | None) -> Recording:
    """Return the samples in a part, s after the first one."""
    if start is None and end is None:
        return recording
    t = recording.t - recording.t[0]
    part = (t >= (start or 0.0)) & (t < (math.inf if end is None else end))
    if not part.any():
        raise InputError(_outside(recording.name, start, end, float(t[-1])))
    return replace(recording, t=recording.t[part], voltage=recording.voltage[part],
                   throttle=recording.throttle[part],
                   current=None if recording.current is None else recording.current[part],
                   notes=(*recording.notes, part_words(start, end)))


def _outside(name: str, start: float | None, end: float | None, length: float) -> str:
    return f'{name} holds no sample {span_words(start, end)}: it lasts {length:.3f} s'


def read_signal(path: str | Path, signal: str, *, partial: bool = False,
                columns: CsvColumns | None = None) -> tuple[FloatArray, FloatArray]:
    """Read one scalar over time; of a CSV `columns` says which is the time."""
    path = Path(path)
    if not signal:
        raise InputError('the name of the signal is empty: TOPIC/FIELD or a column')
    if path.suffix.lower() == '.csv' and not path.is_dir():
        return read_column(path, signal, columns)
    bag = BagReader(path, partial=partial)
    topic, field = _split(path, signal, bag.topics)
    kind = bag.topics[topic]
    spec = FieldSpec(topic, kind, field, nan='unknown',
                     stamp_field='header.stamp' if _has_header(bag, topic) else None)
    parts = [batch['signal'] for batch in batches(bag, {'signal': spec})]
    column = join(parts)
    if not column.n:
        raise InputError(f"{path}: topic '{topic}' holds no message")
    values = np.full(column.n, np.nan)
    values[column.count > 0] = column.values
    return column.stamp, values


def signal_unit(path: str | Path, signal: str, *, partial: bool = False) -> str:
    """Return the unit of a scalar of a bag; empty where nothing states it."""
    path = Path(path)
    if path.suffix.lower() == '.csv' and not path.is_dir():
        return ''
    bag = BagReader(path, partial=partial)
    topic, field = _split(path, signal, bag.topics)
    if bag.topics[topic] == IMU:
        return {'angular_velocity': 'rad/s', 'linear_acceleration': 'm/s^2'}.get(
            field.partition('.')[0], '')
    unit = bag.origins.get(topic, {}).get(f'{topic[1:]}_unit', '')
    return '' if unit == UNKNOWN else unit


def _has_header(bag: BagReader, topic: str) -> bool:
    """Whether messages of a topic carry a stamp in their header."""
    first = next(bag.decoded([topic]), None)
    header = None if first is None else getattr(first.message, 'header', None)
    return hasattr(header, 'stamp')


def _split(path: Path, signal: str, topics: Mapping[str, str]) -> tuple[str, str]:
    """Return the topic and the field that a signal names."""
    wanted = '/' + signal.lstrip('/')
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
