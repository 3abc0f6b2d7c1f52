"""
Any scalar of a recording beside its voltage: a field of a topic, or a column.

Limits first: stamps are those of the message's header where it has one, else
the bag's log times; a voltage with the other kind is off by the delay of the
transmission.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from ou_monitor.errors import InputError, nearest
from ou_monitor.recordings.bag import BagReader
from ou_monitor.recordings.batches import batches
from ou_monitor.recordings.columns import join
from ou_monitor.recordings.csv_table import read_column
from ou_monitor.records import FloatArray
from ou_monitor.stream.config import FieldSpec

# Types whose only number need not be named.
_SCALARS = ('std_msgs/msg/Float32', 'std_msgs/msg/Float64')


def read_signal(path: str | Path, signal: str, *, partial: bool = False,
                ) -> tuple[FloatArray, FloatArray]:
    """Read one scalar over time."""
    path = Path(path)
    if not signal:
        raise InputError('the name of the signal is empty: TOPIC/FIELD or a column')
    if path.suffix.lower() == '.csv' and not path.is_dir():
        return read_column(path, signal)
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
