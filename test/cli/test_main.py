"""`ou-monitor`: choice of the command, exit status, one line on standard error."""

from dataclasses import replace
import os
import re
import shlex
import subprocess
import sys
from types import SimpleNamespace

from command_line import failure
import ou_monitor
from ou_monitor.cli import main as cli
from ou_monitor.errors import InputError
import pytest


def test_version_and_help(capsys):
    """Both leave with 0; the help lists exactly the commands that exist."""
    assert cli.main(['--version']) == 0
    assert capsys.readouterr().out == f'ou-monitor {ou_monitor.__version__}\n'
    assert cli.main(['--help']) == 0
    lines = capsys.readouterr().out.splitlines()
    start = lines.index('  COMMAND') + 1
    listed = {line.split()[0] for line in lines[start:lines.index('', start)]
              if line.startswith('    ') and line[4] != ' '}
    assert listed == set(cli.COMMANDS)


@pytest.mark.parametrize('command', sorted(cli.COMMANDS))
def test_every_command_has_help_json_and_examples(command, capsys):
    """As the contract asks; a page to look at has no result to write."""
    assert cli.main([command, '--help']) == 0
    told, _, examples = capsys.readouterr().out.partition('Examples:\n')
    assert ('--json FILE' in told) == ('--force' in told) == (command != 'live')
    assert len(examples.splitlines()) >= 2
    for line in examples.splitlines():
        program, *words = shlex.split(line)
        assert (program, words[0]) == ('ou-monitor', command)
        assert cli.build_parser([command]).parse_args(words).command == command


@pytest.mark.parametrize('argv, words', [
    ([], 'COMMAND'),
    (['analyse', 'x'], "did you mean 'analyze'?"),
    (['qqqq'], 'valid: analyze'),
    (['--bogus'], 'COMMAND'),
    (['analyze'], 'RECORDING'),
    (['analyze', 'x', '--reprot', 'y'], "did you mean '--report'?"),
    (['analyze', 'x', '--reprot=y'], "did you mean '--report'?"),
    (['analyze', 'x', '--brown', '4'], "did you mean '--brownout-voltage'?"),
    (['analyze', 'x', 'y'], 'no further argument'),
    (['analyze', 'x', '--json'], 'expected one argument'),
])
def test_bad_arguments_are_one_line(argv, words, capsys):
    """Status 2 and what to write instead; options are never guessed from a prefix."""
    assert words in failure(capsys, *argv)


def stand_in(monkeypatch, action):
    command = replace(cli.COMMANDS['analyze'], module='stand_in', options=())
    monkeypatch.setitem(cli.COMMANDS, 'analyze', command)
    monkeypatch.setitem(sys.modules, 'stand_in', SimpleNamespace(run=action))


def test_input_errors_are_one_line_whatever_their_text(monkeypatch, capsys):
    """A line feed in a file name does not make a second line."""
    def run(args):
        raise InputError("cannot read 'a\nb'")

    stand_in(monkeypatch, run)
    assert failure(capsys, 'analyze') == "ou-monitor analyze: cannot read 'a b'\n"


def test_file_names_that_the_terminal_cannot_show_are_escaped(tmp_path):
    path = os.fsdecode(os.path.join(os.fsencode(tmp_path), b'\xff\xc3\xa4.csv'))
    with open(path, 'w') as file:
        file.writelines(['time_s,voltage_v\n', '0,5\n', '1,5\n', '2,5\n'])
    page = tmp_path / 'page.html'
    done = subprocess.run(
        [sys.executable, '-m', 'ou_monitor.cli.main', 'analyze', path, '--report', str(page)],
        env={**os.environ, 'PYTHONIOENCODING': 'ascii'}, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b'')
    assert b'\\udcff' in done.stdout
    assert '\\udcff\xe4.csv' in page.read_text(encoding='utf-8')


@pytest.mark.parametrize('closed', ['>&-', '>&- 2>&-'])
def test_closed_outputs_are_no_failure(tmp_path, closed):
    """What a daemon has closed is no failure, and a bad input is one still."""
    def run(arguments):
        return subprocess.run(
            ['sh', '-c', f'"$0" -m ou_monitor.cli.main {arguments} {closed}', sys.executable],
            capture_output=True, text=True, cwd=tmp_path,
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(map(os.path.abspath, sys.path))})

    done = run('simulate --duration 1 --output a.mcap')
    assert (done.returncode, done.stderr) == (0, '')
    assert (tmp_path / 'a.mcap').stat().st_size > 1000
    assert run('--help').returncode == 0
    done = run('convert nothere out')
    assert done.returncode == 2 and done.stdout == ''
    assert done.stderr == ('' if '2' in closed
                           else "ou-monitor convert: there is no log 'nothere': check the path\n")


@pytest.mark.parametrize('error, words', [
    (PermissionError(13, 'Permission denied', '/locked/x'),
     "cannot use '/locked/x': Permission denied"),
    (OSError(28, 'No space left on device'), 'analyze: No space left on device'),
    (OSError('a\nb'), 'analyze: a b'),
    (MemoryError(), 'not enough memory: take a part'),
])
def test_system_errors_are_one_line(monkeypatch, capsys, error, words):
    def run(args):
        raise error

    stand_in(monkeypatch, run)
    assert words in failure(capsys, 'analyze')


@pytest.mark.parametrize('command', [['analyze'], ['convert', '--list'], ['discover'],
                                     ['fleet', '--output', 'out']])
def test_a_path_that_is_too_long_is_one_line(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    assert 'File name too long' in failure(capsys, *command, 'x' * 300)


def test_interrupt_is_quiet(monkeypatch, capsys):
    def run(args):
        raise KeyboardInterrupt

    stand_in(monkeypatch, run)
    assert cli.main(['analyze']) == 130
    assert capsys.readouterr() == ('', '')


def test_a_shell_completes_commands_and_their_options(monkeypatch):
    asked = []
    stand = SimpleNamespace(autocomplete=asked.append)
    monkeypatch.setitem(sys.modules, 'argcomplete', stand)
    assert cli.main(['analyze', '--help']) == 0 and not asked
    monkeypatch.setenv('_ARGCOMPLETE', '1')
    assert cli.main([]) == 2
    (parser,) = asked
    assert set(cli.COMMANDS) == {
        name for action in parser._actions for name in action.choices or ()}


def test_a_bug_keeps_its_traceback(monkeypatch):
    """What is not InputError keeps its traceback: it must be reported, not hidden."""
    def run(args):
        raise ZeroDivisionError

    stand_in(monkeypatch, run)
    with pytest.raises(ZeroDivisionError):
        cli.main(['analyze'])


def test_a_reader_that_goes_away_is_quiet():
    """`ou-monitor ... | head`: no traceback, also not from the flush at exit."""
    program = ('import sys; from dataclasses import replace; from types import SimpleNamespace\n'
               'from ou_monitor.cli import main\n'
               'def run(args):\n'
               '    for k in range(100000): print("x" * 100)\n'
               '    return 0\n'
               'sys.modules["stand_in"] = SimpleNamespace(run=run)\n'
               'table = main.COMMANDS\n'
               'table["analyze"] = replace(table["analyze"], module="stand_in", options=())\n'
               'sys.exit(main.main(["analyze"]))')
    process = subprocess.Popen([sys.executable, '-c', program], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE)
    process.stdout.readline()
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=60) == 0
    assert err == b''


def test_commands_load_nothing_heavy_for_help():
    """NumPy, SciPy, the readers and ROS wait for work to do."""
    program = ('import sys; from ou_monitor.cli.main import main; main(["--help"]); '
               'heavy = [m for m in ("numpy", "scipy", "mcap", "rclpy") if m in sys.modules]; '
               'sys.exit(" ".join(heavy) or 0)')
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True,
                          timeout=60)
    assert (done.returncode, done.stderr) == (0, '')


@pytest.mark.skipif(not os.path.exists('/dev/full'), reason='needs /dev/full')
@pytest.mark.parametrize('argv', [
    ['analyze', 'CSV'], ['convert', 'CSV', 'OUT.mcap', '--json', '-'], ['simulate', '--list'],
    ['--help']])
def test_a_full_standard_output_is_one_line(argv, tmp_path):
    """Status 2 and the reason: no traceback, and no complaint of the flush at exit."""
    csv = tmp_path / 'in.csv'
    csv.write_text('time_s,voltage_v\n' + ''.join(
        f'{k / 100},{5.0 + 0.01 * (k * k % 7)}\n' for k in range(50)))
    words = [str(csv) if word == 'CSV' else
             str(tmp_path / word) if word == 'OUT.mcap' else word for word in argv]
    with open('/dev/full', 'w') as full:
        done = subprocess.run([sys.executable, '-m', 'ou_monitor.cli.main', *words], stdout=full,
                              stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 2
    assert re.fullmatch(
        r'ou-monitor[^\n]*: cannot write to standard output: [^\n]+\n', done.stderr)


@pytest.mark.parametrize('argv', [
    ['discover', 'IN', '--report', 'IN'], ['discover', 'IN', '--json', 'IN'],
    ['discover', 'IN', '--save-model', 'IN'], ['analyze', 'IN', '--report', 'IN'],
    ['analyze', 'IN', '--json', 'IN'], ['convert', 'IN', 'NEW.mcap', '--json', 'IN'],
    ['design', '--risk', '0.1', '--throttle', '0.4', '--network', 'IN', '--json', 'IN'],
    ['simulate', '--throttle', 'IN', '--output', 'NEW.mcap', '--json', 'IN'],
    ['simulate', '--model', 'IN', '--save-model', 'IN'],
    ['discover', 'IN', '--report', 'NEW', '--json', 'NEW'],
    ['discover', 'IN', '--report', 'NEW', '--save-model', 'NEW'],
    ['analyze', 'IN', '--report', 'NEW', '--json', 'NEW'],
    ['reproduce', '--report', 'NEW', '--json', 'NEW'],
    ['convert', 'IN', 'NEW.mcap', '--json', 'NEW.mcap'],
    ['simulate', '--output', 'NEW.mcap', '--json', 'NEW.mcap'],
    ['discover', ''], ['analyze', ''], ['convert', '', 'NEW.mcap'], ['simulate', '--output', ''],
    ['discover', 'IN', '--report', '']])
def test_no_command_overwrites_its_input_or_its_output(argv, tmp_path, capsys):
    source = tmp_path / 'in.csv'
    source.write_text('time_s,voltage_v\n0,5\n0.1,5.1\n')
    names = {'IN': source, 'NEW': tmp_path / 'new', 'NEW.mcap': tmp_path / 'new.mcap'}
    err = failure(capsys, *[str(names.get(word, word)) for word in argv])
    assert 'overwrite' in err or 'are both' in err or 'path is empty' in err
    assert source.read_text() == 'time_s,voltage_v\n0,5\n0.1,5.1\n'
    assert list(tmp_path.iterdir()) == [source]
