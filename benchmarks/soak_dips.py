"""
What became of each dip of a soak, and what was known of it where it was not told.

A dip that was not told in time is one of three: its messages did not reach the node (not
delivered); the node counted it (`floor_dips`) and the message that said so did not reach the
listener, by the numbers of the messages (not heard); or it was missed.  Messages count from when
the node sent them: a listener without CPU hears them late.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
from typing import Any, NamedTuple

import numpy as np

Span = tuple[float, float]
# A dip is told in time within so long, s, of its begin.  Not counted, there and in silences: time
# that the node was stopped by us or had no CPU though it was ready.
IN_TIME = 1.0
# A dip of fewer low samples that reached the wire is no dip of 40 ms.
SAMPLES = 40
# What was done to the node so long before a dip is told beside it, s.
BEFORE = 2.0


class State(NamedTuple):
    """
    One message of `~/state`.

    Attributes
    ----------
    at : float
        When it was sent, by the monotonic clock, s.
    level, reason, brownout : str
        The flag.
    messages, lost, foreign, dips : int
        The node's counts so far: messages taken, messages that never came, messages of another
        publisher, times that the voltage went down to the floor.
    number : int
        Of the message, by its publisher.
    arrival : float
        Time since the node last took a message, s.

    """

    at: float
    level: str
    reason: str
    brownout: str
    messages: int
    lost: int = 0
    foreign: int = 0
    dips: int = 0
    number: int = 0
    arrival: float = math.nan


class Said(NamedTuple):
    """One message of another output: when it was sent, s, what it says, and its number."""

    at: float
    value: Any = None
    number: int = 0


@dataclass
class Heard:
    """
    All that was heard and noted, times by the monotonic clock, s.

    Attributes
    ----------
    states : list of State
    flags : list of Said
    outputs : dict of str to list of Said
        The messages of the other outputs.
    memory : list of (time, bytes)
    stops, withheld, deaf : list of (begin, end)
        When the node was stopped, when it was ready and had no CPU, and when the listener had
        none.
    deaths : list of float
    done : list of (time, str, str)
        What was done to the node: a parameter and its value, or an event and nothing.
    source : list of dict
        Lines of the source's log.

    """

    states: list[State] = field(default_factory=list)
    flags: list[Said] = field(default_factory=list)
    outputs: dict[str, list[Said]] = field(default_factory=dict)
    memory: list[tuple[float, float]] = field(default_factory=list)
    stops: list[Span] = field(default_factory=list)
    withheld: list[Span] = field(default_factory=list)
    deaf: list[Span] = field(default_factory=list)
    deaths: list[float] = field(default_factory=list)
    done: list[tuple[float, str, str]] = field(default_factory=list)
    source: list[dict[str, Any]] = field(default_factory=list)

    def pauses(self) -> list[Span]:
        """Return the time that is not the node's: the union of all of it, in order."""
        made: list[Span] = []
        for begin, end in sorted([*self.stops, *self.withheld]):
            if made and begin <= made[-1][1]:
                made[-1] = made[-1][0], max(end, made[-1][1])
            else:
                made.append((begin, end))
        return made

    def lately(self, begin: float, end: float) -> str:
        """Return what was done to the node shortly before a time, and until another."""
        return ', '.join(f'{name} {value}'.strip() + f' at {t - begin:+.2f} s'
                         for t, name, value in self.done
                         if begin - BEFORE < t < end) or 'nothing'

    def sent(self) -> tuple[list[float], list[float]]:
        """Return how many messages the source had sent, and when, s."""
        lines = [line for line in self.source if line['kind'] == 'sent']
        return [line['at'] for line in lines], [line['count'] for line in lines]


def overlap(begin: float, end: float, spans: Sequence[Span]) -> float:
    """Return how much of a time lies in the spans, which are in order, s."""
    first = max(bisect_right(spans, (begin, math.inf)) - 1, 0)
    total = 0.0
    for a, b in spans[first:]:
        if a >= end:
            break
        total += max(0.0, min(b, end) - max(a, begin))
    return total


def unheard(messages: Sequence[State] | Sequence[Said]) -> int:
    """Return how many messages are missing between these, by their numbers."""
    return sum(max(b.number - a.number - 1, 0) for a, b in zip(messages, messages[1:]))


def told(dip: Mapping[str, Any], heard: Heard, pauses: Sequence[Span]) -> tuple[float, float]:
    """
    Return when a dip was told, s from its begin, and the same without pauses; inf: it was not.

    Told: a state says CRITICAL because of the floor, and `~/brownout` is true.
    """
    begin = dip['begin']
    when = math.inf
    for state in heard.states[bisect_right(heard.states, (begin,)):]:
        # A later dip must not stand for this one.
        if state.at - begin - overlap(begin, state.at, pauses) > IN_TIME:
            break
        if state.level == 'CRITICAL' and 'brownout.floor (' in state.reason:
            when = state.at
            break
    when = max(when, next((
        said.at for said in heard.flags[bisect_right(heard.flags, (begin,)):] if said.value),
        math.inf))
    net = when - begin - overlap(begin, when, pauses) if when < math.inf else when
    return when - begin, net


def fate(dip: Mapping[str, Any], heard: Heard, sent: tuple[Sequence[float], Sequence[float]]
         ) -> tuple[str, str]:
    """
    Return what became of a dip that was not told, and what is known of it, in one line.

    'lost', 'unheard' or 'missed', from the state before it to that a second after it.
    """
    at = bisect_right(heard.states, (dip['begin'],))
    first = max(at - 1, 0)
    last = next((k for k in range(at, len(heard.states))
                 if heard.states[k].at > dip['end'] + IN_TIME), len(heard.states) - 1)
    states = heard.states[first:last + 1]
    before, after = states[0], states[-1]
    said = heard.flags[max(bisect_left(heard.flags, (before.at,)) - 1, 0):
                       bisect_left(heard.flags, (after.at,)) + 2]
    mute, silent = unheard(states), unheard(said)
    seen = any(s.level == 'CRITICAL' and 'brownout.floor (' in s.reason for s in states[1:])
    # What is sent during the last fiftieth of a second may wait for the next poll.
    due = float(np.diff(np.interp([before.at, after.at - 0.02], *sent))[0])
    came, counted = after.messages - before.messages, after.dips - before.dips
    if counted > 0:
        kind = 'unheard' if (silent if seen else mute) else 'missed'
    else:
        # By what was sent, or by the node's numbers: what came may be of before.
        gone = max(due - came, after.lost - before.lost)
        kind = 'lost' if gone > 0.5 * dip['samples'] else 'missed'
    now = {name: value for t, name, value in heard.done if t < dip['begin'] and value}
    near = (before.at, after.at)
    gaps = np.diff([s.at for s in states])
    return kind, '; '.join([
        f"{dip['samples']} samples at {dip['voltage']:.2f} V within "
        f"{1e3 * (dip['end'] - dip['begin']):.1f} ms, stamps and values: {dip['phase']}",
        f'the node counted {counted} dips, {came} messages of {due:.0f}, '
        f'{after.lost - before.lost} lost, {after.foreign - before.foreign} of others, the last '
        f'{max(s.arrival for s in states):.2f} s old at most',
        f'heard {len(states) - 1} states and not {mute}, {len(said) - 1} flags and not {silent}, '
        f'{max(gaps, default=math.nan):.2f} s apart at most',
        *(f'{word} {overlap(*near, sorted(spans)):.2f} s' for word, spans in (
            ('stopped', heard.stops), ('node without CPU', heard.withheld),
            ('listener without CPU', heard.deaf))),
        'in force: ' + (', '.join(f'{k} {v}' for k, v in now.items()) or 'defaults'),
        'done: ' + heard.lately(dip['begin'], dip['end'] + IN_TIME)])


def dips_of(heard: Heard) -> dict[str, Any]:
    """Return what became of the dips."""
    all_dips = [line for line in heard.source if line['kind'] == 'dip']
    asked = [dip for dip in all_dips if not dip['unseen'] and dip['samples'] >= SAMPLES]
    last = heard.states[-1].at if heard.states else -math.inf
    asked = [dip for dip in asked if dip['end'] + IN_TIME < last]
    pauses, sent = heard.pauses(), heard.sent()
    late: list[float] = []
    others: dict[str, list[dict[str, Any]]] = {'lost': [], 'unheard': [], 'missed': []}
    for dip in asked:
        after, net = told(dip, heard, pauses)
        if net <= IN_TIME:
            late.append(net)
        else:
            kind, why = fate(dip, heard, sent)
            others[kind].append({**dip, 'told': after, 'net': net, 'why': why})
    return {'sent': len(all_dips), 'asked': len(asked), 'in_time': len(late), **others,
            'median': float(np.median(late)) if late else math.nan,
            'longest': max(late, default=math.nan)}
