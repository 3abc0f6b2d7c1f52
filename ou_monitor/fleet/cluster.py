"""Work on the workers of a Dask scheduler: the only module that imports Dask."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
import ipaddress
import logging
import time
from typing import Any
from urllib.parse import urlsplit

from ou_monitor.errors import InputError
from ou_monitor.fleet.workers import failure, LOST, Workers

# How long is waited for a scheduler or for a worker, s.
_PATIENCE = 30.0
# How often a wait looks whether there are workers left, s.
_LOOK = 1.0


def check_address(address: str, insecure: bool = False) -> None:
    """Refuse a scheduler whose connection others can read and change."""
    parts = urlsplit(address if '://' in address else f'tcp://{address}')
    if insecure or parts.scheme == 'tls' or _is_loopback(parts.hostname or ''):
        return
    raise InputError(
        f"--scheduler: '{address}' is not encrypted: whoever is on that network can run programs "
        'on its workers and on this machine. Use tls://HOST:PORT, or --insecure where nobody else '
        'can reach it')


def _is_loopback(host: str) -> bool:
    try:
        return host == 'localhost' or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class ClusterWorkers(Workers):
    """
    The workers of a Dask scheduler, which have this package and the recordings at the same paths.

    Certificates of ``tls://`` are those of Dask's configuration (``distributed.comm.tls``); what
    `check` returns must be the same here and on every worker; `insecure` lets an address of
    another machine be without TLS.  InputError: the address is not safe, no scheduler or no
    worker answers, or the workers have another version.
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
        from distributed import Client

        _quiet()
        try:
            client = self._stack.enter_context(Client(address, timeout=_PATIENCE))
        # Dask raises a TypeError where there is no certificate.
        except (OSError, TypeError, ValueError) as error:
            raise InputError(f"--scheduler: no scheduler answers at '{address}' "
                             f"({str(error).splitlines()[0] if str(error) else 'time-out'}); "
                             "'dask scheduler' starts one; doc/security.md has its certificates"
                             ) from error
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise InputError(f"--scheduler: '{address}' has no worker; 'dask worker {address}' "
                             'starts one') from error
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
        # One beside that in work, so that no worker waits for the next; what is lost with a worker
        # before it was begun is tried again too.
        return 2 * max(1, sum(int(count) for count in self._client.nthreads().values()))

    def _submit(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        return self._client.submit(function, *arguments, pure=False)

    def _wait(self, futures: Sequence[Any]) -> list[Any]:
        from distributed import wait

        alone_since = time.monotonic()
        while True:
            try:
                wait(list(futures), timeout=_LOOK, return_when='FIRST_COMPLETED')
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
            if any(future.status == 'cancelled' for future in futures):
                raise InputError('the scheduler has dropped the work; what is done is kept, the '
                                 'same command goes on from there')
            found = [future for future in futures if future.status in ('finished', 'error')]
            if found:
                return found
            # What was done on a worker that died is being done again.
            time.sleep(0.05)

    def _outcome(self, future: Any) -> tuple[Any, str]:
        from distributed import KilledWorker

        try:
            return future.result(timeout=_PATIENCE), ''
        except (KilledWorker, TimeoutError):
            return None, LOST
        except Exception as error:
            # The function itself raises nothing, so it is the way to or from the worker.
            return None, failure(error)

    def close(self) -> None:
        """Let go of the workers."""
        self._stack.close()


def _quiet() -> None:
    """Keep Dask's own words about workers off the terminal: what matters is in the table."""
    for name in ('distributed', 'distributed.core', 'distributed.client', 'distributed.batched',
                 'tornado', 'asyncio'):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
