"""Real Dask schedulers, local and given, with TLS and without certificates."""

import asyncio
from collections.abc import Iterator
import os
from pathlib import Path
import shutil
import subprocess
import tempfile
import threading
from urllib.request import urlopen

from dask import config
from distributed import get_worker, LocalCluster
from distributed.core import connect
from distributed.security import Security
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.fleet.workers import local_workers, scheduler_workers
import psutil
import pytest

pytestmark = pytest.mark.skipif(shutil.which('openssl') is None,
                                reason='openssl makes the certificate')


def version() -> str:
    return '1.2.3'


def twice(value: int) -> int:
    """Return the double; fail for 3."""
    if value == 3:
        raise ValueError('three')
    return 2 * value


@pytest.fixture(scope='module')
def certificate(tmp_path_factory) -> dict[str, str]:
    """Return Dask's settings for a certificate that signs itself."""
    folder: Path = tmp_path_factory.mktemp('tls')
    subprocess.run(
        ['openssl', 'req', '-x509', '-newkey', 'rsa:2048', '-nodes', '-days', '2', '-subj',
         '/CN=localhost', '-keyout', folder / 'key.pem', '-out', folder / 'cert.pem'],
        check=True, capture_output=True, timeout=60)
    return {'ca-file': str(folder / 'cert.pem'), **{
        f'{role}.{what}': str(folder / f'{what}.pem')
        for role in ('client', 'scheduler', 'worker') for what in ('cert', 'key')}}


@pytest.fixture(scope='module')
def scheduler(certificate) -> Iterator[str]:
    """Yield the address of a scheduler with one worker that speaks TLS alone."""
    with config.set({f'distributed.comm.tls.{name}': value
                     for name, value in certificate.items()}):
        security = Security(require_encryption=True)
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, security=security,
                      protocol='tls://', dashboard_address=None) as cluster:
        yield cluster.scheduler_address


def test_work_is_done_over_tls(scheduler, certificate):
    """With the certificates of Dask's configuration the tasks are done, and a failure is a row."""
    assert scheduler.startswith('tls://')
    with config.set({f'distributed.comm.tls.{name}': value
                     for name, value in certificate.items()}), \
            scheduler_workers(scheduler, version) as each:
        found = {k: (result, why) for k, result, why in each(twice, [(1,), (3,), (5,)])}
    assert found == {0: (2, ''), 2: (10, ''),
                     1: (None, 'The worker failed (ValueError: three).')}


def test_no_certificate_is_one_line(scheduler):
    """Who has none gets no connection, and reads where it is described."""
    with pytest.raises(InputError, match='--scheduler: no scheduler answers.*doc/security.md'):
        scheduler_workers(scheduler, version).__enter__()


def look(_: int) -> dict:
    """Return where a worker can be reached, and its threads that are not of Python."""
    one = np.ones((800, 800))
    assert (one @ one)[0, 0] == 800.0
    worker = get_worker()
    threads = psutil.Process().num_threads() - threading.active_count()
    return {'dask': [worker.address, worker.nanny, worker.scheduler.address],
            'pid': os.getpid(), 'threads': threads}


async def greet(address: str, security: Security) -> None:
    comm = await connect(address, timeout=5, **security.get_connection_args('client'))
    await comm.close()


def test_local_workers_listen_to_this_run_alone(certificate, tmp_path, monkeypatch):
    """All ports are on the loopback; without the key of the run nothing there can be used."""
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    monkeypatch.chdir(tmp_path)
    # Two threads of linear algebra would be two here, whatever the machine has.
    monkeypatch.setenv('OPENBLAS_NUM_THREADS', '2')
    with config.set({f'distributed.comm.tls.{name}': value
                     for name, value in certificate.items()}):
        foreign = Security(require_encryption=True)
    me = psutil.Process()
    before = {one.laddr for one in me.net_connections() if one.status == 'LISTEN'}
    with local_workers(2) as each:
        seen = [result for _, result, _ in each(look, [(k,) for k in range(4)])]
        assert all(one['threads'] == 0 for one in seen)
        pids = {one['pid'] for one in seen}
        ports = {one.laddr for pid in (me.pid, *pids)
                 for one in psutil.Process(pid).net_connections() if one.status == 'LISTEN'}
        assert {at.ip for at in ports - before} == {'127.0.0.1'}
        for address in {address for one in seen for address in one['dask']}:
            assert address.startswith('tls://127.0.0.1:')
            for other in (address, address.replace('tls', 'tcp')):
                with pytest.raises(OSError):
                    asyncio.run(greet(other, foreign if other == address else Security()))
        for at in ports - before:
            for page in ('status', 'health', 'info/main/workers.html', 'json/counts.json'):
                with pytest.raises(OSError):
                    urlopen(f'http://{at.ip}:{at.port}/{page}', timeout=5)
        assert [path.name[:11] for path in tmp_path.iterdir()] == ['ou_monitor_']
    assert not any(map(psutil.pid_exists, pids)) and not list(tmp_path.iterdir())


def test_without_openssl_there_are_no_local_workers(monkeypatch):
    monkeypatch.setenv('PATH', '/nonexistent')
    with pytest.raises(InputError, match='--workers: openssl.*install it, or use --workers 1'):
        local_workers(2).__enter__()
