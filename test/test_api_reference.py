"""The reference that Sphinx builds from doc/: no warnings, and every public name is in it."""

import re
import subprocess
import sys

import ou_monitor
from project import ROOT
import pytest


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
