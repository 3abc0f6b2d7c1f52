"""
Which model file is in force: read when its path changes, never lost to a bad one.

No ROS here: the nodes hand over the parameter.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor, TimeoutError as NotReadyError
from typing import TYPE_CHECKING

from ou_monitor.errors import InputError
from ou_monitor.stream.files import open_regular, path_words

if TYPE_CHECKING:
    from ou_monitor.model.supply import SupplyModel

# How long a callback waits for a file, s: most take 10 ms, the largest 5 s.
PATIENCE = 0.25


class ModelChoice:
    """
    Model of the parameter `model_file`.

    A file is read when the path changes, not again when another parameter does: give an empty path
    and then the old one to have it read anew.  It is read in a thread.  What is not read within
    `PATIENCE` comes into force later, or becomes the `problem`, one line.
    """

    def __init__(self) -> None:
        self.problem = ''
        self._used: tuple[str, SupplyModel | None] = '', None
        self._checked: tuple[str, Future[SupplyModel] | None] = '', None
        self._wanted = ''
        self._reader = ThreadPoolExecutor(1, 'model_file')

    def check(self, path: str, wait: float | None = PATIENCE) -> None:
        """Have the file read, unless it is the one wanted; wait so many s for it (None: all)."""
        if path == self._wanted:
            return
        if not path:
            self._checked = path, None
            return
        future = self._reader.submit(_read, path)
        self._checked = path, future
        try:
            future.result(wait)
        except NotReadyError:
            return
        except InputError as error:
            raise ValueError(f'model_file: {error}') from error

    def use(self, path: str) -> SupplyModel | None:
        """Want a path that was checked last; return the model in force by now."""
        if path != self._wanted:
            if path != self._checked[0]:
                raise ValueError(f'model_file {path} has not been checked')
            self._wanted, self.problem = path, ''
        return self.now()

    def now(self) -> SupplyModel | None:
        """Return the model in force: the one wanted, as soon as it has been read."""
        path, future = self._checked
        if self._wanted != self._used[0] and path == self._wanted and not self.problem:
            if future is None:
                self._used = path, None
            elif future.done():
                error = future.exception()
                if error is None:
                    self._used = path, future.result()
                else:
                    self.problem = f'model_file {path} is not used: {error}'
        return self._used[1]

    @property
    def terms(self) -> str:
        """Return the names of the terms in force, separated by commas; empty without a model."""
        model = self._used[1]
        return '' if model is None else ','.join(term.NAME for term in model.terms)


def _read(path: str) -> SupplyModel:
    """Read a model file; the terms and their fits are loaded only where there is one."""
    try:
        # Loading those takes longer than a callback waits on a busy machine; this does not.
        open_regular(path).close()
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or 'it is no path'
        raise InputError(f'cannot read the model file {path_words(path)}: {why}') from error
    from ou_monitor.recordings.model_file import read_model
    return read_model(path).model
