"""
The data of a plot inside the page, for the script that makes the plot interactive.

One JSON object with one block of bytes, compressed by zlib, in base64.  Rounding: columns of up
to 4096 values are exact (float64).  Longer ones: x to 1/2000 of the median distance of the points
embedded, y to 1 part in 16 million (float32) of the value or, where that is less, of the range.
Beyond 700 000 points in a plot a curve is an envelope: the lowest and the highest of each so many
samples, so that every peak stays; the page says so.
"""

from __future__ import annotations

import base64
from dataclasses import replace
import json
import math
import re
from typing import Any
import zlib

import numpy as np
from ou_monitor.records import FloatArray
from ou_monitor.report.scale import extremes
from ou_monitor.report.svg import Curve, Plot

# Points of a plot that are embedded as they are.
MOST = 700_000
_EXACT = 4096
# Steps of a time stamp in the median distance of two samples.
_GRID = 1000
_UNIT = re.compile(r'(10[\u207b\u00b2\u00b3\u00b9\u2070-\u2079]+ )?'
                   r'(%|1|[mk\u00b5]?(V|A|W|s|Hz|\u03a9))([\u00b2/].*)?')


def embed(plot: Plot, most: int = MOST) -> str:
    """Return the data of a plot as a script element that is never run."""
    block = bytearray()
    drawn = [_changes(c) if c.kind == 'steps' else _in_order(c) for c in plot.curves]
    share = most // max(len(drawn), 1)
    long = [c for c in drawn if c.kind in ('line', 'steps', 'band') and c.x.size > share]
    if sum(c.x.size for c in drawn) <= most:
        long = []
    curves = []
    for curve in drawn:
        every = 1
        if curve in long:
            # Two points stand for `every` samples of a line, one for those of a band.
            room = most // len(long) // (1 if curve.kind == 'band' else 2)
            every = max(math.ceil(curve.x.size / max(room, 1)), 1)
            curve = envelope(curve, every)
        colour, *style = curve.style.split()
        curves.append({
            'kind': curve.kind, 'colour': int(colour[1:]), 'style': style, 'label': curve.label,
            'every': every, 'x': _abscissa(curve.x, plot.log_x, block),
            'y': _ordinate(curve.y, plot.log_y, block),
            'high': None if curve.high is None else _ordinate(curve.high, plot.log_y, block)})
    found = {
        'title': plot.title, 'x': _axis(plot.x_label, plot.x_range, plot.log_x),
        'y': _axis(plot.y_label, plot.y_range, plot.log_y),
        'width': plot.width, 'height': plot.height, 'curves': curves,
        'shades': [[_known(a), _known(b), int(style[1:]), label]
                   for a, b, style, label in plot.shades],
        'marks': [[_known(x), label] for x, label in plot.marks], 'names': plot.names,
        'block': base64.b64encode(zlib.compress(bytes(block), 6)).decode('ascii')}
    text = json.dumps(found, allow_nan=False, separators=(',', ':'))
    # Neither a tag nor an entity: the same text to a parser of HTML and to one of XML.
    for sign in '<>&':
        text = text.replace(sign, f'\\u{ord(sign):04x}')
    return f'<script type="application/json" class="plot-data">{text}</script>'


def envelope(curve: Curve, every: int) -> Curve:
    """Reduce a curve to the lowest and the highest of each so many samples."""
    if curve.high is None:
        index = extremes(curve.y, every)
        return replace(curve, x=curve.x[index], y=curve.y[index])
    start = np.arange(0, curve.x.size, every)
    known = np.isfinite(curve.y) & np.isfinite(curve.high)
    low = np.minimum.reduceat(np.where(known, curve.y, np.inf), start)
    high = np.maximum.reduceat(np.where(known, curve.high, -np.inf), start)
    whole = low <= high
    return replace(curve, x=curve.x[start], y=np.where(whole, low, np.nan),
                   high=np.where(whole, high, np.nan))


def _changes(curve: Curve) -> Curve:
    """Return steps without the points at which nothing steps; nothing is lost."""
    x, y = curve.x, curve.y
    if x.size < 3:
        return curve
    same = (y[1:] == y[:-1]) | (np.isnan(y[1:]) & np.isnan(y[:-1]))
    keep = np.concatenate(([True], ~same))
    keep[-1] = True
    return replace(curve, x=x[keep], y=y[keep])


def _in_order(curve: Curve) -> Curve:
    """Return separate points in the order of x, in which they are found; lines as they are."""
    if curve.kind not in ('markers', 'bars'):
        return curve
    order = np.argsort(curve.x, kind='stable')
    order = order[np.isfinite(curve.x[order])]
    return replace(curve, x=curve.x[order], y=curve.y[order],
                   high=None if curve.high is None else curve.high[order])


def _axis(label: str, ends: tuple[float, float], log: bool) -> dict[str, Any]:
    """Return an axis; its label taken apart into a name and a unit."""
    name, comma, unit = label.rpartition(', ')
    if not comma:
        name, unit = ('', label) if _UNIT.fullmatch(label) else (label, '')
    return {'label': label, 'name': name, 'unit': unit, 'log': log,
            'low': _known(ends[0]), 'high': _known(ends[1])}


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _abscissa(x: FloatArray, log: bool, block: bytearray) -> list[float | str]:
    """Append x; a long increasing one as the second differences of its place on a fine grid."""
    if x.size > _EXACT and not log and np.isfinite(x).all():
        step = np.diff(x)
        by = float(np.median(step)) / _GRID
        if step.min() >= 0.0 and by > 0.0 and x[-1] - x[0] < by * 2 ** 31:
            place = np.rint((x - x[0]) / by).astype(np.int64)
            twice = np.diff(np.diff(place, prepend=0), prepend=0)
            return _append('i4', twice.astype('<i4'), block, float(x[0]), by)
    return _append('f8', x.astype('<f8'), block)


def _ordinate(y: FloatArray, log: bool, block: bytearray) -> list[float | str]:
    """Append y; a long one as float32 from its middle, or from zero where that is nearer."""
    finite = y[np.isfinite(y)]
    if y.size > _EXACT and finite.size:
        middle, size = float(np.median(finite)), np.abs(finite[finite != 0.0])
        offset = 0.0 if log or float(np.ptp(finite)) > abs(middle) else middle
        if not size.size or (size.max() < 1e37 and (size.min() > 1e-37 or not log)):
            return _append('f4', (y - offset).astype('<f4'), block, offset)
    return _append('f8', y.astype('<f8'), block)


def _append(kind: str, values: Any, block: bytearray, low: float = 0.0,
            by: float = 1.0) -> list[float | str]:
    """Append a column; return type, place, length, what to add and what to multiply by."""
    place = len(block)
    block += values.tobytes()
    return [kind, place, int(values.size), low, by]
