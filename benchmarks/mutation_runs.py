"""
Tests run on copies of the project: with a mutant in it, or under coverage; and pytest's plugin.

pytest loads this module as a plugin (`-p mutation_runs`) in the processes started here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
import json
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time
from typing import Any

from mutants import function_lines, lines_that_use, Mutant, names_set

# Times the normal time; and the start of the interpreter, which does not shrink with the tests.
_PATIENCE, _START = 5.0, 30.0
# The context of what a fixture of a whole file, or a process started by a test, reached.
_FILE = '<file>'

# --- The plugin of pytest in the processes that are started below.

_current = ''


def _switch(context: str) -> None:
    if 'coverage' in sys.modules:
        coverage = sys.modules['coverage'].Coverage.current()
        if coverage is not None:
            coverage.switch_context(context)


def pytest_collection_modifyitems(config: Any, items: list[Any]) -> None:
    """Leave the tests asked for, in the order asked for."""
    if 'MUTATION_TESTS' in os.environ:
        order = {name: k for k, name in enumerate(
            json.loads(Path(os.environ['MUTATION_TESTS']).read_text()))}
        items[:] = sorted((one for one in items if one.nodeid in order),
                          key=lambda one: order[one.nodeid])


def pytest_runtest_logstart(nodeid: str, location: object) -> None:
    """Count what follows as reached by this test."""
    global _current
    _current = nodeid
    _switch(nodeid)


def pytest_fixture_setup(fixturedef: Any, request: Any) -> None:
    """Count what a fixture of many tests does as reached by all of the file."""
    # The switch back comes with pytest_runtest_call: before it there is nothing but set-up.
    if fixturedef.scope != 'function':
        _switch(_FILE)


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
    # No byte code: a mutant may have the size and the second of the source before it. No
    # compiled code: coverage cannot see into it.
    return {**os.environ, 'PYTHONPATH': str(tree / 'benchmarks'), 'PYTHONDONTWRITEBYTECODE': '1',
            'OU_MONITOR_COMPILED': '0', 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1',
            **more}


def _run(command: Sequence[str], tree: Path, limit: float, **more: str) -> int | None:
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


_PYTEST = ('-m', 'pytest', '-q', '-p', 'no:cacheprovider', '-p', 'no:xdist', '-p', 'mutation_runs')


class Tree:
    """
    A copy of the project that a mutant may be put into.

    Parameters
    ----------
    work : pathlib.Path
        The folder of all copies; 'origin' in it is the one without mutants.
    name : str
        Of this copy.

    """

    def __init__(self, work: Path, name: str) -> None:
        self.path, self.origin = work / name, work / 'origin'
        if self.path.exists():
            shutil.rmtree(self.path)
        shutil.copytree(self.origin, self.path, symlinks=True)

    def tests(self, names: Sequence[str], limit: float) -> tuple[int | None, list[str]]:
        """Run tests until one fails; return the status and which failed."""
        chosen, times = self.path.with_suffix('.tests'), self.path.with_suffix('.times')
        chosen.write_text(json.dumps(list(names)))
        times.write_text('')
        files = dict.fromkeys(name.partition('::')[0] for name in names)
        status = _run([sys.executable, *_PYTEST, '-x', *files], self.path, limit,
                      MUTATION_TESTS=str(chosen), MUTATION_TIMES=str(times))
        return status, [name for name, _, failed in read_lines(times) if failed]

    def try_mutant(self, mutant: Mutant, names: Sequence[str],
                   seconds: dict[str, float]) -> dict[str, Any]:
        """Return what the tests say of a mutant."""
        file, left = self.path / mutant.path, list(names)
        source = file.read_bytes()
        begin = time.monotonic()
        file.write_bytes(mutant.apply(source))
        try:
            status, by = '', ''
            while not status:
                limit = _START + _PATIENCE * sum(seconds[name] for name in left)
                code, failed = self.tests(left, limit)
                if code is None:
                    status = 'timeout'
                elif code == 0:
                    status = 'survived'
                elif code in (3, 4, 5):
                    raise RuntimeError(f'pytest could not run the tests of {mutant.key}: '
                                       f'{self.path.with_suffix(".output").read_text()[-2000:]}')
                elif failed and self.tests(failed[:1], limit)[0] == 0:
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


# --- Which tests reach which lines.

def reach(tree: Tree, test: str, out: Path) -> None:
    """Run one file of tests under coverage; write what each of its tests reached."""
    data, settings = out.with_suffix('.coverage'), out.with_suffix('.rc')
    settings.write_text(f'[run]\nsource = ou_monitor\nrelative_files = True\nparallel = True\n'
                        f'patch = subprocess\ndata_file = {data}\n')
    times = out.with_suffix('.times')
    for old in (times, *out.parent.glob(data.name + '*')):
        old.unlink(missing_ok=True)
    code = _run([sys.executable, '-m', 'coverage', 'run', f'--rcfile={settings}', *_PYTEST, test],
                tree.path, 3600.0, MUTATION_TIMES=str(times), COVERAGE_CORE='ctrace')
    if code not in (0, 1):
        raise RuntimeError(f'{test} could not be run: pytest ended with {code}, '
                           f'{tree.path.with_suffix(".output").read_text()[-2000:]}')
    seconds: Counter[str] = Counter()
    failed = set()
    for name, took, wrong in read_lines(times):
        seconds[name] += took
        failed |= {name} if wrong else set()
    good = [name for name in seconds if name not in failed]
    where = {name: k for k, name in enumerate(good)}
    found: dict[str, dict[str, set[int]]] = {}
    from coverage import CoverageData
    for piece in out.parent.glob(data.name + '.*'):
        held = CoverageData(str(piece))
        held.read()
        own = any('::' in context for context in held.measured_contexts())
        for path in held.measured_files():
            for line, contexts in held.contexts_by_lineno(path).items():
                at = found.setdefault(path, {}).setdefault(str(line), set())
                for context in contexts:
                    if context == _FILE or not own:
                        at |= set(where.values())
                    elif context in where:
                        at.add(where[context])
        piece.unlink()
    _write(out, {'tests': good, 'seconds': [round(seconds[name], 4) for name in good],
                 'failed': sorted(failed), 'lines': {
                     path: {line: sorted(at) for line, at in lines.items() if at}
                     for path, lines in found.items()}})


def _write(path: Path, value: object) -> None:
    part = path.with_suffix('.part')
    part.write_text(json.dumps(value))
    part.rename(path)


class Reach:
    """
    The map from lines to tests.

    Parameters
    ----------
    files : iterable of pathlib.Path
        What `reach` has written.
    root : pathlib.Path
        Of the sources that were run.

    """

    def __init__(self, files: Iterable[Path], root: Path) -> None:
        self.root = root
        self.seconds: dict[str, float] = {}
        self.failed: list[str] = []
        self._at: dict[str, dict[int, set[str]]] = {}
        for file in files:
            read = json.loads(file.read_text())
            names = read['tests']
            self.seconds.update(zip(names, read['seconds']))
            self.failed += read['failed']
            for path, lines in read['lines'].items():
                at = self._at.setdefault(path, {})
                for line, tests in lines.items():
                    at.setdefault(int(line), set()).update(names[k] for k in tests)

    def _of(self, path: str, lines: Iterable[int]) -> set[str]:
        at = self._at.get(path, {})
        return {name for line in lines for name in at.get(line, ())}

    def tests(self, mutant: Mutant) -> set[str]:
        """Return the tests that reach the statement of a mutant."""
        source = (self.root / mutant.path).read_bytes()
        functions = function_lines(source)
        if any(first <= mutant.line <= last for _, first, last in functions):
            return self._of(mutant.path, range(mutant.first, mutant.last + 1))
        # What runs when the module is loaded is reached where it is used: a default by the body
        # of its function, a name where it is read, all else wherever the module does anything.
        for head, first, last in functions:
            if head <= mutant.line < first:
                return self._of(mutant.path, range(first, last + 1))
        names = names_set(source, mutant)
        module = mutant.path.removesuffix('.py').replace('/', '.')
        within = {line for _, first, last in functions for line in range(first, last + 1)}
        used = self._of(mutant.path, within & lines_that_use(source, names))
        for path in self._at:
            other = (self.root / path).read_bytes()
            if names and path != mutant.path and module.rpartition('.')[2].encode() in other:
                used |= self._of(path, lines_that_use(other, names))
        return used or self._of(mutant.path, within)
