"""What a soak found: silence of the outputs, false flags, memory, and the table of it all."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
import math
from typing import Any

import numpy as np
from scipy import stats
from soak_dips import dips_of, Heard, overlap, Said, Span, State, unheard
from soak_schedule import NEVER_FALSE
from tables import table

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
        ['exit status after SIGINT, time', f"{found['status']}, {found['took']:.2f} s"]]
