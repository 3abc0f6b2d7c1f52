"""
A plugin of pytest that collects tests once and then runs some of them, in forks, on request.

A request is a JSON line of `mutation_runs.Tree`, read from the descriptor MUTATION_READ; the
status of the run goes to MUTATION_WRITE (negative: ended by that signal; null: past the limit). A
mutant within a function replaces the code of the function in the fork. Any other mutant, and what
a test starts as a process of its own, loads the changed module from the tree.
"""

from __future__ import annotations

import gc
import json
import os
from pathlib import Path
import select
import signal
import sys
from types import CodeType, FunctionType
from typing import Any

import pytest

# Functions of the package by module and name.
_functions: dict[tuple[str, str], list[FunctionType]] = {}
_failed: list[str] = []


def pytest_runtest_logreport(report: Any) -> None:
    """Note which test failed."""
    if report.failed:
        _failed.append(report.nodeid)


def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Serve instead of running all tests."""
    if 'MUTATION_READ' not in os.environ:
        return None
    reading, writing = (int(os.environ.pop(name)) for name in ('MUTATION_READ', 'MUTATION_WRITE'))
    items = {item.nodeid: item for item in session.items}
    for one in gc.get_objects():
        if isinstance(one, FunctionType):
            code = one.__code__
            _functions.setdefault((code.co_filename, code.co_qualname), []).append(one)
    gc.freeze()
    with os.fdopen(reading) as requests, os.fdopen(writing, 'w') as answers:
        for line in requests:
            asked = json.loads(line)
            child = os.fork()
            if not child:
                status = 3
                try:
                    os.setsid()
                    output = os.open(asked['output'], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                    os.dup2(output, 1)
                    os.dup2(output, 2)
                    status = _run(asked, items)
                finally:
                    os._exit(status)
            print(json.dumps(_wait(child, asked['limit'])), file=answers, flush=True)
    return True


def _wait(child: int, limit: float) -> int | None:
    handle = os.pidfd_open(child)
    waiting = select.poll()
    waiting.register(handle, select.POLLIN)
    ended = waiting.poll(1000.0 * limit)
    try:
        os.killpg(child, signal.SIGKILL)
    except ProcessLookupError:
        pass
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    os.close(handle)
    return status if ended else None


def _run(asked: dict[str, Any], items: dict[str, pytest.Item]) -> int:
    """Run tests in this process; return its status."""
    os.environ.update(asked['environment'])
    if not _replaced(**asked['place']):
        _forget()
        return int(pytest.main(asked['arguments']))
    from mutation_runs import set_normal
    chosen = [items[name] for name in set_normal() if name in items]
    for k, item in enumerate(chosen):
        item.config.hook.pytest_runtest_protocol(
            item=item, nextitem=chosen[k + 1] if k + 1 < len(chosen) else None)
        if _failed:
            return 1
    return 0


def _replaced(path: str, function: str, line: int) -> bool:
    """Take the code of a function from its file as it is now; return whether that is all."""
    if not function:
        return False
    file = Path(path).resolve()
    if str(file) not in {getattr(one, '__file__', None) for one in [*sys.modules.values()]}:
        return True
    code = _found(compile(file.read_bytes(), str(file), 'exec'), function, line)
    old = [one for one in _functions.get((str(file), function), ())
           if one.__code__.co_firstlineno == line]
    if code is None or not old or any(one.__code__.co_freevars != code.co_freevars for one in old):
        return False
    for one in old:
        one.__code__ = code
    return True


def _found(code: CodeType, function: str, line: int) -> CodeType | None:
    if code.co_qualname == function and code.co_firstlineno == line:
        return code
    for part in code.co_consts:
        if isinstance(part, CodeType):
            found = _found(part, function, line)
            if found is not None:
                return found
    return None


def _forget() -> None:
    """Let the modules of the project be loaded anew."""
    here = str(Path.cwd()) + os.sep
    for name, module in list(sys.modules.items()):
        file = getattr(module, '__file__', None) or ''
        if file.startswith(here) and not file.startswith(here + 'benchmarks'):
            del sys.modules[name]
