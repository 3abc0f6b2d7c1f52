"""
Tests run on copies of the project: with a mutant in it, or under coverage; and pytest's plugin.

pytest loads this module as a plugin (`-p mutation_runs`) in the processes started here.
"""

from __future__ import annotations

from collections.abc import Sequence
import json
import os
from pathlib import Path
import resource
import shutil
import signal
import subprocess
import sys
import time
from typing import Any

from mutants import function_at, Mutant

# Times the normal time of a test, in time of the processor, of which a busy machine takes no more;
# and what the first use of a module takes, s.
_PATIENCE, _START = 5.0, 15.0
# For what waits and does not calculate: times the normal time, and s.
_WAITING, _WAITED = 10.0, 120.0
# The context of what a fixture of a whole file, or a process started by a test, reached.
_FILE = '<file>'

# --- The plugin of pytest in the processes that are started below.

_current = ''
# Normal time of each test and the longest of its file, s.
_normal: dict[str, float] = {}


def _switch(context: str) -> None:
    if 'coverage' in sys.modules:
        coverage = sys.modules['coverage'].Coverage.current()
        if coverage is not None:
            coverage.switch_context(context)


def set_normal() -> dict[str, float]:
    """Read which tests were asked for, in order, and their normal time, s."""
    _normal.update(json.loads(Path(os.environ['MUTATION_TESTS']).read_text()))
    return _normal


def pytest_collection_modifyitems(config: Any, items: list[Any]) -> None:
    """Leave the tests asked for, in the order asked for."""
    if 'MUTATION_TESTS' in os.environ:
        order = {name: k for k, name in enumerate(set_normal())}
        items[:] = sorted((one for one in items if one.nodeid in order),
                          key=lambda one: order[one.nodeid])


def _limit(normal: float) -> None:
    """Let this process calculate for a multiple of a normal time, s, from now on."""
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    end = time.process_time() + _START + _PATIENCE * normal
    resource.setrlimit(resource.RLIMIT_CPU, (int(end) + 1, hard))


def pytest_runtest_logstart(nodeid: str, location: object) -> None:
    """Count what follows as reached by this test."""
    global _current
    _current = nodeid
    _switch(nodeid)
    if nodeid in _normal:
        _limit(_normal[nodeid])


def pytest_fixture_setup(fixturedef: Any, request: Any) -> None:
    """Count what a fixture of many tests does as reached by all of the file."""
    # The switch back comes with pytest_runtest_call: before it there is nothing but set-up.
    if fixturedef.scope != 'function':
        _switch(_FILE)
        if _normal:
            # It may count to another test where the order is another.
            file = _current.partition('::')[0]
            _limit(max(some for name, some in _normal.items() if name.startswith(file)))


def pytest_runtest_call(item: Any) -> None:
    """Count the test itself as its own."""
    _switch(item.nodeid)


def pytest_runtest_logreport(report: Any) -> None:
    """Note how long each test took, and whether it failed."""
    if 'MUTATION_TIMES' in os.environ:
        with open(os.environ['MUTATION_TIMES'], 'a') as file:
            file.write(json.dumps([report.nodeid, report.duration, report.failed]) + '\n')


# --- Running tests.

# Process groups.
_running: set[int] = set()


def _environment(tree: Path, **more: str) -> dict[str, str]:
    # No byte code: a mutant may have the size and the second of the source before it.
    return {**os.environ, 'PYTHONPATH': str(tree / 'benchmarks'), 'PYTHONDONTWRITEBYTECODE': '1',
            'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1',
            **more}


def run(command: Sequence[str], tree: Path, limit: float, **more: str) -> int | None:
    """Run a command in a tree; return its status, or None after the limit, s."""
    with open(tree.with_suffix('.output'), 'w') as output, subprocess.Popen(
            command, cwd=tree, env=_environment(tree, **more), stdout=output,
            stderr=subprocess.STDOUT, start_new_session=True) as process:
        _running.add(process.pid)
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return None
        finally:
            _running.discard(process.pid)
            _end(process.pid)


def _end(group: int) -> None:
    """End a process and all that it has started."""
    try:
        os.killpg(group, signal.SIGKILL)
    except ProcessLookupError:
        pass


def stop() -> None:
    """End what is running; what it would have found counts for nothing."""
    for group in tuple(_running):
        _end(group)


PYTEST = ('-m', 'pytest', '-q', '-p', 'no:cacheprovider', '-p', 'no:xdist', '-p', 'mutation_runs')


def prepare(origin: Path, files: Sequence[str]) -> None:
    """
    Compile a copy of the project.

    The byte code of the package is compared with the source by content: that of a mutant may have
    the size and the second of the source before it.
    """
    run([sys.executable, '-m', 'compileall', '-q', '--invalidation-mode', 'checked-hash',
         'ou_monitor'], origin, 600.0)
    code = run([sys.executable, *PYTEST, '--collect-only', *files], origin, 1200.0,
               PYTHONDONTWRITEBYTECODE='')
    if code:
        raise RuntimeError(f'tests cannot be collected: '
                           f'{origin.with_suffix(".output").read_text()[-2000:]}')


class Tree:
    """
    A copy of the project that a mutant may be put into.

    Parameters
    ----------
    work : pathlib.Path
        The folder of all copies; 'origin' in it is the one without mutants.
    name : str
        Of this copy.
    files : sequence of str
        Files of tests.

    """

    def __init__(self, work: Path, name: str, files: Sequence[str]) -> None:
        self.path, self.origin, self._files = work / name, work / 'origin', files
        if self.path.exists():
            shutil.rmtree(self.path)
        shutil.copytree(self.origin, self.path, symlinks=True)
        self._server: subprocess.Popen[str] | None = None

    def tests(self, names: Sequence[str], seconds: dict[str, float],
              place: dict[str, Any]) -> tuple[int | None, list[str]]:
        """Run tests until one fails; return the status, None past the limit, and which failed."""
        chosen, times = self.path.with_suffix('.tests'), self.path.with_suffix('.times')
        chosen.write_text(json.dumps({name: seconds[name] for name in names}))
        times.write_text('')
        files = dict.fromkeys(name.partition('::')[0] for name in names)
        status = self._ask([*PYTEST[2:], '-x', *files],
                           _WAITED + _WAITING * sum(seconds[name] for name in names),
                           {'MUTATION_TESTS': str(chosen), 'MUTATION_TIMES': str(times)}, place)
        return status, [name for name, _, failed in read_lines(times) if failed]

    def _ask(self, arguments: Sequence[str], limit: float, more: dict[str, str],
             place: dict[str, Any]) -> int | None:
        """Have pytest run in a fork of a process that has collected the tests."""
        if self._server is None:
            there, back = os.pipe(), os.pipe()
            with open(self.path.with_suffix('.server'), 'w') as output:
                self._server = subprocess.Popen(
                    [sys.executable, *PYTEST, '-p', 'mutation_server', *self._files],
                    cwd=self.path, env=_environment(
                        self.path, MUTATION_READ=str(there[0]), MUTATION_WRITE=str(back[1])),
                    stdout=output, stderr=subprocess.STDOUT, pass_fds=(there[0], back[1]),
                    start_new_session=True)
            os.close(there[0])
            os.close(back[1])
            self._requests, self._answers = os.fdopen(there[1], 'w'), os.fdopen(back[0])
            _running.add(self._server.pid)
        print(json.dumps({'arguments': list(arguments), 'limit': limit, 'environment': more,
                          'place': place, 'output': str(self.path.with_suffix('.output'))}),
              file=self._requests, flush=True)
        answer = self._answers.readline()
        if not answer:
            raise RuntimeError(f'the server ended: '
                               f'{self.path.with_suffix(".server").read_text()[-2000:]}')
        status = json.loads(answer)
        return None if status in (None, -signal.SIGXCPU, -signal.SIGKILL) else int(status)

    def close(self) -> None:
        """End the process that runs the tests."""
        if self._server is not None:
            _running.discard(self._server.pid)
            _end(self._server.pid)
            self._server.wait()
            self._requests.close()
            self._answers.close()
            self._server = None

    def try_mutant(self, mutant: Mutant, names: Sequence[str],
                   seconds: dict[str, float]) -> dict[str, Any]:
        """Return what the tests say of a mutant."""
        file, left = self.path / mutant.path, list(names)
        source = file.read_bytes()
        function, line = function_at(source, mutant)
        place = {'path': mutant.path, 'function': function, 'line': line}
        begin = time.monotonic()
        file.write_bytes(mutant.apply(source))
        try:
            status, by = '', ''
            while not status:
                code, failed = self.tests(left, seconds, place)
                if code is None:
                    status = 'timeout'
                elif code == 0:
                    status = 'survived'
                elif code in (3, 4, 5):
                    raise RuntimeError(f'pytest could not run the tests of {mutant.key}: '
                                       f'{self.path.with_suffix(".output").read_text()[-2000:]}')
                elif failed and self.tests(failed[:1], seconds, place)[0] == 0:
                    # It failed once, for want of time perhaps: the rest shall say.
                    left = left[left.index(failed[0]) + 1:]
                    status = '' if left else 'survived'
                else:
                    status, by = 'killed', failed[0] if failed else 'import'
        finally:
            file.write_bytes(source)
        return {'status': status, 'by': by, 'seconds': round(time.monotonic() - begin, 1)}


def read_lines(path: Path) -> list[Any]:
    """Return the values of a file of JSON lines; none where there is no file."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
