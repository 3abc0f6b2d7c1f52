"""
Work on many processes of this machine, over pipes: no port, no socket, nothing to connect to.

Limits: a worker that dies takes with it what it was given.  It may have been
killed for the memory that others used, so a recording is tried a second time
alone, when nothing else runs, before it counts as deadly.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
import multiprocessing
from multiprocessing.connection import Connection
import os
import resource
import signal
import threading
from typing import Any

from ou_monitor.recordings.mcap_file import usable_memory

# Several processes with several threads of linear algebra each are slower than with one.
_ONE_THREAD = dict.fromkeys(
    ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS'), '1')
# Share of the memory that all workers together may fill, and the least that one needs, byte.
_MEMORY_SHARE, _MEMORY_LEAST = 0.9, 1 << 29
LOST = ('The worker died while it did this recording, also in a second try alone: it was killed, '
        'or the recording does not fit into memory.')
# Place of a task in the list of arguments, its result, and why there is none.
Outcome = tuple[int, Any, str]


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
        os.cpu_count() or 1)


class Workers(ABC):
    """Processes that call a function; a context manager."""

    @abstractmethod
    def _room(self) -> int:
        """Return how many tasks may be under way."""

    @abstractmethod
    def _submit(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        """Start a call; return its future."""

    @abstractmethod
    def _wait(self, futures: Sequence[Any]) -> list[Any]:
        """Wait until a future is done; return all that are."""

    @abstractmethod
    def _outcome(self, future: Any) -> tuple[Any, str]:
        """Return the result of a future that is done, or why there is none."""

    @abstractmethod
    def close(self) -> None:
        """End what is under way, and let go of the workers."""

    def each(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]
             ) -> Iterator[Outcome]:
        """Call a function for each tuple of arguments; yield the outcomes."""
        waiting = deque(range(len(arguments)))
        alone: deque[int] = deque()
        retried: set[int] = set()
        running: dict[Any, int] = {}

        def start(k: int) -> None:
            running[self._submit(function, arguments[k])] = k

        while waiting or alone or running:
            while waiting and len(running) < self._room():
                start(waiting.popleft())
            if not running:
                start(alone.popleft())
            for future in self._wait(list(running)):
                k = running.pop(future)
                result, why = self._outcome(future)
                if why == LOST and k not in retried:
                    retried.add(k)
                    alone.append(k)
                else:
                    yield k, result, why

    def __enter__(self) -> Workers:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End what is under way."""
        self.close()


class LocalWorkers(Workers):
    """Processes of this machine, each with a share of the memory."""

    def __init__(self, count: int) -> None:
        # The workers hold the reading end: they end when the other one closes, also by our death.
        self._watched, self._alive = multiprocessing.get_context('spawn').Pipe(duplex=False)
        self._memory = max(int(_MEMORY_SHARE * usable_memory()) // count, _MEMORY_LEAST)
        # A pool of one for each: when a pool breaks, it is clear by whom, and the others go on.
        self._pools: list[ProcessPoolExecutor | None] = [None] * count
        self._at: dict[Future[Any], int] = {}

    def _room(self) -> int:
        return len(self._pools)

    def _submit(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Future[Any]:
        k = min(set(range(len(self._pools))) - set(self._at.values()))
        pool = self._pools[k]
        if pool is not None:
            future = pool.submit(function, *arguments)
        else:
            # Spawned, not forked: there are threads here.  The first task starts the process.
            pool = self._pools[k] = ProcessPoolExecutor(
                1, multiprocessing.get_context('spawn'), _prepare, (self._watched, self._memory))
            with _environment_of_workers():
                future = pool.submit(function, *arguments)
        self._at[future] = k
        return future

    def _wait(self, futures: Sequence[Future[Any]]) -> list[Future[Any]]:
        return list(wait(futures, return_when=FIRST_COMPLETED).done)

    def _outcome(self, future: Future[Any]) -> tuple[Any, str]:
        k = self._at.pop(future)
        try:
            return future.result(), ''
        except BrokenProcessPool:
            pool, self._pools[k] = self._pools[k], None
            if pool is not None:
                pool.shutdown()
            return None, LOST
        except Exception as error:
            # The function itself raises nothing, so it is the way to or from the worker.
            return None, failure(error)

    def close(self) -> None:
        """End the workers at once."""
        self._alive.close()
        for pool in self._pools:
            if pool is not None:
                pool.shutdown(cancel_futures=True)
        self._watched.close()


def failure(error: Exception) -> str:
    """Return the line for an error on the way to or from a worker."""
    return ' '.join(f'The worker failed ({type(error).__name__}: {error}).'.split())


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """
    Let a process that starts now have one thread, and hear no Ctrl-C from its first instruction.

    A terminal sends Ctrl-C to the whole group; the main process ends its
    workers itself, and their words about it would only hide its own.
    """
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)
    # A child inherits the mask; here Ctrl-C waits until the process has started.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _prepare(watched: Connection, memory: int) -> None:
    """Bound the memory of this worker (byte), and end it with the main process."""
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    if hard == resource.RLIM_INFINITY or memory < hard:
        resource.setrlimit(resource.RLIMIT_DATA, (memory, hard))

    def end_with_parent() -> None:
        with suppress(EOFError, OSError):
            watched.recv_bytes()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
