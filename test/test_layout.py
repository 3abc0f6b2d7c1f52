"""The dependencies in doc/architecture.md, checked import by import."""

import ast
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
import re
import sys

from project import ROOT
import pytest

PACKAGE = 'ou_monitor'
# A module may import only from its own part and from parts of a lower level.
LEVEL = {
    'errors': 0, 'text': 0, 'records': 0, 'timeline': 0.5, 'model': 1, 'online': 2,
    'stream': 3, 'adc': 3, 'recordings': 4, 'simulation': 5, 'criticism': 5, 'analysis': 6,
    'comparison': 6.5, 'discovery': 6.5, 'paper': 6, 'fleet': 7, 'report': 8, 'bench': 8.4,
    'nodes': 9, 'cli': 9,
}
# What users reach as `from ou_monitor import ...`: above all but the programs.
FACADE_LEVEL = 8.5
PLOTTING = {'matplotlib', 'plotly', 'seaborn', 'bokeh', 'PIL'}
MCAP = {'mcap', 'mcap_ros2', 'rosbags', 'rosbag2_py', 'zstandard', 'lz4'}
MCAP_MODULES = {f'ou_monitor.recordings.{name}' for name in (
    'bag', 'mcap_file', 'standard_types')}
# Parsers of logs: optional, each in one importer.
PARSERS = {'pyulog': 'ulog', 'pymavlink': 'dataflash', 'orangebox': 'blackbox'}
CORE = {'numpy', 'scipy'}
# Extras, each with the one module that may import it.
EXTRAS = {'argcomplete': 'cli.main', 'dask': 'fleet.workers', 'distributed': 'fleet.workers',
          'pandas': 'report.result', 'pyarrow': 'fleet.table', 'tornado': 'nodes.live'}
# The group of causes of other packages, which is no module.
ENTRY_POINTS = 'ou_monitor.causes'
# The one command that is a node: the table of commands names its module, and loads it last.
NODE_COMMANDS = {('ou_monitor.cli.commands', 'ou_monitor.nodes.live')}
# What each part may import beyond the standard library; ROS is for nodes alone.
ALLOWED = {
    'errors': set(), 'text': set(), 'stream': CORE | {'yaml'}, 'recordings': CORE | {'yaml'},
    'cli': CORE | {'yaml'}, **dict.fromkeys((
        'records', 'timeline', 'model', 'online', 'adc', 'simulation', 'criticism',
        'analysis', 'comparison', 'discovery', 'paper', 'fleet', 'report', 'bench',
        '__init__'), CORE),
}


def imports_of(source: str, module: str) -> Iterator[tuple[int, str]]:
    """Yield line and absolute name of every import, wherever it stands in the source."""
    words = module.split('.')
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = words[:-node.level] if node.level else []
            name = '.'.join(base + ([node.module] if node.module else []))
            # `from ou_monitor import online` names a part by its last word.
            for alias in node.names:
                yield node.lineno, f'{name}.{alias.name}'
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            # Tables of modules loaded on first use, as in ou_monitor/__init__.py.
            named = re.fullmatch(r'(ou_monitor(?:\.\w+)+)(?::\w+)?', node.value)
            if named and named[1] != ENTRY_POINTS:
                yield node.lineno, named[1]
        elif isinstance(node, ast.Call) and node.args:
            called = getattr(node.func, 'attr', getattr(node.func, 'id', ''))
            first = node.args[0]
            if called in ('import_module', '__import__') and isinstance(first, ast.Constant):
                # Those of our own are found as the table's strings are.
                if not str(first.value).startswith(PACKAGE + '.'):
                    yield node.lineno, str(first.value)


def part_of(module: str) -> str:
    """Return the folder, or the top-level module, that a dotted name belongs to."""
    words = module.split('.')
    return words[1] if len(words) > 1 and words[1] in LEVEL else '__init__'


def wrong_imports(source: str, module: str) -> list[str]:
    """Return one sentence for each import of a module that goes against the arrows."""
    part = part_of(module)
    level = LEVEL.get(part, FACADE_LEVEL)
    wrong = []
    for line, name in imports_of(source, module):
        top = name.split('.')[0]
        where = f'{module}:{line}: {name}'
        if (module, name) in NODE_COMMANDS:
            continue
        if top == PACKAGE:
            other = part_of(name)
            other_level = LEVEL.get(other, FACADE_LEVEL)
            if other == '__init__' and part != '__init__' and name != f'{PACKAGE}.__version__':
                wrong.append(f'{where}: import from the module that holds it, not the package')
            elif other_level > level or (other_level == level and other != part and level):
                wrong.append(f'{where}: {part} may not import {other}')
        elif top in sys.stdlib_module_names:
            continue
        elif part == 'nodes' and top not in PLOTTING | MCAP | set(EXTRAS):
            continue
        elif top in MCAP and module in MCAP_MODULES:
            continue
        elif module == f'{PACKAGE}.recordings.importers.{PARSERS.get(top)}':
            continue
        elif top in EXTRAS and module == f'{PACKAGE}.{EXTRAS[top]}':
            continue
        elif top in PLOTTING and module.startswith(f'{PACKAGE}.report'):
            continue
        elif top not in ALLOWED.get(part, set()):
            wrong.append(f'{where}: {part} may not import {top}')
    return wrong


def modules() -> dict[str, Path]:
    return {
        '.'.join(path.relative_to(ROOT).with_suffix('').parts): path
        for path in sorted((ROOT / PACKAGE).rglob('*.py'))}


def test_imports_follow_the_arrows():
    wrong = [sentence for module, path in modules().items()
             for sentence in wrong_imports(path.read_text(encoding='utf-8'), module)]
    assert not wrong, '\n'.join(wrong)


def test_every_part_is_on_disk():
    """Every part is on disk, so that the test above cannot pass on nothing."""
    parts = {part_of(module) for module in modules()}
    assert parts == set(LEVEL) | {'__init__'}


def circle(sources: Mapping[str, str]) -> list[str]:
    """Return modules that import one another in a circle, wherever the imports stand."""
    graph = {module: {name for node in ast.walk(ast.parse(source))
                      if isinstance(node, (ast.Import, ast.ImportFrom))
                      for name in _imported(node) if name in sources and name != module}
             for module, source in sources.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def _imported(node: ast.Import | ast.ImportFrom) -> Iterator[str]:
    for alias in node.names:
        if isinstance(node, ast.Import):
            yield alias.name
        else:
            # A module, or a name in one.
            yield from (f'{node.module}.{alias.name}', str(node.module))


def test_no_modules_import_one_another():
    """Neither within a folder nor across, nor late within a function."""
    assert circle({m: path.read_text(encoding='utf-8') for m, path in modules().items()}) == []


def test_each_command_prints_a_document():
    """What it prints and its JSON go through one function; an export is for another program."""
    said = {path.stem: path.read_text(encoding='utf-8').count('output.say(')
            + path.read_text(encoding='utf-8').count('write_json(')
            for path in (ROOT / PACKAGE / 'cli').glob('*.py') if path.stem != 'output'}
    assert {name: n for name, n in said.items() if n} == {'simulate': 1}


@pytest.mark.parametrize('kind, homes', [
    ('TimeLine', ('timeline', 'online')), ('SupplyFacts', ('analysis',)),
    ('Document', ('report', 'cli'))])
def test_each_stage_is_made_in_its_place(kind, homes):
    """Source -> TimeLine -> Supply -> Facts -> Document: nobody makes one beside it."""
    made = {part_of(module) for module, path in modules().items()
            if re.search(rf'(?<![\w.])(?<!class ){kind}\(', path.read_text(encoding='utf-8'))}
    assert made and made <= set(homes)


@pytest.mark.parametrize('module, source', [
    ('ou_monitor.model.ou', 'from ou_monitor.online.risk.first_passage import x'),
    ('ou_monitor.model.ou', 'from ..online.risk import x'),
    ('ou_monitor.model.__init__', 'from ..online import x'),
    ('ou_monitor.errors', 'import numpy'),
    ('ou_monitor.online.monitor', 'def f():\n    from std_msgs.msg import Float64\n'),
    ('ou_monitor.online.monitor', 'import importlib\nimportlib.import_module("rclpy")\n'),
    ('ou_monitor.online.monitor', 'import matplotlib.pyplot as plt'),
    ('ou_monitor.analysis.analyze', 'if True:\n    import ou_monitor.cli.main'),
    ('ou_monitor.recordings.csv', 'from mcap.reader import make_reader'),
    ('ou_monitor.recordings.importers.ulog', 'import orangebox'),
    ('ou_monitor.recordings.importers.log', 'from ou_monitor.analysis.analyze import analyze'),
    ('ou_monitor.fleet.fleet', 'import dask'),
    ('ou_monitor.nodes.estimator_node', 'import tornado.web'),
    ('ou_monitor.cli.commands', 'MODULE = "ou_monitor.nodes.estimator_node"'),
    ('ou_monitor.cli.main', 'from ou_monitor import SlidingEstimator'),
    ('ou_monitor.__init__', 'HOMES = {"Estimator": "ou_monitor.nodes.estimator_node"}'),
])
def test_a_wrong_import_is_found(module, source):
    """Each kind of leak is one finding: the checker can fail."""
    assert len(wrong_imports(source, module)) == 1
