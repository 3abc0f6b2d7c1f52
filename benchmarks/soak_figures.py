"""What a soak found: dips told in time, silence of the outputs, memory."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
from scipy import stats
from soak_schedule import NEVER_FALSE, RATE
from tables import table

Span = tuple[float, float]
# A dip is told in time within so long, s, of its begin.  Not counted, there and in silences: time
# that the node was stopped by us or had no CPU though it was ready, or that the listener had none.
IN_TIME = 1.0
# A dip of fewer low samples that reached the wire is no dip of 40 ms.
SAMPLES = 40
# Memory is looked at after the warm-up, s at most, or a fifth of the time; in so many blocks.
WARM_UP, BLOCKS = 600.0, 20
# How long the node may speak of what came before a phase, s: the longest `stale_after` that is
# set, and a report.
LINGER = 2.3


@dataclass
class Heard:
    """
    All that was heard and noted, times by the monotonic clock, s.

    Attributes
    ----------
    states : list of (time, level of the flag, reason, brownout, messages taken so far)
    outputs : dict of str to list of float
        Times of the messages of each output.
    flags : list of (time, bool)
        Messages of `~/brownout`.
    memory : list of (time, bytes)
    stops, withheld, deaf : list of (begin, end)
        When the node was stopped, when it was ready and had no CPU, and when the listener had
        none.
    deaths : list of float
    source : list of dict
        Lines of the source's log.

    """

    states: list[tuple[float, str, str, str, int]] = field(default_factory=list)
    outputs: dict[str, list[float]] = field(default_factory=dict)
    flags: list[tuple[float, bool]] = field(default_factory=list)
    memory: list[tuple[float, float]] = field(default_factory=list)
    stops: list[Span] = field(default_factory=list)
    withheld: list[Span] = field(default_factory=list)
    deaf: list[Span] = field(default_factory=list)
    deaths: list[float] = field(default_factory=list)
    source: list[dict[str, Any]] = field(default_factory=list)

    def pauses(self) -> list[Span]:
        """Return the time that is not the node's: the union of all of it, in order."""
        made: list[Span] = []
        for begin, end in sorted([*self.stops, *self.withheld, *self.deaf]):
            if made and begin <= made[-1][1]:
                made[-1] = made[-1][0], max(end, made[-1][1])
            else:
                made.append((begin, end))
        return made


def overlap(begin: float, end: float, spans: Sequence[Span]) -> float:
    """Return how much of a time lies in the spans, which are in order, s."""
    first = max(bisect_right(spans, (begin, math.inf)) - 1, 0)
    total = 0.0
    for a, b in spans[first:]:
        if a >= end:
            break
        total += max(0.0, min(b, end) - max(a, begin))
    return total


def silence(times: Sequence[float], stops: Sequence[Span]) -> tuple[float, float]:
    """Return the longest gap, s: as it was, and without the time that the node was stopped."""
    gaps = list(zip(times, times[1:]))
    if not gaps:
        return math.nan, math.nan
    return (max(b - a for a, b in gaps),
            max(b - a - overlap(a, b, stops) for a, b in gaps))


def told(dip: Mapping[str, Any], heard: Heard, pauses: Sequence[Span]
         ) -> tuple[float, float, bool]:
    """
    Return when a dip was told, s from its begin, without pauses, and whether it was lost.

    Told: a state says CRITICAL because of the floor, and `~/brownout` is true; inf where not.
    Lost: of the messages sent from the state before it to that a second after it, so many did not
    come that more than half of the dip's samples may be among them.
    """
    begin = dip['begin']
    first = bisect_right(heard.states, (begin,))
    when = math.inf
    for t, level, reason, _, _ in heard.states[first:]:
        # A later dip must not stand for this one.
        if t - begin - overlap(begin, t, pauses) > IN_TIME:
            break
        if level == 'CRITICAL' and 'brownout.floor (' in reason:
            when = t
            break
    flag = next((t for t, value in heard.flags[bisect_right(heard.flags, (begin,)):] if value),
                math.inf)
    when = max(when, flag)
    net = when - begin - overlap(begin, when, pauses) if when < math.inf else when
    before = heard.states[max(first - 1, 0)]
    after = next((state for state in heard.states[first:] if state[0] > dip['end'] + IN_TIME),
                 before)
    # A fiftieth of a second may wait for the next poll.
    sent = RATE * (after[0] - before[0] - 0.02)
    return when - begin, net, sent - (after[4] - before[4]) > 0.5 * dip['samples']


def dips_of(heard: Heard) -> dict[str, Any]:
    """Return what became of the dips."""
    all_dips = [line for line in heard.source if line['kind'] == 'dip']
    asked = [dip for dip in all_dips if not dip['unseen'] and dip['samples'] >= SAMPLES]
    last = heard.states[-1][0] if heard.states else -math.inf
    asked = [dip for dip in asked if dip['end'] + IN_TIME < last]
    pauses = heard.pauses()
    missed, lost, late = [], [], []
    for dip in asked:
        after, net, gone = told(dip, heard, pauses)
        if net <= IN_TIME:
            late.append(net)
        else:
            (lost if gone else missed).append({**dip, 'told': after, 'net': net})
    return {'sent': len(all_dips), 'asked': len(asked), 'in_time': len(late),
            'lost': lost, 'missed': missed,
            'median': float(np.median(late)) if late else math.nan,
            'longest': max(late, default=math.nan)}


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
        found += [(t, now['name']) for t, value in heard.flags
                  if begin + overlap(now['at'], begin, pauses) < t < end and not value]
    return round(spent), found


def unmatched(heard: Heard) -> float:
    """Return the longest time between a state that knows the flag and a `~/brownout`, s."""
    times = [t for t, _ in heard.flags]
    worst = 0.0
    for t, _, _, brownout, _ in heard.states:
        if brownout != 'unknown':
            at = bisect_right(times, t)
            worst = max(worst, min((abs(t - times[k]) for k in (at - 1, at)
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
        'silence': {name: silence(times, pauses) for name, times in heard.outputs.items()},
        'unmatched': unmatched(heard), 'dips': dips_of(heard),
        'false': len(false), 'false_in': sorted({name for _, name in false}),
        'unknowable': spent, 'memory': sizes[-1] if sizes else math.nan,
        'most_memory': max(sizes, default=math.nan), 'slope': slope, 'slope_error': error,
        **{f'{name}{what}': function([b - a for a, b in spans] or [0.0])
           for name, spans in (('stopped', heard.stops), ('withheld', heard.withheld),
                               ('deaf', heard.deaf))
           for what, function in (('', sum), ('_most', max))}, 'counters': dict(counters)}


def as_table(*runs: Mapping[str, Any]) -> str:
    """Return the figures as a Markdown table, a column for each run."""
    columns = [_column(found) for found in runs]
    return table(['what', *('found' for _ in runs)], [
        [row[0], *(column[k][1] for column in columns)] for k, row in enumerate(columns[0])])


def _column(found: Mapping[str, Any]) -> list[list[str]]:
    """Return words and figures of one run."""
    dips = found['dips']
    return [
        ['seed, transport, length', f"{found['run']}, {found['minutes']:.1f} min"],
        ['deaths of the node', str(found['deaths'])],
        *([f'longest silence of `{name}` (without the pauses below)',
           f'{gap:.2f} s ({net:.2f} s)'] for name, (gap, net) in found['silence'].items()),
        ['longest time from a state that knows the flag to the next `~/brownout`',
         f"{found['unmatched']:.2f} s"],
        ['dips of 40 to 80 ms that the node must see', str(dips['asked'])],
        ['of these CRITICAL by the floor, and `~/brownout` true, within 1 s',
         str(dips['in_time'])],
        ['of these not told, their messages not delivered', str(len(dips['lost']))],
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
        *([f'`{name}`', str(value)] for name, value in found['counters'].items()),
        ['exit status after SIGINT, time', f"{found['status']}, {found['took']:.2f} s"]]
