"""
Where the messages of a chunk are, as arrays: no Python object for each.

Records stand one after another, each with its length, so that the place of one
follows from those before it.  Two ways lead around that walk: the message
indexes that follow a chunk state every place, and a run of records of one
length is checked as a whole.  Both are verified byte by byte, never trusted:
what comes out is what the walk would have found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.recordings.framing import Damage, MESSAGE_HEAD, Op, RECORD_HEAD

IntArray = npt.NDArray[np.int64]
TimeArray = npt.NDArray[np.uint64]

_HEAD = RECORD_HEAD.size
_PAYLOAD = RECORD_HEAD.size + MESSAGE_HEAD.size

# A run of equal records is looked for this far ahead at first, then twice as far.
_FIRST_RUN = 32
# Records to walk one by one after a run that was not worth looking for: twice as
# many each time, up to this.
_LEAST_PAUSE, _MOST_PAUSE = 16, 2048


@dataclass(frozen=True, eq=False)
class Table:
    """
    Messages in a block of bytes, in the order of the file.

    Attributes
    ----------
    data : bytes
        The block.
    channel : ndarray of uint16, shape (n,)
        Channel of each message.
    log_time : ndarray of uint64, shape (n,)
        Log times, ns.
    begin, end : ndarray of int64, shape (n,)
        Where the serialized message is in `data`.

    """

    data: bytes
    channel: npt.NDArray[np.uint16]
    log_time: TimeArray
    begin: IntArray
    end: IntArray

    @property
    def n(self) -> int:
        """Return the number of messages."""
        return int(self.begin.size)

    def where(self, mask: npt.NDArray[np.bool_]) -> Table:
        """Return the messages for which `mask`, shape (n,), is true."""
        if mask.all():
            return self
        return Table(self.data, self.channel[mask], self.log_time[mask], self.begin[mask],
                     self.end[mask])

    def first(self, n: int) -> Table:
        """Return the first `n` messages."""
        return Table(self.data, self.channel[:n], self.log_time[:n], self.begin[:n], self.end[:n])

    def rows(self, picked: IntArray, length: int) -> npt.NDArray[np.uint8]:
        """Return serialized messages of one length as rows; the length is in bytes."""
        return gather(self.data, self.begin[picked], f'V{length}').view(np.uint8).reshape(
            -1, length)


def gather(data: bytes, at: IntArray, kind: str) -> npt.NDArray[Any]:
    """Return items of a kind from anywhere in a block of bytes."""
    size = np.dtype(kind).itemsize
    if not at.size:
        return np.empty(0, kind)
    # One item at every byte: NumPy picks from such a view far faster than it
    # puts single bytes together.
    everywhere: npt.NDArray[Any] = np.ndarray(
        (len(data) - size + 1,), kind, data, 0, (1,))
    return everywhere[at]


def find_messages(
    data: bytes, *, messages_only: bool = False,
) -> tuple[Table, list[tuple[int, int, int]], int]:
    """Find the messages in a chunk, or in a run of plain records."""
    found: list[IntArray] = []
    single: list[int] = []
    others: list[tuple[int, int, int]] = []
    at, size, last, pause, wait = 0, len(data), -1, 0, _LEAST_PAUSE
    head, shortest, opcode_of_message = RECORD_HEAD.unpack_from, MESSAGE_HEAD.size, int(Op.MESSAGE)
    while at < size:
        if at + _HEAD > size:
            if messages_only:
                break
            raise Damage(at, 'a record within a chunk is cut off')
        opcode, length = head(data, at)
        behind = at + _HEAD + length
        if opcode != opcode_of_message or length < shortest or behind > size:
            if messages_only:
                break
            if behind > size:
                raise Damage(at, 'a record within a chunk is cut off')
            if opcode == opcode_of_message:
                raise Damage(at, 'a message is shorter than its own head')
            others.append((opcode, at + _HEAD, behind))
            at, last = behind, -1
            continue
        pause -= 1
        if length != last or pause > 0:
            single.append(at)
            at, last = behind, length
            continue
        stride = behind - at
        run = _run(data, at, stride)
        if run < _FIRST_RUN:
            pause, wait = wait, min(2 * wait, _MOST_PAUSE)
        else:
            wait = _LEAST_PAUSE
        found += [np.array(single, dtype=np.int64),
                  at + stride * np.arange(run, dtype=np.int64)]
        single = []
        at += run * stride
    found.append(np.array(single, dtype=np.int64))
    return _table(data, np.concatenate(found)), others, at


def _run(data: bytes, at: int, stride: int) -> int:
    """Return how many records from `at` on are messages of one length."""
    most = (len(data) - at) // stride
    seen, ahead = 1, _FIRST_RUN
    while seen < most:
        ahead = min(ahead, most - seen)
        heads: npt.NDArray[np.uint8] = np.ndarray(
            (ahead, _HEAD), np.uint8, data, at + seen * stride, (stride, 1))
        same = (heads == np.frombuffer(data, np.uint8, _HEAD, at)).all(axis=1)
        if not same.all():
            return seen + int(np.argmin(same))
        seen += ahead
        ahead *= 2
    return seen


def _table(data: bytes, at: IntArray) -> Table:
    """Return the table of messages whose records begin at given offsets."""
    length = gather(data, at + 1, '<u8').astype(np.int64)
    return Table(data, gather(data, at + _HEAD, '<u2'), gather(data, at + _HEAD + 6, '<u8'),
                 at + _PAYLOAD, at + _HEAD + length)


def find_by_index(data: bytes, index: bytes) -> Table | None:
    """Find the messages of a chunk with the message indexes behind it."""
    parts: list[IntArray] = []
    at = 0
    while at < len(index):
        if at + _HEAD + 6 > len(index):
            return None
        opcode, length = RECORD_HEAD.unpack_from(index, at)
        count, odd = divmod(length - 6, 16)
        if opcode != Op.MESSAGE_INDEX or odd or count < 0 or at + _HEAD + length > len(index):
            return None
        pairs = np.frombuffer(index, '<u8', 2 * count, at + _HEAD + 6)
        parts.append(pairs[1::2].astype(np.int64))
        at += _HEAD + length
    if not parts:
        return None
    places = np.concatenate(parts)
    if len(parts) > 1 or (np.diff(places) < 0).any():
        places.sort()
    if not places.size or places[0] < 0 or places[-1] > len(data) - _PAYLOAD:
        return None
    table = _table(data, places)
    # A length of 2^63 or more is negative here; one beyond the chunk is too long.
    if not ((gather(data, places, 'u1') == Op.MESSAGE) & (table.end >= table.begin)
            & (table.end <= len(data))).all():
        return None
    behind = np.concatenate([np.zeros(1, np.int64), table.end])
    ahead = np.append(places, len(data))
    for gap in np.nonzero(behind != ahead)[0].tolist():
        if not _only_others(data, int(behind[gap]), int(ahead[gap])):
            return None
    return table


def _only_others(data: bytes, at: int, end: int) -> bool:
    """Whether whole records that are not messages fill a part of the chunk."""
    while at + _HEAD <= end:
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        if opcode == Op.MESSAGE:
            return False
        at += _HEAD + length
    return at == end
