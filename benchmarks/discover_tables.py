"""What a blind run amounts to: levels beside those required, tables, a heat map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from blind_scores import confusion, from_data, Outcome
from discover_runs import TIME_LIMIT
from hidden_effects import labels
import numpy as np
from scipy.stats import binomtest
from tables import drawing, number, table

# Seconds that a recording may take, and MB.
SECONDS, MEMORY = 15.0, 1000.0
# Kind, what is counted, required share (negative: at most), and which recordings count.
_LEVELS: tuple[tuple[str, str, float, Callable[[Outcome], bool]], ...] = (
    ('single', 'named right, alone', 0.90, lambda o: o.alone),
    ('single', 'named right or in the reported set', 0.95, lambda o: o.in_set),
    ('none', 'false alarms', -0.05, lambda o: o.alarm),
    ('pair', 'both named', 0.80, lambda o: o.all_named),
    ('pair', 'both named and nothing else', 0.0, lambda o: o.alone),
    ('pair', 'both in the reported set, nothing false', 0.0, lambda o: o.in_set),
    ('variant', 'family right', 0.90, lambda o: o.family),
    ('variant', 'name right or in the reported set', 0.80, lambda o: o.in_set),
    ('variant', 'named right, alone', 0.0, lambda o: o.alone),
    ('unknown', 'unexplained or partly explained', 0.90, lambda o: o.left_open),
    ('unknown', 'the same, and no name that is wrong', 0.90,
     lambda o: o.left_open and not o.misnamed),
)


@dataclass(frozen=True)
class Level:
    """
    A share of recordings beside the one required.

    Attributes
    ----------
    kind, what : str
        Kind of recordings, and what is counted.
    required : float
        Share at least; negative: at most minus that; 0: not required.
    hits, of : int
        Recordings.

    """

    kind: str
    what: str
    required: float
    hits: int
    of: int

    @property
    def share(self) -> float:
        """Return the share measured."""
        return self.hits / self.of

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of Wilson (1927)."""
        found = binomtest(self.hits, self.of).proportion_ci(0.95, method='wilson')
        return float(found.low), float(found.high)

    @property
    def met(self) -> str:
        """Return whether the share reaches what is required, in a word."""
        if self.required == 0.0:
            return ''
        good = self.share <= -self.required if self.required < 0.0 else \
            self.share >= self.required
        return 'yes' if good else 'no'


def levels(lines: Sequence[dict[str, Any]]) -> list[Level]:
    """Return all shares of which there are recordings."""
    outcomes = [from_data(line) for line in lines]
    found = []
    for kind, what, required, counts in _LEVELS:
        hits = [counts(one) for one in outcomes if one.kind == kind]
        if hits:
            found.append(Level(kind, what, required, sum(hits), len(hits)))
    return found


def report(lines: Sequence[dict[str, Any]], setting: str) -> str:
    """
    Return all tables as Markdown.

    Parameters
    ----------
    lines : sequence of dict
        Results, as `discover_runs.examine` gives them.
    setting : str
        Seed, date and what else the numbers depend on; one line.

    Returns
    -------
    str

    """
    outcomes = [from_data(line) for line in lines]
    parts = [f'{setting}\n', '### Levels\n', _levels(levels(lines)),
             '### Time and memory of one recording\n', _cost(lines),
             '### Effect by effect\n', _effects(outcomes)]
    for kinds, title in ((('single', 'none', 'unknown'), 'One effect, none, and one outside'),
                         (('variant',), 'The same causes in other shapes')):
        part = [one for one in outcomes if one.kind in kinds]
        if part:
            parts += [f'### Confusion: {title}\n', _matrix(part)]
    return '\n'.join(parts)


def _levels(found: Sequence[Level]) -> str:
    rows = []
    for one in found:
        low, high = one.interval
        required = '' if one.required == 0.0 else (
            f'{100 * abs(one.required):.0f} % at ' + ('least' if one.required > 0.0 else 'most'))
        rows.append([f'{one.kind}: {one.what}', required, f'{100 * one.share:.1f} %',
                     f'{100 * low:.1f}..{100 * high:.1f} %', f'{one.hits}/{one.of}', one.met])
    return table(['', 'required', 'measured', '95 % interval', 'recordings', 'met'], rows)


def _cost(lines: Sequence[dict[str, Any]]) -> str:
    rows = []
    for kind in ('single', 'variant', 'pair', 'none', 'unknown', 'all'):
        part = [line for line in lines if kind in (line['kind'], 'all')]
        if not part:
            continue
        done = [line for line in part if line['seconds'] is not None]
        late = sum(line['failure'] == TIME_LIMIT for line in part)
        cells = ['-'] * 5
        if done:
            # A recording that was stopped took longer than all that were not.
            wall = np.array([*(line['seconds'] for line in done), *[np.inf] * late])
            cpu = [line['cpu_s'] for line in done]
            cells = [*(number(float(q), '.1f') for q in (
                *np.quantile(wall, [0.5, 0.9], method='higher'), wall.max())),
                number(float(np.median(cpu)), '.1f'),
                f"{max(line['memory_mb'] for line in done):.0f}"]
        slow = late + sum(line['seconds'] > SECONDS for line in done)
        rows.append([kind, str(len(part)), *cells[:4], str(slow), cells[4], str(late),
                     str(len(part) - len(done) - late)])
    return table(['kind', 'recordings', 'median s', '90 % s', 'max s', 'median CPU s',
                  f'over {SECONDS:g} s', 'max MB', 'stopped', 'failed'], rows) + (
        f'\nRequired: {SECONDS:g} s on two cores, {MEMORY:g} MB. A dash for a time is one of a '
        'recording that was stopped.\n')


def _effects(outcomes: Sequence[Outcome]) -> str:
    groups: dict[tuple[str, str], list[Outcome]] = {}
    for one in outcomes:
        effect = one.kind if one.kind in ('none', 'pair') else one.effect
        groups.setdefault((one.kind, effect), []).append(one)
    order = ('single', 'variant', 'pair', 'none', 'unknown')
    rows = []
    for (kind, effect), part in sorted(groups.items(), key=lambda item: (
            order.index(item[0][0]), item[0][1])):
        right = (lambda o: not o.alarm) if kind == 'none' else (
            lambda o: o.left_open and not o.misnamed) if kind == 'unknown' else (
            lambda o: o.in_set)
        wrong = Counter(_said(one) for one in part if not right(one))
        rows.append([
            effect if kind == 'single' else f'*{kind}*' if effect == kind else f'*{effect}*',
            str(len(part)), *([str(sum(o.alone for o in part)), str(sum(o.in_set for o in part)),
                               str(sum(o.family for o in part))]
                              if kind not in ('none', 'unknown') else ['', '', '']),
            str(sum(map(right, part))),
            '; '.join(f'{text} {count}' if count > 1 else text
                      for text, count in wrong.most_common(6))])
    return table(['effect', 'recordings', 'alone', 'in the set', 'family', 'right',
                  'what was said of the others'], rows)


def _said(one: Outcome) -> str:
    """Return what was reported, in few words."""
    if not one.verdict:
        return 'failed'
    names = ' + '.join(sorted(one.named)) or 'nothing'
    return names + ('' if one.verdict == 'explained' or not one.named else ' (partly)')


def _rows(outcomes: Sequence[Outcome]) -> tuple[list[str], list[str], dict[str, dict[str, int]]]:
    """Return truths and names in the order of the catalogue, and the counts."""
    counts = confusion(outcomes)
    order = [*labels, 'none', 'unknown']
    truths = sorted(counts, key=order.index)
    return truths, [*labels, 'nothing', 'failed'], counts


def _matrix(outcomes: Sequence[Outcome]) -> str:
    truths, names, counts = _rows(outcomes)
    names = [name for name in names if any(name in row for row in counts.values())]
    rows = [[f'{truth} ({counts[truth]["of"]})',
             *(_cell(counts[truth].get(name, 0), truth == name) for name in names)]
            for truth in truths]
    return table(['hidden (recordings) \\ named', *(
        name.replace('_', ' ') for name in names)], rows) + (
        '\nA recording with several names is counted under each.\n')


def _cell(count: int, diagonal: bool) -> str:
    return '' if not count else f'**{count}**' if diagonal else str(count)


def heat_map(lines: Sequence[dict[str, Any]], title: str) -> str:
    """
    Return the confusion matrix as a drawing.

    Parameters
    ----------
    lines : sequence of dict
        Results; those of pairs are left out.
    title : str
        Stands above it.

    Returns
    -------
    str
        An SVG document.

    """
    truths, names, counts = _rows([from_data(line) for line in lines if line['kind'] != 'pair'])
    side, left, top = 30, 170, 190
    width, height = left + side * len(names) + 20, top + side * len(truths) + 20
    parts = [f'<text class="title" x="12" y="20">{escape(title)}</text>',
             '<text x="12" y="40">hidden (rows) and named (columns): recordings, shaded by their '
             'share of the row</text>']
    for column, name in enumerate(names):
        x = left + side * (column + 0.5) + 4
        parts.append(f'<text transform="translate({x:.0f} {top - 6}) rotate(-60)">'
                     f'{escape(name)}</text>')
    for line, truth in enumerate(truths):
        y, of = top + side * line, counts[truth]['of']
        parts.append(f'<text text-anchor="end" x="{left - 8}" y="{y + 19}">{truth} '
                     f'({of})</text>')
        for column, name in enumerate(names):
            x, share = left + side * column, counts[truth].get(name, 0) / of
            if share:
                style = ' class="light"' if share > 0.5 else ''
                parts.append(
                    f'<rect x="{x + 1}" y="{y + 1}" width="{side - 2}" height="{side - 2}" '
                    f'fill="#0072b2" fill-opacity="{min(share, 1.0):.2f}"/><text{style} '
                    f'text-anchor="middle" x="{x + side // 2}" y="{y + 19}">'
                    f'{counts[truth][name]}</text>')
            else:
                parts.append(f'<rect x="{x + 1}" y="{y + 1}" width="{side - 2}" '
                             f'height="{side - 2}" fill="#f5f7f8"/>')
            if truth == name or (truth, name) == ('none', 'nothing'):
                parts.append(f'<rect class="right" x="{x + 1}" y="{y + 1}" width="{side - 2}" '
                             f'height="{side - 2}"/>')
    return drawing(parts, width, height, title)
