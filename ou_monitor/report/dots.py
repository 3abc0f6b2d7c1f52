"""Rows of dots on a band: where data lie beside what simulations produce."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
import math

_WIDTH, _LEFT, _RIGHT, _ROW, _TOP, _BOTTOM = 860, 250, 20, 22, 34, 40
# Scores up to about this are drawn on a straight scale, larger ones on a logarithmic.
_STRAIGHT = 4.0
_TICKS = (0.0, 4.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 10000.0)


def dot_rows(title: str, x_label: str,
             rows: Sequence[tuple[str, float, float, float, float]]) -> str:
    """Draw one row for each statistic: a band, a hollow dot before, a full one after."""
    reach = max([1.5 * _STRAIGHT, *(abs(v) for row in rows for v in row[1:] if math.isfinite(v))])
    end = math.asinh(1.1 * reach / _STRAIGHT)
    middle, half = 0.5 * (_LEFT + _WIDTH - _RIGHT), 0.5 * (_WIDTH - _RIGHT - _LEFT)

    def at(value: float) -> float:
        return middle + half * math.asinh(value / _STRAIGHT) / end

    height = _TOP + _ROW * len(rows) + _BOTTOM
    bottom = height - _BOTTOM
    parts = [f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" '
             f'aria-label="{escape(title, quote=True)}">',
             f'<text class="title" x="14" y="16">{escape(title)}</text>']
    for size in _TICKS:
        for value in sorted({-size, size}):
            value += 0.0
            if abs(value) <= 1.1 * reach:
                x = at(value)
                parts.append(
                    f'<line class="grid" x1="{x:.1f}" y1="{_TOP}" x2="{x:.1f}" y2="{bottom}"/>'
                    f'<text class="tick" text-anchor="middle" x="{x:.1f}" y="{bottom + 16}">'
                    f'{f"{value:g}".replace("-", chr(0x2212))}</text>')
    for k, (name, low, high, before, after) in enumerate(rows):
        y = _TOP + _ROW * (k + 0.5)
        # Browsers show the title of a group where one points at it.
        parts.append(f'<g><title>{escape(_sentence(name, low, high, before, after))}</title>'
                     f'<text class="legend" text-anchor="end" x="{_LEFT - 10}" '
                     f'y="{y + 4:.1f}">{escape(name)}</text>'
                     f'<rect class="band s0" x="{at(low):.1f}" y="{y - 8:.1f}" '
                     f'width="{at(high) - at(low):.1f}" height="16"/>')
        drawn = [v for v in (before, after) if math.isfinite(v)]
        if len(drawn) == 2:
            parts.append(f'<line class="grid" x1="{at(before):.1f}" y1="{y:.1f}" '
                         f'x2="{at(after):.1f}" y2="{y:.1f}"/>')
        for value, fill in ((before, 'var(--paper)'), (after, 'var(--c1)')):
            if math.isfinite(value):
                parts.append(f'<circle cx="{at(value):.1f}" cy="{y:.1f}" r="5" '
                             f'style="fill: {fill}; stroke: var(--c1); stroke-width: 2"/>')
        parts.append('</g>')
    parts.append(f'<text class="label" text-anchor="middle" x="{middle:.0f}" '
                 f'y="{height - 6}">{escape(x_label)}</text></svg>')
    return '\n'.join(parts)


def _sentence(name: str, low: float, high: float, before: float, after: float) -> str:
    """Return the numbers of a row; what is not known is left out."""
    def text(value: float) -> str:
        return f'{value:.3g}'.replace('-', '\u2212')

    known = [(word, value) for word, value in (('before', before), ('after', after))
             if math.isfinite(value)]
    # A single dot has no before and after.
    said = [f'{word} {text(value)}' if len(known) == 2 else text(value) for word, value in known]
    return f'{name}: {", ".join([*said, f"simulations {text(low)} to {text(high)}"])}'
