"""What commands write: tables and progress for people, JSON and files for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import enum
import json
import math
from pathlib import Path
import shutil
import sys
import time
from typing import Any

import numpy as np

from ou_monitor.errors import InputError

STDOUT = '-'


def plain(value: Any) -> Any:
    """
    Return a value as strict JSON can hold it.

    Parameters
    ----------
    value : object
        Numbers, arrays, enums, mappings and sequences, nested.

    Returns
    -------
    object
        The same with NaN and infinities as None, arrays as lists and enums as
        their names.

    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(data: Mapping[str, Any], target: str) -> None:
    """
    Write strict JSON.

    Parameters
    ----------
    data : mapping
        What to write, see `plain`.
    target : str
        A file, or ``-`` for standard output.

    Raises
    ------
    InputError
        When the file cannot be written.

    """
    text = json.dumps(plain(data), indent=2, allow_nan=False, ensure_ascii=False) + '\n'
    if target == STDOUT:
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        write_text(text, target)


def write_text(text: str, target: str | Path) -> None:
    """
    Write a text file in UTF-8.

    Parameters
    ----------
    text : str
        What to write.
    target : str or Path
        The file.

    Raises
    ------
    InputError
        When it cannot be written.

    """
    try:
        Path(target).write_text(text, encoding='utf-8')
    except OSError as error:
        raise InputError(f"cannot write '{target}': {error.strerror or error}") from error


def check_writable(target: str | None) -> None:
    """
    Refuse an output before the work, when it can be seen that it will fail.

    Parameters
    ----------
    target : str or None
        A file; ``-`` and None pass.

    Raises
    ------
    InputError
        When the folder does not exist, or the target is a folder.

    """
    if target is None or target == STDOUT:
        return
    path = Path(target)
    if path.is_dir():
        raise InputError(f"cannot write '{target}': it is a folder; name a file in it")
    if not path.parent.is_dir():
        raise InputError(f"cannot write '{target}': the folder '{path.parent}' does not exist")


def table(headers: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[int] = ()) -> str:
    """
    Lay out an aligned table in plain text.

    Parameters
    ----------
    headers : sequence of str
        Column heads, units included.
    rows : sequence of sequence of str
        Cells.
    left : sequence of int
        Columns set flush left; the others are numbers, flush right.

    Returns
    -------
    str
        Lines without a trailing newline.

    """
    grid = [list(headers), *[list(row) for row in rows]]
    widths = [max(len(line[k]) for line in grid) for k in range(len(headers))]

    def lay(line: Sequence[str]) -> str:
        cells = [cell.ljust(width) if k in left else cell.rjust(width)
                 for k, (cell, width) in enumerate(zip(line, widths))]
        return '  '.join(cells).rstrip()

    rule = '  '.join('-' * width for width in widths)
    return '\n'.join([lay(grid[0]), rule, *[lay(line) for line in grid[1:]]])


class Progress:
    """
    A progress bar on standard error; silent unless that is a terminal.

    Parameters
    ----------
    label : str
        What is being done.

    """

    def __init__(self, label: str) -> None:
        self._label = label
        self._live = sys.stderr.isatty()
        self._drawn = 0.0

    def __call__(self, share: float) -> None:
        """Show that `share`, 0..1, is done."""
        now = time.monotonic()
        if not self._live or (now - self._drawn < 0.1 and share < 1.0):
            return
        self._drawn = now
        width = max(10, min(40, shutil.get_terminal_size().columns - len(self._label) - 12))
        full = int(width * min(max(share, 0.0), 1.0))
        sys.stderr.write(f"\r{self._label} [{'#' * full}{'.' * (width - full)}] {share:4.0%}")
        sys.stderr.flush()

    def close(self) -> None:
        """Wipe the bar."""
        if self._live and self._drawn:
            sys.stderr.write('\r\x1b[K')
            sys.stderr.flush()
        self._live = False

    def __enter__(self) -> Progress:
        """Return the bar."""
        return self

    def __exit__(self, *_: object) -> None:
        """Wipe the bar, whatever happened."""
        self.close()
