"""
Load levels: segments of a recording at constant throttle.

A segment starts when throttle comes within the half width of a level, and lasts until throttle is
there for the last time before it leaves by two half widths (less if the next level is near), so
that stick jitter does not split the segment.  The half width is `HALF_WIDTH`, or more if the
stick jitters more.  A ramp that passes a level is not a segment.  Limits: throttle is a command,
not a current, so two segments at one throttle can have different loads, and a segment need not be
stationary; levels closer than the jitter are merged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray, NAN
from ou_monitor.timeline import GAP_STEPS

BoolArray = npt.NDArray[np.bool_]

# Minimum half width of a level: the levels of the paper are 5 % apart, and a careful stick or a
# hover controller jitters within 2 %.
HALF_WIDTH = 0.02
# With more jitter: half width in standard deviations of the jitter, and its maximum.
_SPREADS, _WIDEST = 2.5, 0.03
# Length of blocks in which the jitter is measured, s, and the quantile of blocks that is used:
# sticks often do not move at idle and jitter only in flight.
_LOOK, _QUIETER = 1.0, 0.75
# Time left out after a change of throttle by more than two half widths, s: six relaxation times of
# the paper's rail (15.9 ms), after which 0.2 % of a step is left.
SETTLE = 0.1
# A level needs this share of the recording, or one segment of this length, s: a few seconds at
# full throttle matter.
MIN_SHARE, LONG_STAY = 0.02, 2.0
# Minimum time at a throttle to consider it, s.
MIN_TIME = 0.25
# Minimum length of the longest segment of a level, s: thirty relaxation times of the paper's rail.
MIN_STAY = 0.5
MAX_LEVELS = 20  # Maximum number of levels
# A passage through a level: maximum duration, s; minimum difference between the means of the first
# and last quarter, as a share of the passage's range (0.75 for a ramp) and of the half width.
_PASSAGE, _STEADY, _CROSSED = 3.0, 0.65, 0.75

# Bin width of the histogram of throttle.
_GRID = 0.0025
# Two peaks are separate levels if, between them, the histogram falls below this share of the lower
# peak.
_VALLEY = 0.7


@dataclass(frozen=True)
class LoadLevel:
    """A throttle, and the segments of the recording in which it was held."""

    throttle: float  # Throttle of the level, 0..1; NaN if it is the whole recording
    segments: tuple[slice, ...]  # Segments at this throttle, without settling
    settling: float = 0.0  # Time left out after changes of throttle, s


def find_levels(t: FloatArray, throttle: FloatArray,
                given: tuple[float, ...] | None = None) -> tuple[LoadLevel, ...]:
    """Split a recording into load levels (t in s)."""
    if not t.size:
        return ()
    width = half_width(t, throttle)
    if given is not None:
        return _split(t, throttle, _checked(given), width, True)
    whole = (LoadLevel(NAN, tuple(_split_at_pauses(slice(0, t.size), _gaps(t)))),)
    centres = _modes(t, throttle, width)
    while centres:
        found = _split(t, throttle, centres, width, False)
        held = [_is_long_enough(t, level) for level in found]
        if all(held):
            return _longest_held(t, found)
        if not any(held):
            # All segments are short: accept the levels if they cover half of the recording.
            enough = 0.5 * float(t[-1] - t[0]) <= sum(_time_at(t, level) for level in found)
            return _longest_held(t, found) if enough else whole
        # Segments of a rejected level may belong to its neighbours.
        centres = [centre for centre, kept in zip(centres, held) if kept]
    return whole


def half_width(t: FloatArray, throttle: FloatArray) -> float:
    """Return the half width of levels."""
    known = throttle[np.isfinite(throttle)]
    step = float(np.median(np.diff(t))) if t.size > 1 else 0.0
    size = max(8, round(_LOOK / step)) if step > 0.0 else known.size + 1
    blocks = known[:known.size // size * size].reshape(-1, size)
    if not blocks.size:
        return HALF_WIDTH
    away = np.abs(blocks - np.median(blocks, axis=1, keepdims=True))
    jitter = float(np.quantile(np.median(away, axis=1), _QUIETER)) / 0.6745
    return max(HALF_WIDTH, min(_WIDEST, _SPREADS * jitter))


def _time_at(t: FloatArray, level: LoadLevel) -> float:
    return sum(float(t[s.stop - 1] - t[s.start]) for s in level.segments)


def _is_long_enough(t: FloatArray, level: LoadLevel) -> bool:
    """Return whether a level has a long segment, or a shorter one and enough time in all."""
    whole = float(t[-1] - t[0])
    longest = max((float(t[s.stop - 1] - t[s.start]) for s in level.segments), default=0.0)
    # In short recordings, a quarter of the recording replaces `MIN_STAY`.
    return longest >= min(MIN_STAY, 0.25 * whole) and (
        longest >= LONG_STAY or _time_at(t, level) >= MIN_SHARE * whole)


def _longest_held(t: FloatArray, found: tuple[LoadLevel, ...]) -> tuple[LoadLevel, ...]:
    """Return at most `MAX_LEVELS` levels, those with most time, in their order."""
    least = sorted((_time_at(t, level) for level in found), reverse=True)[:MAX_LEVELS][-1]
    return tuple(level for level in found if _time_at(t, level) >= least)[:MAX_LEVELS]


def _split(t: FloatArray, throttle: FloatArray, centres: list[float], width: float,
           named: bool) -> tuple[LoadLevel, ...]:
    """Return levels with their segments; levels given by the user (`named`) keep passages."""
    broken = _gaps(t)
    runs: list[list[slice]] = [[] for _ in centres]
    for run, k in level_segments(throttle, centres, width):
        runs[k] += _split_at_pauses(run, broken)
    found = []
    for centre, inner, mine in zip(centres, _half_widths(centres, width), runs):
        if not named:
            mine = [run for run in mine if not _passage(t, throttle, run, inner)]
        away = ~(np.abs(throttle - centre) <= 2.0 * width)
        kept, lost = _drop_settling(t, mine, away, broken)
        mean = centre
        if not named and kept:
            mean = float(np.median(np.concatenate([throttle[s] for s in kept])))
        found.append(LoadLevel(mean, kept, lost))
    return tuple(found)


def _checked(given: tuple[float, ...]) -> list[float]:
    levels = sorted(float(value) for value in given)
    for value in levels:
        if not 0.0 <= value <= 1.0:
            raise ValueError(f'a load level is a throttle between 0 and 1, got {value:g}')
    for low, high in zip(levels, levels[1:]):
        if high - low < 1e-6:
            raise ValueError(f'load level {low:g} is given twice')
    return levels


def _gaps(t: FloatArray) -> BoolArray:
    """Return which samples follow a pause; shape (n,)."""
    steps = np.diff(t)
    if not steps.size:
        return np.zeros(t.size, dtype=np.bool_)
    return np.concatenate(([False], steps > GAP_STEPS * np.median(steps)))


def _modes(t: FloatArray, throttle: FloatArray, width: float) -> list[float]:
    """Return the modes of throttle, weighted by time, in increasing order."""
    known = np.isfinite(throttle)
    if not known.any():
        return []
    steps = np.diff(t, append=t[-1])
    steps = np.minimum(steps, GAP_STEPS * max(float(np.median(steps)), 1e-9))
    value, spent = throttle[known], steps[known]
    low = float(value.min()) - width
    bins = int(math.ceil((float(value.max()) + width - low) / _GRID)) + 1
    where = np.minimum(np.rint((value - low) / _GRID).astype(np.intp), bins - 1)
    time_at = np.bincount(where, weights=spent, minlength=bins)
    reach = int(round(width / _GRID))
    fine = np.convolve(time_at, _triangle(reach // 2), mode='same')
    # In recordings of less than a second, a quarter of the recording replaces `MIN_TIME`.
    least = min(MIN_TIME, 0.25 * float(spent.sum()))
    found: list[int] = []
    while True:
        peak = int(np.convolve(time_at, _triangle(reach), mode='same').argmax())
        left, right = max(0, peak - reach), peak + reach + 1
        held = float(time_at[left:right].sum())
        if held < least or not held > 0.0:
            return [low + _GRID * k for k in sorted(found)]
        if all(_are_separate(fine, peak, other, reach) for other in found):
            found.append(peak)
        time_at[left:right] = 0.0


def _triangle(reach: int) -> FloatArray:
    """Return triangular weights; a box would give a false mode midway between two levels."""
    return 1.0 - np.abs(np.arange(-reach, reach + 1)) / (reach + 1.0)


def _are_separate(density: FloatArray, peak: int, other: int, reach: int) -> bool:
    """Return whether a second peak is a separate level, not a shoulder of the other."""
    if abs(peak - other) > 2 * reach:
        return True
    between = density[min(peak, other):max(peak, other) + 1]
    return abs(peak - other) > reach and bool(
        between.min() < _VALLEY * min(density[peak], density[other]))


def level_segments(throttle: FloatArray, centres: Sequence[float], width: float
                   ) -> list[tuple[slice, int]]:
    """Return the segments of constant throttle, each with the index of its level."""
    if not centres:
        return []
    level = np.asarray(centres)
    nearest = _distance_to_nearest(centres)
    inner = _half_widths(centres, width)
    # Keep the outer limit short of the next level.
    outer = np.maximum(inner, np.minimum(2.0 * width, 0.8 * nearest))
    edges = np.unique(np.concatenate((level - outer, level - inner, level + inner,
                                      level + outer)))
    zone = np.searchsorted(edges, throttle)
    middles = np.concatenate(([-math.inf], 0.5 * (edges[1:] + edges[:-1]), [math.inf]))
    away = np.abs(middles[:, None] - level)
    at = np.where((away <= inner).any(axis=1), away.argmin(axis=1), -1).tolist()
    near = (away <= outer).tolist()
    starts = np.flatnonzero(np.diff(zone, prepend=-1))
    found: list[tuple[slice, int]] = []
    here, begin, last = -1, 0, 0
    for start, stop, where in zip(starts.tolist(), [*starts[1:].tolist(), throttle.size],
                                  zone[starts].tolist()):
        if here >= 0 and not near[where][here]:
            found.append((slice(begin, last), here))
            here = -1
        if here < 0 and at[where] >= 0:
            here, begin = at[where], start
        if here >= 0 and at[where] == here:
            last = stop
    if here >= 0:
        found.append((slice(begin, last), here))
    return found


def _distance_to_nearest(centres: Sequence[float]) -> FloatArray:
    """Return the distance to the nearest other level, for each level."""
    apart = np.diff(np.asarray(centres), prepend=-math.inf, append=math.inf)
    return np.minimum(apart[:-1], apart[1:])


def _half_widths(centres: Sequence[float], width: float) -> FloatArray:
    """Return the half width of each level, reduced if another is near."""
    return np.minimum(width, 0.5 * _distance_to_nearest(centres)) + 1e-9


def _split_at_pauses(run: slice, broken: BoolArray) -> list[slice]:
    cuts = run.start + 1 + np.flatnonzero(broken[run.start + 1:run.stop])
    ends = [run.start, *cuts.tolist(), run.stop]
    return [slice(a, b) for a, b in zip(ends, ends[1:])]


def _passage(t: FloatArray, throttle: FloatArray, run: slice, width: float) -> bool:
    if t[run.stop - 1] - t[run.start] >= _PASSAGE:
        return False
    inside = throttle[run]
    quarter = max(1, inside.size // 4)
    moved = abs(float(inside[-quarter:].mean()) - float(inside[:quarter].mean()))
    return moved > max(_CROSSED * width, _STEADY * float(np.ptp(inside)))


def _drop_settling(t: FloatArray, runs: Sequence[slice], away: BoolArray,
                   broken: BoolArray) -> tuple[tuple[slice, ...], float]:
    """Leave out the settling time after changes of throttle larger than jitter."""
    kept, lost = [], 0.0
    for run in runs:
        start = run.start
        if start > 0 and not broken[start]:
            first = int(np.searchsorted(t, t[start] - SETTLE))
            far = np.flatnonzero(away[first:start])
            if far.size:
                start = int(np.searchsorted(t, t[first + far[-1]] + SETTLE))
        start = min(max(start, run.start), run.stop)
        lost += float(t[min(start, run.stop - 1)] - t[run.start])
        if start < run.stop - 1:
            kept.append(slice(start, run.stop))
    return tuple(kept), lost
