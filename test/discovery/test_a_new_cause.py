"""
A new cause is one module: a toy is added to a copy of the tree, and everything knows it.

Beside its module and its tests (which hold its circuit), one line of the generator of
hidden effects changes.
"""

import os
from pathlib import Path
import shutil
import subprocess
import sys

from project import ROOT

MODULE = '''"""A consumer that draws a rectified sine of current: a heartbeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.segment import Effect, Segment
from ou_monitor.model.terms.term import parameter, Role, Term


@dataclass(frozen=True)
class Heartbeat(Term):
    """Add a rectified sine of a second."""

    NAME: ClassVar[str] = 'heartbeat'
    FAMILY: ClassVar[str] = 'events'
    ROLE: ClassVar[Role] = Role.MEAN
    LINEAR: ClassVar[tuple[str, ...]] = ('height',)
    SIGNS: ClassVar[tuple[str, ...]] = ('line', 'band', 'autocorrelation')
    IMITATES: ClassVar[tuple[str, ...]] = ('tone',)
    MEANING: ClassVar[str] = 'Something draws current once a second.'
    REMEDY: ClassVar[str] = 'Look for a beacon.'
    SEPARATED_BY: ClassVar[str] = 'the beacon switched off'

    height: float = parameter('V', 'height of each beat')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.level += self.height * np.abs(np.sin(np.pi * (s.at - s.origin)))

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return beats of any height."""
        return (cls(0.0),)
'''

TESTS = '''"""The heartbeat, hidden as a circuit, through all that knows causes."""

from hidden_effects import causes, draw
from hidden_registry import effect
import numpy as np
from ou_monitor import discover, Recording
from ou_monitor.cli.discover import model_text
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.recordings.model_file import read_model
from ou_monitor.report.discovery_document import discovery_document
from ou_monitor.report.page import html
from ou_monitor.report.terminal import terminal
import pytest


@effect('heartbeat')
def heartbeat(bench, gain):
    """Let a beacon load the rail once a second."""
    height = -4.0 * gain * bench.stationary
    bench.series.append(height * np.abs(np.sin(np.pi * bench.time)))
    return {'height_v': height}


@pytest.fixture(scope='module')
def found():
    """Return what is hidden, and what is found of it."""
    hidden = draw('single', np.random.default_rng(1), cause='heartbeat', duration=8.0)
    return hidden, discover(Recording(hidden.t, hidden.voltage, hidden.throttle, 'toy'))


def test_the_generator_and_the_catalogue_have_it():
    assert 'heartbeat' in causes() and 'heartbeat' in catalogue()


def test_it_is_named_measured_and_explained(found):
    hidden, finding = found
    assert [cause.name for cause in finding.causes] == ['heartbeat'] == list(hidden.truth)
    (cause,) = finding.causes
    assert cause.term.FAMILY == 'events' == hidden.families[0]
    true = hidden.detail['heartbeat']['height_v']
    assert abs(cause.term.height - true) < 4.0 * cause.se['height'] < 2.0 * abs(true)
    assert 'once a second' in cause.explanation and 'beacon' in cause.explanation
    assert 'heartbeat' in finding.sentence


def test_terminal_page_and_model_file_have_it(found, tmp_path):
    _, finding = found
    said = discovery_document(finding)
    assert 'heartbeat' in terminal(said)
    page = html(said)
    assert 'heartbeat' in page and 'Look for a beacon' in page
    path = tmp_path / 'toy.yaml'
    path.write_text(model_text(finding))
    model = read_model(path).model
    assert model == SupplyModel(finding.model.terms)
    assert np.isfinite(model.simulate(np.arange(100) / 1e3, np.random.default_rng(0))).all()
'''


def test_a_toy_cause_in_a_copy_of_the_tree(tmp_path):
    """Only its module, its tests and one line of the generator are written."""
    for part in ('ou_monitor', 'test/hidden', 'test/support', 'setup.cfg'):
        source, target = ROOT / part, tmp_path / part
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns('__pycache__'))
        else:
            shutil.copy(source, target)
    (tmp_path / 'ou_monitor/model/terms/heartbeat.py').write_text(MODULE)
    tests = tmp_path / 'test/model/test_terms_heartbeat.py'
    tests.parent.mkdir()
    tests.write_text(TESTS)
    registry = tmp_path / 'test/hidden/hidden_registry.py'
    text = registry.read_text()
    assert text.count('LABELS = {\n') == 1
    registry.write_text(text.replace('LABELS = {\n', "LABELS = {\n    'heartbeat': 'events',\n"))
    path = os.pathsep.join(str(tmp_path / part) for part in ('.', 'test/hidden', 'test/support'))
    run = subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', str(tests)],
        cwd=tmp_path, env={**os.environ, 'PYTHONPATH': path}, capture_output=True, text=True,
        timeout=120, check=False)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]
    assert '3 passed' in run.stdout and Path(tmp_path, 'setup.cfg').exists()


def test_without_its_module_the_toy_is_unknown():
    """So that the copy above cannot pass by what is installed."""
    from ou_monitor.model.terms.catalogue import catalogue
    assert 'heartbeat' not in catalogue()
