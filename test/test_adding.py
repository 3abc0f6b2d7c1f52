"""A new cause, format, parameter, command or fact needs a change in one place; tried in a copy."""

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

import numpy as np
from project import ROOT
import pytest

CAUSE = '''"""A cause."""
from ou_monitor.model.terms.slow import Drift


class Leak(Drift):
    NAME = 'leak'
'''
FORMAT = '''"""A format: stamps and volts behind a line of its own."""
import numpy as np
from ou_monitor.recordings.importers.log import Log, Series, VOLTAGE


def read(path, request):
    t, volts = np.loadtxt(path, skiprows=1).T
    return Log('mine', (Series('volts', VOLTAGE, t, volts, '1', rank=0),))
'''
COMMAND = '''"""A command."""
from ou_monitor.cli import output


def run(args):
    output.say('done')
    return 0
'''


def insert(path: Path, before: str, text: str) -> None:
    found = path.read_text(encoding='utf-8')
    assert found.count(before) == 1, before
    path.write_text(found.replace(before, text + before), encoding='utf-8')


@pytest.fixture(scope='module')
def copy(tmp_path_factory):
    """Return a folder with a package to which one of each has been added."""
    folder = tmp_path_factory.mktemp('copy')
    package = folder / 'ou_monitor'
    shutil.copytree(ROOT / 'ou_monitor', package,
                    ignore=shutil.ignore_patterns('__pycache__'))
    (package / 'model/terms/leak.py').write_text(CAUSE)
    (package / 'recordings/importers/mine.py').write_text(FORMAT)
    insert(package / 'recordings/importers/formats.py', '    Format(CSV, ',
           "    Format('mine', 'Mine', lambda head: head.startswith(b'MINE'), 'mine'),\n")
    insert(package / 'online/settings.py', '    brownout_voltage: float = ',
           "    reserve: float = _parameter(0.1, 'Reserve, V.', 0.0, 1.0)\n")
    (package / 'cli/mine.py').write_text(COMMAND)
    insert(package / 'cli/commands.py', 'COMMANDS = {',
           "_MINE = Command('mine', 'nothing', 'ou_monitor.cli.mine', 'Do nothing.', (), ('',))\n")
    insert(package / 'cli/commands.py', '_SIMULATE)}', '_MINE, ')
    insert(package / 'analysis/supply.py', '\n    def to_dict(self)',
           '    shelf_v: float = 0.25\n')
    return folder


def run(copy: Path, *command: object) -> str:
    """Return what a program prints that uses the copy."""
    done = subprocess.run(
        [sys.executable, *map(str, command)], cwd=copy, capture_output=True, text=True,
        env={**os.environ, 'PYTHONPATH': str(copy)}, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_cause_can_be_simulated(copy):
    (copy / 'm.yaml').write_text(
        'model:\n- {term: ou, params: {alpha: 40.0, sigma: 0.5, u0: 12.0}}\n'
        '- {term: leak, params: {rate: -0.1, curvature: 0.0}}\n')
    assert 'leak' in run(copy, '-m', 'ou_monitor.cli.main', 'simulate', '--model', 'm.yaml',
                         '--duration', 2, '--output', 'a.mcap')


def test_a_format_is_read_and_a_fact_is_told(copy):
    t = np.arange(400) / 100.0
    rows = '\n'.join(f'{a:.2f} {5.0 + 0.01 * np.sin(a * a):.4f}' for a in t)
    (copy / 'a.log').write_text(f'MINE 1\n{rows}\n')
    found = json.loads(run(copy, '-m', 'ou_monitor.cli.main', 'analyze', 'a.log', '--json', '-'))
    assert found['n'] == 400 and found['supply']['shelf_v'] == 0.25


def test_a_parameter_is_declared_and_checked(copy):
    said = run(copy, '-c', (
        'from ou_monitor.online.settings import ESTIMATOR_PARAMETERS, monitor_settings\n'
        'print([p.high for p in ESTIMATOR_PARAMETERS if p.name == "reserve"])\n'
        'print(monitor_settings({"reserve": 0.5}).reserve)\n'
        'try:\n    monitor_settings({"reserve": 2.0})\n'
        'except ValueError as error:\n    print(error)\n'))
    assert said.splitlines()[:2] == ['[1.0]', '0.5'] and 'within 0.0..1.0' in said


def test_a_command_is_listed_and_runs(copy):
    assert run(copy, '-m', 'ou_monitor.cli.main', 'mine') == 'done\n'
    assert '  mine ' in run(copy, '-m', 'ou_monitor.cli.main', '--help')
