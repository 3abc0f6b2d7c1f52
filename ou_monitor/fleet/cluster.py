"""
Work on many processes: the only module that imports Dask.

Limits: a worker that dies takes with it what it was given, and nobody can
tell which of that was to blame.  So what was lost is tried a second time
alone, when nothing else runs: two deaths are the least that it takes to call
a recording deadly.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
import logging
import os
import time
from types import TracebackType
from typing import Any

from ou_monitor.errors import InputError

# How long is waited for a scheduler or for a worker, s.
_PATIENCE = 30.0
# How often a wait looks whether there are workers left, s.
_LOOK = 1.0
# A worker of several processes with several threads each would be slower than one.
_ONE_THREAD = dict.fromkeys(
    ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS'), '1')
_PRELOAD = 'ou_monitor.fleet.ctrl_c'
LOST = ('The worker died while it did this recording, also in a second try alone: it was killed, '
        'or the recording does not fit into memory.')


def check_extra() -> None:
    """Refuse to start without the packages of the extra `fleet`."""
    from importlib.util import find_spec

    missing = [name for name in ('dask', 'distributed', 'pyarrow') if find_spec(name) is None]
    if missing:
        raise InputError(f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} not "
                         "installed: pip install 'ou_monitor[fleet]'")


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
        os.cpu_count() or 1)


class Workers:
    """
    Local processes, or those of a cluster; a context manager.

    Parameters
    ----------
    count : int
        Local processes; not used with a scheduler.
    scheduler : str, optional
        Address of a Dask scheduler, whose workers see the recordings under the
        same paths and have this package.
    check : callable, optional
        Of no arguments; what it returns must be the same here and on every
        worker of a cluster.

    Raises
    ------
    InputError
        When no scheduler or no worker answers, or the workers have another
        version.

    """

    def __init__(self, count: int, scheduler: str | None = None,
                 check: Callable[[], str] | None = None) -> None:
        self._stack = ExitStack()
        self._scheduler = scheduler
        self._count = count
        try:
            self._client = self._local() if scheduler is None else self._remote(scheduler, check)
        except BaseException:
            self._stack.close()
            raise

    def _local(self) -> Any:
        import dask
        from distributed import Client, LocalCluster

        # The second try is ours, and alone: see `each`.
        with dask.config.set({'distributed.scheduler.allowed-failures': 0}):
            cluster = self._stack.enter_context(LocalCluster(
                n_workers=self._count, threads_per_worker=1, processes=True,
                dashboard_address='127.0.0.1:0', silence_logs=logging.CRITICAL, env=_ONE_THREAD,
                preload=[_PRELOAD]))
        _quiet()
        return self._stack.enter_context(Client(cluster))

    def _remote(self, address: str, check: Callable[[], str] | None) -> Any:
        from distributed import Client

        _quiet()
        try:
            client = self._stack.enter_context(Client(address, timeout=_PATIENCE))
        except (OSError, ValueError) as error:
            raise InputError(f"--scheduler: no scheduler answers at '{address}' "
                             f"({str(error).splitlines()[0] if str(error) else 'time-out'}); "
                             "'dask scheduler' starts one, tcp://HOST:8786") from error
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise InputError(f"--scheduler: '{address}' has no worker; 'dask worker {address}' "
                             'starts one') from error
        if check is not None:
            try:
                there = set(client.run(check).values())
            except Exception as error:
                raise InputError(f"--scheduler: the workers of '{address}' cannot use ou_monitor "
                                 f'({type(error).__name__}: {error}); install it there') from error
            if there != {check()}:
                raise InputError(
                    f"--scheduler: the workers of '{address}' have ou_monitor "
                    f"{', '.join(sorted(there))}, here it is {check()}: install the same")
        return client

    def _room(self) -> int:
        """Return how many recordings may be under way."""
        # One beside that in work, so that no worker waits for the next; what is lost with a worker
        # before it was begun is tried again too.
        if self._scheduler is None:
            return 2 * self._count
        return 2 * max(1, sum(int(count) for count in self._client.nthreads().values()))

    def each(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]
             ) -> Iterator[tuple[int, Any, str]]:
        """Call a function once for each tuple of arguments, on the workers."""
        waiting = deque(range(len(arguments)))
        alone: deque[int] = deque()
        tried: set[int] = set()
        running: dict[Any, int] = {}
        while waiting or alone or running:
            for _ in range(self._room() - len(running)):
                if waiting:
                    self._start(function, arguments, waiting.popleft(), running)
            if not running:
                self._start(function, arguments, alone.popleft(), running)
            for future in self._done(running):
                k = running.pop(future)
                result, why = _outcome(future)
                if why == LOST and k not in tried:
                    tried.add(k)
                    alone.append(k)
                else:
                    yield k, result, why

    def _start(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], k: int,
               running: dict[Any, int]) -> None:
        running[self._client.submit(function, *arguments[k], pure=False)] = k

    def _done(self, running: dict[Any, int]) -> list[Any]:
        """Wait until something is done; return all that is."""
        from distributed import wait

        alone_since = time.monotonic()
        while True:
            try:
                wait(list(running), timeout=_LOOK, return_when='FIRST_COMPLETED')
            except TimeoutError:
                if self._client.status != 'running':
                    raise InputError('the connection to the scheduler is lost; what is done is '
                                     'kept, the same command goes on from there') from None
                if self._client.nthreads():
                    alone_since = time.monotonic()
                elif time.monotonic() - alone_since > _PATIENCE:
                    raise InputError('no worker is left; what is done is kept, the same command '
                                     'goes on from there') from None
                continue
            found = [future for future in running if future.status in ('finished', 'error',
                                                                       'cancelled')]
            if any(future.status == 'cancelled' for future in found):
                raise InputError('the scheduler has dropped the work; what is done is kept, the '
                                 'same command goes on from there')
            if found:
                return found
            # What was done on a worker that died is being done again.
            time.sleep(0.05)

    def __enter__(self) -> Workers:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Let go of the workers; local ones end."""
        self._stack.close()


def _outcome(future: Any) -> tuple[Any, str]:
    """Return the result of what is done, or why there is none."""
    from distributed import KilledWorker

    try:
        return future.result(timeout=_PATIENCE), ''
    except (KilledWorker, TimeoutError):
        return None, LOST
    except Exception as error:
        # The function itself raises nothing, so it is the way to or from the worker.
        return None, ' '.join(f'The worker failed ({type(error).__name__}: {error}).'.split())


def _quiet() -> None:
    """Keep Dask's own words about workers off the terminal: what matters is in the table."""
    for name in ('distributed', 'distributed.nanny', 'distributed.scheduler', 'distributed.core',
                 'distributed.client', 'distributed.batched', 'distributed.worker', 'tornado',
                 'asyncio'):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
