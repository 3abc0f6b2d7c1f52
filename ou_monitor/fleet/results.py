"""
Results as they come, a file for each recording, so that a run can be taken up again.

A result counts for a recording with the same path, size, time of change,
options and version of the package.  One with an error is not kept: that
recording is tried again.
"""

from __future__ import annotations

from collections.abc import Mapping
import hashlib
import json
import os
from pathlib import Path
from typing import Any

from ou_monitor.errors import InputError
from ou_monitor.fleet.find import Source
from ou_monitor.stream.files import open_regular

FOLDER = 'parts'
# A result has some 10 kB.
_MOST = 50_000_000


class Parts:
    """
    The results in a folder.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the fleet; created when it is missing.
    options : mapping
        What the results depend on, the version of the package among it, as
        JSON holds it.

    Raises
    ------
    InputError
        When the folder cannot be created or written.

    """

    def __init__(self, folder: Path, options: Mapping[str, Any]) -> None:
        self._folder = folder / FOLDER
        self._options = json.dumps(dict(options), sort_keys=True)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot write into '{folder}': {_why(error)}") from error
        # An output folder that cannot be written must fail before the work, not after it.
        probe = self._folder / '.probe'
        write_whole(probe, b' ' * 4096)
        probe.unlink()

    def _path(self, source: Source) -> Path:
        text = json.dumps([str(source.path), source.size, source.stamp, self._options])
        return self._folder / (hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
                               + '.json')

    def load(self, source: Source) -> dict[str, Any] | None:
        """Return the result of a recording; None when there is none."""
        try:
            with open_regular(self._path(source)) as file:
                found = json.loads(file.read(_MOST + 1)[:_MOST])
        except (OSError, ValueError, RecursionError):
            # Not there, cut off by a loss of power, or none of ours: it is computed again.
            return None
        return found if isinstance(found, dict) and found.get('error') == '' else None

    def save(self, source: Source, result: Mapping[str, Any]) -> None:
        """Keep the result of a recording."""
        write_whole(self._path(source), json.dumps(result).encode())


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    draft = path.with_name(path.name + '.draft')
    try:
        # What is there may be a FIFO, which would wait for its reader, or a link to elsewhere.
        draft.unlink(missing_ok=True)
        draft.write_bytes(content)
        os.replace(draft, path)
    except OSError as error:
        try:
            draft.unlink(missing_ok=True)
        except OSError:
            # The folder itself refuses, which is what the error below reports.
            pass
        raise InputError(f"cannot write '{path}': {_why(error)}") from error


def _why(error: OSError) -> str:
    return error.strerror or str(error)
