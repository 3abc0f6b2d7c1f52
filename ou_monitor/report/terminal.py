"""A document as plain text: paragraphs, aligned tables and lists, without legends and plots."""

from __future__ import annotations

from collections.abc import Sequence
import shutil
import sys
from textwrap import fill

from ou_monitor.records import Severity
from ou_monitor.report.document import (
    Document, Facts, Notes, Part, Section, Table, Text)

# Maximum and minimum width of text, characters; between them, the terminal's width is used.
COLUMNS, _NARROWEST = 100, 40


def columns() -> int:
    """Return the width of text, characters."""
    if not sys.stdout.isatty():
        return COLUMNS
    return max(_NARROWEST, min(COLUMNS, shutil.get_terminal_size().columns))


def terminal(document: Document) -> str:
    parts = [paragraph(document.subject), paragraph(document.headline)]
    return '\n\n'.join(part for part in (*parts, *map(_part, document.parts)) if part)


def _part(part: Part) -> str:
    """Return one part; empty if it is for a page only."""
    if isinstance(part, Text):
        return '' if part.legend else paragraph(part.text)
    if isinstance(part, Facts):
        return facts(part.pairs)
    if isinstance(part, Notes):
        lines = [paragraph(text if severity is Severity.INFO else
                           f'{severity.name.lower()}: {text}', '- ')
                 for severity, text in part.notes[:part.most]]
        return '\n'.join(lines + _left_out_line(len(part.notes), part.most))
    if isinstance(part, Table):
        return '\n'.join([table(part.heads, part.rows[:part.most], part.left),
                          *_left_out_line(len(part.rows), part.most)]) if part.rows else ''
    if isinstance(part, Section):
        inside = '\n\n'.join(text for text in map(_part, part.parts) if text)
        return f'{part.heading}:\n{inside}' if inside else ''
    return ''


def _left_out_line(count: int, most: int | None) -> list[str]:
    return [] if most is None or count <= most else [
        f'and {count - most} more: --report and --json have all']


def paragraph(text: str, begin: str = '') -> str:
    """Break a paragraph into lines, indented below `begin`; words and paths stay whole."""
    return fill(text, columns(), initial_indent=begin, subsequent_indent=' ' * len(begin),
                break_long_words=False, break_on_hyphens=False)


def facts(pairs: Sequence[tuple[str, str]]) -> str:
    """Lay out facts in two columns."""
    width = max((len(name) for name, _ in pairs), default=0) + 2
    return '\n'.join(paragraph(words, name.ljust(width)) for name, words in pairs)


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[int] = ()) -> str:
    """Lay out an aligned table; split it if it is wider than the terminal."""
    grid = [[cell.replace('\n', ' ') for cell in line] for line in (heads, *rows)]
    if sys.stdout.isatty():
        return '\n\n'.join(_aligned([[line[k] for k in part] for line in grid],
                                    [n for n, k in enumerate(part) if k in left])
                           for part in _parts(grid, shutil.get_terminal_size().columns))
    return _aligned(grid, left)


def _parts(grid: Sequence[Sequence[str]], most: int) -> list[list[int]]:
    """Return groups of columns at most `most` characters wide; each repeats the first column."""
    widths = [max(len(line[k]) for line in grid) for k in range(len(grid[0]))]
    parts = [[0]]
    for k in range(1, len(widths)):
        if len(parts[-1]) > 1 and sum(widths[c] + 2 for c in (*parts[-1], k)) - 2 > most:
            parts.append([0])
        parts[-1].append(k)
    return parts


def _aligned(grid: Sequence[Sequence[str]], left: Sequence[int]) -> str:
    widths = [max(len(line[k]) for line in grid) for k in range(len(grid[0]))]

    def lay(line: Sequence[str]) -> str:
        cells = [cell.ljust(width) if k in left else cell.rjust(width)
                 for k, (cell, width) in enumerate(zip(line, widths))]
        return '  '.join(cells).rstrip()

    rule = '  '.join('-' * width for width in widths)
    return '\n'.join([lay(grid[0]), rule, *[lay(line) for line in grid[1:]]])
