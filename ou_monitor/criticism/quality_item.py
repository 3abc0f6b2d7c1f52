"""One doubtful thing about a recording."""

from __future__ import annotations

from dataclasses import dataclass
import enum


class Severity(enum.IntEnum):
    """How much it matters."""

    ERROR = 3
    WARNING = 2
    INFO = 1


@dataclass(frozen=True)
class QualityItem:
    """
    One thing to know before using the numbers.

    Attributes
    ----------
    name : str
        Stable key in capitals.
    severity : Severity
        ERROR: there are no numbers; WARNING: they are doubtful; INFO: good to know.
    text : str
        One sentence.
    throttles : tuple of float
        Levels it is true of; empty when it is of the whole recording.

    """

    name: str
    severity: Severity
    text: str
    throttles: tuple[float, ...] = ()
