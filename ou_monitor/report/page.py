"""
A document as an HTML page: skeleton, tables, lists and the data of the plots; all text is escaped.

A page with plots has one script, which makes them interactive from the data embedded beside each.
The content security policy allows that script by its hash, and forbids all other scripts and all
network requests.

The data of a plot are one JSON object; its columns are one block of float32 (zlib, base64).  If a
plot has more than 150 000 points, its curves are reduced to the lowest and highest of each group
of samples, which keeps every peak; the page says so.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
import hashlib
from html import escape
from importlib import resources
import json
import math
from pathlib import Path
import re
from typing import Any
import zlib

import numpy as np
from ou_monitor.records import FloatArray, plain_data, Severity
from ou_monitor.report.document import (
    Document, Facts, Figure, Notes, Pair, Part, Section, Table, Text, UNKNOWN)
from ou_monitor.report.svg import Curve, extremes, Plot
from ou_monitor.stream.files import open_regular

# Maximum points of a plot that is embedded in full, which then takes up to 1.6 MB.
MOST = 150_000
_UNIT = re.compile(r'(10[\u207b\u00b2\u00b3\u00b9\u2070-\u2079]+ )?'
                   r'(%|1|[mk\u00b5]?(V|A|W|s|Hz|\u03a9))([\u00b2/].*)?')


def embed(plot: Plot, most: int = MOST) -> str:
    """Return the data of a plot as a script element that browsers do not run."""
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
            # `every` samples become two points of a line, one point of a band.
            room = most // len(long) // (1 if curve.kind == 'band' else 2)
            every = max(math.ceil(curve.x.size / max(room, 1)), 1)
            curve = envelope(curve, every)
        colour, *style = curve.style.split()
        curves.append({
            'kind': curve.kind, 'colour': int(colour[1:]), 'style': style, 'label': curve.label,
            'every': every, 'x': _column(curve.x, block), 'y': _column(curve.y, block),
            'high': None if curve.high is None else _column(curve.high, block)})
    found = {
        'title': plot.title, 'x': _axis(plot.x_label, plot.x_range, plot.log_x),
        'y': _axis(plot.y_label, plot.y_range, plot.log_y),
        'width': plot.width, 'height': plot.height, 'curves': curves,
        'shades': [[a, b, int(style[1:]), label]
                   for a, b, style, label in plot.shades],
        'marks': [[x, label] for x, label in plot.marks], 'names': plot.names,
        'block': base64.b64encode(zlib.compress(bytes(block), 6)).decode('ascii')}
    text = json.dumps(plain_data(found), allow_nan=False, separators=(',', ':'))
    # Without these signs there are no tags and entities: HTML and XML parsers read the same text.
    for sign in '<>&':
        text = text.replace(sign, f'\\u{ord(sign):04x}')
    return f'<script type="application/json" class="plot-data">{text}</script>'


def envelope(curve: Curve, every: int) -> Curve:
    """Reduce a curve to the lowest and the highest of each group of `every` samples."""
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
    """Drop the points of steps at which the value does not change; lossless."""
    x, y = curve.x, curve.y
    if x.size < 3:
        return curve
    same = (y[1:] == y[:-1]) | (np.isnan(y[1:]) & np.isnan(y[:-1]))
    keep = np.concatenate(([True], ~same))
    keep[-1] = True
    return replace(curve, x=x[keep], y=y[keep])


def _in_order(curve: Curve) -> Curve:
    """Sort markers and bars by x, for the search in the script; leave other curves unchanged."""
    if curve.kind not in ('markers', 'bars'):
        return curve
    order = np.argsort(curve.x, kind='stable')
    order = order[np.isfinite(curve.x[order])]
    return replace(curve, x=curve.x[order], y=curve.y[order],
                   high=None if curve.high is None else curve.high[order])


def _axis(label: str, ends: tuple[float, float], log: bool) -> dict[str, Any]:
    """Return an axis, with its label split into name and unit."""
    name, comma, unit = label.rpartition(', ')
    if not comma:
        name, unit = ('', label) if _UNIT.fullmatch(label) else (label, '')
    return {'label': label, 'name': name, 'unit': unit, 'log': log,
            'low': ends[0], 'high': ends[1]}


def _column(values: FloatArray, block: bytearray) -> list[int]:
    """Append a column to the block; return its place and length."""
    place = len(block)
    # Numbers beyond the range of float32 become infinite, and are not drawn.
    with np.errstate(over='ignore'):
        block += values.astype('<f4').tobytes()
    return [place, values.size]


# An unknown cell on a page.
_DASH = '\u2013'


# How each page begins and ends.
_BEGIN, _END = '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/>', '</body></html>\n'


@cache
def _file(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding='utf-8')


@cache
def _script() -> tuple[str, str]:
    """Return the script, and its hash as a source of the content security policy."""
    code = ''.join(_file(f'plots_{part}.js') for part in ('draw', 'input', 'live'))
    # For XML parsers these marks enclose character data; in the script they are comments.
    text = f"//<![CDATA[\n'use strict';\n{{\n{code}}}\n//]]>"
    digest = base64.b64encode(hashlib.sha256(text.encode('utf-8')).digest()).decode('ascii')
    return text, f"'sha256-{digest}'"


# A hyphen that is a minus sign, not one within a word or a date.
_MINUS = re.compile(r'(?<![\w.)^-])-(?=[\d.])')
# Signs that a terminal may lack.
_SIGNS = {'+-': '\u00b1', ' -> ': ' \u2192 '}
_SOFT, _LEFT = ' class="soft"', ' class="left"'
# Symbols and units in the heads of tables.
_SYMBOLS = {'alpha': '\u03b1', 'sigma': '\u03c3', 'tau': '\u03c4', 'Var_inf': 'Var\u221e',
            'V/sqrt(s)': 'V/\u221as', 'V^2': 'V\u00b2', 'uF': '\u00b5F', 'us': '\u00b5s',
            'Ohm': '\u03a9', 'mOhm': 'm\u03a9'}
_SYMBOL = re.compile(r'(?<!\w)(' + '|'.join(map(re.escape, _SYMBOLS)) + r')(?!\w)')


def _html(text: str) -> str:
    """Return a text, escaped, with typographic signs."""
    for plain, sign in _SIGNS.items():
        text = text.replace(plain, sign)
    return escape(_MINUS.sub('\u2212', text))


def _head(text: str) -> str:
    """Return the head of a column, capitalised, with symbols."""
    text = _SYMBOL.sub(lambda found: _SYMBOLS[found[1]], text)
    first = re.split(r'\W', text, maxsplit=1)[0]
    return text[:1].upper() + text[1:] if first.isascii() and len(first) > 1 else text


def html(document: Document, command: str = '') -> str:
    """Return a document as a self-contained page (command: makes the page again)."""
    body = _joined(document.parts)
    if command:
        again = f'<p><code>{escape(command)}</code></p>'
        body += '\n' * bool(body) + _folded('<h2>To repeat this</h2>', again)
    text, source = _script() if 'class="plot-data"' in body else ('', "'none'")
    policy = (f"default-src 'none'; script-src {source}; style-src 'unsafe-inline'; "
              "base-uri 'none'; form-action 'none'")
    style = _file('page.css') + (_file('plots.css') if text else '')
    script = f'<script>{text}</script>\n' if text else ''
    return (f'{_BEGIN}\n'
            f'<meta http-equiv="Content-Security-Policy" content="{policy}"/>\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1"/>\n'
            f'<title>{escape(document.title)}</title>\n<style>\n{style}</style></head>\n'
            f'<body>\n{_top(document)}{body}\n{script}{_END}')


def is_page(path: Path, title: str) -> bool:
    """Return whether a file begins and ends as the page of a document with this title."""
    try:
        with open_regular(path) as file:
            page = file.read()
    except OSError:
        return False
    return page.startswith(_BEGIN.encode()) and page.endswith(_END.encode()) and (
        f'<title>{escape(title)}</title>'.encode() in page[:1000])


def section(document: Document) -> str:
    """Return a document for inclusion in another page, with static plots."""
    # Nesting limits the CSS rules to this section.
    style = _file('page.css').replace(':root', 'article').replace('body {', 'article {')
    return (f'<div class="ou-monitor"><style>.ou-monitor {{\n{style}}}</style><article>\n'
            f'{_top(document)}{_joined(document.parts, live=False)}\n</article></div>\n')


def _top(document: Document) -> str:
    return (f'<h1>{escape(document.title)}</h1>\n<p{_SOFT}>{escape(document.subject)}</p>\n'
            f'<p class="headline">{_html(document.headline)}</p>\n')


def _joined(parts: Sequence[Part], live: bool = True) -> str:
    return '\n'.join(text for text in (_part(part, live) for part in parts) if text)


def _part(part: Part, live: bool = True) -> str:
    """Return one part of a document; live: with the data of its plots."""
    if isinstance(part, Text):
        return '' if not part.text else f'<p{_SOFT if part.legend else ""}>{_html(part.text)}</p>'
    if isinstance(part, Facts):
        return '' if not part.pairs else '<dl class="facts">' + ''.join(
            f'<dt>{_html(name)}</dt><dd>{_html(words)}</dd>'
            for name, words in part.pairs) + '</dl>'
    if isinstance(part, Notes):
        return '' if not part.notes else '<ul>' + ''.join(
            f'<li>{_html(text)}</li>' if severity is Severity.INFO else
            f'<li class="warn">{severity.name.lower()}: {_html(text)}</li>'
            for severity, text in part.notes) + '</ul>'
    if isinstance(part, Table):
        return _table(part)
    if isinstance(part, Figure):
        drawn = part.drawing.svg() + (embed(part.drawing) if live else '')
        below = f'<figcaption>{_html(part.caption)}</figcaption>' if part.caption else ''
        return f'<figure>{drawn}{below}</figure>'
    if isinstance(part, Pair):
        # A single figure takes half the width.
        more = '<div></div>' if len(part.figures) == 1 else ''
        both = ''.join(_part(figure, live) for figure in part.figures)
        return f'<div class="pair">{both}{more}</div>'
    if isinstance(part, Section):
        inside, heading = _joined(part.parts, live), f'<h2>{_html(part.heading)}</h2>'
        if not inside:
            return ''
        return _folded(heading, inside) if part.folded else (
            f'<section>{heading}\n{inside}\n</section>')
    return _joined(part(), live)


def _folded(heading: str, inside: str) -> str:
    return f'<details class="section"><summary>{heading}</summary>\n{inside}\n</details>'


def _table(part: Table) -> str:
    def line(tag: str, cells: Sequence[str]) -> str:
        out = []
        for k, text in enumerate(cells):
            main, _, small = (_DASH if text == UNKNOWN else text).partition('\n')
            inner = _html(main) + (f'<br/><small>{_html(small)}</small>' if small else '')
            out.append(f'<{tag}{_LEFT if k in part.left else ""}>{inner}</{tag}>')
        return '<tr>' + ''.join(out) + '</tr>'

    return '' if not part.rows else (
        '<div class="scroll"><table><thead>' + line('th', [_head(head) for head in part.heads])
        + '</thead><tbody>' + ''.join(line('td', row) for row in part.rows)
        + '</tbody></table></div>')
