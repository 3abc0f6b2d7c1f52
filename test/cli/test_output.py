"""Tables, strict JSON, files and progress bar of the commands."""

import enum
import errno
import io
import json
import math
import os
from pathlib import Path

import numpy as np
from ou_monitor.cli import output
from ou_monitor.errors import InputError
from ou_monitor.report import terminal
from ou_monitor.records import plain_data
import pytest


class Colour(enum.Enum):
    """An enum whose value is a sentence."""

    RED = 'It is red.'


def test_plain_is_strict_json_at_any_depth():
    """All of NaN and infinities are null; arrays, tuples, NumPy numbers and enums are plain."""
    data = {'a': math.nan, 'b': [math.inf, (1, -math.inf)], 'c': np.array([[1.0, math.nan]]),
            'd': {1: np.float64('nan'), 'e': np.int64(3)}, 'f': Colour.RED, 'g': np.bool_(True)}
    found = plain_data(data)
    assert found == {'a': None, 'b': [None, [1, None]], 'c': [[1.0, None]],
                     'd': {'1': None, 'e': 3}, 'f': 'RED', 'g': True}
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_write_json_to_a_file_and_to_standard_output(tmp_path, capsys):
    target = tmp_path / 'x.json'
    output.write_json({'unit': 'V/√s', 'x': math.nan}, str(target))
    output.write_json({'unit': 'V/√s', 'x': math.nan}, '-')
    assert target.read_text(encoding='ascii') == capsys.readouterr().out
    assert json.loads(target.read_text(encoding='ascii')) == {'unit': 'V/√s', 'x': None}


def test_table_is_aligned():
    """Numbers flush right, words flush left, no trailing blanks."""
    text = terminal.table(['n', 'word'], [['1', 'a'], ['1000', 'long one']], left=[1])
    assert text.splitlines() == ['   n  word', '----  --------', '   1  a', '1000  long one']


def test_paths_that_collide_are_named(tmp_path):
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
    output.check_paths({'RECORDING': str(source), '--model': None},
                       {'--json': '-', '--report': new, '--save-model': None})
    output.check_paths({}, {'--json': '/dev/null', '--report': '/dev/null'})


@pytest.mark.parametrize('name, part', [
    ('metadata.yaml', True), ('bag_0.mcap', True), ('bag_1.db3', True), ('bag_0.mcap.zstd', True),
    ('report.html', False), ('result.json', False)])
def test_files_of_a_bag_are_not_overwritten(tmp_path, name, part):
    """Its metadata and storage files are refused; a report may lie beside them."""
    bag = tmp_path / 'bag'
    bag.mkdir()
    (bag / name).write_text('x')
    if part:
        with pytest.raises(InputError, match='would overwrite RECORDING'):
            output.check_paths({'RECORDING': str(bag)}, {'--report': str(bag / name)})
    else:
        output.check_paths({'RECORDING': str(bag)}, {'--report': str(bag / name)}, force=True)


def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    """Half a page is left neither in its place nor beside it."""
    target = tmp_path / 'report.html'
    output.write_text('old', target)

    def full(path, content):
        with path.open('wb') as file:
            file.write(content[:2])
        raise OSError(errno.ENOSPC, 'No space left on device')
    monkeypatch.setattr(Path, 'write_bytes', full)
    with pytest.raises(InputError, match='No space left'):
        output.write_text('new page', target, force=True)
    assert target.read_text() == 'old' and list(tmp_path.iterdir()) == [target]


def bag_folder(path: Path, content: str) -> Path:
    """Make a rosbag2 folder of sorts."""
    path.mkdir()
    (path / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information: {storage_identifier: mcap, '
        f'relative_file_paths: [{path.name}_0.mcap]}}')
    (path / f'{path.name}_0.mcap').write_text(content)
    return path


def test_a_bag_makes_room_for_the_next(tmp_path):
    """The old one goes when the new one is whole, and comes back when it is not."""
    bag = bag_folder(tmp_path / 'bag', 'old')
    with pytest.raises(InputError, match='exists already: --force'):
        with output.replacing(bag, force=False):
            pytest.fail('there is no room')
    with pytest.raises(KeyboardInterrupt):
        with output.replacing(bag, force=True):
            assert not bag.exists()
            raise KeyboardInterrupt
    assert (bag / 'bag_0.mcap').read_text() == 'old'
    with output.replacing(bag, force=True):
        bag_folder(bag, 'new')
    assert (bag / 'bag_0.mcap').read_text() == 'new' and list(tmp_path.iterdir()) == [bag]
    with output.replacing(tmp_path / 'other.mcap', force=False):
        pass


@pytest.mark.parametrize('foreign', ['notes.txt', 'monday.mcap', 'backup.tar.zst', 'bag_1.mcap'])
@pytest.mark.parametrize('whole', [True, False])
def test_a_folder_that_is_not_one_bag_stays(tmp_path, foreign, whole):
    bag = bag_folder(tmp_path / 'bag', 'old')
    (bag / foreign).write_text('mine')
    if not whole:
        (bag / 'metadata.yaml').unlink()
    there = {path: path.read_text() for path in bag.iterdir()}
    with pytest.raises(InputError, match='more than a bag'):
        with output.replacing(bag, force=True):
            pytest.fail('nothing of a user is taken away')
    assert {path: path.read_text() for path in bag.iterdir()} == there


def test_a_fifo_is_no_bag_and_hangs_nothing(tmp_path):
    fifo = tmp_path / 'fifo'
    os.mkfifo(fifo)
    with pytest.raises(InputError, match='neither a file nor a folder'):
        with output.replacing(fifo, force=True):
            pytest.fail('it is not replaced')
    with pytest.raises(InputError, match='cannot write'):
        output.write_text('nobody reads this', fifo, force=True)


def test_an_output_within_another_or_around_an_input_is_refused(tmp_path):
    bag, log = bag_folder(tmp_path / 'bag', 'old'), tmp_path / 'logs' / 'log.csv'
    log.parent.mkdir()
    log.write_text('x')
    for inner in ('bag_0.mcap', 'metadata.yaml', 'deep/x.json'):
        with pytest.raises(InputError, match='would lie in the bag'):
            output.check_paths({}, {'--output': bag, '--json': bag / inner}, force=True)
    with pytest.raises(InputError, match='would overwrite LOG'):
        output.check_paths({'LOG': log}, {'OUT': log.parent}, force=True)


def test_files_that_appear_during_the_work_are_not_overwritten(tmp_path):
    late, link = tmp_path / 'late.json', tmp_path / 'link.json'
    late.write_text('mine')
    link.symlink_to(tmp_path / 'nowhere')
    for path in (late, link):
        with pytest.raises(InputError, match='File exists'):
            output.write_text('new', path)
    with pytest.raises(InputError, match='exists already'):
        output.check_paths({}, {'--json': link})
    assert late.read_text() == 'mine' and link.is_symlink()
    for path in (late, link):
        output.write_text('new', path, force=True)
        assert path.read_text() == 'new'
    assert {path.name for path in tmp_path.iterdir()} == {'late.json', 'link.json'}


class Screen(io.StringIO):
    """An output that is a terminal."""

    def isatty(self):
        """Say so."""
        return True


@pytest.mark.parametrize('width', [40, 60, 80, 200])
def test_the_width_of_the_terminal_is_kept(monkeypatch, width):
    """Paragraphs end there, or at 100; tables come in parts, the first column in each."""
    monkeypatch.setattr('sys.stdout', Screen())
    monkeypatch.setattr('shutil.get_terminal_size', lambda *_, **__: os.terminal_size((width, 24)))
    words = ' '.join(['word'] * 60)
    for text in (terminal.paragraph(words), terminal.paragraph(words, '- '),
                 terminal.facts([('Sag', words), ('Noise', words)])):
        assert max(map(len, text.splitlines())) <= min(width, 100)
    heads = ['vehicle', *[f'column {k}' for k in range(8)]]
    text = terminal.table(heads, [[f'uav{k}', *['12.34'] * 8] for k in range(3)], left=[0])
    assert max(map(len, text.splitlines())) <= width
    assert text.count('uav1') == text.count('vehicle') >= (2 if width < 92 else 1)
    for head in heads:
        assert head in text


def test_a_file_is_as_wide_as_ever(monkeypatch):
    """What no terminal shows is not broken by the width of one."""
    monkeypatch.setenv('COLUMNS', '40')
    assert terminal.columns() == 100
    heads = [f'column {k}' for k in range(20)]
    assert len(terminal.table(heads, [['1'] * 20]).splitlines()) == 3


def test_a_link_that_loops_is_replaced_only_with_force(tmp_path):
    """It names no file of anybody; without --force it is refused in one line."""
    loop = tmp_path / 'page.html'
    loop.symlink_to(loop)
    inputs = {'RECORDING': str(tmp_path / 'flight.csv')}
    with pytest.raises(InputError, match='exists already'):
        output.check_paths(inputs, {'--report': loop})
    output.check_paths(inputs, {'--report': loop}, force=True)


@pytest.mark.parametrize('width', [20, 40, 80])
def test_the_bar_fits_shows_the_time_left_and_is_wiped(monkeypatch, width):
    """Results of an earlier run took no time of this one; a closed stream stops nothing."""
    terminal, now = Screen(), [100.0]
    monkeypatch.setattr('sys.stderr', terminal)
    monkeypatch.setattr('time.monotonic', lambda: now[0])
    monkeypatch.setattr('shutil.get_terminal_size', lambda *_, **__: os.terminal_size((width, 24)))
    with pytest.raises(KeyboardInterrupt):
        with output.Progress('work') as progress:
            progress(0.5)
            now[0] += 30.0
            progress(0.75)
            shown = terminal.getvalue().split('\r')[-1].removesuffix('\x1b[K')
            raise KeyboardInterrupt
    assert shown.endswith('75%, 30 s left') and len(shown) <= width
    assert terminal.getvalue().endswith('\r\x1b[K')
    with output.Progress('work') as progress:
        terminal.close()
        progress(1.0)


def test_off_a_terminal_nothing_is_shown(capsys):
    with output.Progress('work') as progress:
        progress(1.0)
    assert capsys.readouterr() == ('', '')
