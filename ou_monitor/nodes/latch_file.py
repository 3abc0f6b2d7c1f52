"""
The latched flag on disk: a brown-out that resets the companion does not clear its own latch.

One JSON object in one small file, replaced as a whole (rename after fsync).  No ROS here.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import json
import os
from pathlib import Path
import stat
import time
from typing import Any

# More than any of ours; nothing longer is read.
_MOST = 4096
_KEYS = {'node', 'level', 'reason', 'time'}


class LatchFile:
    """
    Remembers that the flag of one node is latched: in a file, or in one of a folder.

    `problem` says why the file could not be read or written, in one line.
    """

    def __init__(self, path: str | Path, node: str) -> None:
        self.path = Path(path).expanduser()
        if self.path.is_dir():
            self.path /= node.strip('/').replace('/', '_') + '.latch.json'
        self.problem = ''
        self._node = node
        self._held: bool | None = None
        # A disk may take a second for an fsync: not in a callback.
        self._writer = ThreadPoolExecutor(1, 'latch_file')

    def read(self) -> str:
        """Return why the flag was latched, and when; empty when it was not, or is not known."""
        try:
            data = self._load()
        except FileNotFoundError:
            return ''
        except (OSError, ValueError) as error:
            self.problem = f'state_file {self.path} is not used: {_words(error)}'
            return ''
        self._held = True
        when = time.strftime('%Y-%m-%d %H:%M:%S UTC', time.gmtime(data['time']))
        return f'latched before the node was started anew, at {when}: {data["reason"]}'

    def _load(self) -> dict[str, Any]:
        # Without O_NONBLOCK a FIFO would wait for its writer.
        handle = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK)
        try:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise ValueError('it is not a regular file')
            text = os.read(handle, _MOST + 1)
        finally:
            os.close(handle)
        if len(text) > _MOST:
            raise ValueError(f'it is larger than {_MOST} bytes')
        try:
            data = json.loads(text)
        except (ValueError, RecursionError):
            raise ValueError('it is damaged') from None
        if not isinstance(data, dict) or set(data) != _KEYS or data['level'] != 'CRITICAL' or (
                not isinstance(data['reason'], str) or not isinstance(data['time'], (int, float))
                or not 0.0 <= data['time'] < 1e11):
            raise ValueError('it is damaged')
        if data['node'] != self._node:
            raise ValueError('it is that of another node')
        data['reason'] = ' '.join(c for c in data['reason'].split() if c.isprintable())[:300]
        return data

    def keep(self, latched: bool, reason: str) -> None:
        """Write the file when the flag has become latched, and remove it when it no longer is."""
        if latched == self._held:
            return
        self._held = latched
        text = json.dumps({'node': self._node, 'level': 'CRITICAL', 'reason': reason[:300],
                           'time': time.time()}) if latched else ''
        self._writer.submit(self._replace, text)

    def _replace(self, text: str) -> None:
        try:
            if text:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                beside = self.path.with_name(f'.{self.path.name}.{os.getpid()}')
                with beside.open('w') as file:
                    file.write(text)
                    file.flush()
                    os.fsync(file.fileno())
                beside.replace(self.path)
            else:
                self.path.unlink(missing_ok=True)
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            self.problem = f'state_file {self.path} cannot be written: {_words(error)}'

    def close(self) -> None:
        """Wait for what is being written."""
        self._writer.shutdown()


def _words(error: Exception) -> str:
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return ' '.join(text.split())
