"""
What a recording may claim: bytes that chunks unpack to, length of definitions and metadata.

In proportion to the file and to the memory, so that a small file cannot take all of it.
"""

from __future__ import annotations

from contextlib import suppress
import os
from pathlib import Path
import resource

from ou_monitor.errors import InputError
from ou_monitor.text import printable

# A definition has some kB; a metadata record may hold the text of a metadata.yaml, which
# has at most 8 MB.
MOST_DEFINITION = 256 * 1024
MOST_METADATA = 10_000_000
# How much more than the file its chunks may unpack to.  Logs of a constant voltage come
# to 20 to 30 times, zeros alone to 30 000 times.
_MOST_RATIO = 256
_LEAST_LIMIT = 64 * 1024 * 1024
_CHUNKS_AT_ONCE = 8
_VARIABLE = 'OU_MONITOR_MAX_CHUNK_MB'


def usable_memory() -> int:
    """
    Return the memory that this process may use, byte.

    That of the machine, of its control group, or of its own limit, whatever is least.
    """
    limits = [os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES')]
    for file in ('/sys/fs/cgroup/memory.max', '/sys/fs/cgroup/memory/memory.limit_in_bytes'):
        # Not there, or the word "max".
        with suppress(OSError, ValueError):
            limits.append(int(Path(file).read_text(encoding='ascii')))
    allowed = resource.getrlimit(resource.RLIMIT_AS)[0]
    return min(limits if allowed == resource.RLIM_INFINITY else [*limits, allowed])


def chunk_limit(size: int, stated: int | None = None) -> int:
    """
    Return how many bytes a chunk of a file of `size` bytes may unpack to.

    In proportion to the file, and never more than an eighth of the memory; `stated`, or the
    environment variable OU_MONITOR_MAX_CHUNK_MB, goes before both.
    """
    if stated is not None:
        return stated
    text = os.environ.get(_VARIABLE, '')
    if text:
        try:
            return max(1, int(float(text) * 1e6))
        except (ValueError, OverflowError):
            raise InputError(f'{_VARIABLE} must be a number of MB, got '
                             f"'{printable(text, 40)}'") from None
    return min(max(_LEAST_LIMIT, _MOST_RATIO * size),
               max(_LEAST_LIMIT, usable_memory() // _CHUNKS_AT_ONCE))


def file_limit(size: int, chunk: int) -> int:
    """Return how many bytes all chunks of a file may unpack to; `chunk`: the limit of one."""
    return max(16 * chunk, _MOST_RATIO * size)


def over_limit(what: str, length: int, limit: int) -> str:
    """Return why something is not read."""
    return (f'{what} {length / 1e6:.4g} MB, and {limit / 1e6:.4g} MB is the limit: set '
            f'{_VARIABLE} if that is meant')
