"""
`InputError` for mistakes of the user, and hints for its message.

A bug of the caller raises `ValueError` with the value and its unit.  A mistake that the *user* can
correct (a file, a topic, a key in a YAML file) raises `InputError`; its text is the one line that
the user sees: what is wrong, where, and what to do.  A property of the data is not an error, but a
`Status` in the result.
"""

from __future__ import annotations

from collections.abc import Iterable
import difflib
import itertools

from ou_monitor.text import printable

# Maximum number of valid words searched for a hint (a table may have many columns), and listed.
_MOST_CHOICES, _MOST_SHOWN = 1000, 60


class InputError(Exception):
    """
    A user's input cannot be used; the text is one line for the user.

    Command-line programs print it after their name and exit with status 2; nodes log it at FATAL
    and exit with status 2.  Unprintable characters, as from file names, are escaped, so that they
    cannot control a terminal (`text.printable`).

    Examples
    --------
    >>> from ou_monitor import InputError, read_recording
    >>> try:
    ...     read_recording('no_such.csv')
    ... except InputError as error:
    ...     print(error)
    cannot read no_such.csv: No such file or directory

    """

    def __init__(self, text: str) -> None:
        """Join the lines of the text to one printable line."""
        super().__init__(printable(' '.join(str(text).splitlines())))


def refusal(error: OSError) -> str:
    """Return the reason for an error of the operating system, in one line."""
    why = ' '.join((error.strerror or str(error)).split())
    return printable(why if error.filename is None else f"cannot use '{error.filename}': {why}")


def how_to_install(extra: str) -> str:
    """Return how to install an extra: from the source, because the package is not on PyPI."""
    return f"run pip install '.[{extra}]' in the folder of its source"


def closest(word: str, valid: Iterable[str]) -> str | None:
    """Return the first valid word that starts with `word`, else the most similar one, or None."""
    choices = list(itertools.islice(valid, _MOST_CHOICES))
    begun = [choice for choice in choices if word.strip('-') and choice.startswith(word)]
    return next(iter(begun or difflib.get_close_matches(word, choices, n=1, cutoff=0.5)), None)


def nearest(word: str, valid: Iterable[str]) -> str:
    """Return a hint that names the valid word nearest to a misspelt one."""
    choices = [printable(word, 60) for word in itertools.islice(valid, _MOST_CHOICES)]
    close = closest(word, choices)
    if close is not None:
        return f"did you mean '{close}'?"
    shown = sorted(choices)[:_MOST_SHOWN]
    return 'valid: ' + ', '.join(shown) + (', ...' if len(shown) < len(choices) else '')
