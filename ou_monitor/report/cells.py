"""Numbers as a page sets them: with a true minus, and an en dash for what is not known."""

from __future__ import annotations

import math

from ou_monitor.text import number

UNKNOWN = '\u2013'


def typeset(text: str) -> str:
    """Return a cell of a terminal's table as a page sets it."""
    return UNKNOWN if text == '-' else text.replace('-', '\u2212')


def figure(value: float, digits: int = 3) -> str:
    """Return a number to some significant digits."""
    return typeset(number(value, digits))


def probability(p: float) -> str:
    """Return a probability to two digits; below 1e-6 only that."""
    if not math.isfinite(p):
        return UNKNOWN
    return '< 1e\u22126' if p < 1e-6 else typeset(f'{p:.2g}')
