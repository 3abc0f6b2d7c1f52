"""Files that are not recordings despite their names: one row each; the others are analysed."""

import os
from pathlib import Path
import time

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.fleet.analysis import Options, work
from ou_monitor.fleet.find import duplicates, find_recordings
from ou_monitor.fleet.fleet import run_fleet, SavedResults
from ou_monitor.fleet.vehicles import assign, read_pattern
from ou_monitor.model.ou import simulate
import pytest


@pytest.fixture
def odd(tmp_path):
    """Return a folder with a flight, and all that may lie beside it."""
    folder = tmp_path / 'logs'
    folder.mkdir()
    t = np.arange(4000) * 1e-3
    v = simulate(t, 63.0, np.full(t.size, 0.4), np.random.default_rng(1), u0=5.0)
    (folder / 'flight.csv').write_text('time_s,voltage_v\n' + ''.join(
        f'{a},{b}\n' for a, b in zip(t.tolist(), v.tolist())))
    for name in ('fifo.mcap', 'fifo.csv'):
        os.mkfifo(folder / name)
    (folder / 'loop.mcap').symlink_to(folder / 'loop.mcap')
    (folder / 'gone.mcap').symlink_to(folder / 'nowhere.mcap')
    (folder / 'gone.csv').symlink_to('/nowhere/at/all.csv')
    (folder / 'zero.mcap').symlink_to('/dev/zero')
    (folder / 'up').symlink_to(folder)
    (folder / 'name\x1b[2J.mcap').write_text('x')
    bag = folder / 'bag'
    bag.mkdir()
    (bag / 'metadata.yaml').write_text('a: ' + '9' * 5000)
    os.mkfifo(bag / 'bag_0.mcap')
    (bag / 'bag_1.mcap').symlink_to(bag / 'bag_1.mcap')
    parts = folder / 'cut'
    parts.mkdir()
    os.mkfifo(parts / 'cut_0.mcap')
    return folder


def test_each_failure_is_one_row(odd, tmp_path, one_process):
    began = time.monotonic()
    found = find_recordings([str(odd)])
    assert duplicates(found.sources) == {}
    fleet = run_fleet(found, tmp_path / 'out', Options(), lambda: '1', workers=1)
    assert time.monotonic() - began < 60.0
    assert {row['recording'] for row in fleet.failed} == {
        'fifo.mcap', 'fifo.csv', 'loop.mcap', 'gone.mcap', 'gone.csv', 'zero', 'bag', 'cut',
        'name\\x1b[2J.mcap'}
    assert len(fleet.analysed) == 1
    for row in fleet.failed:
        assert row['error'].isprintable() and len(row['error']) < 500
    errors = {row['recording']: row['error'] for row in fleet.failed}
    assert all('not a regular file' in errors[name] for name in ('fifo.mcap', 'fifo.csv', 'zero'))
    assert all('broken link' in errors[name] for name in ('loop.mcap', 'gone.mcap'))
    assert all(note.isprintable() for note in fleet.notes)


def test_a_defect_of_the_reader_costs_one_row(odd, tmp_path, one_process, monkeypatch):
    def form_of(path, *_, **__):
        raise KeyError(path.stem)

    monkeypatch.setattr('ou_monitor.recordings.importers.csv_table.form_of', form_of)
    found = find_recordings([str(odd)])
    fleet = run_fleet(found, tmp_path / 'out', Options(), lambda: '1', workers=1)
    errors = {row['recording']: row['error'] for row in fleet.failed}
    assert "(KeyError: 'flight')" in errors['flight.csv'] and len(errors) == 10


def test_very_deep_folders_are_not_searched(odd):
    """Hundreds of levels are not searched, and what lies beside them is."""
    before = len(find_recordings([str(odd)]).sources)
    # Not more: Python 3.12's rmtree, with which pytest clears up, recurses once a level.
    at = os.open(odd, os.O_RDONLY)
    for _ in range(300):
        os.mkdir('d', dir_fd=at)
        at, above = os.open('d', os.O_RDONLY, dir_fd=at), at
        os.close(above)
    os.close(at)
    found = find_recordings([str(odd)])
    assert len(found.sources) == before and 'more than 50 folders deep' in ' '.join(found.notes)


def test_a_folder_without_permission_to_enter_is_noted(odd, monkeypatch):
    """The search continues, and a note reports the folder."""
    is_file = Path.is_file

    def refuse(self):
        if self.parent.name == 'bag':
            raise PermissionError(13, 'Permission denied', str(self))
        return is_file(self)
    monkeypatch.setattr(Path, 'is_file', refuse)
    assert len(find_recordings([str(odd)]).sources) >= 8


@pytest.mark.parametrize('content', [
    None, '', '\0' * 99, '{"err', '{"error": "", "levels": ' + '[' * 100_000])
def test_invalid_saved_results_are_computed_again(odd, tmp_path, content):
    (source,) = find_recordings([str(odd / 'flight.csv')]).sources
    parts = SavedResults(tmp_path / 'out', {})
    parts.save(source, {'error': '', 'levels': []})
    (path,) = (tmp_path / 'out' / 'parts').glob('*.json')
    path.unlink()
    if content is None:
        os.mkfifo(path)
    else:
        path.write_text(content)
    assert parts.load(source) is None


@pytest.mark.parametrize('content', ['mine', '{}', '[' * 100_000, '{"error": 0}', '\0mine'])
def test_a_foreign_file_in_place_of_a_saved_result_is_refused(odd, tmp_path, content):
    (source,) = find_recordings([str(odd / 'flight.csv')]).sources
    parts = SavedResults(tmp_path / 'out', {})
    parts.save(source, {'error': '', 'levels': []})
    (path,) = (tmp_path / 'out' / 'parts').glob('*.json')
    path.write_text(content)
    with pytest.raises(InputError, match=f'{path.name}.*not written by fleet'):
        parts.load(source)
    assert path.read_text() == content


@pytest.mark.parametrize('content, words', [
    (b'0.0,5.1\n\0\1garbage;;;\n0.1,abc\n"unclosed\n', 'cut.csv:3: the byte 0x00 is not text'),
    (b'0.0,5.1\n' + bytes(range(256)), 'cut.csv:3: the byte 0x00 is not text'),
    (b'garbage\n', 'cut.csv'),
    (b'0,5\n1,5.1\n', "'cut.csv' holds 2 usable samples: nothing can be estimated from fewer")])
def test_a_damaged_or_short_csv_is_an_error_and_not_skipped(content, words, tmp_path):
    (tmp_path / 'cut.csv').write_bytes(b'time_s,voltage_v\n' + content)
    (tmp_path / 'tuning.csv').write_bytes(b'gain,value\n' + content)
    found = find_recordings([str(tmp_path)])
    assert [source.path.name for source in found.sources] == ['cut.csv']
    assert len(found.notes) == 1 and 'tuning.csv' in found.notes[0]
    assert words in work(str(tmp_path / 'cut.csv'), Options())['error']


@pytest.mark.parametrize('text', ['(' * 900, 'a{99999999999999999999}', '*'])
def test_an_invalid_pattern_is_refused(text):
    with pytest.raises(InputError, match='--vehicle-from') as caught:
        read_pattern(text)
    assert '\n' not in str(caught.value)


def test_a_pattern_finds_the_vehicle():
    """The group `vehicle`, else the first one; bytes that are not text are escaped."""
    path = Path('/f/uav7_\x1b\udcff.csv')
    for text, name in ((r'/(uav\d+)_(.)', 'uav7'), (r'uav\d', 'uav7'), ('none', ''),
                       (r'_(?P<vehicle>..)', '\\x1b\\udcff')):
        found, _ = assign({path: ''}, read_pattern(text))
        assert found[path].name == name
