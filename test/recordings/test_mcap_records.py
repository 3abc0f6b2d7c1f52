"""Messages of a chunk as arrays: what a walk, record by record, finds."""

import struct

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.recordings.mcap_records import (
    Damage, find_by_index, find_messages, inner_records, MESSAGE_HEAD, Op)
import pytest


def record(opcode, content):
    """Return one record."""
    return struct.pack('<BQ', opcode, len(content)) + content


def message(channel, time, size):
    """Return a message record."""
    return record(Op.MESSAGE, struct.pack('<HIQQ', channel, 1, time, time) + b'\x05' * size)


def walked(data):
    """Return (channel, time, begin, end) of each message by the plain walk."""
    found = []
    for opcode, begin, end in inner_records(data):
        if opcode == Op.MESSAGE:
            channel, _, time, _ = MESSAGE_HEAD.unpack_from(data, begin)
            found.append((channel, time, begin + MESSAGE_HEAD.size, end))
    return found


def rows(table):
    """Return the same of a table."""
    return list(zip(table.channel.tolist(), table.log_time.tolist(), table.begin.tolist(),
                    table.end.tolist(), strict=True))


def index_of(data, change=None):
    """Return the message indexes of a chunk, the newest entry first, changed if asked."""
    entries = {}
    for channel, time, begin, _ in walked(data):
        entries.setdefault(channel, []).insert(0, [time, begin - 9 - MESSAGE_HEAD.size])
    if change:
        change(entries)
    out = b''
    for channel, pairs in entries.items():
        content = b''.join(struct.pack('<QQ', *pair) for pair in pairs)
        out += record(Op.MESSAGE_INDEX, struct.pack('<HI', channel, len(content)) + content)
    return out


# (kind, how many): runs of equal records, alternating ones, other records between.
PARTS = st.lists(st.tuples(st.sampled_from(['a', 'b', 'ab', 'aab', 'odd', 'other']),
                           st.integers(1, 90)), max_size=8)


def chunk(parts, rng):
    """Return the records of a chunk."""
    out = []
    for kind, count in parts:
        for k in range(count):
            time = int(rng.integers(2**64, dtype=np.uint64))
            if kind == 'other':
                out.append(record(int(rng.choice([3, 4, 0x81])), b'x' * int(rng.integers(40))))
                break
            if kind == 'odd':
                out.append(message(3, time, int(rng.integers(60))))
                continue
            letter = kind[k % len(kind)]
            out.append(message(1 if letter == 'a' else 2, time, 8 if letter == 'a' else 21))
    return b''.join(out)


@settings(max_examples=150, deadline=None)
@given(PARTS, st.integers(0, 2**32))
def test_as_the_walk(parts, seed):
    """Runs, mixtures and records between them; with and without the index."""
    data = chunk(parts, np.random.default_rng(seed))
    expected = walked(data)
    table, others, stop = find_messages(data)
    assert rows(table) == expected and stop == len(data)
    assert others == [r for r in inner_records(data) if r[0] != Op.MESSAGE]
    if expected:
        assert rows(find_by_index(data, index_of(data))) == expected


@settings(max_examples=150, deadline=None)
@given(PARTS, st.integers(0, 2**32))
def test_cut_and_broken_as_the_walk(parts, seed):
    """Cut off or with a wrong byte: the same messages, or the same damage."""
    rng = np.random.default_rng(seed)
    data = bytearray(chunk(parts, rng) or b'\x05')
    if rng.random() < 0.6:
        data[rng.integers(len(data))] = rng.choice([0, 1, 5, 6, 30, 255])
    data = bytes(data[:len(data) if rng.random() < 0.4 else rng.integers(1, len(data) + 1)])
    try:
        expected = walked(data)
    except Damage as error:
        with pytest.raises(Damage) as caught:
            find_messages(data)
        assert str(caught.value) == str(error)
        return
    assert rows(find_messages(data)[0]) == expected


def test_messages_only_stops_at_anything_else():
    """A run ends where another record, or a message that is not whole, begins."""
    run = b''.join(message(1, k, 8) for k in range(100))
    for rest in (b'', record(3, b'abc'), message(1, 7, 30)[:-1], b'\x05\x00'):
        table, others, stop = find_messages(run + rest, messages_only=True)
        assert (table.n, others, stop) == (100, [], len(run))


def drop_one(entries):
    """Leave out a message."""
    entries[1].pop(3)


def name_twice(entries):
    """Name one message twice."""
    entries[1].append(entries[1][0])


def shift(entries):
    """Point beside a record."""
    entries[2][0][1] += 1


def far(entries):
    """Point behind the chunk."""
    entries[2][0][1] = 2**63 + 5


def to_the_schema(entries):
    """Point to a record that is no message."""
    entries[1].append([0, 0])


def drop_a_channel(entries):
    """Leave out a channel."""
    del entries[2]


@pytest.mark.parametrize('change', [drop_one, name_twice, shift, far, to_the_schema,
                                    drop_a_channel])
def test_an_index_that_does_not_fit_is_not_used(change):
    """Each kind of mistake is found, and the walk then has the word."""
    data = record(3, b'x' * 30) + b''.join(message(1 + k % 2, k, 8) for k in range(40))
    assert find_by_index(data, index_of(data)) is not None
    assert find_by_index(data, index_of(data, change)) is None


def test_an_index_that_is_none():
    """No index, half an index, another record."""
    data = message(1, 5, 8)
    good = index_of(data)
    for index in (b'', good[:-1], good[:5], record(3, good[9:]), good + b'\x07'):
        assert find_by_index(data, index) is None
