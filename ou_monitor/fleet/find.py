"""
Find recordings: files, bags, and both in folders.

Limits: links to folders are not followed, and hidden folders are skipped.  A FIFO, a device or a
broken link with the name of a recording counts as an unreadable recording.  Two recordings are
duplicates if all bytes of their data are equal; a recompressed copy is not a duplicate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import hashlib
import os
from pathlib import Path
import stat

from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import FILE, is_part
from ou_monitor.recordings.importers.csv_table import holds_supply
from ou_monitor.recordings.importers.formats import is_log
from ou_monitor.stream.files import open_regular
from ou_monitor.text import printable

# Endings of autopilot logs; the first bytes decide whether a file is one.
_LOGS = ('', '.ulg', '.bin', '.log', '.bbl', '.bfl', '.txt', '.db3')
# Endings shared by other files, which are skipped without a note.
_COMMON = ('', '.log', '.txt')
_BLOCK = 1 << 20  # Bytes read at once for the digest
# Maximum depth of the folders searched.
_MOST_DEPTH = 50


@dataclass(frozen=True)
class FoundRecording:
    """One recording on disk."""

    path: Path  # File, or folder of a bag; absolute, links resolved
    files: tuple[Path, ...]  # Its data files, in order of name
    size: int  # Bytes of data
    stamp: tuple[int, ...]  # Time of the last change, ns, and size of each file, metadata included


@dataclass(frozen=True)
class SearchResult:
    """The result of a search."""

    sources: tuple[FoundRecording, ...]  # In order of path, each once
    notes: tuple[str, ...]  # What was skipped, one sentence each


def find_recordings(given: Sequence[str], leave_out: Path | None = None) -> SearchResult:
    """Return the recordings at some paths."""
    search = _Search(None if leave_out is None else leave_out.resolve())
    for text in given:
        if not text:
            raise InputError('RECORDING: the path is empty')
        path = Path(text)
        if not path.exists():
            raise InputError(f"there is no recording or folder '{text}': check the path")
        if leave_out is not None and path.resolve() == leave_out.resolve():
            raise InputError(f"--output is the folder of the recordings, '{text}': name another")
        if path.is_dir() and not _is_bag(path):
            search.walk(path)
        else:
            search.add(path)
    notes = search.notes()
    if not search.paths:
        where = ', '.join(f"'{text}'" for text in given)
        raise InputError(f'no recording in {where}: expected .mcap files, rosbag2 folders, logs '
                         'of autopilots, or .csv files with columns of time and voltage'
                         + (f' ({" ".join(notes)})' if notes else ''))
    return SearchResult(tuple(_source(path) for path in sorted(search.paths)),
                        tuple(map(printable, notes)))


class _Search:
    """Collects recordings and skipped paths."""

    def __init__(self, leave_out: Path | None) -> None:
        self.paths: set[Path] = set()
        self._leave_out = leave_out
        self._csv: list[Path] = []
        self._logs: list[Path] = []
        self._closed: list[str] = []

    def add(self, path: Path) -> None:
        path = path.parent if path.name == FILE else path
        real = Path(os.path.realpath(path))
        # A broken or circular link keeps its own name.
        self.paths.add(real if os.path.exists(real) else
                       Path(os.path.realpath(path.parent)) / path.name)

    def walk(self, root: Path) -> None:
        """Search a folder; a bag in it is one recording."""
        def closed(error: OSError) -> None:
            self._closed.append(f"'{error.filename}' ({error.strerror})")

        for folder, inner, names in _walk(root, closed):
            here = Path(folder)
            if self._leave_out is not None and here.resolve() == self._leave_out:
                inner.clear()
                continue
            if here != root and _is_bag(here):
                self.add(here)
                inner.clear()
                continue
            inner[:] = sorted(name for name in inner if not name.startswith('.'))
            for name in sorted(names):
                self._file(here / name)

    def _file(self, path: Path) -> None:
        kind = path.suffix.lower()
        if kind == '.mcap':
            self.add(path)
        elif kind == '.csv':
            if _has_columns(path):
                self.add(path)
            else:
                self._csv.append(path)
        elif kind in _LOGS:
            if is_log(path):
                self.add(path)
            elif kind not in _COMMON:
                self._logs.append(path)

    def notes(self) -> list[str]:
        """Return what was skipped, one sentence per kind."""
        found = []
        if self._csv:
            found.append(_skipped(self._csv, '.csv file', 'without columns of time and voltage'))
        if self._logs:
            found.append(_skipped(self._logs, 'file', 'with the ending of a log, but in no known '
                                  'format'))
        found += [f'The folder {text} cannot be searched.' for text in self._closed]
        return found


def _walk(root: Path, onerror: Callable[[OSError], None] | None = None,
          ) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yield as os.walk does, to a limited depth, because os.walk recurses into each folder."""
    for folder, inner, names in os.walk(root, onerror=onerror):
        if folder.count(os.sep) - str(root).count(os.sep) >= _MOST_DEPTH and inner:
            inner.clear()
            if onerror is not None:
                onerror(OSError(0, f'its content is more than {_MOST_DEPTH} folders deep', folder))
        yield folder, inner, names


def _skipped(paths: Sequence[Path], what: str, why: str) -> str:
    many = '' if len(paths) == 1 else 's'
    return f"{len(paths)} {what}{many} skipped, such as '{paths[0]}': {why}."


def _is_bag(folder: Path) -> bool:
    """Return whether a folder is one bag: it has metadata, or is a truncated bag."""
    try:
        if (folder / FILE).is_file():
            return True
        parts = list(folder.glob('*.mcap'))
    except OSError:
        return False
    # rosbag2 names the files after the folder, and writes the metadata last.
    return bool(parts) and all(is_part(part, folder) for part in parts)


def _has_columns(path: Path) -> bool:
    """Return whether the first lines of a file have columns of time and voltage."""
    try:
        open_regular(path).close()
    except OSError:
        # Accept it by its name; the reader reports the error.
        return True
    return holds_supply(path)


def _source(path: Path) -> FoundRecording:
    files = [path]
    if os.path.isdir(path):
        files = sorted(Path(folder) / name for folder, _, names in _walk(path) for name in names)
    size, stamps = 0, []
    for file in list(files):
        try:
            found = file.stat()
        except OSError:
            # Deleted, a broken link, or unreadable: the reader reports it.
            files.remove(file)
            continue
        if not stat.S_ISREG(found.st_mode):
            files.remove(file)
            continue
        size += 0 if file.name == FILE else found.st_size
        stamps += [found.st_mtime_ns, found.st_size]
    data = tuple(file for file in files if file.name != FILE)
    return FoundRecording(path, data, size, tuple(stamps))


def duplicates(sources: Sequence[FoundRecording],
               progress: Callable[[float], None] | None = None) -> dict[Path, Path]:
    """Return each duplicate with its original, the oldest of the equal ones (progress 0..1)."""
    sizes: dict[int, list[FoundRecording]] = {}
    for source in sources:
        if source.size:
            sizes.setdefault(source.size, []).append(source)
    alike = [source for group in sizes.values() if len(group) > 1 for source in group]
    total = sum(source.size for source in alike)
    done = 0
    first: dict[bytes, Path] = {}
    found: dict[Path, Path] = {}
    for source in sorted(alike, key=lambda s: (max(s.stamp[::2], default=0), str(s.path))):
        digest = _digest(source)
        done += source.size
        if progress is not None:
            progress(done / total)
        if digest is None:
            continue
        if digest in first:
            found[source.path] = first[digest]
        else:
            first[digest] = source.path
    return found


def _digest(source: FoundRecording) -> bytes | None:
    """Return a hash of the data; None if unreadable (the reader reports it)."""
    digest = hashlib.blake2b()
    try:
        for path in source.files:
            with open_regular(path) as file:
                while block := file.read(_BLOCK):
                    digest.update(block)
    except OSError:
        return None
    return digest.digest()
