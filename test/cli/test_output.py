"""Tables, strict JSON, files and progress of the commands."""

import argparse
import enum
import errno
import io
import json
import math
from pathlib import Path

import numpy as np
from ou_monitor.cli import output
from ou_monitor.errors import InputError
import pytest


class Colour(enum.Enum):
    """An enum whose value is a sentence."""

    RED = 'It is red.'


def test_plain_is_strict_json_at_any_depth():
    """All of NaN and infinities are null; arrays, tuples, NumPy numbers and enums are plain."""
    data = {'a': math.nan, 'b': [math.inf, (1, -math.inf)], 'c': np.array([[1.0, math.nan]]),
            'd': {1: np.float64('nan'), 'e': np.int64(3)}, 'f': Colour.RED, 'g': np.bool_(True)}
    plain = output.plain(data)
    assert plain == {'a': None, 'b': [None, [1, None]], 'c': [[1.0, None]],
                     'd': {'1': None, 'e': 3}, 'f': 'RED', 'g': True}
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain


def test_write_json_to_a_file_and_to_standard_output(tmp_path, capsys):
    """Both hold the same text, one object, in any encoding."""
    target = tmp_path / 'x.json'
    output.write_json({'unit': 'V/√s', 'x': math.nan}, str(target))
    output.write_json({'unit': 'V/√s', 'x': math.nan}, '-')
    assert target.read_text(encoding='ascii') == capsys.readouterr().out
    assert json.loads(target.read_text(encoding='ascii')) == {'unit': 'V/√s', 'x': None}


def test_what_cannot_be_written_is_named(tmp_path):
    """A missing folder, a folder, and a file used as a folder; the last only when written."""
    (tmp_path / 'file').write_text('')
    for target in (tmp_path / 'no' / 'x.json', tmp_path):
        with pytest.raises(InputError, match='cannot write'):
            output.check_writable(str(target))
        with pytest.raises(InputError, match='cannot write'):
            output.write_text('x', target)
    output.check_writable(None)
    output.check_writable('-')
    output.check_writable(str(tmp_path / 'new.json'))


def test_table_is_aligned():
    """Numbers flush right, words flush left, no trailing blanks."""
    text = output.table(['n', 'word'], [['1', 'a'], ['1000', 'long one']], left=[1])
    assert text.splitlines() == ['   n  word', '----  --------', '   1  a', '1000  long one']


def test_progress_is_silent_without_a_terminal(capsys):
    """Nothing reaches a log file."""
    with output.Progress('work') as progress:
        progress(0.5)
        progress(1.0)
    assert capsys.readouterr() == ('', '')


class Terminal(io.StringIO):
    """A standard error that is a terminal."""

    def isatty(self):
        """Say so."""
        return True


def test_progress_draws_and_wipes_on_a_terminal(monkeypatch):
    """The bar fills to 100 % and is gone at the end, also after an exception."""
    terminal = Terminal()
    monkeypatch.setattr('sys.stderr', terminal)
    with pytest.raises(KeyboardInterrupt):
        with output.Progress('work') as progress:
            progress(1.0)
            assert 'work [####' in terminal.getvalue() and '100%' in terminal.getvalue()
            raise KeyboardInterrupt
    assert terminal.getvalue().endswith('\r\x1b[K')


def test_paths_that_collide_or_are_empty_are_named(tmp_path):
    """By name, by another spelling, by a link; two outputs; but not two devices."""
    source = tmp_path / 'in.csv'
    source.write_text('x')
    (tmp_path / 'soft.csv').symlink_to(source)
    (tmp_path / 'hard.csv').hardlink_to(source)
    for target in (source, tmp_path / '..' / tmp_path.name / 'in.csv', tmp_path / 'soft.csv',
                   tmp_path / 'hard.csv'):
        with pytest.raises(InputError, match='--json .* would overwrite RECORDING'):
            output.check_paths({'RECORDING': str(source)}, {'--json': str(target)})
    new = str(tmp_path / 'new')
    with pytest.raises(InputError, match='--json and --report are both'):
        output.check_paths({}, {'--json': new, '--report': new})
    for inputs, outputs in (({'RECORDING': ''}, {}), ({}, {'--json': ''})):
        with pytest.raises(InputError, match='(RECORDING|--json): the path is empty'):
            output.check_paths(inputs, outputs)
    output.check_paths({'RECORDING': str(source), '--model': None},
                       {'--json': '-', '--report': new, '--save-model': None})
    output.check_paths({}, {'--json': '/dev/null', '--report': '/dev/null'})
    with pytest.raises(argparse.ArgumentTypeError, match='empty'):
        output.path_argument('')


@pytest.mark.parametrize('name, part', [
    ('metadata.yaml', True), ('bag_0.mcap', True), ('bag_1.db3', True), ('bag_0.mcap.zstd', True),
    ('report.html', False), ('result.json', False)])
def test_what_a_bag_is_made_of_is_not_overwritten(tmp_path, name, part):
    """Its metadata and storage files are refused; a report may lie beside them."""
    bag = tmp_path / 'bag'
    bag.mkdir()
    (bag / name).write_text('x')
    if part:
        with pytest.raises(InputError, match='would overwrite RECORDING'):
            output.check_paths({'RECORDING': str(bag)}, {'--report': str(bag / name)})
    else:
        output.check_paths({'RECORDING': str(bag)}, {'--report': str(bag / name)})


def test_what_was_there_stays_when_the_disk_is_full(tmp_path, monkeypatch):
    """Half a page is left neither in its place nor beside it."""
    target = tmp_path / 'report.html'
    output.write_text('old', target)

    def full(path, text, **_):
        with path.open('w') as file:
            file.write(text[:2])
        raise OSError(errno.ENOSPC, 'No space left on device')
    monkeypatch.setattr(Path, 'write_text', full)
    with pytest.raises(InputError, match='No space left'):
        output.write_text('new page', target)
    assert target.read_text() == 'old' and list(tmp_path.iterdir()) == [target]
