"""
Which model file is in force: read when its path changes, never lost to a bad one.

No ROS here: the nodes hand over the parameter.
"""

from __future__ import annotations

from ou_monitor.errors import InputError
from ou_monitor.model.supply import SupplyModel
from ou_monitor.recordings.model_file import read_model


class ModelChoice:
    """
    Model of the parameter `model_file`.

    A file is read when the path changes, not again when another parameter
    does: give an empty path and then the old one to have it read anew.
    """

    def __init__(self) -> None:
        self._used: tuple[str, SupplyModel | None] = '', None
        self._checked: tuple[str, SupplyModel | None] = self._used

    def check(self, path: str) -> None:
        """Read the file, unless it is the one in use."""
        if path == self._used[0]:
            return
        try:
            self._checked = path, read_model(path).model if path else None
        except InputError as error:
            raise ValueError(f'model_file: {error}') from error

    def use(self, path: str) -> SupplyModel | None:
        """Bring a path that was checked last into force; return its model."""
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
