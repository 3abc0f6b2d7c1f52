"""A real Dask scheduler, with TLS and without certificates."""

from collections.abc import Iterator
import gc
from pathlib import Path
import shutil
import subprocess
import threading
import time

from dask import config
from distributed import Client, LocalCluster
from distributed.comm.core import CommClosedError
from distributed.security import Security
from ou_monitor.errors import InputError
from ou_monitor.fleet.workers import ClusterWorkers
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
    assert scheduler.startswith('tls://')
    with config.set({f'distributed.comm.tls.{name}': value
                     for name, value in certificate.items()}), \
            ClusterWorkers(scheduler, version) as pool:
        found = {k: (result, why) for k, result, why in pool.each(twice, [(1,), (3,), (5,)])}
    assert found == {0: (2, ''), 2: (10, ''),
                     1: (None, 'The worker failed (ValueError: three).')}


def test_no_certificate_is_one_line(scheduler):
    """Who has none gets no connection, and reads where it is described."""
    with pytest.raises(InputError, match='--scheduler: no scheduler answers.*doc/security.md'):
        ClusterWorkers(scheduler, version)
    # If the collector closed the failed client while Dask starts a loop, Dask would wait for ever.
    gc.collect()


@pytest.mark.filterwarnings('ignore')
@pytest.mark.parametrize('asked', [False, True])
def test_a_lost_scheduler_is_one_line(monkeypatch, asked):
    """It goes away while a task runs, or while it is asked; Dask's own messages are no fault."""
    begin, nthreads = time.monotonic(), Client.nthreads

    def reset(client):
        if time.monotonic() > begin + 1.0:
            raise CommClosedError('reset by peer')
        return nthreads(client)

    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False,
                      protocol='tcp://', dashboard_address=None) as cluster, \
            ClusterWorkers(cluster.scheduler_address, version) as pool:
        begin = time.monotonic()
        if asked:
            monkeypatch.setattr(Client, 'nthreads', reset)
        threading.Timer(1.0 + asked, cluster.close).start()
        with pytest.raises(InputError, match='same command resumes'):
            list(pool.each(time.sleep, [(3.0,), (3.0,)]))
