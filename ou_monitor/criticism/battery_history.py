"""
Signed statistics of normal scores against what went before: loops of throttle, large errors.

No term of the catalogue answers to these: they tell effects that imitate one, by
what they do over minutes, on the way up and on the way down, or after they have begun.
"""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

# Shares of the time that throttle is below and above where a relay switches.
_RELAYS = ((0.15, 0.85), (0.28, 0.72), (0.4, 0.6))
# Share of a regressor's power that the mean response to throttle must leave.
_LEAST = 0.02
# Errors this large begin something, in standard deviations; one in so many samples.
_LARGE, _APART = 4.0, 20
# Fewer of them tell nothing.
_FEW = 5
# Samples after them, in groups.
_AFTER = (1, 4, 16, 64, 256, 1024)


def score(a: FloatArray, b: FloatArray) -> float:
    """Return the correlation of two series, as a normal score; 0 for a constant one."""
    a, b = a - a.mean(), b - b.mean()
    norm = math.sqrt(float(a @ a) * float(b @ b))
    return math.sqrt(a.size) * float(a @ b) / norm if norm > 0.0 else 0.0


def throttle_paths(throttle: FloatArray, keep: float) -> Iterator[tuple[str, FloatArray]]:
    """Yield regressors that are no function of throttle now: its growing effect, and loops."""
    time = np.linspace(-1.0, 1.0, throttle.size)
    spread = float(throttle.std())
    if not spread > 0.0:
        return
    u = (throttle - throttle.mean()) / spread
    cubic = np.vander(u, 4)
    yield from _left('growing effect of throttle', u * time, np.column_stack((cubic, time)), keep)
    for low, high in _RELAYS:
        below, above = np.quantile(u, (low, high))
        state = np.where(u > above, 1.0, np.where(u < below, -1.0, 0.0))
        last = np.maximum.accumulate(np.where(state != 0.0, np.arange(u.size), 0))
        yield from _left(f'loop of throttle {100 * low:g} to {100 * high:g} %', state[last],
                         cubic, keep)


def _left(name: str, wanted: FloatArray, known: FloatArray, keep: float
          ) -> Iterator[tuple[str, FloatArray]]:
    """Yield what other regressors leave of one, whitened, where it is not next to nothing."""
    less = wanted - known @ np.linalg.lstsq(known, wanted, rcond=None)[0]
    if float(less @ less) > _LEAST * float(wanted @ wanted):
        yield name, less - keep * np.concatenate((less[:1], less[:-1]))


def large_ones(errors: FloatArray, found: npt.NDArray[np.bool_] | None = None) -> FloatArray:
    """Return where something begins: large errors that no other one has come shortly before."""
    large = np.abs(errors) > _LARGE
    if found is not None:
        large |= found
    where = np.flatnonzero(large)
    first = np.concatenate((where[:1] >= 0, np.diff(where) > _APART))
    out = np.zeros(errors.size)
    out[where[first]] = np.sign(errors[where[first]])
    return out


def after_large(w: FloatArray, square: FloatArray, large: FloatArray
                ) -> Iterator[tuple[str, float]]:
    """Yield whether errors that follow large ones have their sign, and whether they are larger."""
    told = int((large != 0.0).sum()) >= _FEW
    signs, counts = np.cumsum(large), np.cumsum(np.abs(large))
    for low, high in zip(_AFTER[:-1], _AFTER[1:]):
        if high > large.size // 4:
            return
        yield (f'after large errors {low} to {high}',
               score(w, _window(signs, low, high)) if told else 0.0)
        yield (f'power after large errors {low} to {high}',
               score(square, _window(counts, low, high)) if told else 0.0)


def _window(total: FloatArray, low: int, high: int) -> FloatArray:
    """Return what a running total gained from `high` - 1 to `low` samples ago."""
    def ago(k: int) -> FloatArray:
        return np.concatenate((np.zeros(k), total[:-k]))
    return ago(low) - ago(high)
