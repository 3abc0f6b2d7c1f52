"""Style, types and shell syntax: ament's own linters with ament's own settings."""

import re
import subprocess
import sys

from ament_flake8.main import main_with_errors as flake8
from ament_pep257.main import main as pep257
from mypy import api as mypy
import numpy as np
from project import project_files, ROOT
import pytest
import yaml

# What is shipped; tests and benchmarks are held by ruff here, whose rules are ament's as far as
# it has them, in a hundredth of the time, and by ament's own tools at each commit.
FOLDERS = [str(ROOT / name) for name in ('ou_monitor', 'scripts', 'launch', 'setup.py')]
SHELL = [ROOT / name for name in (
    'scripts/demo', 'scripts/test', 'scripts/common.sh', 'scripts/lock', '.ci/run')]
# Folders that a machine has and another has not; written in two parts so as not to find itself.
MACHINE_PATH = re.compile(rb'/(?:ho' rb'me|ro' rb'ot|Us' rb'ers|wo' rb'rk)/')


@pytest.mark.filterwarnings('ignore')
def test_flake8_finds_nothing():
    """Ament's flake8 finds nothing."""
    code, errors = flake8(argv=FOLDERS)
    assert code == 0, '\n'.join(errors)


def test_ruff_finds_nothing():
    """The quick rules of ruff.toml, which the pre-commit hook runs, accept the tree."""
    done = subprocess.run([sys.executable, '-m', 'ruff', 'check', '--no-cache', str(ROOT)],
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_pre_commit_runs_what_the_suite_runs():
    hooks = yaml.safe_load((ROOT / '.pre-commit-config.yaml').read_text(encoding='utf-8'))
    tools = {hook['entry'].split()[0] for repo in hooks['repos'] for hook in repo['hooks']}
    assert tools == {'bash', '.venv/bin/ruff', '.venv/bin/ament_flake8', '.venv/bin/ament_pep257'}


@pytest.mark.filterwarnings('ignore')
def test_pep257_finds_nothing(capsys):
    """Ament's PEP 257 finds nothing."""
    code = pep257(argv=FOLDERS)
    assert code == 0, capsys.readouterr().err


@pytest.mark.skipif(np.__version__ < '2', reason='the types that NumPy 1 states are others')
def test_mypy_finds_nothing():
    out, err, code = mypy.run(['--config-file', str(ROOT / 'setup.cfg'), '--cache-dir',
                               str(ROOT / '.mypy_cache'), str(ROOT / 'ou_monitor')])
    assert code == 0, out + err


@pytest.mark.skipif(np.__version__ < '2', reason='the types that NumPy 1 states are others')
def test_strict_where_there_is_no_ros(tmp_path):
    module = tmp_path / 'core.py'
    module.write_text('def f(x):\n    return x\n', encoding='utf-8')
    out, err, code = mypy.run(['--config-file', str(ROOT / 'setup.cfg'), '--cache-dir',
                               str(ROOT / '.mypy_cache'), str(module)])
    assert code == 1 and 'no-untyped-def' in out, out + err


@pytest.mark.parametrize('script', SHELL, ids=lambda path: path.name)
def test_scripts_are_valid_bash(script):
    """Bash can read the script, and runs it directly unless it is sourced."""
    done = subprocess.run(['bash', '-n', script], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, '')
    assert script.suffix == '.sh' or script.stat().st_mode & 0o111 == 0o111


def test_no_machine_paths():
    """Nothing in the project names a folder of somebody's machine."""
    files = project_files()
    assert ROOT / 'setup.py' in files
    found = [f'{path.relative_to(ROOT)}: {match.group().decode()}' for path in files
             if path.suffix != '.mcap' and (match := MACHINE_PATH.search(path.read_bytes()))]
    assert not found, '\n'.join(found)
