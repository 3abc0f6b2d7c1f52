"""
The HTML page around the plots: skeleton, tables, lists; everything is escaped here.

A page with plots has one script, which makes them interactive from the data embedded beside each.
Its content security policy names that script by its hash and forbids all other scripts, and every
request to a network.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from functools import cache
import hashlib
from html import escape
from importlib import resources

from ou_monitor.report.embedding import embed
from ou_monitor.report.svg import Plot
from ou_monitor.text import chance, number

# What is not known, as a page sets it.
UNKNOWN = '\u2013'
# Hues of Okabe & Ito (2008), distinct with every common colour blindness;
# lifted for the dark form.
_LIGHT = ('#0072b2', '#d55e00', '#009e73', '#cc79a7', '#b07d00', '#3a9bd9', '#6b4fa0', '#5f6b6d')
_DARK = ('#5cb3f0', '#ff8a45', '#35cfa0', '#ea9cc9', '#e6b84a', '#9bd2f7', '#b59cf0', '#a9b4b6')

_STYLE = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #1c2326; --soft: #5d686c;
  --rule: #dde3e5; --panel: #f5f7f8; --edge: #9aa6aa88; --warn: #9a4a00; LIGHT }
@media (prefers-color-scheme: dark) { :root { --paper: #14191b; --ink: #e6eaeb;
  --soft: #9aa6aa; --rule: #2e373a; --panel: #1c2326;
  --edge: #00000099; --warn: #ffb070; DARK } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 24px 20px 48px; max-width: 940px; background: var(--paper);
  color: var(--ink); font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif;
  overflow-wrap: break-word; }
h1 { font-size: 22px; margin: 0 0 2px; }
h2 { font-size: 17px; margin: 30px 0 8px; }
p { margin: 6px 0; } .soft { color: var(--soft); }
.headline { font-size: 17px; padding: 12px 16px; margin: 14px 0; background: var(--panel);
  border-left: 4px solid var(--c0); border-radius: 3px; }
.scroll { overflow-x: auto; margin: 0 0 14px; background-color: var(--paper);
  background-image: linear-gradient(to right, var(--paper), var(--paper)),
    linear-gradient(to right, var(--paper), var(--paper)),
    linear-gradient(to right, var(--edge), transparent),
    linear-gradient(to left, var(--edge), transparent);
  background-position: left, right, left, right; background-repeat: no-repeat;
  background-size: 24px 100%, 24px 100%, 12px 100%, 12px 100%;
  background-attachment: local, local, scroll, scroll; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums;
  font-size: 14px; }
th { text-align: right; font-weight: 600; color: var(--soft); vertical-align: bottom;
  border-bottom: 1px solid var(--soft); padding: 4px 10px 4px 0; }
td { text-align: right; padding: 4px 10px 4px 0; border-bottom: 1px solid var(--rule);
  white-space: nowrap; } td.left, th.left { text-align: left; }
td small { color: var(--soft); display: inline-block; max-width: 250px; white-space: normal;
  line-height: 1.3; }
details.section { border-top: 1px solid var(--rule); margin: 10px 0; }
details.section > summary { cursor: pointer; padding: 8px 0 4px; }
details.section > summary h2 { display: inline; }
dl.facts { display: grid; grid-template-columns: max-content 1fr; gap: 3px 16px; margin: 10px 0; }
dl.facts dt { color: var(--soft); } dl.facts dd { margin: 0; overflow-wrap: anywhere; }
@media (max-width: 560px) { dl.facts { grid-template-columns: 1fr; gap: 0; }
  dl.facts dd { margin: 0 0 6px; }
  body { padding: 16px 14px 32px; } .headline { font-size: 16px; padding: 10px 12px; }
  table { font-size: 13px; } th, td { padding: 4px 7px 4px 0; }
  td.left { white-space: normal; overflow-wrap: anywhere; min-width: 92px; } }
li { margin: 3px 0; overflow-wrap: anywhere; } li.warn::marker { color: var(--warn); }
code { font: 13px/1.5 ui-monospace, Menlo, Consolas, monospace; background: var(--panel);
  padding: 2px 5px; border-radius: 3px; overflow-wrap: anywhere; }
figure { margin: 10px 0; } figcaption { font-size: 13px; color: var(--soft); }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(340px, 1fr)); gap: 8px; }
figure > svg { width: 100%; height: auto; display: block; }
svg text { fill: var(--soft); font: 12px system-ui, -apple-system, "Segoe UI", sans-serif; }
svg text.title { fill: var(--ink); font-weight: 600; font-size: 13px; }
svg text.legend { fill: var(--ink); }
svg .grid { stroke: var(--rule); stroke-width: 1; }
svg .mark { stroke: var(--ink); stroke-width: 1; stroke-dasharray: 3 3; }
svg .line { fill: none; stroke-width: 1.2; stroke-linejoin: round; }
svg .thick { stroke-width: 2.2; } svg .dash { stroke-dasharray: 6 4; }
svg .faint { opacity: .55; } svg .band { stroke: none; opacity: .22; }
svg .panel { fill: var(--paper); opacity: .8; }
svg .shade { stroke: none; opacity: .10; }
@media print { body { max-width: none; } section { break-inside: avoid; } }
"""


def _stylesheet() -> str:
    def names(colours: Sequence[str]) -> str:
        return ' '.join(f'--c{k}: {colour};' for k, colour in enumerate(colours))

    series = ''.join(
        f'svg .line.s{k} {{ stroke: var(--c{k}); }} '
        f'svg .band.s{k}, svg .shade.s{k}, svg .dot.s{k} {{ fill: var(--c{k}); }}\n'
        for k in range(len(_LIGHT)))
    return _STYLE.replace('LIGHT', names(_LIGHT)).replace('DARK', names(_DARK)) + series


@cache
def _file(name: str) -> str:
    """Return a text file of this folder."""
    return resources.files(__package__).joinpath(name).read_text(encoding='utf-8')


@cache
def _script() -> tuple[str, str]:
    """Return the text of the script, and the source that names it in the policy."""
    code = ''.join(_file(f'plots_{part}.js') for part in ('draw', 'input', 'live'))
    # A section of character data to a parser of XML, comments to a script.
    text = f"//<![CDATA[\n'use strict';\n{{\n{code}}}\n//]]>"
    digest = base64.b64encode(hashlib.sha256(text.encode('utf-8')).digest()).decode('ascii')
    return text, f"'sha256-{digest}'"


def page(title: str, subtitle: str, sections: Sequence[str]) -> str:
    """Return a whole page that needs nothing but itself."""
    body = '\n'.join(sections)
    text, source = _script() if 'class="plot-data"' in body else ('', "'none'")
    policy = (f"default-src 'none'; script-src {source}; style-src 'unsafe-inline'; "
              "base-uri 'none'; form-action 'none'")
    style = _stylesheet() + (_file('plots.css') if text else '')
    script = f'<script>{text}</script>\n' if text else ''
    return (f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/>\n'
            f'<meta http-equiv="Content-Security-Policy" content="{policy}"/>\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1"/>\n'
            f'<title>{escape(title)}</title>\n<style>{style}</style></head>\n'
            f'<body>\n<h1>{escape(title)}</h1>\n<p class="soft">{escape(subtitle)}</p>\n'
            f'{body}\n{script}</body></html>\n')


def headline(text: str) -> str:
    """Return the sentence that says it all."""
    return f'<p class="headline">{escape(text)}</p>'


def section(heading: str, *content: str, folded: bool = False) -> str:
    """Return a headed section; `content` is HTML.  A folded one opens at a click."""
    inside = '\n'.join(content)
    if folded:
        return (f'<details class="section"><summary><h2>{escape(heading)}</h2></summary>\n'
                f'{inside}\n</details>')
    return f'<section><h2>{escape(heading)}</h2>\n{inside}\n</section>'


def facts(pairs: Sequence[tuple[str, str]]) -> str:
    """Return names and what is known of each, as a list."""
    return '<dl class="facts">' + ''.join(
        f'<dt>{escape(name)}</dt><dd>{escape(words)}</dd>' for name, words in pairs) + '</dl>'


def paragraph(text: str, soft: bool = False) -> str:
    """Return a paragraph of plain text."""
    kind = ' class="soft"' if soft else ''
    return f'<p{kind}>{escape(text)}</p>'


def code(text: str) -> str:
    """Return a command as a paragraph."""
    return f'<p><code>{escape(text)}</code></p>'


def bullets(items: Sequence[str], warn: bool = False) -> str:
    """Return a list of plain sentences; nothing when there are none."""
    if not items:
        return ''
    kind = ' class="warn"' if warn else ''
    return '<ul>' + ''.join(f'<li{kind}>{escape(item)}</li>' for item in items) + '</ul>'


def figure(drawing: Plot | str, caption: str = '') -> str:
    """Return a drawing with a caption; a plot with its data, from which it becomes interactive."""
    drawn = drawing.svg() + embed(drawing) if isinstance(drawing, Plot) else drawing
    below = f'<figcaption>{escape(caption)}</figcaption>' if caption else ''
    return f'<figure>{drawn}{below}</figure>'


def pair(*figures: str) -> str:
    """Return figures side by side where there is room."""
    return f'<div class="pair">{"".join(figures)}</div>'


def table(headers: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[int] = ()) -> str:
    """Return a table."""
    def cells(tag: str, line: Sequence[str]) -> str:
        out = []
        for k, text in enumerate(line):
            main, _, small = text.partition('\n')
            inner = escape(main) + (f'<br/><small>{escape(small)}</small>' if small else '')
            kind = ' class="left"' if k in left else ''
            out.append(f'<{tag}{kind}>{inner}</{tag}>')
        return '<tr>' + ''.join(out) + '</tr>'

    return ('<div class="scroll"><table><thead>' + cells('th', headers) + '</thead><tbody>'
            + ''.join(cells('td', row) for row in rows) + '</tbody></table></div>')


def typeset(text: str) -> str:
    """Return a cell of a terminal's table as a page sets it."""
    return UNKNOWN if text == '-' else text.replace('-', '\u2212')


def rounded(value: float, digits: int = 3) -> str:
    """Return a number to some significant digits."""
    return typeset(number(value, digits))


def probability(p: float) -> str:
    """Return a probability to two digits; below 0.001 only that."""
    return typeset(chance(p))
