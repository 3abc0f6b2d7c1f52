"""SVG documents that stand alone, and what is written between marks of a file."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

STYLE = """<style>
text { fill: #5d686c; font: 12px system-ui, -apple-system, "Segoe UI", sans-serif; }
text.title { fill: #1c2326; font-weight: 600; font-size: 13px; } text.legend { fill: #1c2326; }
text.light { fill: #ffffff; } .grid { stroke: #dde3e5; stroke-width: 1; }
.line { fill: none; stroke-width: 1.6; stroke-linejoin: round; }
.thick { stroke-width: 2.2; } .dash { stroke-dasharray: 6 4; }
.s0 { stroke: #0072b2; } .s1 { stroke: #d55e00; } .s2 { stroke: #009e73; }
.s3 { stroke: #cc79a7; } .s4 { stroke: #8a6d00; } .s5 { stroke: #56b4e9; }
.s6 { stroke: #444444; } .s7 { stroke: #9aa5a9; }
.band { stroke: none; opacity: .18; } .band.s0 { fill: #0072b2; } .band.s1 { fill: #d55e00; }
.band.s7 { fill: #9aa5a9; }
.panel { fill: #ffffff; opacity: .8; } .right { fill: none; stroke: #1c2326; stroke-width: 1.2; }
</style>"""


def drawing(parts: Sequence[str], width: int, height: int, title: str) -> str:
    """Return an SVG document that stands alone, on white."""
    return '\n'.join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" role="img" '
        f'aria-label="{escape(title, quote=True)}">', STYLE,
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>', *parts, '</svg>', ''])


def put(path: Path, text: str, name: str) -> None:
    """Write text: between the marks of that name where the file has them, else as the file."""
    begin, end = f'<!-- {name} begins -->', f'<!-- {name} ends -->'
    if path.exists():
        head, mark, rest = path.read_text().partition(begin)
        _, last, tail = rest.partition(end)
        if mark and last:
            text = f'{head}{mark}\n{text}\n{last}{tail}'
    path.write_text(text)
