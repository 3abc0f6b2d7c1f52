"""Scheduling of tests: files run in parallel, but those that start ROS run one by one."""

import compileall
import os
from pathlib import Path
import signal

from hypothesis import HealthCheck, settings
import pytest

_ROS = ('nodes/', 'test_package.py', 'test_scripts.py', 'test_readme.py')
# These read the same recordings, which the support module keeps for the process.
_READERS = ('online/test_trust.py', 'criticism/test_one_engine.py')
# Folders whose files take long come first: at the end, both workers have short files.
_LONG = ('discovery/', 'cli/', 'test_', 'online/', 'criticism/', 'analysis/', 'benchmarks/',
         'fleet/')


# A busy machine generates examples slowly. The same examples in every run;
# `--hypothesis-profile=hunt` draws others.
settings.register_profile('hunt', deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile('suite', settings.get_profile('hunt'), derandomize=True)
settings.load_profile('suite')


def pytest_configure(config):
    """Compile the package once; let processes that the tests start receive Ctrl-C."""
    # A process with a limited file size (as with a full disk) would leave truncated byte code.
    os.environ['PYTHONDONTWRITEBYTECODE'] = '1'
    # Workers of pytest-xdist use the controller's byte code.
    if not hasattr(config, 'workerinput'):
        compileall.compile_dir(Path(__file__).parents[1] / 'ou_monitor', force=True, quiet=1)
    # The order of the files is that of the collection, not that of the number of their tests.
    config.option.loadscopereorder = False
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _file_of(nodeid: str) -> str:
    return nodeid.split('::', 1)[0].removeprefix('test/')


def pytest_collection_modifyitems(items):
    """Put the files that take long first."""
    order = [_ROS, *_LONG]
    items.sort(key=lambda item: next(
        (k for k, names in enumerate(order) if _file_of(item.nodeid).startswith(names)),
        len(order)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Run each file on one worker of pytest-xdist, and all ROS tests on the same one."""
    # Groups of xdist itself are ignored from pytest 9.2 on (pytest-xdist issue 1386).
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        """Schedules whole files."""

        def _split_scope(self, nodeid):
            path = _file_of(nodeid)
            return 'ros' if path.startswith(_ROS) else 'readers' if path in _READERS else path

    return ByFile(config, log)


@pytest.fixture
def one_process(monkeypatch):
    """Make `fleet` work in this process."""
    class Here:
        """Replaces the pool of workers."""

        def __init__(self, *_: object) -> None:
            """Ignore all options."""

        def each(self, function, arguments):
            for k, given in enumerate(arguments):
                yield k, function(*given), ''

        def __enter__(self):
            return self

        def __exit__(self, *_: object) -> None:
            pass

    monkeypatch.setattr('ou_monitor.fleet.fleet.LocalWorkers', Here)
