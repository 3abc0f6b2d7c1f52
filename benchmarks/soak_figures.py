"""
What a soak found: what became of each dip, silence of the outputs, false flags, memory.

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
from scipy import stats
from soak_schedule import NEVER_FALSE
from tables import table

Span = tuple[float, float]
# A dip is told in time within so long, s, of its begin.  Not counted, there and in silences: time
# that the node was stopped by us or had no CPU though it was ready.
IN_TIME = 1.0
# A dip of fewer low samples that reached the wire is no dip of 40 ms.
SAMPLES = 40
# What was done to the node so long before a dip is told beside it, s.
BEFORE = 2.0


class State(NamedTuple):
    """One message of `~/state`."""

    at: float  # When it was sent, by the monotonic clock, s.
    # The flag.
    level: str
    reason: str
    brownout: str
    # The node's counts so far: messages taken, messages that never came, messages of another
    # publisher, times that the voltage went down to the floor.
    messages: int
    lost: int = 0
    foreign: int = 0
    dips: int = 0
    number: int = 0  # Of the message, by its publisher.
    arrival: float = math.nan  # Time since the node last took a message, s.


class Said(NamedTuple):
    """One message of another output: when it was sent, s, what it says, and its number."""

    at: float
    value: Any = None
    number: int = 0


@dataclass
class Heard:
    """All that was heard and noted, times by the monotonic clock, s."""

    states: list[State] = field(default_factory=list)
    flags: list[Said] = field(default_factory=list)
    # The messages of the other outputs.
    outputs: dict[str, list[Said]] = field(default_factory=dict)
    memory: list[tuple[float, float]] = field(default_factory=list)
    # When the node was stopped, when it was ready and had no CPU, and when the listener had
    # none.
    stops: list[Span] = field(default_factory=list)
    withheld: list[Span] = field(default_factory=list)
    deaf: list[Span] = field(default_factory=list)
    deaths: list[float] = field(default_factory=list)
    # What was done to the node: a parameter and its value, or an event and nothing.
    done: list[tuple[float, str, str]] = field(default_factory=list)
    source: list[dict[str, Any]] = field(default_factory=list)  # Lines of the source's log.

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
         ) -> tuple[str, dict[str, Any]]:
    """
    Return what became of a dip that was not told, and what is known of it.

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
    near = (before.at, after.at)
    return kind, {
        'counted': counted, 'came': came, 'due': round(due), 'lost': after.lost - before.lost,
        'foreign': after.foreign - before.foreign, 'oldest': max(s.arrival for s in states),
        'states_unheard': mute, 'flags_unheard': silent,
        'gap': max(np.diff([s.at for s in states]), default=math.nan),
        'stopped': overlap(*near, sorted(heard.stops)),
        'withheld': overlap(*near, sorted(heard.withheld)),
        'deaf': overlap(*near, sorted(heard.deaf)),
        'in_force': {name: value for t, name, value in heard.done
                     if t < dip['begin'] and value},
        'done': heard.lately(dip['begin'], dip['end'] + IN_TIME)}


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


# Memory is looked at after the warm-up, s at most, or a fifth of the time; in so many blocks.
WARM_UP, BLOCKS = 600.0, 20
# How long the node may speak of what came before a phase, s: the longest `stale_after` that is
# set, and a report.
LINGER = 2.3


def silence(said: Sequence[Said] | Sequence[State], stops: Sequence[Span]
            ) -> tuple[float, float, float]:
    """
    Return the longest gap, s: as it was, without time that the node was stopped; when the latter.

    Of messages that follow one another by their numbers: between others, some were not heard.
    """
    gaps = [(a.at, b.at) for a, b in zip(said, said[1:]) if b.number == a.number + 1]
    if not gaps:
        return math.nan, math.nan, math.nan
    return (max(b - a for a, b in gaps),
            *max((b - a - overlap(a, b, stops), a) for a, b in gaps))


def false_of(heard: Heard) -> tuple[int, list[tuple[float, str]]]:
    """Return how many seconds nothing could be known, and when `~/brownout` was false then."""
    marks = [line for line in heard.source if line['kind'] == 'phase']
    pauses = heard.pauses()
    spent, found = 0.0, []
    for now, then in zip(marks, marks[1:]):
        if now['name'] not in NEVER_FALSE:
            continue
        begin, end = now['at'] + LINGER, then['at']
        spent += max(end - begin, 0.0)
        begin += overlap(now['at'], begin, pauses)
        part = slice(bisect_right(heard.flags, (begin, True, math.inf)),
                     bisect_left(heard.flags, (end,)))
        found += [(said.at, now['name']) for said in heard.flags[part] if not said.value]
    return round(spent), found


def unmatched(heard: Heard) -> float:
    """Return the longest time between a state that knows the flag and a `~/brownout`, s."""
    times = [said.at for said in heard.flags]
    worst = 0.0
    for state in heard.states:
        if state.brownout != 'unknown':
            at = bisect_right(times, state.at)
            worst = max(worst, min((abs(state.at - times[k]) for k in (at - 1, at)
                                    if 0 <= k < len(times)), default=math.inf))
    return worst


def growth(memory: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """
    Return the slope of memory and its standard error, bytes/h, after the warm-up.

    Of the means of blocks, since neighbouring values are not independent.
    """
    if len(memory) < 2 * BLOCKS:
        return math.nan, math.nan
    t, size = np.array(memory).T
    kept = t - t[0] > min(WARM_UP, 0.2 * (t[-1] - t[0]))
    means = [(np.mean(a), np.mean(b)) for a, b in zip(
        np.array_split(t[kept], BLOCKS), np.array_split(size[kept], BLOCKS))]
    fit = stats.linregress(*np.array(means).T)
    return 3600.0 * float(fit.slope), 3600.0 * float(fit.stderr)


def figures(heard: Heard, counters: Mapping[str, int], end: Mapping[str, Any]) -> dict[str, Any]:
    """Return all figures, given counters that are added up, and status and time of the exit."""
    slope, error = growth(heard.memory)
    spent, false = false_of(heard)
    pauses = heard.pauses()
    sizes = [size for _, size in heard.memory]
    return {
        **end, 'deaths': len(heard.deaths),
        'silence': {name: silence(said, pauses) for name, said in (
            ('~/state', heard.states), *heard.outputs.items())},
        'unmatched': unmatched(heard), 'dips': dips_of(heard),
        'unheard': unheard(heard.states),
        'false': len(false), 'false_in': sorted({name for _, name in false}),
        'unknowable': spent, 'memory': sizes[-1] if sizes else math.nan,
        'most_memory': max(sizes, default=math.nan), 'slope': slope, 'slope_error': error,
        **{f'{name}{what}': function([b - a for a, b in spans] or [0.0])
           for name, spans in (('stopped', heard.stops), ('withheld', heard.withheld),
                               ('deaf', heard.deaf))
           for what, function in (('', sum), ('_most', max))}, 'counters': dict(counters)}


def as_table(found: Mapping[str, Any]) -> str:
    """Return the figures as a Markdown table."""
    dips = found['dips']
    return table(['what', 'found'], [
        ['seed, transport, length', f"{found['run']}, {found['minutes']:.1f} min"],
        ['deaths of the node', str(found['deaths'])],
        *([f'longest silence of `{name}` (without the pauses below)',
           f'{gap:.2f} s ({net:.2f} s)'] for name, (gap, net, _) in found['silence'].items()),
        ['longest time from a state that knows the flag to the next `~/brownout`',
         f"{found['unmatched']:.2f} s"],
        ['dips of 40 to 80 ms that the node must see', str(dips['asked'])],
        ['of these CRITICAL by the floor, and `~/brownout` true, within 1 s',
         str(dips['in_time'])],
        ['not told: their messages did not reach the node', str(len(dips['lost']))],
        ['counted by the node (`floor_dips`), the message lost on its way to the listener',
         str(len(dips['unheard']))],
        ['**delivered, and missed**', str(len(dips['missed']))],
        ['from the begin of a dip to both, median, longest',
         f"{dips['median']:.2f} s, {dips['longest']:.2f} s"],
        ['`~/brownout` false while nothing could be known',
         f"{found['false']} times in {found['unknowable']} s"],
        ['resident memory at the end, at most',
         f"{found['memory'] / 1e6:.1f} MB, {found['most_memory'] / 1e6:.1f} MB"],
        ['its slope after the warm-up',
         f"{found['slope'] / 1e6:+.2f} ± {found['slope_error'] / 1e6:.2f} MB/h"],
        ['parameters set, refused as they must be, answered wrongly, not answered',
         f"{found['set']}, {found['refused']}, {found['wrong']}, {found['unanswered']}"],
        ['longest answer of the parameter service', f"{found['answer']:.2f} s"],
        *([words, f"{found[name]:.0f} s, {found[f'{name}_most']:.2f} s"] for name, words in (
            ('stopped', 'pauses: the node stopped by SIGSTOP, in all, longest'),
            ('withheld', 'the node ready, but no CPU for it, by the kernel (above 0.05 s)'),
            ('deaf', 'the listener without CPU (above 0.1 s)'))),
        ['messages of `~/state` that the listener never got, by their numbers',
         str(found['unheard'])],
        *([f'`{name}`', str(value)] for name, value in found['counters'].items()),
        ['exit status after SIGINT, time', f"{found['status']}, {found['took']:.2f} s"]])
