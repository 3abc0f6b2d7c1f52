"""Detection limits: the strength that is found in half, and in nine tenths, of recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math
from typing import Any

from blind_scores import from_data
from discover_runs import key_of, Results, Task
import numpy as np
from ou_monitor.records import FloatArray
from ou_monitor.report.svg import Plot
from scipy.special import log_expit
from tables import drawing, table

CAUSES = ('load_sag', 'measurement_noise', 'tone', 'second_relaxation', 'load_dependent_sigma',
          'jumps', 'regime_switching', 'load_dependent_alpha')
DURATIONS = (5.0, 15.0, 60.0, 180.0)
WEAKEST, STRONGEST = 1.0 / 8.0, 2.0
SHARES = (0.5, 0.9)
# Recordings after which a point that lies beyond the strengths may be given up.
_FEW, _SURE = 8, 0.99
# What may be: the strength found in half of recordings, and the slope against its
# logarithm, both evenly by their logarithms.
_MIDDLES = np.linspace(math.log(WEAKEST / 4.0), math.log(STRONGEST * 4.0), 161)
_SLOPES = np.geomspace(0.7, 20.0, 41)


@dataclass(frozen=True, eq=False)
class Curve:
    """
    Chance of detection against strength: ``expit(slope * ln(strength / middle))``.

    Attributes
    ----------
    weight : ndarray, shape (161, 41)
        Probability of each middle and slope, given hits and misses.
    runs : int
        Recordings.

    """

    weight: FloatArray
    runs: int

    def limit(self, share: float) -> tuple[float, float, float]:
        """
        Return the strength that is found in this share of recordings.

        Parameters
        ----------
        share : float
            Below 1.

        Returns
        -------
        tuple of float
            Median, and the ends of the central 95 %.

        """
        at = _MIDDLES[:, None] + math.log(share / (1.0 - share)) / _SLOPES[None, :]
        order = np.argsort(at, axis=None)
        below = np.cumsum(self.weight.ravel()[order])
        found = np.exp(np.interp([0.5, 0.025, 0.975], below, at.ravel()[order]))
        return float(found[0]), float(found[1]), float(found[2])

    def chance_above(self, strength: float) -> float:
        """Return the probability that the middle is above a strength."""
        return float(self.weight[math.log(strength) < _MIDDLES].sum())

    @property
    def settled(self) -> bool:
        """Whether the middle surely lies beyond the strengths that are tried."""
        return self.runs >= _FEW and (self.chance_above(STRONGEST) > _SURE
                                      or self.chance_above(WEAKEST) < 1.0 - _SURE)


def fit(strengths: Sequence[float], hits: Sequence[bool]) -> Curve:
    """
    Fit the logistic curve.

    Few hits and misses do not fix both of its numbers: all that they allow is
    kept, from flat beliefs about the logarithms of both.

    Parameters
    ----------
    strengths : sequence of float
        Of the recordings.
    hits : sequence of bool
        Whether the cause was reported.

    Returns
    -------
    Curve

    """
    logs = np.zeros((_MIDDLES.size, _SLOPES.size))
    for strength, hit in zip(strengths, hits):
        x = _SLOPES[None, :] * (math.log(strength) - _MIDDLES[:, None])
        logs += log_expit(x if hit else -x)
    weight = np.exp(logs - logs.max())
    return Curve(weight / weight.sum(), len(hits))


@dataclass(frozen=True)
class Point:
    """
    One cause at one duration.

    Attributes
    ----------
    cause : str
        Name.
    duration, rate : float
        s and Hz.
    seed : int
        Of the run.

    """

    cause: str
    duration: float
    rate: float
    seed: int

    def task(self, number: int, strength: float) -> Task:
        """Return a recording of it."""
        return Task('single', self.cause, self.seed, number, self.duration, self.rate, strength)

    def lines(self, results: Results) -> list[dict[str, Any]]:
        """Return the results of it, in the order of their numbers."""
        want = self.task(0, 0.0).key
        mine = [line for line in results.by_key.values() if _apart(key_of(line)) == _apart(want)]
        return sorted(mine, key=lambda line: line['task']['number'])


def _apart(key: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return a key without number and strength."""
    return (*key[:3], *key[4:6])


def curve_of(lines: Sequence[dict[str, Any]]) -> Curve:
    """Return the curve of results."""
    return fit([line['task']['strength'] for line in lines],
               [from_data(line).covered for line in lines])


class Search:
    """
    Choice of what to run next: where the curves would learn most.

    Parameters
    ----------
    points : sequence of Point
        What is asked for.
    runs : int
        Recordings of each at most.
    results : Results
        What there is; grows while this is used.

    """

    def __init__(self, points: Sequence[Point], runs: int, results: Results) -> None:
        self._points, self._runs, self._results = points, runs, results

    def next_task(self, under_way: Sequence[Task]) -> Task | None:
        """Return a recording of the point with the fewest; None when there is none now."""
        busy = {(task.effect, task.duration) for task in under_way}
        free = [(len(lines), k, point, lines) for k, (point, lines) in enumerate(self.state())
                if (point.cause, point.duration) not in busy and len(lines) < self._runs]
        for count, _, point, lines in sorted(free, key=lambda item: item[:2]):
            curve = curve_of(lines)
            if not curve.settled:
                return point.task(count, _strength(curve, count))
        return None

    def state(self) -> Iterator[tuple[Point, list[dict[str, Any]]]]:
        """Yield all points with their results."""
        for point in self._points:
            yield point, point.lines(self._results)


def _strength(curve: Curve, count: int) -> float:
    """Return the strength to try next: in turn where a half, and where more, is found."""
    # Either side of the middle for the slope; at the limits themselves for them.
    share = (0.5, 0.9, 0.3, 0.8)[count % 4]
    wanted = curve.limit(share)[0] if count else 0.5
    return round(min(max(wanted, WEAKEST), STRONGEST), 3)


def limits_table(search: Search) -> str:
    """Return the limits as Markdown."""
    rows = []
    for point, lines in search.state():
        if lines:
            curve = curve_of(lines)
            rows.append([point.cause, f'{point.duration:g}', str(len(lines)),
                         *(_words(curve.limit(share)) for share in SHARES)])
    return table(['cause', 'duration s', 'recordings', *(
        f'strength found in {100 * share:.0f} %' for share in SHARES)], rows)


def _words(limit: tuple[float, float, float]) -> str:
    middle, low, high = limit
    if middle > STRONGEST:
        return f'above {STRONGEST:g}'
    if middle < WEAKEST:
        return f'below {WEAKEST:g}'
    return f'{middle:.2g} ({low:.2g}..{high:.2g})'


def figure(search: Search, title: str) -> str:
    """
    Return the figure: strength against duration, a plot for each cause.

    Parameters
    ----------
    search : Search
        Points and results.
    title : str
        Stands above it.

    Returns
    -------
    str
        An SVG document.

    """
    by_cause: dict[str, list[tuple[float, Curve]]] = {}
    for point, lines in search.state():
        if lines:
            by_cause.setdefault(point.cause, []).append((point.duration, curve_of(lines)))
    durations = [duration for found in by_cause.values() for duration, _ in found] or [1.0]
    ends = (min(durations) / 1.2, 1.2 * max(durations))
    wide, high, top = 430, 250, 48
    parts = [f'<text class="title" x="12" y="20">{title}</text>',
             f'<text x="12" y="38">Bars: 95 %. Limits outside of {WEAKEST:g} to {STRONGEST:g} are '
             'not drawn.</text>']
    for k, (cause, found) in enumerate(by_cause.items()):
        plot = Plot(cause, 'duration, s', 'strength', width=wide, height=high, log_x=True,
                    log_y=True).limits(ends, (WEAKEST, STRONGEST))
        found.sort(key=lambda item: item[0])
        x = np.array([duration for duration, _ in found])
        for colour, share in enumerate(SHARES):
            at = np.array([curve.limit(share) for _, curve in found])
            outside = (at[:, 0] > STRONGEST) | (at[:, 0] < WEAKEST)
            at[outside] = np.nan
            apart = x * (1.02 if colour else 0.98)
            for place, (middle, low, top_end) in zip(apart, at):
                plot.line(np.full(2, place), np.array([low, top_end]), '', colour)
                # Seen also where neither neighbour has a limit.
                plot.line(place * np.array([0.97, 1.03]), np.full(2, middle), '', colour, 'thick')
            plot.line(apart, at[:, 0], f'found in {100 * share:.0f} %', colour,
                      'dash' if colour else 'thick')
        place = f'<svg x="{wide * (k % 2)}" y="{top + high * (k // 2)}" width="{wide}" ' \
            f'height="{high}" '
        parts.append(plot.svg().replace('<svg ', place, 1))
    return drawing(parts, 2 * wide, top + high * ((len(by_cause) + 1) // 2), title)
