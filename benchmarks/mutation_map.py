"""Which test of the suite reaches which line, measured once and carried over to later sources."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterable, Iterator
import difflib
import json
from pathlib import Path
import sys

from mutants import function_lines, lines_that_use, Mutant, names_set
from mutation_runs import PYTEST, read_lines, run, Tree

_FILE = '<file>'


def reach(tree: Tree, test: str, out: Path) -> None:
    """Run one file of tests under coverage; write what each of its tests reached."""
    data, settings = out.with_suffix('.coverage'), out.with_suffix('.rc')
    settings.write_text(f'[run]\nsource = ou_monitor\nrelative_files = True\nparallel = True\n'
                        f'patch = subprocess\ndata_file = {data}\n')
    times = out.with_suffix('.times')
    for old in (times, *out.parent.glob(data.name + '*')):
        old.unlink(missing_ok=True)
    code = run([sys.executable, '-m', 'coverage', 'run', f'--rcfile={settings}', *PYTEST, test],
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
    write(out, {'tests': good, 'seconds': [round(seconds[name], 4) for name in good],
                'failed': sorted(failed), 'lines': {
                    path: {line: sorted(at) for line, at in lines.items() if at}
                    for path, lines in found.items()}})


def write(path: Path, value: object) -> None:
    """Write a value as JSON, all of it or nothing."""
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


# --- A map of earlier sources.

def carry(old: Path, new: Path, names: Iterable[str]) -> list[str]:
    """
    Carry an earlier map over; return the files of tests that are the same but for imports.

    Lines of the sources are followed by their text, to other modules too. A line of a function
    that changed counts as reached by all that reached a function of its name: tests that do not
    reach it cost time and notice nothing, tests that are missed make the score too low.
    """
    same = [name for name in names if (old / 'reach' / file_of(name)).exists()
            and not (new / 'reach' / file_of(name)).exists()
            and _body(old / 'origin' / name) == _body(new / 'origin' / name) is not None]
    followed = _follow(old / 'origin', new / 'origin')
    for name in same:
        held = json.loads((old / 'reach' / file_of(name)).read_text())
        lines: dict[str, dict[str, set[int]]] = {}
        for path, reached in held['lines'].items():
            for line, tests in reached.items():
                for to, at in followed.get((path, int(line)), ()):
                    lines.setdefault(to, {}).setdefault(str(at), set()).update(tests)
        write(new / 'reach' / file_of(name), {**held, 'lines': {
            path: {line: sorted(at) for line, at in some.items()}
            for path, some in lines.items()}})
    return same


def file_of(test: str) -> str:
    """Return the name of the file that keeps the map of a file of tests."""
    return test.replace('/', '.') + '.json'


def _body(path: Path) -> str | None:
    """Return a module without its imports, which change when others move."""
    if not path.exists():
        return None
    return '\n'.join(ast.unparse(node) for node in ast.parse(path.read_bytes()).body
                     if not isinstance(node, (ast.Import, ast.ImportFrom)))


def _follow(old: Path, new: Path) -> dict[tuple[str, int], set[tuple[str, int]]]:
    """Return where lines of the package went: by module and number."""
    before, after = _sources(old), _sources(new)
    followed: dict[tuple[str, int], set[tuple[str, int]]] = {}
    matched = set()
    homes: dict[str, set[tuple[str, int]]] = {}
    for path, source in before.items():
        for name, first, last in _functions(source):
            homes.setdefault(name, set()).update((path, line) for line in range(first, last + 1))
        to = path if path in after else _likest(source, after)
        if to is None:
            continue
        match = difflib.SequenceMatcher(None, source.splitlines(), after[to].splitlines(), False)
        for one, other, size in match.get_matching_blocks():
            for k in range(1, size + 1):
                followed.setdefault((path, one + k), set()).add((to, other + k))
                matched.add((to, other + k))
    for path, source in after.items():
        for name, first, last in _functions(source):
            some = homes.get(name, set())
            here = {at for at in some if at[0] == path} or some
            for line in range(first, last + 1):
                if (path, line) not in matched:
                    for at in here:
                        followed.setdefault(at, set()).add((path, line))
    return followed


def _likest(source: str, others: dict[str, str]) -> str | None:
    lines = set(source.splitlines())
    best = max(others, key=lambda path: len(lines & set(others[path].splitlines())))
    return best if 2 * len(lines & set(others[best].splitlines())) > len(lines) else None


def _sources(root: Path) -> dict[str, str]:
    return {path.relative_to(root).as_posix(): path.read_text()
            for path in sorted((root / 'ou_monitor').rglob('*.py'))}


def _functions(source: str) -> Iterator[tuple[str, int, int]]:
    """Yield the qualified name, first and last line of each function."""
    def within(node: ast.AST, prefix: str) -> Iterator[tuple[str, int, int]]:
        for part in ast.iter_child_nodes(node):
            if isinstance(part, (ast.FunctionDef, ast.AsyncFunctionDef)):
                yield prefix + part.name, part.body[0].lineno, part.end_lineno or part.lineno
            elif isinstance(part, ast.ClassDef):
                yield from within(part, f'{part.name}.')
    yield from within(ast.parse(source), '')
