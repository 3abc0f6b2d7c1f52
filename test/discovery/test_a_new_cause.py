"""
A cause of another package: the example is put on the path, and everything knows it.

One that cannot be used, or that fails in a search, costs a note and no answer.
"""

from contextlib import contextmanager
import json
from pathlib import Path
import shutil
import subprocess
import sys
import tomllib

from hidden_effects import causes, draw
import hidden_registry
from hidden_registry import effect
import numpy as np
from ou_monitor import discover, Recording
from ou_monitor.cli.main import main
from ou_monitor.cli.recorded import model_text
from ou_monitor.model.supply import SupplyModel
import ou_monitor.model.terms.catalogue as terms
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.recordings.model_file import read_model
from project import ROOT
import pytest

EXAMPLE = ROOT / 'examples/heartbeat'
PROJECT = tomllib.loads((EXAMPLE / 'pyproject.toml').read_text())['project']
(ENTRY,) = PROJECT['entry-points'][terms.GROUP].items()


@contextmanager
def installed(folder: Path, **entries: str):
    """Have entry points as pip would write them, beside the modules of a folder."""
    about = folder / f"{PROJECT['name'].replace('-', '_')}-{PROJECT['version']}.dist-info"
    about.mkdir()
    (about / 'METADATA').write_text(
        f"Metadata-Version: 2.1\nName: {PROJECT['name']}\nVersion: {PROJECT['version']}\n")
    (about / 'entry_points.txt').write_text(f'[{terms.GROUP}]\n' + ''.join(
        f'{name} = {target}\n' for name, target in entries.items()))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        patch.setattr(terms, '_left_out', {})
        before = set(sys.modules)
        catalogue.cache_clear()
        try:
            yield
        finally:
            catalogue.cache_clear()
            for name in set(sys.modules) - before:
                if str(folder) in str(getattr(sys.modules[name], '__file__', '')):
                    del sys.modules[name]


@pytest.fixture(scope='module')
def example(tmp_path_factory):
    """Return the folder of the installed example, with a circuit that causes its effect."""
    folder = tmp_path_factory.mktemp('site')
    for module in EXAMPLE.glob('*.py'):
        shutil.copy(module, folder)
    with pytest.MonkeyPatch.context() as patch, installed(folder, **dict([ENTRY])):
        patch.setitem(hidden_registry.LABELS, 'heartbeat', 'events')
        patch.setattr(hidden_registry, 'EFFECTS', hidden_registry.EFFECTS)

        @effect('heartbeat')
        def heartbeat(bench, gain):
            """Let a beacon load the rail once a second."""
            height = -4.0 * gain * bench.stationary
            bench.series.append(height * np.abs(np.sin(np.pi * bench.time)))
            return {'height_v': height}

        yield folder
        del hidden_registry.EFFECTS['heartbeat']


@pytest.fixture(scope='module')
def found(example):
    """Return what is hidden, and what is found of it."""
    hidden = draw('single', np.random.default_rng(1), cause='heartbeat', duration=8.0)
    return hidden, discover(Recording(hidden.t, hidden.voltage, hidden.throttle, 'toy'))


def test_the_generator_and_the_catalogue_have_it(example):
    assert 'heartbeat' in causes() and [*catalogue()][-1] == 'heartbeat'
    assert terms.left_out() == {}


def test_it_is_named_measured_and_explained(found):
    hidden, finding = found
    assert [cause.name for cause in finding.causes] == ['heartbeat'] == list(hidden.truth)
    (cause,) = finding.causes
    assert cause.term.FAMILY == 'events' == hidden.families[0]
    true = hidden.detail['heartbeat']['height_v']
    assert abs(cause.term.height - true) < 4.0 * cause.se['height'] < 2.0 * abs(true)
    assert 'once a second' in cause.explanation.text and 'beacon' in cause.explanation.text
    assert 'heartbeat' in finding.sentence


def test_terminal_page_and_model_file_have_it(found, tmp_path):
    _, finding = found
    assert 'heartbeat' in str(finding)
    page = finding._repr_html_()
    assert 'heartbeat' in page and 'Look for a beacon' in page
    path = tmp_path / 'toy.yaml'
    path.write_text(model_text(finding.record))
    model = read_model(path).model
    assert model == SupplyModel(finding.model.terms)
    assert np.isfinite(model.simulate(np.arange(100) / 1e3, np.random.default_rng(0))).all()


def test_without_its_package_the_example_is_unknown():
    """So that what is above cannot pass by what is installed; in a process of its own."""
    code = ('from ou_monitor.model.terms.catalogue import catalogue\n'
            "raise SystemExit('heartbeat' in catalogue())")
    assert subprocess.run([sys.executable, '-c', code], cwd=ROOT, check=False).returncode == 0


RAIL = Recording(np.arange(600) / 100.0, 15.0 + 0.02 * np.random.default_rng(4).standard_normal(
    600), np.where(np.arange(600) % 200 < 100, 0.2, 0.5), 'rail')
# Modules of broken causes by name, and what is said of each.
BROKEN = {
    'absent': (None, 'ModuleNotFoundError'),
    'wrong': ('1 +', 'SyntaxError'),
    'ends': ('raise SystemExit(3)', 'SystemExit: 3'),
    'number': ('Cause = 3', 'not a class derived from Term'),
    'silent': ("class Cause(Heartbeat):\n    NAME = 'silent'\n    MEANING = ''", 'no MEANING'),
    'tone': ("class Cause(Heartbeat):\n    NAME = 'tone'", 'not the name of another cause'),
    'other': ("class Cause(Heartbeat):\n    NAME = 'another'", 'the name of the entry point'),
    'linear': ("class Cause(Heartbeat):\n    NAME = 'linear'\n    LINEAR = ('width',)",
               'width is in LINEAR'),
}
FAILING = {
    # Where it fails in a search: with an error that fits have too, and with one that is a bug.
    'candidates': ('    @classmethod\n    def candidates(cls, view):\n        return view.nothing',
                   'AttributeError'),
    'value': ("    @classmethod\n    def candidates(cls, view):\n        raise ValueError('no')",
              'ValueError: no'),
    'columns': ('    def start(self, rng):\n        return lambda s: 1 / 0', 'ZeroDivisionError'),
    'bases': ('    def columns(self, s):\n        return None', 'Error'),
}
HEAD = 'from dataclasses import dataclass\nfrom ou_monitor_heartbeat import Heartbeat\n\n\n'


@pytest.fixture(scope='module')
def plain(tmp_path_factory):
    """Return a recording, and what is found in it without a cause of another package."""
    path = tmp_path_factory.mktemp('plain') / 'rail.csv'
    np.savetxt(path, np.column_stack([RAIL.t, RAIL.voltage, RAIL.throttle]), '%.9g', ',',
               header='time_s,voltage_v,throttle', comments='')
    return path, discover(path).to_dict()


def test_a_broken_cause_is_a_note(plain, tmp_path):
    """Whatever is wrong with a package: a sentence, and the answer as without it."""
    recording, expected = plain
    shutil.copy(EXAMPLE / 'ou_monitor_heartbeat.py', tmp_path)
    for name, (text, _) in BROKEN.items():
        if text is not None:
            (tmp_path / f'broken_{name}.py').write_text(HEAD + text)
    with installed(tmp_path, **{name: f'broken_{name}:Cause' for name in BROKEN}):
        said = tuple(terms.left_out().values())
        result = discover(recording).to_dict()
    assert result == {**expected, 'notes': [*expected['notes'], *said]}
    assert len(said) == len(BROKEN) and not any('\n' in one for one in said)
    for name, (_, words) in BROKEN.items():
        (one,) = (one for one in said if f"'{name}'" in one.split(' of another ')[0])
        assert words in one


@pytest.mark.parametrize('name', FAILING)
def test_a_cause_that_fails_is_left_out(name, plain, tmp_path, capsys):
    """The search begins again without it; of the command no traceback."""
    text, words = FAILING[name]
    shutil.copy(EXAMPLE / 'ou_monitor_heartbeat.py', tmp_path)
    (tmp_path / 'failing.py').write_text(
        f"{HEAD}@dataclass(frozen=True)\nclass Cause(Heartbeat):\n    NAME = '{name}'\n"
        f'    SIGNS = ()\n    MEASURED = True\n{text}\n')
    recording, expected = plain
    with installed(tmp_path, **{name: 'failing:Cause'}):
        assert main(['discover', str(recording), '--json', str(tmp_path / 'x.json')]) == 0
        data = json.loads((tmp_path / 'x.json').read_text())
        (said,) = terms.left_out().values()
    assert f"'{name}'" in said and words in said
    assert data == {**expected, 'notes': [*expected['notes'], said]}
    assert 'Traceback' not in capsys.readouterr().err


def test_a_model_with_a_failing_cause_is_one_line(tmp_path, capsys):
    """Of any other command; and of a model file whose cause was left out, the reason."""
    shutil.copy(EXAMPLE / 'ou_monitor_heartbeat.py', tmp_path)
    (tmp_path / 'failing.py').write_text(
        f"{HEAD}class Cause(Heartbeat):\n    NAME = 'fails'\n"
        '    def start(self, rng):\n        return lambda s: s.nothing\n')
    (tmp_path / 'ends.py').write_text('raise SystemExit(3)')
    with installed(tmp_path, fails='failing:Cause', ends='ends:Cause'):
        for term, words in (('fails', "'fails' of another package failed: AttributeError"),
                            ('ends', "'ends' of another package was left out: SystemExit: 3")):
            path = tmp_path / f'{term}.yaml'
            path.write_text('model:\n- {term: ou, params: {alpha: 60, sigma: 0.3, u0: 5}}\n'
                            f'- {{term: {term}, params: {{height: 0.1}}}}\n')
            assert main(['simulate', '--model', str(path), '--duration', '1', '--rate', '100',
                         '--output', str(tmp_path / 'x.mcap')]) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert words in line
