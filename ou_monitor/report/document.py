"""
The report of a command as records, which `page` turns into HTML and `terminal` into text.

Empty parts are left out.  Texts for a terminal are ASCII; a page replaces '+-' by its sign, and
'sigma' and 'V/sqrt(s)' in the heads of tables by symbols.  In a cell or a head, text after a line
break is small on a page and continues the line on a terminal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Union

from ou_monitor.records import Severity

if TYPE_CHECKING:
    from ou_monitor.report.svg import Plot


@dataclass(frozen=True)
class Text:
    """A paragraph; a legend appears on a page only."""

    text: str
    legend: bool = False


@dataclass(frozen=True)
class Facts:
    """Facts: names and values."""

    pairs: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Notes:
    """Sentences of a list, each with its severity."""

    notes: Sequence[tuple[Severity, str]]
    most: int | None = None  # Maximum sentences on a terminal; the page has all

    @classmethod
    def of(cls, texts: Iterable[str], severity: Severity = Severity.INFO,
           most: int | None = None) -> Notes:
        """Return notes of one severity; empty texts are left out."""
        return cls([(severity, text) for text in texts if text], most)


# Text of an unknown cell.
UNKNOWN = '-'


@dataclass(frozen=True)
class Table:
    """Rows of cells under heads."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: Sequence[int] = ()  # Columns flush left
    most: int | None = None  # Maximum rows on a terminal; the page has all

    @classmethod
    def of_known(cls, heads: Sequence[str], rows: Sequence[Sequence[str]],
                 left: Sequence[int] = (), most: int | None = None) -> Table:
        """Return a table without the columns that are unknown in every row."""
        kept = [k for k in range(len(heads)) if any(row[k] != UNKNOWN for row in rows)]
        return cls([heads[k] for k in kept], [[row[k] for k in kept] for row in rows],
                   [n for n, k in enumerate(kept) if k in left], most)


@dataclass(frozen=True)
class Figure:
    """A plot, for a page."""

    drawing: Plot
    caption: str = ''


@dataclass(frozen=True)
class Pair:
    """Figures side by side if there is room; a single one takes half the width."""

    figures: Sequence[Figure]

    @classmethod
    def two_by_two(cls, figures: Sequence[Figure]) -> list[Pair]:
        return [cls(figures[k:k + 2]) for k in range(0, len(figures), 2)]


@dataclass(frozen=True)
class Section:
    """Parts under a heading; on a page, a click unfolds a folded one."""

    heading: str
    parts: Sequence[Part]
    folded: bool = False


# A function returns parts for a page only; a terminal never calls it.
Part = Union[Text, Facts, Notes, Table, Figure, Pair, Section,
             Callable[[], 'Sequence[Part]']]


@dataclass(frozen=True)
class Document:
    """A whole report."""

    title: str  # Heading of a page
    subject: str  # Recording and its size, one line
    answer: Sequence[str]  # Sentences, most important first
    parts: Sequence[Part]

    @property
    def headline(self) -> str:
        """Return the answer as a paragraph."""
        return ' '.join(self.answer)


def worst_first(notes: Iterable[tuple[Severity, str]]) -> Notes:
    """Return notes in order of severity, worst first, each sentence once."""
    said: dict[str, Severity] = {}
    for severity, text in notes:
        said[text] = max(severity, said.get(text, severity))
    return Notes(sorted(((severity, text) for text, severity in said.items()),
                        key=lambda note: -note[0]))
