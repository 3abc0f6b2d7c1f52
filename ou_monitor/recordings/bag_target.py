"""The place on disk that a bag is written to, and its removal when writing fails."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
import shutil
from typing import BinaryIO

from ou_monitor.errors import InputError
from ou_monitor.recordings.rosbag2_metadata import TopicInfo, write_metadata


class BagTarget:
    """
    A new .mcap file, or a new rosbag2 directory with one in it.

    Parameters
    ----------
    path : pathlib.Path
        Ends in .mcap for a file; else a directory is made.

    Attributes
    ----------
    file : binary file
        The MCAP file, open for writing.

    Raises
    ------
    InputError
        When the target exists, its folder does not, or it cannot be written.

    """

    def __init__(self, path: Path) -> None:
        """Open the target; nothing that exists is touched."""
        self.path = path
        self._folder = None if path.suffix == '.mcap' else path
        if path.exists() or path.is_symlink():
            raise InputError(f'{path} exists already: remove it or choose another name')
        if not path.parent.is_dir():
            raise InputError(f'cannot write {path}: there is no folder {path.parent}')
        self._mcap = path
        try:
            if self._folder is not None:
                self._folder.mkdir()
                self._mcap = self._folder / f'{path.name}_0.mcap'
            self.file: BinaryIO = self._mcap.open('xb')
        except OSError as error:
            raise InputError(f'cannot write {path}: {error.strerror}') from error

    def finish(
        self, topics: Iterable[TopicInfo], hashes: dict[str, str], start_ns: int, end_ns: int,
        custom: Mapping[str, str] | None = None,
    ) -> None:
        """Close the file and, in a directory, write its metadata.yaml."""
        self.file.close()
        if self._folder is not None:
            write_metadata(self._folder, self._mcap.name, topics, hashes, start_ns, end_ns,
                           custom)

    def remove(self) -> None:
        """Take away what was written; it was made by this object and by no other."""
        # On a full disk closing fails as well: what is still in the buffer has no place.
        with suppress(OSError):
            self.file.close()
        if self._folder is not None:
            shutil.rmtree(self._folder)
        else:
            self._mcap.unlink()
