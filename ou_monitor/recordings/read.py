"""
Any recording -> `Recording`: .mcap, rosbag2 directory, CSV.

Limits first: stamps of a bag are seconds of its own clock in float64, which
for a clock that counts from 1970 resolves 0.24 us; more than that is not kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ou_monitor.errors import InputError
from ou_monitor.messages.blocks import BlockClock
from ou_monitor.messages.config import FieldSpec
from ou_monitor.messages.extract import Extractor
from ou_monitor.messages.throttle import hold_last
from ou_monitor.recordings.bag import BagReader, RawMessage
from ou_monitor.recordings.cdr import decode_block, decode_scalars, FLOAT32_ARRAY
from ou_monitor.recordings.csv_table import read_csv
from ou_monitor.recordings.topic_choice import choose
from ou_monitor.records import FloatArray, Recording

# Messages decoded at once: large enough for NumPy, small enough for memory.
BATCH = 16384

# Where the fields of the shortcut have their stamp.
HEADER_STAMP = 'header.stamp'


def read_recording(
    path: str | Path, *, msg_config: str | Path | None = None, voltage_topic: str | None = None,
    throttle_topic: str | None = None, partial: bool = False,
) -> Recording:
    """
    Read a recording of a supply.

    Parameters
    ----------
    path : str or path
        An .mcap file, a rosbag2 directory, or a CSV with the columns
        ``time_s, voltage_v[, throttle]``.
    msg_config : str or path, optional
        Name of a msg config, or a YAML file; found out when the bag leaves
        one choice.
    voltage_topic, throttle_topic : str, optional
        Topics, where the config's are not meant.
    partial : bool
        Whether a damaged bag is read as far as it holds; a note says so.

    Returns
    -------
    Recording
        Stamps (s), voltage (V) and throttle (0..1), each of shape (n,),
        n >= 1; what was dropped or mended is in `notes`.

    Raises
    ------
    InputError
        When it cannot be read, the topics cannot be told, or no sample is
        left.

    """
    path = Path(path)
    if path.suffix.lower() == '.csv' and not path.is_dir():
        for name, value in (('--msg-config', msg_config), ('--voltage-topic', voltage_topic),
                            ('--throttle-topic', throttle_topic)):
            if value is not None:
                raise InputError(f'{path} is a CSV: {name} is for bags')
        t, voltage, throttle = read_csv(path)
        return tidy(t, voltage, throttle, path.name, {'file': path.name, 'format': 'csv'}, [])
    return _read_bag(BagReader(path, partial=partial), msg_config, voltage_topic, throttle_topic)


def tidy(
    t: FloatArray, voltage: FloatArray, throttle: FloatArray, name: str,
    source: dict[str, str], notes: list[str],
) -> Recording:
    """
    Return a `Recording`: finite, in order, each stamp once; notes say what that took.

    Parameters
    ----------
    t, voltage, throttle : ndarray, shape (n,)
        As found.
    name : str
        For people.
    source : dict of str to str
        Where it came from.
    notes : list of str
        Notes so far.

    Returns
    -------
    Recording
        At least one sample.

    Raises
    ------
    InputError
        When no sample is left.

    """
    total = t.size
    good = np.isfinite(t) & np.isfinite(voltage)
    if not good.all():
        notes.append(f'{_samples(total - int(good.sum()))} dropped: not a finite number.')
        t, voltage, throttle = t[good], voltage[good], throttle[good]
    late = int(np.count_nonzero(np.diff(t) < 0.0))
    if late:
        notes.append(f'{_samples(late)} came before the stamp ahead of them: sorted by stamp.')
        order = np.argsort(t, kind='stable')
        t, voltage, throttle = t[order], voltage[order], throttle[order]
    fresh = np.ones(t.size, dtype=bool)
    fresh[1:] = np.diff(t) > 0.0
    if not fresh.all():
        notes.append(f'{_samples(t.size - int(fresh.sum()))} dropped: the stamp was there '
                     'before; the first of each was kept.')
        t, voltage, throttle = t[fresh], voltage[fresh], throttle[fresh]
    if not t.size:
        why = ' '.join(note for note in notes if 'dropped' in note)
        raise InputError(f'{name} holds no usable sample' + (f': {why}' if why else ''))
    throttle = np.where(np.isfinite(throttle), throttle, np.nan)
    return Recording(t, voltage, throttle, name, source, tuple(notes))


def _samples(count: int) -> str:
    return f'{count} sample' if count == 1 else f'{count} samples'


def _read_bag(
    bag: BagReader, msg_config: str | Path | None, voltage_topic: str | None,
    throttle_topic: str | None,
) -> Recording:
    choice = choose(bag.path, bag.topics, msg_config=msg_config, voltage_topic=voltage_topic,
                    throttle_topic=throttle_topic)
    notes = [*bag.notes, *choice.notes]
    if bag.damage is not None:
        notes.append(f'The bag is damaged; what it still holds was read: {bag.damage}.')
    spec = choice.voltage
    stated = bag.sample_rates.get(spec.topic)
    if spec.sample_rate is not None and stated is not None:
        # The bag knows better than a config that is made for many.
        spec = replace(spec, sample_rate=stated)
    t, voltage = _series(bag, spec, 'voltage', notes)
    throttle = np.full(t.shape, np.nan)
    source = {
        'file': bag.path.name, 'format': 'mcap', 'msg_config': choice.config.name,
        'voltage_topic': choice.voltage.topic, 'voltage_type': choice.voltage.type}
    if choice.throttle is not None:
        source |= {'throttle_topic': choice.throttle.topic,
                   'throttle_type': choice.throttle.type}
        stamps, values = _series(bag, choice.throttle, 'throttle', notes)
        stamps_known = np.isfinite(stamps)
        stamps, values = stamps[stamps_known], values[stamps_known]
        order = np.argsort(stamps, kind='stable')
        # Stamps within a block are worked out, and may be a rounding short of a
        # throttle that was meant to hold for that sample.
        rate = spec.sample_rate
        slack = 0.0 if rate is None else 0.1 / rate
        throttle = hold_last(stamps[order], values[order], t + slack)
    return tidy(t, voltage, throttle, bag.path.name, source, notes)


def _series(
    bag: BagReader, spec: FieldSpec, what: str, notes: list[str],
) -> tuple[FloatArray, FloatArray]:
    """Return stamps (s) and values of one topic, in log-time order."""
    extractor = Extractor(spec)
    clock = None if spec.sample_rate is None else BlockClock(spec.sample_rate)
    stamps: list[FloatArray] = [np.empty(0)]
    values: list[FloatArray] = [np.empty(0)]
    missing = 0
    messages = bag.raw_messages([spec.topic])
    while batch := list(islice(messages, BATCH)):
        found = None if clock else _scalars(batch, spec)
        if found is None:
            for end, block, lost in _general(bag, batch, extractor):
                missing += lost
                values.append(block)
                stamps.append(np.full(block.size, end) if clock is None
                              else clock.stamps(end, block.size))
            continue
        ends, block = found
        if spec.nan == 'drop':
            finite = np.isfinite(block)
            missing += block.size - int(finite.sum())
            ends, block = ends[finite], block[finite]
        stamps.append(ends)
        values.append(block)
    if missing and what == 'throttle':
        notes.append(f'{missing} throttle value{"s" * (missing != 1)} dropped: not a finite '
                     'number.')
    elif missing and clock is None and spec.nan == 'drop':
        notes.append(f'{_samples(missing)} dropped: not a finite number.')
    if clock is not None and clock.gaps:
        notes.append(f'{clock.gaps} gap{"s" * (clock.gaps != 1)} between blocks of samples.')
    return np.concatenate(stamps), np.concatenate(values)


def _seconds(stamps_ns: npt.NDArray[np.int64]) -> FloatArray:
    """Return ns as s; whole seconds apart, for an epoch in ns does not fit a float64."""
    return stamps_ns // 1_000_000_000 + (stamps_ns % 1_000_000_000) * 1e-9


def _scalars(batch: Sequence[RawMessage], spec: FieldSpec) -> tuple[FloatArray, FloatArray] | None:
    """Decode a batch of a standard type at once; None when that cannot be done."""
    if spec.stamp_field not in (None, HEADER_STAMP):
        return None
    found = decode_scalars(spec.type, spec.field, [message.data for message in batch])
    if found is None:
        return None
    own, raw = found
    stamps = np.array([message.log_time_ns for message in batch], dtype=np.int64)
    if spec.stamp_field is not None:
        if own is None:
            return None
        stamps = np.where(own != 0, own, stamps)
    return _seconds(stamps), spec.sign * spec.unit_factor * raw + spec.offset


def _general(
    bag: BagReader, batch: Sequence[RawMessage], extractor: Extractor,
) -> Iterator[tuple[float, FloatArray, int]]:
    """Yield (stamp of the last sample, values, missing) of any message."""
    spec = extractor.spec
    scale = spec.sign * spec.unit_factor
    quick = spec.type == FLOAT32_ARRAY and spec.field == 'data' and spec.stamp_field is None
    decode = None
    for message in batch:
        logged = message.log_time_ns // 1_000_000_000 + message.log_time_ns % 1_000_000_000 * 1e-9
        block = decode_block(message.data) if quick and spec.sample_rate else None
        if block is not None:
            block = block * scale + spec.offset
            finite = np.isfinite(block)
            yield logged, np.where(finite, block, np.nan), block.size - int(finite.sum())
            continue
        decode = decode or bag.decoder(spec.type)
        found = extractor.extract(decode(message.data))
        yield (logged if found.stamp is None else found.stamp), found.values, found.missing
