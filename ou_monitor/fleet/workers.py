"""
Run tasks in many processes: on this machine, or on the workers of a Dask scheduler.

Local processes are reached over pipes, so no port is open.  Only this module imports Dask.

Limits: if a local worker dies, the running tasks of all local workers are lost.  Any of them may
have exhausted the memory, so each is tried once more, alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, ExitStack, suppress
import ipaddress
import logging
import multiprocessing
from multiprocessing.connection import Connection
import os
from pathlib import Path
import resource
import signal
import threading
import time
from typing import Any
from urllib.parse import urlsplit

from ou_monitor.errors import InputError

# Several processes are slower with several threads of linear algebra each than with one each.
_ONE_THREAD = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1')
# Share of the memory that all workers together may use, and the minimum for one, bytes.
_MEMORY_SHARE, _MEMORY_LEAST = 0.9, 1 << 29
# Timeout for an answer of a scheduler or a worker, s.
_PATIENCE = 30.0
# Time between checks whether any worker is left, s.
_LOOK = 1.0
LOST = ('A worker died while only this recording was analysed: the worker was killed, or the '
        'recording does not fit into memory.')
_RESUME = 'finished recordings are kept, and the same command resumes'
# Index of a task in the list of arguments, its result, and its error.
Outcome = tuple[int, Any, str]


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
        os.cpu_count() or 1)


def usable_memory() -> int:
    """Return the smallest memory limit of machine, control group and process, bytes."""
    limits = [os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES')]
    for file in ('/sys/fs/cgroup/memory.max', '/sys/fs/cgroup/memory/memory.limit_in_bytes'):
        # The file may be missing, or hold the word "max".
        with suppress(OSError, ValueError):
            limits.append(int(Path(file).read_text(encoding='ascii')))
    allowed = resource.getrlimit(resource.RLIMIT_AS)[0]
    return min(limits if allowed == resource.RLIM_INFINITY else [*limits, allowed])


class Workers:
    """Processes that call a function; a context manager."""

    # Of each kind: errors of a task whose worker died; how many tasks may run; start a call, and
    # return its future; wait for one of some futures, and return those that are done.
    _deaths: tuple[type[Exception], ...]
    _room: Callable[[], int]
    _submit: Callable[[Callable[..., Any], tuple[Any, ...]], Any]
    _wait: Callable[[Sequence[Any]], list[Any]]
    close: Callable[[], None]

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
                result, why = None, ''
                try:
                    result = future.result(timeout=_PATIENCE)
                except self._deaths:
                    if k not in retried:
                        retried.add(k)
                        alone.append(k)
                        continue
                    why = LOST
                except Exception as error:
                    # The function catches its own errors, so this is an error of the transport.
                    why = ' '.join(f'The worker failed ({type(error).__name__}: {error}).'.split())
                yield k, result, why

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class LocalWorkers(Workers):
    """Processes of this machine, each with a share of the memory."""

    _deaths = (BrokenProcessPool,)

    def __init__(self, count: int) -> None:
        # Each worker waits at the reading end, and exits when this process closes the other end
        # or dies.
        self._watched, self._alive = multiprocessing.get_context('spawn').Pipe(duplex=False)
        self._memory = max(int(_MEMORY_SHARE * usable_memory()) // count, _MEMORY_LEAST)
        self._count = count
        self._pool = self._new_pool()

    def _new_pool(self) -> ProcessPoolExecutor:
        # Spawned, because forking with threads is unsafe.
        return ProcessPoolExecutor(self._count, multiprocessing.get_context('spawn'), _prepare,
                                   (self._watched, self._memory))

    def _room(self) -> int:
        return self._count

    def _submit(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Future[Any]:
        # Submitting a task may start a worker process.
        with _environment_of_workers():
            try:
                return self._pool.submit(function, *arguments)
            except BrokenProcessPool:
                self._pool.shutdown()
                self._pool = self._new_pool()
                return self._pool.submit(function, *arguments)

    def _wait(self, futures: Sequence[Future[Any]]) -> list[Future[Any]]:
        return list(wait(futures, return_when=FIRST_COMPLETED).done)

    def close(self) -> None:
        """End the workers at once."""
        self._alive.close()
        self._pool.shutdown(cancel_futures=True)
        self._watched.close()


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Start processes with one thread each and with Ctrl-C blocked."""
    # A terminal sends Ctrl-C to all processes of the group; the main process ends its workers
    # itself, and their tracebacks would hide its message.
    before = {name: os.environ[name] for name in _ONE_THREAD if name in os.environ}
    os.environ.update(_ONE_THREAD)
    # A child inherits the mask; in this process, Ctrl-C is delayed until the child has started.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        for name in _ONE_THREAD:
            del os.environ[name]
        os.environ.update(before)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _prepare(watched: Connection, memory: int) -> None:
    """Limit the memory of this worker (bytes), and make it exit when the main process ends."""
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    if hard == resource.RLIM_INFINITY or memory < hard:
        resource.setrlimit(resource.RLIMIT_DATA, (memory, hard))

    def end_with_parent() -> None:
        with suppress(EOFError, OSError):
            watched.recv_bytes()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def check_address(address: str, insecure: bool = False) -> None:
    """Raise InputError if others can read and change the connection to a scheduler."""
    parts = urlsplit(address if '://' in address else f'tcp://{address}')
    if insecure or parts.scheme == 'tls' or parts.hostname == 'localhost':
        return
    with suppress(ValueError):
        if ipaddress.ip_address(parts.hostname or '').is_loopback:
            return
    raise InputError(
        f"--scheduler: '{address}' is not encrypted: anyone on that network can run programs "
        'on its workers and on this machine. Use tls://HOST:PORT, or --insecure on a network '
        'that nobody else can reach')


class ClusterWorkers(Workers):
    """
    The workers of a Dask scheduler, which have this package and the recordings at the same paths.

    Dask's configuration (``distributed.comm.tls``) names the certificates for ``tls://``.  `check`
    must return the same text here and on every worker.  `insecure` allows another machine without
    TLS.  Raises InputError if the address is unsafe, no scheduler or worker answers, or the
    results of `check` differ.
    """

    def __init__(self, address: str, check: Callable[[], str], insecure: bool = False) -> None:
        check_address(address, insecure)
        self._stack = ExitStack()
        try:
            self._client = self._connect(address, check)
        except BaseException:
            self._stack.close()
            raise

    def _connect(self, address: str, check: Callable[[], str]) -> Any:
        from distributed import Client, KilledWorker

        self._deaths = (KilledWorker, TimeoutError)
        # Silence Dask's messages about workers: the table reports failures.
        for name in ('distributed', 'distributed.core', 'distributed.client',
                     'distributed.batched', 'tornado', 'asyncio'):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        try:
            client = self._stack.enter_context(Client(address, timeout=_PATIENCE))
        # Dask raises a TypeError if there is no certificate.
        except (OSError, TypeError, ValueError) as error:
            raise InputError(f"--scheduler: no scheduler answers at '{address}' "
                             f"({str(error).splitlines()[0] if str(error) else 'time-out'}); "
                             "start one with 'dask scheduler'; doc/security.md explains "
                             'certificates') from error
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise InputError(f"--scheduler: '{address}' has no worker; start one with "
                             f"'dask worker {address}'") from error
        try:
            there = set(client.run(check).values())
        except Exception as error:
            raise InputError(f"--scheduler: the workers of '{address}' cannot use ou_monitor "
                             f'({type(error).__name__}: {error}); install it there') from error
        if there != {check()}:
            raise InputError(
                f"--scheduler: the workers of '{address}' have ou_monitor "
                f"{', '.join(sorted(there))}, this machine has {check()}: install the same "
                'version')
        return client

    def _room(self) -> int:
        # Two tasks per thread, so that no worker is idle between tasks.
        return 2 * max(1, sum(int(count) for count in self._client.nthreads().values()))

    def _submit(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        return self._client.submit(function, *arguments, pure=False)

    def _wait(self, futures: Sequence[Any]) -> list[Any]:
        from distributed import CancelledError, wait

        alone_since = time.monotonic()
        while True:
            try:
                wait(list(futures), timeout=_LOOK, return_when='FIRST_COMPLETED')
            except TimeoutError:
                if self._client.status != 'running':
                    raise InputError(f'the connection to the scheduler is lost; {_RESUME}'
                                     ) from None
                with suppress(OSError):  # The scheduler may be lost just now.
                    if self._client.nthreads():
                        alone_since = time.monotonic()
                if time.monotonic() - alone_since > _PATIENCE:
                    raise InputError(f'no worker is left; {_RESUME}') from None
                continue
            except CancelledError as error:
                raise InputError('the scheduler was lost, or has cancelled the work; '
                                 f'{_RESUME}') from error
            found = [future for future in futures if future.status in ('finished', 'error')]
            if found:
                return found
            # No task is done: the scheduler is repeating the work of a worker that died.
            time.sleep(0.05)

    def close(self) -> None:
        """Release the workers."""
        self._stack.close()
