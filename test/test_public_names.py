"""`import ou_monitor`: fast, complete, and with clear errors for missing names."""

import doctest
import pathlib
import re
import subprocess
import sys

import ou_monitor
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.term import Term
from ou_monitor.paper import reproduce as reproduction
import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]


@pytest.mark.parametrize('name', ou_monitor.__all__)
def test_every_public_name_can_be_imported(name):
    """It is listed, and is the same object the second time."""
    value = getattr(ou_monitor, name)
    assert name in dir(ou_monitor) and getattr(ou_monitor, name) is value


@pytest.mark.parametrize('value', [
    *(getattr(ou_monitor, name) for name in ou_monitor.__all__ if name != '__version__'),
    SupplyModel, Term], ids=lambda value: value.__name__)
def test_the_example_of_every_public_name_runs(value, monkeypatch):
    """Its docstring has one, and it prints what it says; `reproduce` with fewer simulations."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(reproduction, 'CREST_PATHS', 200)
    monkeypatch.setattr(reproduction, 'JUMP_SECONDS', 10.0)
    (example,) = doctest.DocTestFinder(recurse=False).find(value, value.__name__)
    assert example.examples, f'{value.__name__} has no example'
    failed = []
    doctest.DocTestRunner().run(example, out=failed.append)
    assert not failed, ''.join(failed)


def test_unknown_names_are_attribute_errors():
    assert not hasattr(ou_monitor, 'no_such_name')
    with pytest.raises(AttributeError, match='no_such_name'):
        ou_monitor.no_such_name
    with pytest.raises(ImportError):
        exec('from ou_monitor import no_such_name', {})


def test_import_loads_nothing_else():
    program = ('import sys, ou_monitor\n'
               'assert not {"numpy", "scipy", "mcap"} & set(sys.modules)\n'
               'ou_monitor.SlidingEstimator\n'
               'assert not {"mcap", "yaml", "rclpy"} & set(sys.modules)')
    subprocess.run([sys.executable, '-c', program], check=True, timeout=60)


def test_version_is_that_of_the_package():
    """One number in __init__, which pyproject.toml reads, package.xml and CITATION.cff."""
    package = re.search(r'<version>([^<]+)<', (ROOT / 'package.xml').read_text()).group(1)
    cited = re.search(r'^version: (\S+)$', (ROOT / 'CITATION.cff').read_text(), re.M).group(1)
    assert ou_monitor.__version__ == package == cited


def test_public_names_are_not_folders():
    """`from ou_monitor import x` must not depend on which folder was imported before."""
    folders = {path.name for path in (ROOT / 'ou_monitor').iterdir() if path.is_dir()}
    assert 'discovery' in folders and not folders & set(ou_monitor.__all__)
