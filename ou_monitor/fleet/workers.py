"""
Run tasks in this process, on Dask workers of this machine, or on those of a given scheduler.

Local workers listen on the loopback, to TLS with the key of this run only; no other user can read
it.  Only this module imports Dask.

Limits: a worker that dies loses its tasks.  Other workers may have used up the memory for which it
was killed, so its task is tried once more, alone, before it fails.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, ExitStack, suppress
from functools import partial
import ipaddress
import logging
from multiprocessing import resource_tracker
import os
import resource
import signal
import subprocess
from tempfile import TemporaryDirectory
import time
from typing import Any
from urllib.parse import urlsplit

from ou_monitor.errors import InputError
from ou_monitor.recordings.mcap_file import usable_memory

# Several processes with several threads of linear algebra each are slower than with one thread.
_ONE_THREAD = dict.fromkeys(
    ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS'), '1')
# Dask's settings for local workers.  `Workers` repeats lost tasks; Dask's web server has no
# authentication, so it serves no pages; the environment that Dask would set lets malloc return all
# memory at once, which takes 60 % more CPU time.
_LOCAL = {'distributed.scheduler.allowed-failures': 0, 'distributed.scheduler.http.routes': [],
          'distributed.worker.http.routes': [], 'distributed.nanny.pre-spawn-environ': {}}
# Writes a key and its certificate to a pipe.  Dask's own function needs the package cryptography.
_NEW_KEY = ('openssl', 'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:P-256',
            '-nodes', '-days', '365', '-subj', '/CN=ou_monitor', '-keyout', '/dev/stdout')
# Share of the memory that all workers together may use, and the minimum for one, bytes.
_MEMORY_SHARE, _MEMORY_LEAST = 0.9, 1 << 29
# Timeout for a scheduler and for a worker, s.
_PATIENCE = 30.0
# Timeout for closing the local scheduler, s.
_CLOSING = 5.0
# Period of checking whether workers are left, s.
_LOOK = 1.0
LOST = ('The worker died on this recording, also in a second attempt on its own: it was killed, '
        'or the recording does not fit into memory.')
_RESUME = 'finished recordings are kept, and the same command resumes'
# Index of a task in the list of arguments, its result, and its error.
Outcome = tuple[int, Any, str]
# Calls a function for each tuple of arguments, and yields the outcomes.
Each = Callable[[Callable[..., Any], Sequence[tuple[Any, ...]]], Iterator[Outcome]]


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
        os.cpu_count() or 1)


@contextmanager
def local_workers(count: int) -> Iterator[Each]:
    """Start workers on this machine, each with a share of the memory; one is this process."""
    memory = max(int(_MEMORY_SHARE * usable_memory()) // count, _MEMORY_LEAST)
    with ExitStack() as stack:
        each = _here if count == 1 else Workers(_start(count, stack), 1).each
        yield lambda function, arguments: each(partial(_with_memory, memory, function), arguments)


def _start(count: int, stack: ExitStack) -> Any:
    """Start local workers, which end with the stack; return their client."""
    import dask
    from distributed import Client, LocalCluster

    _quiet()
    security = _security()
    folder = stack.enter_context(TemporaryDirectory(
        prefix='ou_monitor_', ignore_cleanup_errors=True))
    # Dask imports NumPy before a task could set them.
    os.environ.update(_ONE_THREAD)
    # Workers inherit that Ctrl-C is blocked: a terminal sends it to them too, and their tracebacks
    # would hide the message of this process.  Starting the tracker later would unblock it.
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        stack.enter_context(dask.config.set({**_LOCAL, 'temporary-directory': folder}))
        cluster = LocalCluster(
            n_workers=count, threads_per_worker=1, memory_limit=None, security=security,
            death_timeout=_PATIENCE, silence_logs=logging.CRITICAL, dashboard_address=None,
            scheduler_kwargs={'dashboard_address': '127.0.0.1:0'})
        stack.callback(_end, cluster)
    except Exception as error:
        # Dask raises errors of many types.
        raise InputError(f'--workers: the local workers do not start ({type(error).__name__}: '
                         f'{error}); use --workers 1') from error
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    return stack.enter_context(Client(cluster))


def _end(cluster: Any) -> None:
    """End the workers at once; Dask would wait for their tasks."""
    for nanny in cluster.workers.values():
        nanny.close_gracefully()
        # It may have died at this moment.
        with suppress(ProcessLookupError):
            if nanny.pid is not None:
                os.kill(nanny.pid, signal.SIGKILL)
    # Dask closes again at exit.
    cluster.shutdown_on_close = False
    # If a worker is being restarted, some versions of Dask wait for it for ever, others fail; new
    # processes end with this one.
    with suppress(AssertionError, TimeoutError):
        cluster.close(timeout=_CLOSING)


def _here(function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> Iterator[Outcome]:
    """Call a function for each tuple of arguments in this process; yield the outcomes."""
    for k, given in enumerate(arguments):
        yield k, function(*given), ''


def _with_memory(memory: int, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function while this process may have only so much memory, bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = memory if soft == resource.RLIM_INFINITY else min(memory, soft)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    try:
        return function(*arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _security() -> Any:
    """Return Dask's settings for TLS with a new key."""
    from distributed.security import Security

    try:
        made = subprocess.run(_NEW_KEY, capture_output=True, check=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        raise InputError('--workers: openssl, which makes the key of local workers, failed '
                         f'({error}); install it, or use --workers 1') from error
    return Security(require_encryption=True, tls_ca_file=made, **{
        f'tls_{role}_{what}': made
        for role in ('client', 'scheduler', 'worker') for what in ('key', 'cert')})


def check_address(address: str, insecure: bool = False) -> None:
    """Raise InputError if others can read and change the connection to a scheduler."""
    parts = urlsplit(address if '://' in address else f'tcp://{address}')
    if insecure or parts.scheme == 'tls' or _is_loopback(parts.hostname or ''):
        return
    raise InputError(
        f"--scheduler: '{address}' is not encrypted: anyone on that network can run programs "
        'on its workers and on this machine. Use tls://HOST:PORT, or --insecure on a network '
        'that nobody else can reach')


def _is_loopback(host: str) -> bool:
    try:
        return host == 'localhost' or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@contextmanager
def scheduler_workers(address: str, check: Callable[[], str], insecure: bool = False
                      ) -> Iterator[Each]:
    """
    Use the workers of a scheduler, which have this package and the recordings at the same paths.

    Dask's configuration (``distributed.comm.tls``) names the certificates for ``tls://``; `check`
    must return the same here and on every worker; `insecure` allows another machine without TLS.
    InputError: the address is not safe, no scheduler or worker answers, or the versions differ.
    """
    check_address(address, insecure)
    from distributed import Client

    _quiet()
    try:
        connected = Client(address, timeout=_PATIENCE)
    # Dask raises a TypeError if there is no certificate.
    except (OSError, TypeError, ValueError) as error:
        raise InputError(f"--scheduler: no scheduler answers at '{address}' "
                         f"({str(error).splitlines()[0] if str(error) else 'time-out'}); "
                         "start one by 'dask scheduler'; doc/security.md explains certificates"
                         ) from error
    with connected as client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise InputError(f"--scheduler: '{address}' has no worker; start one by "
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
        # Two tasks a thread, so that no worker idles between tasks.
        yield Workers(client, 2).each


class Workers:
    """The workers of a Dask scheduler, each thread with at most `depth` tasks."""

    def __init__(self, client: Any, depth: int) -> None:
        self._client, self._depth = client, depth

    def each(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]
             ) -> Iterator[Outcome]:
        """Call a function for each tuple of arguments; yield the outcomes."""
        waiting = deque(range(len(arguments)))
        alone: deque[int] = deque()
        retried: set[int] = set()
        running: dict[Any, int] = {}

        def start(k: int) -> None:
            running[self._client.submit(function, *arguments[k], pure=False)] = k

        while waiting or alone or running:
            while waiting and len(running) < self._room():
                start(waiting.popleft())
            if not running:
                start(alone.popleft())
            for future in self._wait(list(running)):
                k = running.pop(future)
                result, why = self._outcome(future)
                # Otherwise Dask repeats the task if its worker dies later.
                future.release()
                if why == LOST and k not in retried:
                    retried.add(k)
                    alone.append(k)
                else:
                    yield k, result, why

    def _room(self) -> int:
        """Return the maximum number of running tasks."""
        return self._depth * max(1, sum(int(n) for n in self._client.nthreads().values()))

    def _wait(self, futures: Sequence[Any]) -> list[Any]:
        """Wait until a future is done; return all finished ones."""
        from distributed import wait

        alone_since = time.monotonic()
        while True:
            try:
                wait(list(futures), timeout=_LOOK, return_when='FIRST_COMPLETED')
            except TimeoutError:
                if self._client.status != 'running':
                    raise InputError(f'the connection to the scheduler is lost; {_RESUME}'
                                     ) from None
                if self._client.nthreads():
                    alone_since = time.monotonic()
                elif time.monotonic() - alone_since > _PATIENCE:
                    raise InputError(f'no worker is left; {_RESUME}') from None
                continue
            if any(future.status == 'cancelled' for future in futures):
                raise InputError(f'the scheduler has cancelled the work; {_RESUME}')
            found = [future for future in futures if future.status in ('finished', 'error')]
            if found:
                return found
            # The scheduler is repeating the work of a worker that died.
            time.sleep(0.05)

    def _outcome(self, future: Any) -> tuple[Any, str]:
        """Return the result of a finished future, or its error."""
        from distributed import KilledWorker

        try:
            return future.result(timeout=_PATIENCE), ''
        except (KilledWorker, TimeoutError):
            return None, LOST
        except Exception as error:
            # The function catches its own errors: this one is of the transport.
            why = f'The worker failed ({type(error).__name__}: {error}).'
            return None, ' '.join(why.split())


def _quiet() -> None:
    """Silence Dask's messages about workers: the table reports failures."""
    for name in ('distributed', 'distributed.core', 'distributed.client', 'distributed.batched',
                 'tornado', 'asyncio'):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
