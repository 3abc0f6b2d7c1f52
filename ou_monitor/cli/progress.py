"""How far a command is: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

from contextlib import suppress
import math
import shutil
import sys
import time

# Seconds between two lines where there is no terminal, and until the time left is guessed.
_EVERY, _FIRST = 10.0, 2.0
# Share that must be done before the time left is guessed.
_LEAST = 0.02


class Progress:
    """
    How far a command is, on standard error.

    A terminal shows a bar and the time left; elsewhere a line comes every 10 s, so that what ends
    sooner says nothing.

    Parameters
    ----------
    label : str
        What is being done.
    quiet : bool
        Write no lines where there is no terminal: a program reads what the command says.

    """

    def __init__(self, label: str, quiet: bool = False) -> None:
        self._label, self._quiet = label, quiet
        self._live = sys.stderr.isatty()
        self._drawn = 0.0
        self._told = time.monotonic()
        # When the first share was told, and which: what an earlier run did took no time.
        self._first: tuple[float, float] | None = None

    def __call__(self, share: float) -> None:
        """Show that `share`, 0..1, is done."""
        now = time.monotonic()
        self._first = self._first or (now, share)
        if not self._live:
            if now - self._told >= _EVERY and share < 1.0 and not self._quiet:
                self._told = now
                self._write(f'{self._label}: {share:.0%} done{self._left(share, now)}\n')
            return
        if now - self._drawn < 0.1 and share < 1.0:
            return
        self._drawn = now
        left = self._left(share, now)
        width = min(40, shutil.get_terminal_size().columns - len(self._label) - 12 - len(left))
        full = int(width * min(max(share, 0.0), 1.0))
        bar = f"[{'#' * full}{'.' * (width - full)}] " if width >= 5 else ''
        self._write(f'\r{self._label} {bar}{share:4.0%}{left}\x1b[K')

    def _left(self, share: float, now: float) -> str:
        """Return the time left, as far as it can be told from what is done."""
        began, first = self._first or (now, share)
        passed, done = now - began, share - first
        if done < _LEAST or share >= 1.0 or passed < _FIRST:
            return ''
        return f', {duration(passed * (1.0 - share) / done)} left'

    @staticmethod
    def _write(text: str) -> None:
        # That nobody listens must not stop the work.
        with suppress(OSError, ValueError):
            sys.stderr.write(text)
            sys.stderr.flush()

    def close(self) -> None:
        """Wipe the bar."""
        if self._live and self._drawn:
            self._write('\r\x1b[K')
        self._live, self._drawn, self._told = False, 0.0, math.inf

    def __enter__(self) -> Progress:
        """Return the bar."""
        return self

    def __exit__(self, *_: object) -> None:
        """Wipe the bar, whatever happened."""
        self.close()


def duration(seconds: float) -> str:
    """Return a time that is a guess, in words."""
    if seconds < 90.0:
        return f'{max(1, round(seconds))} s'
    return f'{round(seconds / 60.0)} min' if seconds < 5400.0 else f'{seconds / 3600.0:.1f} h'
