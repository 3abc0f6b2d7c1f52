"""
The result of a command in Python: record, JSON, table, plot, HTML.

Limits: `to_dataframe` and `plots` give the main results; `to_dict` gives all numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, TYPE_CHECKING

import numpy as np
from ou_monitor.errors import how_to_install, InputError, nearest
from ou_monitor.records import plain_data
from ou_monitor.report.document import Document, Figure, Pair, Part, Section
from ou_monitor.report.svg import Plot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from ou_monitor.analysis.supply import SupplyFacts
    from pandas import DataFrame

# Pixels of a page per inch.
_INCH = 100.0
# Line styles of a page, as matplotlib names them.
_LOOKS: dict[str, dict[str, Any]] = {
    'dash': {'linestyle': '--'}, 'thick': {'linewidth': 2.0}, 'faint': {'alpha': 0.55}}
# Rows by name, or columns by name.
Rows = Sequence[Mapping[str, Any]] | Mapping[str, Any]


class Result:
    """
    The result of a command such as `analyze`.

    Attributes of the record are attributes of the result: ``found.causes``.  Printing it shows
    the terminal output of the command; a notebook shows its page.

    Attributes
    ----------
    record : object
        The record, with all results.
    supply : SupplyFacts or None
        The facts of the supply; None without a recording.

    Examples
    --------
    >>> from ou_monitor import simulate
    >>> drawn = simulate(preset='idle', duration=2.0, rate=100.0)
    >>> drawn.to_dict()['n'], drawn.recording.n        # of the JSON, and of the record
    (200, 200)

    """

    def __init__(self, record: Any, document: Callable[[], Document],
                 data: Callable[[], Mapping[str, Any]], rows: str | Callable[[], Rows],
                 supply: SupplyFacts | Callable[[], SupplyFacts] | None = None) -> None:
        """
        Keep the record, and functions that compute the rest on demand.

        rows: a function, or the name of a list in the data.  If `supply` is a function, the JSON
        does not contain it.  Use module-level functions: closures cannot be pickled.
        """
        self.record = record
        self.document = document
        self._data, self._rows, self._supply = data, rows, supply

    @cached_property
    def supply(self) -> SupplyFacts | None:
        """Return the facts of the supply."""
        return self._supply() if callable(self._supply) else self._supply

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the record."""
        if name.startswith('_') or 'record' not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.record, name)

    def __dir__(self) -> list[str]:
        """Return the names of all attributes, including the record's."""
        return sorted({*super().__dir__(), *dir(self.record)})

    @property
    def headline(self) -> str:
        """Return the answer in words, as on the first screen."""
        return self.document().headline

    def to_dict(self) -> dict[str, Any]:
        """
        Return all numbers, equal to the command's `--json`.

        Returns
        -------
        dict
            Plain values; unknown numbers are None.

        """
        data = dict(self._data())
        if self._supply is not None and not callable(self._supply):
            data['supply'] = self._supply.to_dict()
        found: dict[str, Any] = plain_data(data)
        return found

    def to_dataframe(self) -> DataFrame:
        """
        Return the main table; unknown numbers are NaN.

        Returns
        -------
        pandas.DataFrame
            Load levels, causes, frequencies or rows; an interval ``x`` is two columns, ``x_low``
            and ``x_high``.

        Raises
        ------
        InputError
            When pandas is not installed.

        """
        try:
            from pandas import DataFrame
        except ImportError as error:
            raise InputError(f"to_dataframe needs pandas: {how_to_install('python')}") from error
        rows = self._data()[self._rows] if isinstance(self._rows, str) else self._rows()
        return DataFrame(dict(rows) if isinstance(rows, Mapping) else [
            dict(_cells(row)) for row in rows])

    def plots(self) -> dict[str, Plot]:
        """
        Return the plots of the page.

        Returns
        -------
        dict
            By title, the main one first.

        """
        return dict(self._drawn)

    @cached_property
    def _drawn(self) -> dict[str, Plot]:
        # Kept, because some plots show simulations; not copied with the result.
        return {plot.title: plot for plot in _plots(self.document().parts)}

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != '_drawn'}

    def plot(self, ax: Axes | None = None, title: str | None = None) -> Axes:
        """
        Draw one plot of the page.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes to draw on; by default, of a new figure.
        title : str, optional
            Title in `plots`; by default, the main one.

        Returns
        -------
        matplotlib.axes.Axes
            The axes with the drawing.

        Raises
        ------
        InputError
            When there is no such plot, or no matplotlib for a new figure.

        """
        found = self._drawn
        if not found:
            raise InputError('there is nothing to plot')
        if title is not None and title not in found:
            raise InputError(f"there is no plot '{title}': {nearest(title, found)}")
        return draw(next(iter(found.values())) if title is None else found[title], ax)

    def _repr_html_(self) -> str:
        from ou_monitor.report.page import section

        return section(self.document())

    def __str__(self) -> str:
        """Return what the command prints."""
        from ou_monitor.report.terminal import terminal

        return terminal(self.document())

    def __repr__(self) -> str:
        """Return the kind of the record, and the answer."""
        return f'<{type(self.record).__name__}: {self.document().headline}>'


def _cells(row: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the cells of a row: scalars, and the ends of intervals; deeper data are left out."""
    for name, value in row.items():
        if isinstance(value, (list, tuple)) and len(value) == 2 and all(
                isinstance(end, (int, float)) for end in value):
            yield from zip((f'{name}_low', f'{name}_high'), value)
        elif not isinstance(value, (list, tuple, Mapping, np.ndarray)):
            yield name, value


def _plots(parts: Sequence[Part]) -> Iterator[Plot]:
    for part in parts:
        if isinstance(part, Figure):
            yield part.drawing
        elif isinstance(part, (Section, Pair)):
            yield from _plots(part.parts if isinstance(part, Section) else part.figures)
        elif callable(part):
            yield from _plots(part())


def draw(plot: Plot, ax: Axes | None = None) -> Axes:
    """Draw on axes, by default of a new figure, and return them."""
    if ax is None:
        try:
            from matplotlib import pyplot
        except ImportError as error:
            raise InputError(f"a new figure needs matplotlib: {how_to_install('python')}"
                             ) from error
        figure = pyplot.figure(figsize=(plot.width / _INCH, plot.height / _INCH),
                               layout='constrained')
        ax = figure.add_subplot()
    for curve in plot.curves:
        colour, *names = curve.style.split()
        look: dict[str, Any] = {'color': f'C{colour[1:]}', 'label': curve.label or None}
        for name in names:
            look |= _LOOKS[name]
        if curve.kind == 'band' and curve.high is not None:
            ax.fill_between(curve.x, curve.y, curve.high, **{
                'alpha': 0.22, 'linewidth': 0.0, **look})
        elif curve.kind == 'bars' and curve.high is not None:
            middle, half = 0.5 * (curve.y + curve.high), 0.5 * (curve.high - curve.y)
            ax.errorbar(curve.x, middle, half, linestyle='none', capsize=4.0, **look)
        elif curve.kind == 'markers':
            ax.plot(curve.x, curve.y, 'o', **look)
        else:
            ax.plot(curve.x, curve.y, **look, drawstyle=(
                'steps-post' if curve.kind == 'steps' else 'default'))
    for start, stop, colour, _ in plot.shades:
        ax.axvspan(start, stop, color=f'C{colour[1:]}', alpha=0.1, linewidth=0.0)
    for x, label in plot.marks:
        ax.axvline(x, color='black', linestyle=':', label=label)
    ax.set(title=plot.title, xlabel=plot.x_label, ylabel=plot.y_label,
           xscale='log' if plot.log_x else 'linear', yscale='log' if plot.log_y else 'linear',
           xlim=plot.x_range, ylim=plot.y_range)
    if plot.names:
        ax.set_xticks(range(1, len(plot.names) + 1), plot.names)
    if plot.marks or any(curve.label for curve in plot.curves):
        ax.legend()
    return ax
