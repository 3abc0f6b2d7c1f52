"""The documents name only existing files, links, options and keys, and their examples run."""

import ast
import importlib.util
import json
from pathlib import Path
import re

from ou_monitor.analysis.crafts import CELL_LIMIT, pack_limit
from ou_monitor.cli.commands import COMMANDS
from ou_monitor.cli.main import main
from ou_monitor.nodes.__main__ import replay_options
from ou_monitor.stream.config import load_msg_config
from project import metadata, ROOT
import pytest

README = (ROOT / 'README.md').read_text(encoding='utf-8')
PAGES = sorted((ROOT / 'doc').glob('*.md'))
# Tables that benchmarks write.
RESULTS = sorted((ROOT / 'doc/results').glob('*.md'))
# Documents with relative links: what a reader clicks through.
LINKED = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'benchmarks/README.md',
          ROOT / 'SECURITY.md', *PAGES, *RESULTS]
# What names a file that a reader makes or has, rather than one of the project.
OTHERS = {'my_adc.yaml', 'flight.yaml', 'rail.yaml', 'metadata.yaml', 'px4_motors.yaml',
          'crazyflie.yaml', 'crazyflies.yaml', 'dds_topics.yaml'}


def page(name: str) -> str:
    return (ROOT / 'doc' / name).read_text(encoding='utf-8')


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf'^```{language}\n(.*?)^```', text, re.MULTILINE | re.DOTALL)


def anchors(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r'^```.*?^```', '', path.read_text(encoding='utf-8'), flags=re.M | re.S)
    return {re.sub(r'[^\w\- ]', '', title.lower()).replace(' ', '-')
            for title in re.findall(r'^#+ (.+)$', text, re.MULTILINE)}


def test_the_quick_start_is_the_two_commands():
    first = blocks('console')[0].split()
    assert first == ['./scripts/demo', './scripts/test']
    assert all((ROOT / path).stat().st_mode & 0o111 for path in first)


def test_readme_is_short():
    assert len(README.splitlines()) <= 150


@pytest.mark.parametrize('path', PAGES, ids=lambda path: path.name)
def test_page_is_short(path):
    """At most 250 lines, and the README or another page links it."""
    assert len(path.read_text(encoding='utf-8').splitlines()) < 250
    others = [other for other in LINKED if other != path]
    assert any(re.search(rf'\]\([\w./]*\b{path.name}[)#]', other.read_text(encoding='utf-8'))
               for other in others)


@pytest.mark.parametrize('path', LINKED, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_resolve(path):
    """Every relative link leads to a file of the project, and to a heading if it names one."""
    text = re.sub(r'^```.*?^```', '', path.read_text(encoding='utf-8'), flags=re.M | re.S)
    for target in re.findall(r'\]\(([^)\s]+)\)', text):
        if re.match(r'[a-z]+:', target):
            continue
        name, _, anchor = target.partition('#')
        there = (path.parent / name).resolve() if name else path
        assert there.exists() and there.is_relative_to(ROOT), target
        assert not anchor or anchor in anchors(there), target


@pytest.mark.parametrize('path', [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *PAGES],
                         ids=lambda path: path.name)
def test_paths_named_in_the_documents_exist(path):
    text = path.read_text(encoding='utf-8')
    named = set(re.findall(
        r'(?<![\w/.])((?:bags|doc|scripts|msg_config|launch|config|benchmarks|test|ou_monitor)'
        r'/[\w./*-]*\w)', text)) | set(re.findall(r'`(\w+\.yaml)`', text)) - OTHERS
    missing = [name for name in named
               if not any(ROOT.glob(name)) and not (ROOT / 'msg_config' / name).exists()]
    modules = [f'/{path.relative_to(ROOT).as_posix()}' for folder in (
        'ou_monitor', 'test', 'benchmarks', 'scripts') for path in (ROOT / folder).rglob('*.py')]
    missing += [name for name in re.findall(r'`([\w/]+\.py)`', text)
                if not any(module.endswith(f'/{name}') for module in modules)]
    assert not missing


@pytest.mark.parametrize('path', RESULTS, ids=lambda path: path.name)
def test_tables_of_benchmarks_have_their_place(path):
    text = path.read_text(encoding='utf-8')
    first = text.split('\n## ')[0].split('<!--')[0]
    (program,) = set(re.findall(r'`benchmarks/(\w+)\.py', first))
    assert (ROOT / f'benchmarks/{program}.py').is_file() and path.stem.startswith(program)
    assert f'doc/results/{path.name}' in (ROOT / 'benchmarks/README.md').read_text('utf-8')
    marks = re.findall(r'<!-- ([\w ]+) begins -->(.*?)<!-- \1 ends -->', text, re.DOTALL)
    assert marks and len(marks) == text.count(' begins -->')
    assert all('|' in table for _, table in marks)
    assert any(f'results/{path.name}' in page.read_text(encoding='utf-8') for page in PAGES)


def test_launch_file_exists():
    for name in re.findall(r'ros2 launch ou_monitor (\S+)', README):
        assert (ROOT / 'launch' / name).is_file()


@pytest.mark.parametrize('command', sorted(set(re.findall(r'ou-monitor ([a-z]+)', README))))
def test_commands_exist(command, capsys):
    assert main([command, '--help']) == 0
    shown = capsys.readouterr().out
    for path in [ROOT / 'README.md', *PAGES]:
        for line in path.read_text(encoding='utf-8').replace('\\\n', '').splitlines():
            if re.search(rf'ou-monitor {command}\b', line):
                for option in re.findall(r'(?<![\w-])--[a-z][\w-]*', line):
                    assert option in shown, (path.name, option)


def test_no_command_is_missing():
    assert set(COMMANDS) == set(re.findall(r'^\| `ou-monitor (\w+)', README, re.MULTILINE))


def test_executables_exist(capsys):
    """Each executable that is named is an entry point, and replay has the options named."""
    scripts = metadata()['scripts']
    for name in re.findall(r'ros2 run ou_monitor (\w+)', README):
        assert scripts[name] == f'ou_monitor.nodes.__main__:{name}'
    line = next(line for line in README.splitlines() if 'run ou_monitor replay' in line)
    with pytest.raises(SystemExit):
        replay_options(['--help'])
    shown = capsys.readouterr().out
    assert all(option in shown for option in re.findall(r'--\w+', line))


def test_brownout_parameters_are_listed():
    from ou_monitor.online.settings import ESTIMATOR_PARAMETERS
    defaults = {p.name: p.default for p in ESTIMATOR_PARAMETERS}
    for path in [ROOT / 'README.md', *PAGES]:
        assert set(re.findall(r'`(brownout\.\w+)`', path.read_text('utf-8'))) <= set(defaults)
    rows = dict(re.findall(r'^\| (`(?:brownout\.|model_file)[^|]*) \| ([^|]*) \|',
                           page('risk.md'), re.MULTILINE))
    listed = {}
    for names, values in rows.items():
        for name, value in zip(names.split(', '), (values + ', ').split(', ')):
            listed[name.strip('`')] = value.strip().split(' ')[0]
    wanted = {name: default for name, default in defaults.items()
              if name.startswith('brownout.') or name == 'model_file'}
    assert listed == {name: f'{v:g}' if isinstance(v, float) else str(v).lower() or 'none'
                      for name, v in wanted.items()}


def test_filter_parameters_are_listed():
    from ou_monitor.online.settings import NOTCH_PARAMETERS
    from ou_monitor.online.settings import FILTER_PARAMETERS
    section = page('filter.md').split('## Parameters')[1].split('\n## ')[0]
    listed = {}
    for names, values in re.findall(r'^\| ((?:`[\w.]+`(?:, )?)+) \| ([^|]*) \|', section,
                                    re.MULTILINE):
        for name, value in zip(names.split(', '), values.split(', '), strict=True):
            listed[name.strip('`')] = value.strip()
    where = [f'{quantity}.{key}' for quantity in ('throttle', 'rpm')
             for key in ('topic', 'type', 'field')]
    assert listed == {
        'input.type': 'auto', 'input.field': 'none',
        'msg_config': 'auto', 'publish_rate': '10',
        **dict.fromkeys(where, 'none'), **{
            p.name: f'{p.default:g}' if isinstance(p.default, float) else str(p.default).lower()
            for p in (*FILTER_PARAMETERS, *NOTCH_PARAMETERS)}}


def test_filter_laws_are_listed():
    from ou_monitor.online.settings import LAWS
    section = page('filter.md').split('| law | cutoff |')[1].split('\n\n')[0]
    assert set(re.findall(r'^\| `(\w+)` \|', section, re.MULTILINE)) == set(LAWS)


def test_python_example_of_the_readme_runs(monkeypatch):
    """It estimates a bag of the library, whose sigma is known."""
    monkeypatch.chdir(ROOT)
    (code,) = blocks('python')
    scope: dict[str, object] = {}
    exec(compile(code, 'README.md', 'exec'), scope)
    low, high = scope['report'].ou.sigma_95
    assert low < 0.632 < high


def test_log_example_is_true(tmp_path):
    spec = importlib.util.spec_from_file_location('make_readme', ROOT / 'scripts/make_readme.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    printed = module.run(module.command(README), tmp_path / 'report.html')
    (shown,) = blocks('text', README.split('<!-- example begins -->')[1].split('<!-- ')[0])
    assert shown.strip() == module.shortened(printed)
    assert '[...]' in shown and '\nSag ' in shown and (tmp_path / 'report.html').stat().st_size


def test_python_example_runs():
    (code,) = blocks('python', page('commands.md'))
    scope: dict[str, object] = {}
    exec(compile(code, 'commands.md', 'exec'), scope)
    e = scope['e']
    assert e.usable
    # Seeded; four standard errors instead of two leave room for another numpy's random stream.
    for name in ('alpha', 'sigma'):
        low, high = e.interval(name, z=4.0)
        assert low < scope[name] < high


def test_message_example_is_accepted(tmp_path):
    from ou_monitor.stream.config import load_msg_config
    (text,) = blocks('yaml', page('messages.md'))
    path = tmp_path / 'my_adc.yaml'
    path.write_text(text, encoding='utf-8')
    config = load_msg_config(str(path))
    assert config.voltage.unit_factor == 1e-3 and config.throttle is None


def test_the_glossary_has_the_words_of_the_screens():
    """Every name of a fact and of a quantity is explained; the words are in order."""
    rows = re.findall(r'^\| ([^|]+) \| [^|]+ \|$', (ROOT / 'doc/glossary.md').read_text(), re.M)
    words = rows[2:] if rows[1].startswith('-') else rows[1:]
    assert words == sorted(words, key=str.lower) and len(set(words)) == len(words)
    known = ' '.join(words).lower()
    for word in ('sag', 'rail', 'alpha', 'sigma', 'tau', 'Var_inf', 'brown-out', 'first passage',
                 'nat', 'innovation', 'load level', 'noise', 'line', 'budget', 'dip', 'limit',
                 'risk', 'resistance', 'cell', 'coupling', 'horizon', 'window', 'throttle'):
        assert re.search(rf'\b{word.lower()}\b', known), word
    for page in ('README.md', 'doc/commands.md', 'doc/analysis.md', 'doc/index.rst'):
        assert 'glossary' in (ROOT / page).read_text(), page


def test_every_cause_has_a_formula_and_a_sketch():
    from ou_monitor.model.terms.catalogue import catalogue
    rows = re.findall(r'^\| `(\w+)` \| [^|]+ \| !\[\1\]\((causes/\w+\.svg)\) \| [^|]+ \|$',
                      page('glossary.md'), re.M)
    assert sorted(name for name, _ in rows) == sorted(catalogue()) and rows[0][0] == 'ou'
    assert all(picture == f'causes/{name}.svg' and (ROOT / 'doc' / picture).is_file()
               for name, picture in rows)


def test_continuous_integration_runs_the_suite():
    for path in ('.github/workflows/test.yml', '.ci/run'):
        assert './scripts/test' in (ROOT / path).read_text(encoding='utf-8')


def test_the_limit_is_documented_as_it_is():
    text = ' '.join((ROOT / 'doc/commands.md').read_text().split())
    assert f'`--cells N` alone means {CELL_LIMIT:g} V per cell' in text
    assert pack_limit(3.5, 4) == 14.0 and '`--cells 4 --brownout-voltage 3.5` is 14 V' in text
    for name in ('analyze', 'compare', 'coupling', 'discover', 'fleet'):
        options = [n for one in COMMANDS[name].options if not isinstance(one, tuple)
                   for n in one.names]
        assert {'--cells', '--brownout-voltage'} <= set(options), name


NOTEBOOK = ROOT / 'doc/recording_in_python.ipynb'


def test_the_notebook_runs_and_its_answers_are_those_of_the_recording(monkeypatch):
    monkeypatch.chdir(NOTEBOOK.parent)
    shown = []
    space = {'display': shown.append}
    book = json.loads(NOTEBOOK.read_text(encoding='utf-8'))
    assert book['nbformat'] == 4 and len({cell['id'] for cell in book['cells']}) == len(
        book['cells'])
    for cell in book['cells']:
        if cell['cell_type'] != 'code':
            continue
        assert cell['outputs'] == [] and cell['execution_count'] is None
        tree = ast.parse(''.join(cell['source']))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, NOTEBOOK.name, 'exec'), space)
        if last is not None:
            shown.append(eval(compile(ast.Expression(last.value), NOTEBOOK.name, 'eval'), space))
    assert any('<svg' in found._repr_html_() for found in shown if hasattr(found, '_repr_html_'))
    recording, analysis = space['recording'], space['analysis']
    assert analysis.supply.lowest.voltage_v == recording.voltage.min()
    assert 'load_sag' in [cause.name for cause in space['finding'].causes]
    assert space['drawn'].duration == pytest.approx(recording.duration, abs=0.01)
    assert space['drawn'].voltage.mean() == pytest.approx(recording.voltage.mean(), abs=0.1)
    assert shown[-1].explained > 0.9


AUTOPILOTS = page('autopilots.md')


@pytest.mark.parametrize('block', re.findall(
    r'```yaml\n(description:.*?)```', AUTOPILOTS, re.DOTALL))
def test_a_description_loads(block, tmp_path):
    path = tmp_path / 'own.yaml'
    path.write_text(block, encoding='utf-8')
    found = load_msg_config(path)
    assert found.voltage.topic and found.throttle is not None and found.throttle.topic


class Port:
    """A serial port with what a flight controller sends."""

    def __init__(self, volts, amps, motors, broken=False):
        """Keep it: V, A, and 1000 to 2000."""
        self.analog = bytes((int(10 * volts), 0, 0, 0, 0)) + round(100 * amps).to_bytes(
            2, 'little', signed=True) + round(100 * volts).to_bytes(2, 'little')
        self.motors = b''.join(one.to_bytes(2, 'little') for one in motors)
        self.broken, self.rest = broken, b''

    def write(self, data):
        assert data[:3] == b'$M<' and data[3] ^ data[4] == data[5]
        payload = {110: self.analog, 104: self.motors}[data[4]]
        check = len(payload) ^ data[4]
        for byte in payload:
            check ^= byte
        self.rest = b'$M>' + bytes((len(payload), data[4])) + payload + bytes(
            ((check + self.broken) % 256,))

    def read(self, size):
        found, self.rest = self.rest[:size], self.rest[size:]
        return found

    def reset_input_buffer(self):
        self.rest = b''


def test_betaflight_msp_is_decoded():
    """Volts, amperes and the mean of the motors that are there; a broken answer is none."""
    code = re.search(r'```python\n(import struct.*?)```', AUTOPILOTS, re.DOTALL)[1]
    space = {}
    exec(compile(code, 'autopilots.md', 'exec'), space)
    volts, amps, throttle = space['supply'](Port(15.87, 23.4, (1500, 1600, 1400, 1500, 0, 0)))
    assert (volts, amps, throttle) == pytest.approx((15.87, 23.4, 0.5))
    assert space['supply'](Port(15.87, -1.0, (1000,) * 4)) == pytest.approx((15.87, -1.0, 0.0))
    assert space['supply'](Port(15.87, 1.0, (1500,) * 4, broken=True)) is None
