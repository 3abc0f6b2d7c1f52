"""
Which model file is in force: read when its path changes, never lost to a bad one.

No ROS here: the nodes hand over the parameter.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, TimeoutError as NotReadyError
import time
from typing import TYPE_CHECKING

from ou_monitor.errors import InputError
from ou_monitor.stream.files import open_regular, path_words

if TYPE_CHECKING:
    from ou_monitor.model.supply import SupplyModel

# Maximum time to read a file, s: most take 10 ms, the largest that is read at all 5 s.
PATIENCE = 20.0
# Time between calls of what the node must do meanwhile, s.
PAUSE = 0.02


class ModelChoice:
    """
    Model of the parameter `model_file`.

    A file is read when the path changes, not again when another parameter does: give an empty path
    and then the old one to have it read anew.  It is read in a thread, and whoever has it checked
    waits for it, so that the answer is true.
    """

    def __init__(self) -> None:
        self._used: tuple[str, SupplyModel | None] = '', None
        self._checked: tuple[str, SupplyModel | None] = '', None
        self._reader = ThreadPoolExecutor(1, 'model_file')

    def check(self, path: str, meanwhile: Callable[[], object] = lambda: None) -> None:
        """
        Read the file, unless it is the one in force; `ValueError` says why it cannot be used.

        `meanwhile` is called every `PAUSE` until it has been read.
        """
        if not path or path == self._used[0]:
            self._checked = self._used if path else ('', None)
            return
        future = self._reader.submit(_read, path)
        until = time.monotonic() + PATIENCE
        while True:
            try:
                self._checked = path, future.result(PAUSE)
                return
            except NotReadyError as error:
                if time.monotonic() > until:
                    future.cancel()
                    raise ValueError(f'model_file: {path_words(path)} was not read within '
                                     f'{PATIENCE:g} s') from error
                meanwhile()
            except InputError as error:
                raise ValueError(f'model_file: {error}') from error

    def use(self, path: str) -> SupplyModel | None:
        """Bring a path into force that was checked last; return its model."""
        if path != self._used[0]:
            if path != self._checked[0]:
                raise ValueError(f'model_file {path} has not been checked')
            self._used = self._checked
        return self._used[1]

    @property
    def terms(self) -> str:
        """Return the names of the terms in force, separated by commas; empty without a model."""
        model = self._used[1]
        return '' if model is None else ','.join(term.NAME for term in model.terms)


def _read(path: str) -> SupplyModel:
    """Read a model file; the terms and their fits are loaded only where there is one."""
    try:
        # Loading those takes a second on a busy machine; this is told at once.
        open_regular(path).close()
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or 'it is no path'
        raise InputError(f'cannot read the model file {path_words(path)}: {why}') from error
    from ou_monitor.recordings.model_file import read_model
    return read_model(path).model
