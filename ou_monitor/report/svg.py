"""
Plots as inline SVG, without a plotting library.

`page.embed` puts the data beside the drawing, from which the script of the page makes an
interactive plot; on paper, and without scripts, the drawing stays.  Colours are CSS classes
(``s0`` .. ``s7`` for series), defined in `page.css` for light and dark mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

SERIES = 8  # Colours

_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 14, 30, 42  # Margins, pixels
# Width of a character of the 12-pixel sans serif, rounded up.
_LETTER = 7.0
# Half the width of an error bar's cap, pixels.
_CAP = 7.0
# Minimum characters of a shortened name.
_SHORTEST = 4
# Height of a row of the legend, pixels.
_LEGEND = 18
# Maximum magnitude of a drawn value; larger ones would overflow in the arithmetic of the axis.
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
        """Return pixels; NaN for values that a log axis cannot show."""
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


# A logarithmic axis whose ends differ by less than this factor has evenly spaced ticks.
_SHORT = 10.0 ** 0.7


def linear_ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Return multiples of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= 0.999 * rough)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten, and 2 and 5 times these if the axis is short."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    decades = math.log10(high / low)
    if high < low * _SHORT:
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
    """Return the ends of an axis with a margin, without a share `trim` of values at either end."""
    joined = np.concatenate([np.ravel(v) for v in values]) if values else np.zeros(0)
    joined = joined[np.abs(joined) < _HUGE]
    if log:
        joined = np.log10(joined[joined > 1.0 / _HUGE])
    if not joined.size:
        return (0.1, 10.0) if log else (0.0, 1.0)
    low, high = (float(v) for v in np.quantile(joined, [trim, 1.0 - trim]))
    room = high - low
    # Widen a range that is within the rounding error of its values.
    if room <= 1e-9 * max(abs(low), abs(high), 1e-12):
        room = 0.5 if log else max(0.1 * abs(low), 1e-6)
        low, high = low - 0.5 * room, high + 0.5 * room
    low, high = low - pad * room, high + pad * room
    return (10.0 ** low, 10.0 ** high) if log else (low, high)


def extremes(y: FloatArray, every: int) -> npt.NDArray[np.intp]:
    """Return the indices of the lowest, highest and last NaN sample of each group of `every`."""
    start = np.arange(0, y.size, every)
    group = np.arange(y.size) // every
    kept = []
    for sign in (1.0, -1.0):
        value = np.where(np.isfinite(y), sign * y, np.inf)
        least = np.minimum.reduceat(value, start)
        where = np.flatnonzero(np.isfinite(y) & (value == least[group]))
        kept.append(where[np.unique(group[where], return_index=True)[1]])
    broken = np.flatnonzero(~np.isfinite(y))
    kept.append(broken[::-1][np.unique(group[broken][::-1], return_index=True)[1]])
    return np.unique(np.concatenate(kept))


def thin(x: FloatArray, y: FloatArray, columns: int) -> tuple[FloatArray, FloatArray]:
    """Thin a long series to the extremes of each column of pixels."""
    if x.size <= 2 * columns:
        return x, y
    index = extremes(y, -(-x.size // columns))
    return x[index], y[index]


@dataclass(frozen=True, eq=False)
class Curve:
    """One series."""

    # Points, shape (n,); with `high`, y is the lower edge.
    x: FloatArray
    y: FloatArray
    high: FloatArray | None  # Upper edge of a band, upper ends of bars; shape (n,)
    label: str  # Name in the legend; empty: no entry
    # CSS classes; the first is ``s0`` .. ``s7``, the colour.
    style: str
    kind: str  # ``line``, ``steps``, ``band``, ``markers`` or ``bars``


class Plot:
    """
    One plot with two axes; sizes are in pixels.

    The legend is in rows below the title, which is also the text for screen readers.
    """

    def __init__(self, title: str, x_label: str, y_label: str, *, width: int = 860,
                 height: int = 240, log_x: bool = False, log_y: bool = False) -> None:
        self.title = title
        self.x_label, self.y_label = x_label, y_label
        self.width, self.height = width, height
        self.log_x, self.log_y = log_x, log_y
        self.curves: list[Curve] = []
        self.shades: list[tuple[float, float, str, str]] = []
        self.marks: list[tuple[float, str]] = []
        self.names: tuple[str, ...] = ()
        self._x_range: tuple[float, float] | None = None
        self._y_range: tuple[float, float] | None = None

    def _add(self, kind: str, x: FloatArray, y: FloatArray, high: FloatArray | None, label: str,
             colour: int, style: str = '') -> Plot:
        self.curves.append(Curve(
            np.asarray(x, float), np.asarray(y, float),
            None if high is None else np.asarray(high, float), label,
            f's{colour % SERIES} {style}'.strip(), kind))
        return self

    def line(self, x: FloatArray, y: FloatArray, label: str = '', colour: int = 0,
             style: str = '') -> Plot:
        """Add a line; NaN breaks it."""
        return self._add('line', x, y, None, label, colour, style)

    def level(self, x: FloatArray | Sequence[float], y: float, label: str = '', colour: int = 1,
              style: str = 'dash') -> Plot:
        """Add a horizontal line from x[0] to x[-1]."""
        return self.line(np.array([x[0], x[-1]]), np.full(2, y), label, colour, style)

    def steps(self, x: FloatArray, y: FloatArray, label: str = '', colour: int = 0) -> Plot:
        """Add a line that holds each value until the next point."""
        return self._add('steps', x, y, None, label, colour)

    def band(self, x: FloatArray, low: FloatArray, high: FloatArray, label: str = '',
             colour: int = 0) -> Plot:
        """Add a shaded band; NaN breaks it."""
        return self._add('band', x, low, high, label, colour)

    def markers(self, x: FloatArray, y: FloatArray, label: str = '', colour: int = 0) -> Plot:
        """Add a dot at each finite point."""
        return self._add('markers', x, y, None, label, colour)

    def bars(self, x: FloatArray, low: FloatArray, high: FloatArray, label: str = '',
             colour: int = 0) -> Plot:
        """Add a bar with caps from `low` to `high` at each finite point."""
        return self._add('bars', x, low, high, label, colour)

    def shade(self, start: float, stop: float, colour: int = 0, label: str = '') -> Plot:
        """Shade a span of the x axis; its label is drawn if there is room."""
        self.shades.append((start, stop, f's{colour % SERIES}', label))
        return self

    def mark(self, x: float, label: str) -> Plot:
        """Add a labelled vertical line."""
        self.marks.append((x, label))
        return self

    def places(self, names: Sequence[str]) -> Plot:
        """Write names below the x axis, at 1, 2 and so on, in place of numbers."""
        self.names = tuple(names)
        return self.limits(x=(0.4, max(len(names), 1) + 0.6))

    def limits(self, x: tuple[float, float] | None = None,
               y: tuple[float, float] | None = None) -> Plot:
        """Set the ends of an axis; ends that are not set follow the data."""
        self._x_range = x or self._x_range
        self._y_range = y or self._y_range
        return self

    @property
    def x_range(self) -> tuple[float, float]:
        """Return the ends of the x axis."""
        return self._x_range or span([c.x for c in self.curves], self.log_x, pad=0.0)

    @property
    def y_range(self) -> tuple[float, float]:
        """Return the ends of the y axis."""
        return self._y_range or span([c.y for c in self.curves] + [
            c.high for c in self.curves if c.high is not None], self.log_y)

    def svg(self) -> str:
        right, bottom = self.width - _RIGHT, self.height - _BOTTOM
        x = Scale(*self.x_range, _LEFT, right, self.log_x)
        y = Scale(*self.y_range, bottom, self._top, self.log_y)
        # A nested SVG clips curves at the axes without a clip path and its id.
        inner = f'{_LEFT} {self._top} {right - _LEFT} {bottom - self._top}'
        parts = [
            f'<svg viewBox="0 0 {self.width} {self.height}" role="img" '
            f'aria-label="{escape(self.title, quote=True)}">',
            f'<text class="title" x="{_LEFT}" y="16">{escape(self.title)}</text>',
            *self._axes(x, y, right, bottom),
            f'<svg x="{_LEFT}" y="{self._top}" width="{right - _LEFT}" '
            f'height="{bottom - self._top}" '
            f'viewBox="{inner}">']
        for start, stop, style, label in self.shades:
            a, b = np.clip(x(np.array([start, stop])), _LEFT, right)
            parts.append(f'<rect class="shade {style}" x="{a:.1f}" y="{self._top}" '
                         f'width="{max(b - a, 0.5):.1f}" height="{bottom - self._top}"/>')
            if label and b - a > _LETTER * len(label) + 8.0:
                parts.append(f'<text class="note" text-anchor="middle" '
                             f'x="{0.5 * (a + b):.1f}" y="{self._top + 13}">'
                             f'{escape(label)}</text>')
        # Bands and bars lie behind lines and dots.
        for curve in sorted(self.curves, key=lambda c: c.kind not in ('band', 'bars')):
            parts.append(self._draw(curve, x, y))
        parts.append('</svg>')
        ends: list[float] = []
        for where, label in sorted(self.marks):
            pixel = float(x(where))
            if _LEFT <= pixel <= right:
                # Put the label left of its line near the right edge, and below earlier labels that
                # it would cover.
                width = _LETTER * len(label)
                start = pixel + 4.0 if pixel + 4.0 + width <= right else pixel - 4.0 - width
                row = next((k for k, end in enumerate(ends) if end <= start), len(ends))
                ends[row:row + 1] = [start + width]
                parts.append(f'<line class="mark" x1="{pixel:.1f}" y1="{self._top}" '
                             f'x2="{pixel:.1f}" y2="{bottom}"/><text class="marked" '
                             f'x="{start:.1f}" y="{self._top + 12 + 15 * row}">'
                             f'{escape(label)}</text>')
        return '\n'.join([*parts, *self._legend(), '</svg>'])

    @property
    def _legend_rows(self) -> list[list[Curve]]:
        """Return the named curves in rows that fit between the margins."""
        rows: list[list[Curve]] = []
        room = 0.0
        for curve in self.curves:
            if not curve.label:
                continue
            if _entry_width(curve) > room:
                rows.append([])
                room = self.width - _LEFT - _RIGHT
            rows[-1].append(curve)
            room -= _entry_width(curve)
        return rows

    @property
    def _top(self) -> int:
        """Return the upper end of the axes, pixels."""
        return _TOP + _LEGEND * len(self._legend_rows)

    def _axes(self, x: Scale, y: Scale, right: int, bottom: int) -> list[str]:
        parts = []
        places = [float(k + 1) for k in range(len(self.names))]
        named = short(self.names, (right - _LEFT) / max(len(self.names), 1))
        for ticks, scale, across in ((places if named else x.ticks(7), x, True),
                                     (y.ticks(5), y, False)):
            uneven = len(ticks) < 2 or scale.log and scale.high >= scale.low * _SHORT
            for value in ticks:
                step = abs(value) if uneven else ticks[1] - ticks[0]
                text = named[round(value) - 1] if across and named else tick_text(
                    value, step or 1.0)
                text, pixel = escape(text), float(scale(value))
                if across:
                    parts.append(f'<line class="grid" x1="{pixel:.1f}" y1="{self._top}" '
                                 f'x2="{pixel:.1f}" y2="{bottom}"/><text class="tick" '
                                 f'text-anchor="middle" x="{pixel:.1f}" y="{bottom + 16}">'
                                 f'{text}</text>')
                else:
                    parts.append(f'<line class="grid" x1="{_LEFT}" y1="{pixel:.1f}" '
                                 f'x2="{right}" y2="{pixel:.1f}"/><text class="tick" '
                                 f'text-anchor="end" x="{_LEFT - 6}" y="{pixel + 4:.1f}">'
                                 f'{text}</text>')
        middle = 0.5 * (self._top + bottom)
        parts.append(f'<text class="label" text-anchor="middle" x="{0.5 * (_LEFT + right):.0f}" '
                     f'y="{self.height - 6}">{escape(self.x_label)}</text>')
        parts.append(f'<text class="label" text-anchor="middle" transform="translate(14 '
                     f'{middle:.0f}) rotate(-90)">{escape(self.y_label)}</text>')
        return parts

    def _draw(self, curve: Curve, x: Scale, y: Scale) -> str:
        if curve.kind == 'markers':
            return ''.join(
                f'<circle class="dot {curve.style}" cx="{a:.1f}" cy="{b:.1f}" r="4"/>'
                for a, b in _pixels(x(curve.x), y(curve.y)))
        if curve.kind == 'bars' and curve.high is not None:
            ends = _pixels(x(curve.x), y(curve.y), y(curve.high))
            path = ''.join(
                f'M{a - _CAP:.1f},{b:.1f}H{a + _CAP:.1f}M{a:.1f},{b:.1f}V{c:.1f}'
                f'M{a - _CAP:.1f},{c:.1f}H{a + _CAP:.1f}' for a, b, c in ends)
            return f'<path class="line thick {curve.style}" d="{path}"/>'
        if curve.high is not None:
            pieces = []
            px, low, high = x(curve.x), y(curve.y), y(curve.high)
            for run in _runs(np.isfinite(px) & np.isfinite(low) & np.isfinite(high)):
                there = _points(px[run], low[run])
                back = _points(px[run][::-1], high[run][::-1])
                pieces.append(f'M{there}L{back}Z')
            return f'<path class="band {curve.style}" d="{"".join(pieces)}"/>'
        px, py = x(curve.x), y(curve.y)
        if curve.kind == 'steps':
            px, py = thin(px, py, self.width)
            px, py = np.repeat(px, 2)[1:], np.repeat(py, 2)[:-1]
        px, py = thin(px, py, self.width)
        pieces = [f'M{_points(px[run], py[run])}'
                  for run in _runs(np.isfinite(px) & np.isfinite(py))]
        return f'<path class="line {curve.style}" d="{"".join(pieces)}"/>'

    def _legend(self) -> list[str]:
        found = []
        for k, row in enumerate(self._legend_rows, 1):
            left = float(_LEFT)
            for curve in row:
                found.append(_legend_entry(curve, left, 16 + k * _LEGEND))
                left += _entry_width(curve)
        return found


def _entry_width(curve: Curve) -> float:
    return _LETTER * len(curve.label) + 34.0


def _legend_entry(curve: Curve, x: float, y: int) -> str:
    swatch = (f'<rect class="band {curve.style}" x="{x:.0f}" y="{y - 9}" width="18" height="10"/>'
              if curve.kind == 'band' else
              f'<circle class="dot {curve.style}" cx="{x + 9:.0f}" cy="{y - 4}" r="4"/>'
              if curve.kind == 'markers' else
              f'<path class="line thick {curve.style}" '
              f'd="M{x:.0f},{y - 4}L{x + 18:.0f},{y - 4}"/>')
    return f'{swatch}<text class="legend" x="{x + 22:.0f}" y="{y}">{escape(curve.label)}</text>'


def short(names: Sequence[str], room: float) -> list[str]:
    """Return names shortened to `room` pixels each; empty if that is too little."""
    most = int(room / _LETTER) - 1
    if most < min(_SHORTEST, max(map(len, names), default=0)):
        return []
    return [name if len(name) <= most else f'{name[:most - 1]}\u2026' for name in names]


def _pixels(*columns: FloatArray) -> list[list[float]]:
    """Return the rows without NaN, clipped to coordinates that renderers can handle."""
    rows = np.clip(np.column_stack(columns), -1e4, 1e4)
    found: list[list[float]] = rows[np.isfinite(rows).all(axis=1)].tolist()
    return found


def _runs(good: np.ndarray) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate(([0], good.astype(np.int8), [0]))))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2])]


def _points(x: FloatArray, y: FloatArray) -> str:
    return 'L'.join(f'{a:.1f},{b:.1f}' for a, b in _pixels(x, y))
