"""`import ou_monitor`: fast, complete, documented, and with clear errors for missing names."""

import doctest
import re
import subprocess
import sys

import ou_monitor
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.term import Term
from ou_monitor.paper import reproduce as reproduction
from project import ROOT
import pytest


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


@pytest.fixture(scope='module')
def built(tmp_path_factory):
    """Return the folder of the pages; the build itself is the test that nothing warns."""
    folder = tmp_path_factory.mktemp('reference')
    done = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-W', '--keep-going', '-E', '-q', '-d',
         str(folder / 'doctrees'), str(ROOT / 'doc'), str(folder / 'html')],
        capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return folder / 'html'


def test_public_names_are_documented(built):
    page = (built / 'api.html').read_text(encoding='utf-8')
    names = {f'ou_monitor.{name}' for name in ou_monitor.__all__ if name != '__version__'} | {
        'ou_monitor.model.supply.SupplyModel', 'ou_monitor.model.terms.term.Term'}
    listed = set(re.findall(r'<dt class="[^"]*sig-object[^"]*" id="([\w.]+)"', page))
    assert names <= listed
    # Nothing but these and their members: the reference is of the public names.
    assert {name for name in listed if not any(
        name == public or name.startswith(public + '.') for public in names)} == set()
    for name in names:
        assert re.search(rf'id="{re.escape(name)}".*?<dd><p>\w', page, re.DOTALL), name


def test_every_page_is_in_the_table_of_contents(built):
    index = (built / 'index.html').read_text(encoding='utf-8')
    for path in (ROOT / 'doc').glob('*.md'):
        assert f'href="{path.stem}.html"' in index, path.name


def test_sections_of_docstrings_are_sections(built):
    """Sections of NumPy have become fields, not text with a line of dashes."""
    page = (built / 'api.html').read_text(encoding='utf-8')
    assert 'Parameters' in page and '-----' not in page
