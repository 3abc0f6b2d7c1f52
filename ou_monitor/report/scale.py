"""Axes: where the ticks lie, how they are written, and how long series are thinned."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

_HUGE = 1e100


@dataclass(frozen=True)
class Scale:
    """One axis: data to pixels."""

    # Ends in data units, low < high; both positive on a log axis.
    low: float
    high: float
    # Ends in pixels.
    start: float
    stop: float
    log: bool = False  # Whether the axis is logarithmic

    def __call__(self, values: FloatArray | float) -> FloatArray:
        """Return pixels; NaN for what a log axis cannot show."""
        data = np.asarray(values, dtype=np.float64)
        low, high = self.low, self.high
        if self.log:
            with np.errstate(divide='ignore', invalid='ignore'):
                data = np.where(data > 0.0, np.log10(data), np.nan)
            low, high = math.log10(low), math.log10(high)
        pixels: FloatArray = self.start + (data - low) / (high - low) * (self.stop - self.start)
        return pixels

    def ticks(self, count: int = 6) -> list[float]:
        """Return round values inside the axis, about `count` of them."""
        return log_ticks(self.low, self.high) if self.log else linear_ticks(
            self.low, self.high, count)


def linear_ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Return multiples of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= 0.999 * rough)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten; with 2 and 5 between them when the axis is short."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    decades = math.log10(high / low)
    if decades < 0.7:
        return linear_ticks(low, high, 5)
    marks = (1.0, 2.0, 5.0) if decades < 2.5 else (1.0,)
    stride = max(1, math.ceil(decades / 8.0))
    return [m * 10.0 ** p for p in range(first, last + 1, stride) for m in marks
            if low * (1 - 1e-9) <= m * 10.0 ** p <= high * (1 + 1e-9)]


def tick_text(value: float, step: float) -> str:
    """Return a tick as text, with the decimals that its step needs."""
    if value == 0.0 or abs(value) < 1e-9 * step:
        return '0'
    size = abs(value)
    if size >= 1e5 or size < 1e-3:
        mantissa, exponent = f'{value:.2e}'.split('e')
        mantissa = mantissa.rstrip('0').rstrip('.')
        text = f'{mantissa}e{int(exponent)}'
    else:
        digits = max(0, -math.floor(math.log10(step) + 1e-9))
        text = f'{value:.{digits}f}'
    return text.replace('-', '\u2212')


def span(values: list[FloatArray], log: bool = False, pad: float = 0.05,
         trim: float = 0.0) -> tuple[float, float]:
    """Return the ends of an axis that holds all finite values, with a margin."""
    joined = np.concatenate([np.ravel(v) for v in values]) if values else np.zeros(0)
    # What is larger or, on a log axis, smaller than this would overflow in the
    # arithmetic of the axis; it is no voltage either.
    joined = joined[np.abs(joined) < _HUGE]
    if log:
        joined = np.log10(joined[joined > 1.0 / _HUGE])
    if not joined.size:
        return (0.1, 10.0) if log else (0.0, 1.0)
    low, high = (float(v) for v in np.quantile(joined, [trim, 1.0 - trim]))
    room = high - low
    # The range must stay wide beside the rounding of the values themselves.
    if room <= 1e-9 * max(abs(low), abs(high), 1e-12):
        room = 0.5 if log else max(0.1 * abs(low), 1e-6)
        low, high = low - 0.5 * room, high + 0.5 * room
    low, high = low - pad * room, high + pad * room
    return (10.0 ** low, 10.0 ** high) if log else (low, high)


def extremes(y: FloatArray, every: int) -> npt.NDArray[np.intp]:
    """Return where each so many samples are lowest and highest, and where they break off (NaN)."""
    start = np.arange(0, y.size, every)
    group = np.arange(y.size) // every
    kept = []
    for sign in (1.0, -1.0):
        value = np.where(np.isfinite(y), sign * y, np.inf)
        least = np.minimum.reduceat(value, start)
        where = np.flatnonzero(np.isfinite(y) & (value == least[group]))
        kept.append(where[np.unique(group[where], return_index=True)[1]])
    broken = np.flatnonzero(~np.isfinite(y))
    # The last one of each group.
    kept.append(broken[::-1][np.unique(group[broken][::-1], return_index=True)[1]])
    return np.unique(np.concatenate(kept))


def thin(x: FloatArray, y: FloatArray, columns: int) -> tuple[FloatArray, FloatArray]:
    """Thin a long series to the extremes of each column of pixels."""
    if x.size <= 2 * columns:
        return x, y
    index = extremes(y, -(-x.size // columns))
    return x[index], y[index]
