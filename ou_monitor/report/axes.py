"""A `Plot` drawn on axes of matplotlib, with the colours of the user's style."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from ou_monitor.errors import how_to_install, InputError
from ou_monitor.report.svg import Plot

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Pixels of a page per inch.
_INCH = 100.0
# Line styles of a page, as matplotlib names them.
_LOOKS: dict[str, dict[str, Any]] = {
    'dash': {'linestyle': '--'}, 'thick': {'linewidth': 2.0}, 'faint': {'alpha': 0.55}}


def draw(plot: Plot, ax: Axes | None = None) -> Axes:
    """Draw on axes, or on those of a new figure, and return them."""
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
