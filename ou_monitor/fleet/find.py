"""
Find recordings: files, bags, and folders that contain them.

Limits: links to folders are not followed, and hidden folders are skipped.  A FIFO, a device or a
broken link with the name of a recording counts as an unreadable recording.  Two recordings are
duplicates if all bytes of their data files are equal; so a recompressed copy is not a duplicate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
import hashlib
import os
from pathlib import Path
import stat

from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import FILE, is_part
from ou_monitor.recordings.importers.csv_table import holds_supply
from ou_monitor.recordings.importers.formats import BAG, CSV, kind_of
from ou_monitor.stream.files import open_regular
from ou_monitor.text import counted, printable

# Endings of autopilot logs; the first bytes decide whether a file is one.
_LOGS = ('', '.ulg', '.bin', '.log', '.bbl', '.bfl', '.txt', '.db3')
# Endings that are common elsewhere: such files are skipped without a note, unless they are logs.
_COMMON = ('', '.log', '.txt')
# Files that are noted as skipped: what they are, and why.
_CSV = '.csv file', 'without columns of time and voltage'
_LOG = 'file', 'with the ending of a log, but in no known format'
_MOST_DEPTH = 50  # Maximum depth of the folders searched


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
    left_out = None if leave_out is None else leave_out.resolve()
    paths: set[Path] = set()
    closed: list[str] = []
    # Kind of file and why it is skipped -> files.
    skipped: dict[tuple[str, str], list[Path]] = {_CSV: [], _LOG: []}
    for text in given:
        if not text:
            raise InputError('RECORDING: the path is empty')
        path = Path(text)
        if not path.exists():
            raise InputError(f"there is no recording or folder '{text}': check the path")
        if path.resolve() == left_out:
            raise InputError(f"--output is the folder of the recordings, '{text}': name another")
        if path.is_dir() and not _is_bag(path):
            for found in _candidates(path, left_out, closed):
                kind = _kind(found)
                if kind is None:
                    paths.add(_real(found))
                elif kind in skipped:
                    skipped[kind].append(found)
        else:
            paths.add(_real(path.parent if path.name == FILE else path))
    notes = [f"{counted(len(files), what)} skipped, such as '{files[0]}': {why}."
             for (what, why), files in skipped.items() if files]
    notes += [f'The folder {text} cannot be searched.' for text in closed]
    if not paths:
        where = ', '.join(f"'{text}'" for text in given)
        raise InputError(f'no recording in {where}: expected .mcap files, rosbag2 folders, logs '
                         'of autopilots, or .csv files with columns of time and voltage'
                         + (f' ({" ".join(notes)})' if notes else ''))
    return SearchResult(tuple(_source(path) for path in sorted(paths)),
                        tuple(map(printable, notes)))


def _real(path: Path) -> Path:
    """Return a path with links resolved; a broken or circular link keeps its own name."""
    real = Path(os.path.realpath(path))
    return real if os.path.exists(real) else Path(os.path.realpath(path.parent)) / path.name


def _candidates(root: Path, left_out: Path | None, closed: list[str]) -> Iterator[Path]:
    """Yield the files and bags in a folder; add the folders that cannot be read to `closed`."""
    for folder, inner, names in os.walk(root, onerror=lambda error: closed.append(
            f"'{error.filename}' ({error.strerror})")):
        here = Path(folder)
        leave = here.resolve() == left_out
        if leave or (here != root and _is_bag(here)):
            inner.clear()
            yield from () if leave else (here,)
            continue
        inner[:] = sorted(name for name in inner if not name.startswith('.'))
        if inner and len(here.parts) - len(root.parts) >= _MOST_DEPTH:
            # In Python 3.11, os.walk is recursive.
            inner.clear()
            closed.append(f"'{here}' (its content is more than {_MOST_DEPTH} folders deep)")
        yield from (here / name for name in sorted(names))


def _kind(path: Path) -> tuple[str, str] | None:
    """Return None for a recording, else what is skipped and why (empty texts: no note)."""
    kind = path.suffix.lower()
    if os.path.isdir(path) or kind == '.mcap':
        return None
    if kind == '.csv':
        return None if _has_columns(path) else _CSV
    if kind in _LOGS and kind_of(path) not in (BAG, CSV):
        return None
    return _LOG if kind in _LOGS and kind not in _COMMON else ('', '')


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
        return holds_supply(path)
    except Exception:
        # Accept it by its name; its row in the table reports the error, or a defect of the reader.
        return True


def _source(path: Path) -> FoundRecording:
    files = [path]
    if os.path.isdir(path):
        with suppress(OSError):
            files = sorted(path.iterdir())
    found: dict[Path, os.stat_result] = {}
    for file in files:
        # Deleted, a broken link, or unreadable: the reader reports it.
        with suppress(OSError):
            if stat.S_ISREG((status := file.stat()).st_mode):
                found[file] = status
    data = tuple(file for file in found if file.name != FILE)
    return FoundRecording(
        path, data, sum(found[file].st_size for file in data),
        tuple(value for one in found.values() for value in (one.st_mtime_ns, one.st_size)))


def duplicates(sources: Sequence[FoundRecording],
               progress: Callable[[float], None] | None = None) -> dict[Path, Path]:
    """Return duplicate -> original: the oldest recording with equal data (progress: 0..1)."""
    sizes = Counter(source.size for source in sources)
    alike = [source for source in sources if source.size and sizes[source.size] > 1]
    total = sum(source.size for source in alike)
    done = 0
    first: dict[tuple[bytes, ...], Path] = {}
    found: dict[Path, Path] = {}
    for source in sorted(alike, key=lambda s: (max(s.stamp[::2], default=0), str(s.path))):
        digest = _digest(source)
        done += source.size
        if progress is not None:
            progress(done / total)
        if digest in first:
            found[source.path] = first[digest]
        elif digest is not None:
            first[digest] = source.path
    return found


def _digest(source: FoundRecording) -> tuple[bytes, ...] | None:
    """Return a hash of each data file; None if unreadable (the reader reports it)."""
    found = []
    try:
        for path in source.files:
            with open_regular(path) as file:
                found.append(hashlib.file_digest(file, 'blake2b').digest())
    except OSError:
        return None
    return tuple(found)
