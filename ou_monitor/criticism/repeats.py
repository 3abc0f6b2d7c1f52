"""
Repeats: values that a logger or a link gave again, told from codes alike by chance.

The density of a change that noise rounds off is smooth about zero: among changes by whole codes
none at all come as often as those by one and by two say, whatever lines and slopes the signal
has.  Intensity that varies makes them more, at all distances alike; holds at the shortest only,
or in runs that begin in the midst of ordinary changes.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.adc import find_step, usual_change
from ou_monitor.records import FloatArray
from ou_monitor.timeline.line import reading_places, reading_times

# Repeats, or runs of them, that are called so, at least; and the share of ties by chance up to
# which the size of the changes says how many there are.
_FEWEST_TIES, _FINE = 20, 0.15
# Samples apart at which values alike are counted: at 8 seven held of ten show.  A line brings its
# values back after periods of its own, where holds are no longer seen.
_APART, _PERIODS = (2, 4, 8), range(9, 101)
# The noise of a rail falls to one part in so many at rest: ties are so much likelier there.
_CALMEST = 100.0
# Standard errors by which ties must exceed what is expected, and ends of runs may fall short.
_CLEAR, _SHORT = 6.0, 3.0
# Share at either end of the range where readings may be squeezed together.
_END = 0.1
_FLOAT32 = 1.2e-7
# Samples looked at for repeats.
_LOOK = 200_000


def without_repeats(t: FloatArray, v: FloatArray, u: FloatArray | None
                    ) -> tuple[FloatArray, FloatArray, FloatArray | None, float]:
    """Return readings, and samples a reading: 1 where none repeats."""
    places, period = reading_places(v)
    t, v, u = reading_times(t[places], period), v[places], None if u is None else u[places]
    if period > 1.0:
        return t, v, u, period
    first = max(0, (v.size - _LOOK) // 2)
    held = v[1:] == v[:-1] if _ties(v[first:first + _LOOK]) else _stuck(v)
    fresh = np.concatenate(([True], ~held))
    return t[fresh], v[fresh], None if u is None else u[fresh], v.size / int(fresh.sum())


def _ties(v: FloatArray) -> bool:
    """Return whether more samples repeat the one before than the codes of the ADC explain."""
    step = np.diff(v)
    # At the ends of the range there are other reasons to repeat.
    inner = (v[1:] > v.min()) & (v[1:] < v.max())
    equal, count = int(((step == 0.0) & inner).sum()), int(inner.sum())
    if equal < _FEWEST_TIES:
        return False
    moved = step[(step != 0.0) & inner]
    if moved.size < 2:
        return False
    code = _code(v)
    # Chance of two normal values one code apart or less, on average over their codes.
    chance = min(1.0, code / (math.sqrt(2.0 * math.pi) * float(np.sqrt(np.mean(moved**2)))))
    if chance >= _FINE and float(np.mean(moved[1:] * moved[:-1] > 0.0)) > 0.5:
        # A voltage that goes on where it goes stays in each code for a while.
        return False
    share = _ties_without_holds(v, inner)
    if int(((step[1:] == 0.0) & (step[:-1] != 0.0)).sum()) < _FEWEST_TIES:
        # Where a rail is calm, ties are likelier; but that calm none is, and a sensor was stuck.
        share = min(share, _CALMEST * chance)
    expected = count * max(chance if chance < _FINE else 0.0, share)
    smooth, error = _ties_of_codes(moved, code)
    return (equal - expected > _CLEAR * math.sqrt(max(expected, 1.0))
            and equal - smooth > _CLEAR * math.hypot(math.sqrt(max(smooth, 1.0)), error)
            and equal > count * _alike_again(v, inner))


def _code(v: FloatArray) -> float:
    """Return the step between codes, at least that of floats, V."""
    return max(find_step(v), usual_change(v), _FLOAT32 * float(np.abs(v).max()))


def _ties_of_codes(moved: FloatArray, code: float) -> tuple[float, float]:
    """
    Return the ties expected from changes by one and by two codes (V), and their standard error.

    The logarithm of a density that is smooth about zero is a parabola there: that of a normal law
    behind any ramp, line or load, as most of what adds to a change is as likely at either sign.
    """
    size = np.abs(moved)
    one, two = (max(0.5 * float((np.abs(size - k * code) < 0.5 * code).sum()), 0.5)
                for k in (1.0, 2.0))
    expected = (one**4 / two) ** (1.0 / 3.0)
    return expected, expected * math.sqrt(8.0 / (9.0 * one) + 1.0 / (18.0 * two))


def _stuck(v: FloatArray) -> npt.NDArray[np.bool_]:
    """
    Return which samples but the first repeat the one before in runs that no chance makes.

    A rail that is calm comes to rest, and moves on, by a code or so; a link that is lost holds
    what it had in the midst of ordinary changes, and has moved on by the more when it is back.
    """
    step = np.diff(v)
    none = np.zeros(step.size, dtype=np.bool_)
    equal = (step == 0.0) & (v[1:] > v.min()) & (v[1:] < v.max())
    size = np.sort(np.abs(step[step != 0.0]))
    code = _code(v)
    edge = np.diff(equal.astype(np.int8), prepend=0, append=0)
    begins, ends = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)
    if not size.size or not begins.size:
        return none
    chance = _ties_of_codes(size, code)[0] / step.size
    if float(size[size.size // 2]) < 1.5 * code:
        # Where most changes are by one code, what is alike stays so more often than codes say.
        chance = max(chance, float(np.mean(ends - begins > 1)))
    chance = min(chance, 0.9)
    least = max(2, math.ceil(math.log(step.size) / -math.log(chance)))
    long = (ends - begins >= least) & (begins > 0) & (ends < step.size)
    begins, ends = begins[long], ends[long]
    if begins.size < _FEWEST_TIES:
        return none
    low, high = np.quantile(v, (_END, 1.0 - _END))
    if float(np.mean((v[begins] > low) & (v[begins] < high))) < 0.5:
        return none
    usual = 0.5 - _SHORT / math.sqrt(12.0 * begins.size)
    if 0.5 * float(np.mean(size < 1.25 * code)) > usual:
        # Coming to rest by a code is no small change.
        return none
    for ending in (np.abs(step[begins - 1]), np.abs(step[ends])):
        rank = (np.searchsorted(size, ending - 0.25 * code)
                + np.searchsorted(size, ending + 0.25 * code)) / (2.0 * size.size)
        if float(rank.mean()) < usual:
            return none
    edge[:] = 0
    edge[begins], edge[ends] = 1, -1
    held: npt.NDArray[np.bool_] = np.cumsum(edge[:-1]) > 0
    return held


def _ties_without_holds(v: FloatArray, inner: npt.NDArray[np.bool_]) -> float:
    """
    Return the share of ties to neighbours that values alike without any hold explain.

    Values some samples apart are alike by chance of their codes, whatever the intensity does over
    the recording; neighbours are the more so as they lie nearer to each other, by sqrt(k) over k
    samples in a diffusion and less in white noise, or as the recording itself says.  Of a share h
    held, h^k are alike k apart, too.
    """
    near = float(np.mean((v[1:] - v[:-1]) ** 2))
    shares = []
    for k in _APART:
        apart = v[k:] - v[:-k]
        nearer = math.sqrt(max(k, float(np.mean(apart**2)) / near)) if near > 0.0 else math.sqrt(k)
        shares.append(nearer * float(np.mean(apart[inner[k - 1:]] == 0.0)))
    return min(shares)


def _alike_again(v: FloatArray, inner: npt.NDArray[np.bool_]) -> float:
    """Return the share of values that come back after the period at which most do."""
    return max((float(np.mean(v[k:][inner[k - 1:]] == v[:-k][inner[k - 1:]]))
                for k in _PERIODS if k < v.size // 2), default=0.0)
