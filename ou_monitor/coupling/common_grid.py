"""
Several series of different rates on one even grid of stamps.

The fastest series sets the grid; slower ones are interpolated by cubic splines, so nothing is
aliased here.  Above a quarter of the slowest rate the spline attenuates by more than 3 %: there
the usable band ends.  Limits: aliases of the original sampling stay, and jittering stamps leave a
phase error of the order of their jitter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.records import FloatArray
from scipy.interpolate import CubicSpline

# Pause, in typical steps, from which it is a gap; gaps are not interpolated.
GAP = 3.0
# Ratio of rates above which the fastest series is averaged onto a slower grid; rate of that grid
# over the slowest rate.
_FASTEST = 8.0
_STEPS = 4.0
# Cubic splines need four points.
_SHORTEST = 4


@dataclass(frozen=True, eq=False)
class Grid:
    """Series on one grid."""

    rate: float  # Of the grid, Hz
    usable: float  # Highest frequency at which all series are unattenuated, Hz
    # Stretches without a gap in any series; each a tuple of the series, shape (n,).
    runs: list[tuple[FloatArray, ...]]
    rates: tuple[float, ...]  # Usual rate of each series, Hz
    # Dropped samples of each series: not finite, or with a repeated stamp.
    lost: tuple[int, ...]
    gaps: int  # Gaps between the stretches
    shared: float  # Time between the latest start and the earliest end of the series, s

    @property
    def duration(self) -> float:
        """Time in the stretches, s."""
        return sum(run[0].size for run in self.runs) / self.rate


def on_grid(series: dict[str, tuple[FloatArray, FloatArray]]) -> Grid:
    """Bring series onto one grid (series in s)."""
    clean: list[tuple[FloatArray, FloatArray]] = []
    lost, rates = [], []
    for name, (t, values) in series.items():
        good = np.isfinite(t) & np.isfinite(values)
        stamps, kept = t[good], values[good]
        order = np.argsort(stamps, kind='stable')
        stamps, kept = stamps[order], kept[order]
        fresh = np.ones(stamps.size, dtype=bool)
        fresh[1:] = np.diff(stamps) > 0.0
        stamps, kept = stamps[fresh], kept[fresh]
        if stamps.size < _SHORTEST:
            raise InputError(f'{name} has {stamps.size} finite samples: at least {_SHORTEST} '
                             'are needed')
        lost.append(int(t.size - stamps.size))
        rates.append(float(1.0 / np.median(np.diff(stamps))))
        clean.append((stamps, kept))
    slowest, fastest = min(rates), max(rates)
    rate = fastest if fastest <= _FASTEST * slowest else _STEPS * slowest
    spans = [_spans(t, 1.0 / r) for (t, _), r in zip(clean, rates)]
    shared = spans[0]
    for other in spans[1:]:
        shared = _shared(shared, other)
    runs, begin = [], min(t[0] for t, _ in clean)
    for start, stop in shared:
        # One grid for all stretches, so that a lag means the same in each.
        first = int(np.ceil((start - begin) * rate - 1e-9))
        last = int(np.floor((stop - begin) * rate + 1e-9))
        if last - first >= _SHORTEST:
            at = begin + np.arange(first, last + 1) / rate
            runs.append(tuple(_at(at, t, x, r, rate) for (t, x), r in zip(clean, rates)))
    if not runs:
        ranges = ', '.join(f'{name} {t[0]:.6g}..{t[-1]:.6g} s'
                           for name, (t, _) in zip(series, clean))
        raise InputError(f'the series have no stretch of time in common: {ranges}')
    span = min(float(t[-1]) for t, _ in clean) - max(float(t[0]) for t, _ in clean)
    return Grid(rate, 0.25 * slowest, runs, tuple(rates), tuple(lost), len(runs) - 1, span)


def _spans(t: FloatArray, step: float) -> list[tuple[float, float]]:
    """Return the stretches without a gap: first and last stamp of each, s."""
    breaks = np.flatnonzero(np.diff(t) > GAP * step)
    starts = np.concatenate(([0], breaks + 1))
    stops = np.concatenate((breaks, [t.size - 1]))
    return [(float(t[a]), float(t[b])) for a, b in zip(starts, stops) if b - a >= _SHORTEST]


def _shared(one: list[tuple[float, float]], other: list[tuple[float, float]],
            ) -> list[tuple[float, float]]:
    """Return the intersection of two ordered lists of stretches."""
    found, i, j = [], 0, 0
    while i < len(one) and j < len(other):
        low, high = max(one[i][0], other[j][0]), min(one[i][1], other[j][1])
        if high > low:
            found.append((low, high))
        if one[i][1] < other[j][1]:
            i += 1
        else:
            j += 1
    return found


def _at(at: FloatArray, t: FloatArray, x: FloatArray, own: float, rate: float) -> FloatArray:
    """Return a series at the stamps of a stretch."""
    inside = slice(max(int(np.searchsorted(t, at[0] - 2.0 / own)) - 1, 0),
                   int(np.searchsorted(t, at[-1] + 2.0 / own)) + 1)
    t, x = t[inside], x[inside]
    if own > 1.5 * rate:
        # Averages over the steps of the grid; a step that jitter left empty
        # takes its neighbours' line.
        place = np.rint((t - at[0]) * rate).astype(np.intp)
        good = (place >= 0) & (place < at.size)
        count = np.bincount(place[good], minlength=at.size)
        total = np.bincount(place[good], x[good], minlength=at.size)
        filled = count > 0
        means: FloatArray = np.interp(at, at[filled], total[filled] / count[filled])
        return means
    if t.size < _SHORTEST:
        line: FloatArray = np.interp(at, t, x)
        return line
    spline: FloatArray = CubicSpline(t, x)(at)
    return spline
