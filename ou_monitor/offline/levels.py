"""
Load levels: which stretches of a recording were flown at which throttle.

A level is a throttle at which much time was spent; its segments are the
unbroken stretches within `HALF_WIDTH` of it.  Limits: throttle is a command,
not a current, so two stretches at one throttle can carry different loads; and
a stretch is only as stationary as its throttle says.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from ou_monitor.records import FloatArray, NAN

BoolArray = npt.NDArray[np.bool_]

# The paper's levels lie 5 % apart; +-2 % keeps neighbours apart and still
# holds the jitter of a stick or of a hover controller.
HALF_WIDTH = 0.02
# Left out after throttle came from more than two half widths away: six
# relaxation times of the paper's rail (tau = 15.9 ms), when 0.2 % of the step
# is left.
SETTLE = 0.1
# A level needs this share of the recording (and this many seconds) to be
# found without being asked for.
MIN_SHARE = 0.02
MIN_TIME = 0.25
# And one stretch that can be fitted by itself, s: thirty relaxation times of the
# paper's rail.  A ramp that lingers here and there is no level where others are.
MIN_STRETCH = 0.5
MAX_LEVELS = 10
# A pause of more than this many median steps breaks a segment.
GAP_STEPS = 20.0

_GRID = 0.0025


@dataclass(frozen=True)
class Segment:
    """A stretch of samples: indices ``start <= k < stop`` of the recording."""

    start: int
    stop: int


@dataclass(frozen=True)
class LoadLevel:
    """
    One throttle and where in the recording it was held.

    Attributes
    ----------
    throttle : float
        Throttle of the level, 0..1; NaN for a level that holds everything.
    segments : tuple of Segment
        Stretches at this throttle, settling left out.
    settling : float
        Time left out after changes of throttle, s.

    """

    throttle: float
    segments: tuple[Segment, ...]
    settling: float = 0.0


def find_levels(t: FloatArray, throttle: FloatArray,
                given: tuple[float, ...] | None = None) -> tuple[LoadLevel, ...]:
    """
    Split a recording into load levels.

    Parameters
    ----------
    t : ndarray, shape (n,)
        Stamps, s, strictly increasing.
    throttle : ndarray, shape (n,)
        Throttle 0..1, NaN where unknown.
    given : tuple of float, optional
        Levels to use; found from the throttle when left out.

    Returns
    -------
    tuple of LoadLevel
        In order of throttle; a throttle that was only passed through, with no
        stretch of `MIN_STRETCH`, is none where others have one.  Without
        throttle, or when none was held for long, one level, NaN, that holds the
        whole recording.  A given level that was never flown has no segments.

    Raises
    ------
    ValueError
        When a given level is outside 0..1 or given twice.

    """
    if not t.size:
        return ()
    broken = _gaps(t)
    centres = _checked(given) if given is not None else _modes(t, throttle)
    while centres:
        found = _split(t, throttle, centres, broken, given is not None)
        held = [given is not None or _longest(t, level) >= _least(t) for level in found]
        if all(held) or not any(held):
            # Where every stay is short, short stays are all there is to tell from.
            return found
        # What was taken for a level may be its neighbours'.
        centres = [centre for centre, kept in zip(centres, held) if kept]
    return (LoadLevel(NAN, _runs(np.ones(t.size, dtype=np.bool_), broken)),)


def _least(t: FloatArray) -> float:
    """Return the stretch that a level needs, s; a short recording may be all one level."""
    return min(MIN_STRETCH, 0.25 * float(t[-1] - t[0]))


def _longest(t: FloatArray, level: LoadLevel) -> float:
    """Return the longest stretch of a level, s; settling left out."""
    return max((float(t[s.stop - 1] - t[s.start]) for s in level.segments), default=0.0)


def _split(t: FloatArray, throttle: FloatArray, centres: list[float], broken: BoolArray,
           named: bool) -> tuple[LoadLevel, ...]:
    """Give each sample near a centre to the nearest one."""
    nearest = np.abs(throttle[:, None] - np.asarray(centres)[None, :])
    nearest[~np.isfinite(nearest)] = math.inf
    owner = nearest.argmin(axis=1)
    reach = HALF_WIDTH
    if len(centres) > 1:
        reach = min(reach, 0.5 * float(np.diff(centres).min()))
    inside = nearest.min(axis=1) <= reach + 1e-9
    found = []
    for k, centre in enumerate(centres):
        runs = _runs(inside & (owner == k), broken)
        away = ~(np.abs(throttle - centre) <= 2.0 * HALF_WIDTH)
        kept, lost = _settle(t, runs, away, broken)
        mean = centre
        if not named and kept:
            mean = float(np.median(np.concatenate([throttle[s.start:s.stop] for s in kept])))
        found.append(LoadLevel(mean, kept, lost))
    return tuple(found)


def runs_at(t: FloatArray, throttle: FloatArray, centre: float) -> tuple[Segment, ...]:
    """
    Return the unbroken stretches within `HALF_WIDTH` of a throttle, settling included.

    Parameters
    ----------
    t, throttle : ndarray, shape (n,)
        Stamps, s, and throttle 0..1.
    centre : float
        Throttle of the level.

    Returns
    -------
    tuple of Segment
        In order of time.

    """
    return _runs(np.abs(throttle - centre) <= HALF_WIDTH + 1e-9, _gaps(t))


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
    """Return where a pause lies before the sample; shape (n,)."""
    steps = np.diff(t)
    if not steps.size:
        return np.zeros(t.size, dtype=np.bool_)
    return np.concatenate(([False], steps > GAP_STEPS * np.median(steps)))


def _modes(t: FloatArray, throttle: FloatArray) -> list[float]:
    """Return the throttles at which most time was spent, increasing."""
    known = np.isfinite(throttle)
    if not known.any():
        return []
    steps = np.diff(t, append=t[-1])
    steps = np.minimum(steps, GAP_STEPS * max(float(np.median(steps)), 1e-9))
    value, spent = throttle[known], steps[known]
    low = float(value.min()) - HALF_WIDTH
    bins = int(math.ceil((float(value.max()) + HALF_WIDTH - low) / _GRID)) + 1
    where = np.minimum(np.rint((value - low) / _GRID).astype(np.intp), bins - 1)
    time_at = np.bincount(where, weights=spent, minlength=bins)
    # A triangle, not a box: a box midway between two levels would hold both.
    reach = int(round(HALF_WIDTH / _GRID))
    kernel = 1.0 - np.abs(np.arange(-reach, reach + 1)) / (reach + 1.0)
    # A recording of less than a second may be all one level.
    total = float(spent.sum())
    least = max(min(MIN_TIME, 0.25 * total), MIN_SHARE * total)
    found: list[float] = []
    while len(found) < MAX_LEVELS:
        peak = int(np.convolve(time_at, kernel, mode='same').argmax())
        left, right = max(0, peak - reach), peak + reach + 1
        held = float(time_at[left:right].sum())
        if held < least or not held > 0.0:
            break
        centre = low + peak * _GRID
        if all(abs(centre - other) > HALF_WIDTH for other in found):
            found.append(centre)
        time_at[left:right] = 0.0
    return sorted(found)


def _runs(inside: BoolArray, broken: BoolArray) -> tuple[Segment, ...]:
    """Return unbroken stretches of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], inside.astype(np.int8), [0]))))
    runs: list[Segment] = []
    for start, stop in zip(edges[::2], edges[1::2]):
        cuts = start + np.flatnonzero(broken[start:stop])
        ends = [int(start), *(int(c) for c in cuts if c > start), int(stop)]
        runs.extend(Segment(a, b) for a, b in zip(ends, ends[1:]))
    return tuple(runs)


def _settle(t: FloatArray, runs: tuple[Segment, ...], away: BoolArray,
            broken: BoolArray) -> tuple[tuple[Segment, ...], float]:
    """Leave out the time after throttle came from far away; jitter is not a step."""
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
            kept.append(Segment(start, run.stop))
    return tuple(kept), lost
