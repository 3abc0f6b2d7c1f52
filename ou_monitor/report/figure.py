"""What a plot holds, apart from how it is drawn: passed on to where it becomes interactive."""

from __future__ import annotations

from dataclasses import dataclass

from ou_monitor.records import FloatArray


@dataclass(frozen=True, eq=False)
class Curve:
    """
    One series.

    Attributes
    ----------
    x, y : ndarray, shape (n,)
        Points; the lower edge where there is an upper one.
    high : ndarray, shape (n,), or None
        Upper edge of a band, upper ends of bars.
    label : str
        Name in the legend; none when empty.
    style : str
        CSS classes; the first is ``s0`` .. ``s7``, the colour.
    kind : str
        ``line``, ``steps``, ``band``, ``markers`` or ``bars``.

    """

    x: FloatArray
    y: FloatArray
    high: FloatArray | None
    label: str
    style: str
    kind: str


@dataclass(frozen=True, eq=False)
class Figure:
    """
    One plot, with the ends of its axes.

    Attributes
    ----------
    title, x_label, y_label : str
        For people.
    width, height : int
        Pixels of the drawing.
    log_x, log_y : bool
        Logarithmic axes.
    x_range, y_range : tuple of float
        Ends of the axes.
    curves : tuple of Curve
        In the order of drawing.
    shades : tuple of tuple
        Shaded stretches: start, stop, CSS class of the colour, label.
    marks : tuple of tuple
        Vertical lines: x, label.

    """

    title: str
    x_label: str
    y_label: str
    width: int
    height: int
    log_x: bool
    log_y: bool
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    curves: tuple[Curve, ...]
    shades: tuple[tuple[float, float, str, str], ...]
    marks: tuple[tuple[float, str], ...]


class Drawing(str):
    """
    An ``<svg>`` element that remembers what it shows.

    A page that takes it as a string shows the static drawing; `page.figure` embeds the data as
    well.  What is made from it by string operations is a plain string again.

    Attributes
    ----------
    figure : Figure
        What is shown.

    """

    figure: Figure

    def __new__(cls, text: str, figure: Figure) -> Drawing:
        """Return the text of the drawing with its figure."""
        made = super().__new__(cls, text)
        made.figure = figure
        return made
