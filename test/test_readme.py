"""README.md names only what exists: files, options, modules, keys, and an example that runs."""

import re
import subprocess
import sys

from project import ROOT
import pytest

README = (ROOT / 'README.md').read_text(encoding='utf-8')


def blocks(language: str) -> list[str]:
    """Return the fenced blocks in one language."""
    return re.findall(rf'^```{language}\n(.*?)^```', README, re.MULTILINE | re.DOTALL)


def run(*command: str) -> subprocess.CompletedProcess:
    """Run a command in the repository."""
    return subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True,
                          timeout=120)


def test_the_quick_start_is_the_two_commands():
    """The first commands are the demo and the tests, and both can be started."""
    first = blocks('console')[0].split()
    assert first == ['./scripts/demo', './scripts/test']
    assert all((ROOT / path).stat().st_mode & 0o111 for path in first)


@pytest.mark.parametrize('path', sorted(set(re.findall(
    r'(?<![\w/.])((?:bags|doc|scripts|msg_config|launch|config|benchmarks|test|ou_monitor)'
    r'/[\w./]*)', README)) | set(re.findall(r'`(\w+\.yaml)`', README)) - {'my_adc.yaml'}))
def test_what_is_named_exists(path):
    """Every file and folder named is there."""
    assert (ROOT / path).exists() or (ROOT / 'msg_config' / path).exists()


def test_launch_file_exists():
    """The launch file that is started is there."""
    for name in re.findall(r'ros2 launch ou_monitor (\S+)', README):
        assert (ROOT / 'launch' / name).is_file()


@pytest.mark.parametrize('command', sorted(set(re.findall(r'ou-monitor (\w+)', README))))
def test_commands_exist(command):
    """Each command of ou-monitor that is named has its help, with the options named beside it."""
    shown = run('-m', 'ou_monitor.cli.main', command, '--help')
    assert shown.returncode == 0, shown.stderr
    for line in README.splitlines():
        if f'ou-monitor {command}' in line:
            for option in re.findall(r'--\w+', line):
                assert option in shown.stdout


def test_no_command_is_missing():
    """The table lists every command there is."""
    from ou_monitor.cli.main import COMMANDS
    assert set(COMMANDS) == set(re.findall(r'^\| `ou-monitor (\w+)', README, re.MULTILINE))


def test_executables_exist():
    """Each executable that is named is an entry point, and replay has the options named."""
    setup = (ROOT / 'setup.py').read_text(encoding='utf-8')
    for name in re.findall(r'ros2 run ou_monitor (\w+)', README):
        assert f"'{name} = ou_monitor.nodes.{name}:main'" in setup
    line = next(line for line in README.splitlines() if 'run ou_monitor replay' in line)
    shown = run('-m', 'ou_monitor.nodes.replay', '--help')
    assert shown.returncode == 0, shown.stderr
    for option in re.findall(r'--\w+', line):
        assert option in shown.stdout


def test_brownout_parameters_are_listed():
    """Each with its default; none is named that does not exist."""
    from ou_monitor.online.settings import ESTIMATOR_PARAMETERS
    defaults = {p.name: p.default for p in ESTIMATOR_PARAMETERS}
    assert set(re.findall(r'`(brownout\.\w+)`', README)) <= set(defaults)
    rows = dict(re.findall(r'^\| (`(?:brownout\.|model_file)[^|]*) \| ([^|]*) \|', README,
                           re.MULTILINE))
    listed = {}
    for names, values in rows.items():
        for name, value in zip(names.split(', '), (values + ', ').split(', ')):
            listed[name.strip('`')] = value.strip().split(' ')[0]
    wanted = {name: default for name, default in defaults.items()
              if name.startswith('brownout.') or name == 'model_file'}
    assert listed == {name: f'{v:g}' if isinstance(v, float) else str(v).lower() or 'none'
                      for name, v in wanted.items()}


def test_filter_parameters_are_listed():
    """Each with its default, in the section of the filter."""
    from ou_monitor.online.settings import FILTER_PARAMETERS
    section = README.split('## Adaptive low-pass')[1].split('## ')[0]
    listed = {}
    for names, values in re.findall(r'^\| ((?:`[\w.]+`(?:, )?)+) \| ([^|]*) \|', section.split(
            '| parameter |')[1], re.MULTILINE):
        for name, value in zip(names.split(', '), values.split(', '), strict=True):
            listed[name.strip('`')] = value.strip()
    assert listed == {'input.type': 'auto', 'input.field': 'none', **{
        p.name: f'{p.default:g}' if isinstance(p.default, float) else str(p.default).lower()
        for p in FILTER_PARAMETERS}}


def test_filter_laws_are_listed():
    """Every law has a row, and there are no others."""
    from ou_monitor.online.settings import LAWS
    section = README.split('| law | cutoff |')[1].split('\n\n')[0]
    assert set(re.findall(r'^\| `(\w+)` \|', section, re.MULTILINE)) == set(LAWS)


def test_filter_numbers_are_those_of_the_laws():
    """Noise taken off between 150 and 20 Hz, lags, and what the pole of Kalman loses."""
    import math

    from ou_monitor.online.filter.cutoff_laws import supply_noise
    from ou_monitor.online.filter.lag import cutoff_for_lag
    from ou_monitor.online.filter.wiener import squared_error
    off = {mode: 1.0 - math.sqrt(supply_noise(mode, 2, 20.0, 63.0)
                                 / supply_noise(mode, 2, 150.0, 63.0))
           for mode in ('lowpass', 'derivative')}
    # 15 % for order 2 and 16 % for order 1; 73 % and 69 % of the derivative.
    assert off == {'lowpass': pytest.approx(0.15, abs=0.01),
                   'derivative': pytest.approx(0.7, abs=0.04)}
    assert [round(cutoff_for_lag(2, lag, 10.0), 1) for lag in (45.0, 20.0)] == [19.3, 41.3]
    for ratio, loss in ((5.0, 2.0), (2.0, 16.0)):
        pole, best = math.hypot(1.0, ratio), ratio - 1.0
        errors = [squared_error(1, w, (ratio, 1.0), (0.0, 1.0), 1.0) for w in (pole, best)]
        assert 100.0 * (errors[0] / errors[1] - 1.0) == pytest.approx(loss, abs=0.5)


def test_python_example_runs():
    """The example runs and its intervals hold the values it was made with."""
    (code,) = blocks('python')
    scope: dict[str, object] = {}
    exec(compile(code, 'README.md', 'exec'), scope)
    e = scope['e']
    assert e.usable
    # Seeded; four standard errors instead of two leave room for another numpy's random stream.
    for name in ('alpha', 'sigma'):
        low, high = e.interval(name, z=4.0)
        assert low < scope[name] < high


def test_message_example_is_accepted(tmp_path):
    """The example of a message description is one that the package reads."""
    from ou_monitor.stream.config import load_msg_config
    (text,) = blocks('yaml')
    path = tmp_path / 'my_adc.yaml'
    path.write_text(text, encoding='utf-8')
    config = load_msg_config(str(path))
    assert config.voltage.unit_factor == 1e-3 and config.throttle is None


def test_options_are_seen():
    """The pattern above sees an option that is named."""
    line = next(line for line in README.splitlines() if 'ou-monitor analyze R' in line)
    assert re.findall(r'--\w+', line) == ['--report']
