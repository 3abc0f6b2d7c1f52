"""
The files of a node: the model file, and the latch file, which keeps a latched flag over a restart.

A model file is replaced only if it is a regular file and still has the bytes that were read.  The
latch is a small file with one JSON object: node, level (OK or CRITICAL), reason and time.  While
the node runs, it holds a lock on the inode of this file.  An existing latch file is replaced only
if it is a regular file that names this node.  This module does not import ROS.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, TimeoutError as NotReadyError
from contextlib import contextmanager
from dataclasses import replace
import fcntl
from itertools import takewhile
import json
import os
from pathlib import Path
import stat
import tempfile
import time
from typing import Any, TYPE_CHECKING, TypeVar

from ou_monitor.errors import InputError
from ou_monitor.stream.files import open_regular, path_words

if TYPE_CHECKING:
    from ou_monitor.model.load import LoadStart
    from ou_monitor.model.supply import SupplyModel
    from ou_monitor.recordings.model_file import ModelFile

T = TypeVar('T')

# Timeout of reading or writing a file, s: most files take 10 ms, the largest allowed take 5 s.
PATIENCE = 20.0
# Period at which `meanwhile` is called while a file is read or written, s.
PAUSE = 0.02
# Maximum number of flights in the history of a model file; maximum size of the file, bytes.
_HISTORY, _LARGEST = 200, 2_000_000


class ModelChoice:
    """The model in use, from the parameter `model_file`; a thread reads and writes files."""

    def __init__(self) -> None:
        self._used: _Chosen = '', None, b''
        self._checked: _Chosen = '', None, b''
        self._reader = ThreadPoolExecutor(1, 'model_file')

    def check(self, path: str, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Read a model file that is not yet in use; raise `ValueError` if it is unusable."""
        if not path or path == self._used[0]:
            self._checked = self._used if path else ('', None, b'')
            return
        try:
            self._checked = path, *self._wait(self._reader.submit(_read, path), meanwhile)
        except NotReadyError as error:
            raise ValueError(f'model_file: {path_words(path)} was not read within '
                             f'{PATIENCE:g} s') from error
        except InputError as error:
            raise ValueError(f'model_file: {error}') from error

    def _wait(self, future: Future[T], meanwhile: Callable[[], object]) -> T:
        """Return the result, calling `meanwhile` every `PAUSE`; NotReadyError after `PATIENCE`."""
        until = time.monotonic() + PATIENCE
        while True:
            try:
                return future.result(PAUSE)
            except NotReadyError:
                if time.monotonic() > until:
                    future.cancel()
                    raise
                meanwhile()

    def use(self, path: str) -> SupplyModel | None:
        """Use the file of a path, which must be the one checked last; return its model."""
        if path != self._used[0]:
            if path != self._checked[0]:
                raise ValueError(f'model_file {path} has not been checked')
            self._used = self._checked
        return None if self._used[1] is None else self._used[1].model

    @property
    def terms(self) -> str:
        """Return the names of the terms in use, separated by commas; empty without a model."""
        file = self._used[1]
        return '' if file is None else ','.join(term.NAME for term in file.model.terms)

    def save(self, load: LoadStart, entry: Mapping[str, object],
             meanwhile: Callable[[], object] = lambda: None) -> str:
        """Write a learned load, and an entry of the history, into the file; return its path."""
        path, file, known = self._used
        if file is None:
            raise InputError('There is no model_file in use.')
        past = file.provenance.get('history')
        history = [*(past if isinstance(past, list) else []), dict(entry)][-_HISTORY:]
        file = replace(file, model=replace(file.model, load=load, date=str(entry['date'])),
                       provenance={**file.provenance, 'date': entry['date'], 'history': history})
        try:
            written = self._wait(self._reader.submit(_save, path, file, known), meanwhile)
        except (OSError, ValueError) as error:
            raise InputError(f'model_file {path_words(path)} was not changed: '
                             f'{_words(error)}.') from error
        except NotReadyError as error:
            raise InputError(f'model_file {path_words(path)} was not written within '
                             f'{PATIENCE:g} s.') from error
        self._used = path, file, written
        return path


# Path, parsed content, and bytes of the file.
_Chosen = tuple[str, 'ModelFile | None', bytes]


def _read(path: str) -> tuple[ModelFile, bytes]:
    """Return a parsed model file, and its bytes."""
    try:
        # Read the file before the slow import below (a second on a busy machine), so that errors
        # are reported at once.
        with open_regular(path) as file:
            known = file.read(_LARGEST)
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or 'it is not a path'
        raise InputError(f'cannot read the model file {path_words(path)}: {why}') from error
    from ou_monitor.recordings.model_file import read_model
    return read_model(path), known


def _save(path: str, file: ModelFile, known: bytes) -> bytes:
    """Replace a model file if its bytes are still `known`; return the new bytes."""
    from ou_monitor.recordings.model_file import as_yaml
    # Keep the comments at the top of the file.
    lines = known.decode('utf-8-sig').splitlines(keepends=True)
    head = ''.join(takewhile(lambda line: line.startswith('#'), lines))
    text = (head + as_yaml(file)).encode()
    _check_kind(path)
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    with open(handle, 'rb') as found:
        mode = stat.S_IMODE(os.fstat(handle).st_mode)
        if found.read(len(known) + 1) != known:
            raise ValueError('it has changed since it was read')
    with _draft(Path(path), text, mode) as (handle, beside):
        os.rename(beside, path)
        os.close(handle)
    return text


def _check_kind(path: str | Path) -> None:
    """Raise `ValueError` unless a path is a regular file: opening a device has side effects."""
    kind = os.lstat(path).st_mode
    if not stat.S_ISREG(kind):
        raise ValueError('it is a symbolic link' if stat.S_ISLNK(kind)
                         else 'it is not a regular file')


@contextmanager
def _draft(path: Path, text: bytes, mode: int) -> Iterator[tuple[int, str]]:
    """Write a new file in the folder of a path, sync and verify it; yield its handle and name."""
    # `mkstemp` uses O_CREAT | O_EXCL and a random name, so no other file is opened or removed.
    handle, beside = tempfile.mkstemp(prefix=f'.{path.name}.', dir=path.parent)
    try:
        os.fchmod(handle, mode)
        os.write(handle, text)
        os.fsync(handle)
        if os.pread(handle, len(text) + 1, 0) != text:
            raise ValueError('the bytes read back differ from those written')
        yield handle, beside
    except BaseException:
        os.close(handle)
        os.unlink(beside)
        raise
    # Flush the rename to the disk.
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


# Maximum size of a latch file that is read, bytes; nodes write at most 1000.
_MOST = 4096
_KEYS = {'node', 'level', 'reason', 'time'}
# Time between attempts to write the latch file, s.
RETRY = 1.0


class LatchFile:
    """Latch file of a node; if the path is a folder, a file in it that is named after the node."""

    def __init__(self, path: str | Path, node: str) -> None:
        self.path = Path(path).expanduser()
        if self.path.is_dir():
            self.path /= node.strip('/').replace('/', '_') + '.latch.json'
        # Why the file cannot be used now, one line; empty: the last request is on disk.
        self.problem = ''
        # Whether the file found at the start is unusable, and must not be changed.
        self.refused = False
        self._node = node
        # Open handle of the file, which holds the lock.
        self._lock: int | None = None
        self._wanted: dict[str, Any] = self._record(False, '')
        self._written: dict[str, Any] | None = None
        self._last_try = 0.0
        # A thread writes, because an fsync may take a second, too long for a callback.
        self._writer = ThreadPoolExecutor(1, 'latch_file')
        self._job: Future[None] | None = None

    def _record(self, latched: bool, reason: str) -> dict[str, Any]:
        return {'node': self._node, 'level': 'CRITICAL' if latched else 'OK',
                'reason': reason[:300], 'time': time.time()}

    def read(self) -> str:
        """Claim or create the file; return why and when the flag was latched, or ''."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            found = self._claim()
        except (OSError, ValueError) as error:
            self.refused = True
            self.problem = (f'state_file {self.path} is refused and was not changed: '
                            f'{_words(error)}; a latched flag will not survive a restart')
            return ''
        if found is None:
            self._write(self._wanted)
            return ''
        self._wanted = self._written = found
        if found['level'] == 'OK':
            return ''
        when = time.strftime('%Y-%m-%d %H:%M:%S UTC', time.gmtime(found['time']))
        reason = ' '.join(c for c in found['reason'].split() if c.isprintable())[:300]
        return f'latched before a restart of the node, at {when}: {reason}'

    def keep(self, latched: bool, reason: str) -> None:
        """Write whether the flag is latched; call it often, because it also retries writes."""
        if self.refused:
            return
        changed = latched != (self._wanted['level'] == 'CRITICAL')
        if changed:
            self._wanted = self._record(latched, reason)
        if self._written is not self._wanted and (self._job is None or self._job.done()) and (
                changed or time.monotonic() - self._last_try >= RETRY):
            self._last_try = time.monotonic()
            self._job = self._writer.submit(self._write, self._wanted)

    def close(self) -> None:
        """Write pending changes, and release the file."""
        if not self.refused and self._written is not self._wanted:
            self._writer.submit(self._write, self._wanted)
        self._writer.shutdown()
        self._keep_lock(None)

    def _write(self, record: dict[str, Any]) -> None:
        """Replace the file, unless an earlier job has written the same record."""
        if self._written is record:
            return
        try:
            self._replace(json.dumps(record).encode())
        except (OSError, ValueError) as error:
            self.problem = (f'state_file {self.path} cannot be written: {_words(error)}; until '
                            'it can, a latched flag will not survive a restart')
            return
        self._written, self.problem = record, ''

    def _claim(self) -> dict[str, Any] | None:
        """Lock the file and return its content; None if there is no file."""
        try:
            # Check before opening, because opening a FIFO would give it a reader.
            _check_kind(self.path)
        except FileNotFoundError:
            return None
        # Neither follow a link, nor wait for a FIFO, that has replaced the file since the check.
        handle = os.open(self.path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            found = self._parse(handle)
            mine = os.fstat(handle)
            if self._lock is None or not os.path.samestat(os.fstat(self._lock), mine):
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise ValueError('another node of this name is using it') from None
                # The file just locked may be an old one that its owner has replaced.
                if not os.path.samestat(os.lstat(self.path), mine):
                    raise ValueError('another node of this name is using it')
                self._keep_lock(handle)
                handle = -1
        finally:
            if handle >= 0:
                os.close(handle)
        return found

    def _parse(self, handle: int) -> dict[str, Any]:
        """Return the record in an open file; `ValueError` if it is not this node's."""
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise ValueError('it is not a regular file')
        text = os.read(handle, _MOST + 1)
        if len(text) > _MOST:
            raise ValueError(f'it is larger than {_MOST} bytes, so it belongs to another program')
        try:
            data = json.loads(text)
        except (ValueError, RecursionError):
            raise ValueError("it is damaged, or not this node's") from None
        if not isinstance(data, dict) or set(data) != _KEYS or (
                data['level'] not in ('OK', 'CRITICAL') or not isinstance(data['reason'], str)
                or not isinstance(data['time'], (int, float)) or not 0.0 <= data['time'] < 1e11):
            raise ValueError("it is damaged, or not this node's")
        if data['node'] != self._node:
            raise ValueError('it belongs to another node')
        return data

    def _replace(self, text: bytes) -> None:
        """Write a new file, sync, read back and lock it, and rename it over the old one."""
        exists = self._claim() is not None
        # Readable by everyone, like an ordinary file.
        with _draft(self.path, text, 0o644) as (handle, beside):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not exists:
                # Fails if a file has appeared meanwhile.  (`os.link` would fail too, but FAT has
                # no links.)
                os.close(os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
            os.rename(beside, self.path)
            self._keep_lock(handle)
        if not os.path.samestat(os.lstat(self.path), os.fstat(handle)):
            raise ValueError('another file has taken its place')

    def _keep_lock(self, handle: int | None) -> None:
        """Keep the handle that has the lock; close the previous one."""
        old, self._lock = self._lock, handle
        if old is not None:
            os.close(old)


def _words(error: Exception) -> str:
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return ' '.join(text.split())
