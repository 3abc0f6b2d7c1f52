"""scripts/: one line for what demo and test refuse, no repeated installation; the man page."""

import importlib.util
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import time

from ou_monitor.cli.commands import COMMANDS
from ou_monitor.cli.main import main
from project import ROOT
import pytest

# Nothing listens on the discard port of this machine.
NOWHERE = 'http://127.0.0.1:9/simple'


@pytest.fixture
def tree(tmp_path) -> Path:
    """Return a copy of the scripts in a folder with a space in its name."""
    copy = tmp_path / 'a clone'
    shutil.copytree(ROOT / 'scripts', copy / 'scripts')
    return copy


def environment(**changes: str) -> dict[str, str]:
    """Return the environment of a shell in which no ROS is sourced."""
    dropped = ('ROS_DISTRO', 'PYTHON', 'PYTHONPATH', 'VIRTUAL_ENV')
    kept = {key: value for key, value in os.environ.items()
            if key not in dropped and not key.startswith('PIP_')}
    return kept | changes


def run(tree: Path, name: str = 'test', *arguments: str,
        **changes: str) -> subprocess.CompletedProcess:
    """Run one of the scripts from another folder than its own."""
    return subprocess.run([tree / 'scripts' / name, *arguments], cwd='/', text=True,
                          capture_output=True, timeout=300, env=environment(**changes))


def fake(folder: Path, **programs: str) -> str:
    """Put shell scripts in front of the programs of those names; return the PATH."""
    folder.mkdir()
    for name, body in programs.items():
        path = folder / name.replace('_', '.')
        path.write_text(f'#!/bin/sh\n{body}\n', encoding='utf-8')
        path.chmod(0o755)
    return f'{folder}:{os.environ["PATH"]}'


def refused(done: subprocess.CompletedProcess, *words: str) -> None:
    """Check for status 2 and one line that holds the words."""
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert all(word in line for word in words), line


@pytest.mark.parametrize('name', ['demo', 'test'])
def test_another_ros_is_refused(tree, name):
    """Another distribution's environment would load the wrong libraries."""
    refused(run(tree, name, ROS_DISTRO='humble'), f'scripts/{name}', "'humble'", 'jazzy')


def test_jazzy_without_rclpy_is_refused(tree, tmp_path):
    path = fake(tmp_path / 'bin', python3='exit 1')
    refused(run(tree, ROS_DISTRO='jazzy', PATH=path), 'cannot import rclpy', 'source')


def test_another_processor_is_refused(tree, tmp_path):
    """The wheels are for x86-64; where they are not, apt's ROS is named."""
    path = fake(tmp_path / 'bin', uname='[ "$1" = -s ] && echo Linux || echo aarch64')
    refused(run(tree, PATH=path), 'x86-64', 'aarch64', 'ros-jazzy-ros-base')


def test_a_wrong_interpreter_is_refused(tree, tmp_path):
    """What PYTHON names must run and be of a supported version."""
    fake(tmp_path / 'bin', old='echo 3.8', broken='exit 127')
    refused(run(tree, PYTHON=str(tmp_path / 'bin/old')), 'Python 3.8', '3.11 or 3.12')
    refused(run(tree, PYTHON=str(tmp_path / 'bin/broken')), 'not a Python that runs')


def test_no_interpreter_is_refused(tree, tmp_path):
    shim = 'echo "pyenv: command not found" >&2; exit 127'
    path = fake(tmp_path / 'bin', python3_12=shim, python3_11=shim, python3=shim)
    refused(run(tree, PATH=path), 'no Python 3.11 or 3.12', 'python3.12 python3.11 python3')


def test_an_interpreter_without_venv_is_refused(tree, tmp_path):
    """Debian's Python comes without venv: the package to install is named."""
    bare = 'case "$2" in *version*) echo 3.12;; *) exit 1;; esac'
    path = fake(tmp_path / 'bin', python3_12=bare, python3_11=bare, python3=bare)
    refused(run(tree, PATH=path), 'venv', 'python3.12-venv')


OFFLINE = {'PIP_INDEX_URL': NOWHERE, 'PIP_CONFIG_FILE': os.devnull, 'PIP_NO_CACHE_DIR': '1',
           'PYTHON': sys.executable}


@pytest.fixture(scope='module')
def made(tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess]:
    """Return a tree with an environment that the demo has made, with empty lists; and that run."""
    tree = tmp_path_factory.mktemp('made') / 'a clone'
    shutil.copytree(ROOT / 'scripts', tree / 'scripts')
    for name in ('requirements-run.txt', 'requirements-live.txt', 'requirements-test.txt',
                 'build.lock', 'run.lock', 'test.lock'):
        (tree / 'scripts' / name).write_text('', encoding='utf-8')
    (tree / 'scripts/run_demo.py').write_text(
        'import os, sys\nprint(sys.prefix, os.getcwd(), *sys.argv[1:], sep="|")\n',
        encoding='utf-8')
    return tree, run(tree, 'demo', '--bag', 'some bag', **OFFLINE)


def test_nothing_is_installed_twice_and_a_broken_environment_is_mended(made):
    tree, first = made
    expected = f'{tree}/.venv|{tree}|--bag|some bag\n'
    assert (first.returncode, first.stdout) == (0, expected), first.stderr
    assert 'making .venv' in first.stderr and 'installing' in first.stderr
    second = run(tree, 'demo', '--bag', 'some bag', **OFFLINE)
    assert (second.returncode, second.stdout, second.stderr) == (0, expected, '')
    (tree / '.venv/bin/python').unlink()
    third = run(tree, 'demo', '--bag', 'some bag', **OFFLINE)
    assert (third.returncode, third.stdout) == (0, expected), third.stderr
    assert 'making .venv' in third.stderr
    # A list that has changed is installed; the environment stays.
    (tree / 'scripts/run.lock').write_text('# nothing\n', encoding='utf-8')
    fourth = run(tree, 'demo', **OFFLINE)
    assert fourth.returncode == 0
    assert 'installing' in fourth.stderr and 'making .venv' not in fourth.stderr


def failed_install(tree: Path, lock: str, content: str, **changes: str) -> tuple[str, str]:
    """Run the demo, which must fail to install a list; return its last line, and pip's log."""
    (tree / 'scripts' / lock).write_text(content, encoding='utf-8')
    installed = tree / '.venv/.installed-run'
    before = installed.read_text()
    done = run(tree, 'demo', **changes)
    assert done.returncode == 2 and installed.read_text() == before
    assert 'installing' in done.stderr and 'Traceback' not in done.stderr
    (tree / 'scripts' / lock).write_text('', encoding='utf-8')
    last = done.stderr.splitlines()[-1]
    return last, Path(last.rpartition('log: ')[2]).read_text(encoding='utf-8')


def test_no_registry_is_refused_and_the_next_run_tries_again(made):
    """Pip's trouble is one line with its cause and its log; nothing counts as installed."""
    build = (ROOT / 'scripts/build.lock').read_text(encoding='utf-8')
    for _ in range(2):
        last, log = failed_install(made[0], 'build.lock', build, **OFFLINE)
        assert 'registry' in last and 'connection' in last, last
        assert NOWHERE.split('/')[2].split(':')[0] in log


@pytest.mark.parametrize('line', [
    'wheel', 'wheel==0.48.0', 'wheel==0.48.0 --hash=sha256:' + 64 * '0'])
def test_a_package_without_its_hash_is_refused(made, line):
    last, log = failed_install(made[0], 'run.lock', line + '\n', PYTHON=sys.executable)
    assert 'could not fetch' in last and 'hash' in log.lower()


def test_a_sourced_jazzy_is_used(made, tmp_path):
    """Where rclpy is there already no wheel is asked for, and the machine's packages count."""
    tree, _ = made
    kind = tree / '.venv/pyvenv.cfg'
    assert 'include-system-site-packages = false' in kind.read_text()
    (tree / 'scripts/run.lock').write_text('no-such-package\n', encoding='utf-8')
    path = fake(tmp_path / 'bin', python3=f'exec "{sys.executable}" "$@"')
    done = run(tree, 'demo', PATH=path, ROS_DISTRO='jazzy', PIP_INDEX_URL=NOWHERE,
               PIP_CONFIG_FILE=os.devnull)
    assert done.returncode == 0, done.stderr
    # The environment of the other kind is replaced.
    assert 'making .venv' in done.stderr
    assert 'include-system-site-packages = true' in kind.read_text()


def test_versions_other_than_noble_are_refused(tree, tmp_path):
    refused(run(tree, 'test', '--versions', 'jammy'), 'noble', "'jammy'")
    old = 'echo 3.11'
    path = fake(tmp_path / 'bin', python3_12=old, python3_11=old, python3=old)
    refused(run(tree, 'test', '--versions', 'noble', PATH=path), 'no Python 3.12', 'tried')


def test_demo_refuses_a_missing_bag():
    done = subprocess.run([sys.executable, 'scripts/run_demo.py', '--bag', 'bags/none'],
                          cwd=ROOT, capture_output=True, text=True, timeout=60)
    refused(done, 'bags/none')


def test_demo_ends_its_children_on_interrupt(tmp_path):
    """Ctrl-C in the middle of the demo leaves no process behind."""
    report = tmp_path / 'report.html'
    environment = os.environ | {'OU_DEMO_TEST': str(tmp_path)}
    environment.pop('ROS_DOMAIN_ID', None)
    demo = subprocess.Popen(
        [sys.executable, 'scripts/run_demo.py', '--report', report], cwd=ROOT, text=True,
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        for line in demo.stdout:
            if line.split()[:1] == ['t']:
                break
        assert len(marked(tmp_path)) >= 4, demo.poll()
        demo.terminate()
        assert demo.wait(60) == 130, demo.stderr.read()
        deadline = time.monotonic() + 10.0
        while marked(tmp_path) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert marked(tmp_path) == []
    finally:
        demo.kill()
        demo.communicate()


def marked(folder: Path) -> list[int]:
    """Return the processes that carry this test's mark in their environment."""
    mark = f'OU_DEMO_TEST={folder}'.encode()
    found = []
    for entry in Path('/proc').iterdir():
        if entry.name.isdigit():
            try:
                if mark in (entry / 'environ').read_bytes().split(b'\0'):
                    found.append(int(entry.name))
            except OSError:
                # Gone meanwhile, or not ours to look into.
                continue
    return found


@pytest.mark.parametrize('source', [(), ('--simulated',)], ids=['recorded', 'simulated'])
def test_demo_shows_estimates_and_leaves_a_report(tmp_path, source):
    report = tmp_path / 'report.html'
    environment = dict(os.environ)
    environment.pop('ROS_DOMAIN_ID', None)
    done = subprocess.run(
        [sys.executable, 'scripts/run_demo.py', '--seconds', '8', '--report', report, *source],
        cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert str(report) in done.stdout and '<html' in report.read_text(encoding='utf-8').lower()
    rows = [line.split() for line in done.stdout.splitlines() if line[:6].strip()
            .replace('.', '').isdigit()]
    # One a second, less what a busy machine takes to start; the last one has a number in every
    # column but, at most, sag, alpha and risk.
    assert 1 <= len(rows) <= 10
    assert all(float(cell) > 0.0 for cell in (*rows[-1][2:4], rows[-1][8]))
    # Open-circuit voltage of the 4S pack of the recorded flight, or of its model.
    assert ('pack ages' in done.stdout) == bool(source)
    assert 15.0 < float(rows[-1][2]) < 17.5


def test_the_man_page_has_the_texts_of_help(capsys):
    name = 'make_man'
    spec = importlib.util.spec_from_file_location(name, ROOT / 'scripts' / f'{name}.py')
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    written = maker.PAGE.read_text(encoding='utf-8')
    assert written == maker.page()
    words = written.replace('\\-', '-')
    for command in COMMANDS:
        assert main([command, '--help']) == 0
        shown = capsys.readouterr().out
        assert f'.SS {command}\n' in words
        assert all(option in words for option in re.findall(r'--[a-z-]+', shown))
