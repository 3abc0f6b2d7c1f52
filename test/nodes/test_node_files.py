"""The files of a node: the latch and the model file, of which no other is touched."""

from dataclasses import replace
import errno
import json
import os
import stat
import sys
import threading
from types import SimpleNamespace

from live import ROOT, wait_until
from ou_monitor.errors import InputError
from ou_monitor.nodes import node_files
from ou_monitor.nodes.node_files import LatchFile, ModelChoice
from ou_monitor.recordings.model_file import read_model
import pytest

GOOD = {'node': '/n', 'level': 'CRITICAL', 'reason': 'low', 'time': 1.7e9}


def level_of(path):
    return json.loads(path.read_text())['level']


def use(latch):
    """Do all that a node does with a latch, a dip included."""
    latch.read()
    for latched in (False, True, False, True):
        latch.keep(latched, 'the voltage is low')
    latch.close()


def test_the_latch_is_kept_until_it_is_cleared(tmp_path):
    """In a folder, a file named after the node; nothing else is left there."""
    latch = LatchFile(tmp_path, '/a/ou_estimator')
    assert latch.read() == '' and latch.problem == ''
    path = tmp_path / 'a_ou_estimator.latch.json'
    assert level_of(path) == 'OK'
    latch.keep(True, 'the voltage is low')
    latch.keep(True, 'and again')
    latch.close()
    assert list(tmp_path.iterdir()) == [path] and level_of(path) == 'CRITICAL'
    again = LatchFile(tmp_path, '/a/ou_estimator')
    assert 'the voltage is low' in again.read() and 'UTC' in again.read()
    again.keep(False, '')
    again.close()
    assert list(tmp_path.iterdir()) == [path] and level_of(path) == 'OK'
    assert again.problem == ''
    assert LatchFile(tmp_path, '/a/ou_estimator').read() == ''


@pytest.mark.parametrize('text', [
    '', '{', 'null', '[' * 3000, 'x' * 100_000, '\x00\xff', json.dumps({**GOOD, 'time': 'now'}),
    json.dumps({**GOOD, 'time': 1e300}), json.dumps({**GOOD, 'time': float('nan')}),
    json.dumps({**GOOD, 'level': 'WARN'}), json.dumps({**GOOD, 'more': 1}),
    json.dumps({**GOOD, 'reason': None}), '1' * 4000, json.dumps({**GOOD, 'node': '/other'})],
    ids=lambda text: text[:12])
def test_a_file_that_is_not_its_own_is_left(tmp_path, text):
    """Notes, a damaged file, another node's brown-out: refused in one line, byte for byte kept."""
    path = tmp_path / 'state'
    path.write_text(text)
    before = path.stat()
    latch = LatchFile(path, '/n')
    use(latch)
    assert latch.refused and latch.read() == ''
    assert '\n' not in latch.problem and len(latch.problem) < 300 + len(str(path))
    assert path.read_text() == text and list(tmp_path.iterdir()) == [path]
    assert (path.stat().st_ino, path.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_irregular_files_are_left_alone(tmp_path):
    """A FIFO hangs nothing; of a link neither end is touched, be it to a file of its own."""
    own, fifo, link, dangling = (tmp_path / name for name in ('own', 'fifo', 'link', 'dangling'))
    own.write_text(json.dumps(GOOD))
    os.mkfifo(fifo)
    link.symlink_to(own)
    dangling.symlink_to(tmp_path / 'none')
    (tmp_path / 'n.latch.json').mkdir()
    for path in (fifo, link, dangling, tmp_path):
        latch = LatchFile(path, '/n')
        use(latch)
        assert latch.refused and latch.problem
    assert stat.S_ISFIFO(fifo.lstat().st_mode) and link.is_symlink() and dangling.is_symlink()
    assert json.loads(own.read_text()) == GOOD
    assert {path.name for path in tmp_path.iterdir()} == {
        'own', 'fifo', 'link', 'dangling', 'n.latch.json'}
    latch = LatchFile('/proc/no/such/file', '/n')
    use(latch)
    assert latch.refused


def test_of_two_nodes_on_one_file_the_second_refuses(tmp_path):
    """While the first runs, through its writes too; a node of another name always."""
    path = tmp_path / 'state'
    first = LatchFile(path, '/n')
    first.read()
    use(LatchFile(path, '/other'))
    second = LatchFile(path, '/n')
    second.read()
    assert second.refused
    first.keep(True, 'low')
    wait_until(lambda: level_of(path) == 'CRITICAL', what='the latch')
    third = LatchFile(path, '/n')
    use(third)
    assert third.refused and level_of(path) == 'CRITICAL'
    first.close()
    after = LatchFile(path, '/n')
    assert 'low' in after.read() and not after.refused
    after.close()


def test_a_file_replaced_meanwhile_is_left_alone(tmp_path):
    path = tmp_path / 'state'
    latch = LatchFile(path, '/n')
    latch.read()
    path.unlink()
    path.write_text('notes')
    latch.keep(True, 'low')
    wait_until(lambda: latch.problem, what='the problem')
    assert path.read_text() == 'notes' and not latch.refused
    path.unlink()
    wait_until(lambda: (latch.keep(True, 'low'), path.exists())[1], what='the latch')
    latch.close()
    assert level_of(path) == 'CRITICAL' and latch.problem == ''


@pytest.mark.parametrize('call', ['write', 'fsync', 'rename'])
def test_a_write_that_fails_is_done_again(tmp_path, monkeypatch, call):
    """A full disk: said, retried by the same state until it is written, and nothing is left."""
    path = tmp_path / 'state'
    latch = LatchFile(path, '/n')
    latch.read()
    full, tried = threading.Event(), threading.Event()
    right = getattr(os, call)

    def fails(*arguments):
        if full.is_set():
            tried.set()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return right(*arguments)
    monkeypatch.setattr(node_files.os, call, fails)
    full.set()
    latch.keep(True, 'low')
    wait_until(lambda: latch.problem, what='the problem')
    assert tried.is_set() and level_of(path) == 'OK' and list(tmp_path.iterdir()) == [path]
    full.clear()
    wait_until(lambda: (latch.keep(True, 'low'), latch.problem == '')[1], what='the latch')
    assert level_of(path) == 'CRITICAL'
    latch.close()
    assert list(tmp_path.iterdir()) == [path]


def test_a_text_that_does_not_read_as_written_replaces_nothing(tmp_path, monkeypatch):
    """Nor does a part of it, which a full disk takes."""
    path = tmp_path / 'state'
    latch = LatchFile(path, '/n')
    latch.read()
    right = os.write
    monkeypatch.setattr(node_files.os, 'write',
                        lambda handle, text: right(handle, text[:-1]))
    latch.keep(True, 'low')
    wait_until(lambda: latch.problem, what='the problem')
    latch.close()
    assert level_of(path) == 'OK' and list(tmp_path.iterdir()) == [path]


def test_control_characters_of_a_hostile_file_stay_in_it(tmp_path):
    path = tmp_path / 'state'
    path.write_text(json.dumps({**GOOD, 'reason': 'a \x1b[31m\nlow b'}))
    assert LatchFile(path, '/n').read().endswith('a low b')


def test_a_model_file_that_is_no_file_is_refused(tmp_path):
    """At once, in one line; nothing is loaded for it."""
    choice = ModelChoice()
    fifo = tmp_path / 'fifo'
    os.mkfifo(fifo)
    for path in (str(fifo), '/dev/zero', str(tmp_path), '/no/such.yaml', 'a\0b'):
        with pytest.raises(ValueError, match='model_file: cannot read the model file') as caught:
            choice.check(path)
        assert '\n' not in str(caught.value)


def slow(monkeypatch, looks, result):
    """Have files read only when the node has done its work `looks` times; return what it does."""
    done = [0]

    def read_model(path):
        while done[0] < looks:
            pass
        return result()
    monkeypatch.setitem(sys.modules, 'ou_monitor.recordings.model_file',
                        SimpleNamespace(read_model=read_model))

    def meanwhile():
        done[0] += 1
    return meanwhile


def test_the_answer_waits_for_the_file_and_the_node_works_on(tmp_path, monkeypatch):
    """Good or refused, it is known when the answer is given; the model before stays in force."""
    path = tmp_path / 'model.yaml'
    path.write_text('')
    model = SimpleNamespace(terms=(SimpleNamespace(NAME='ou'),))
    choice = ModelChoice()
    choice.check(str(path), slow(monkeypatch, 30, lambda: SimpleNamespace(model=model)))
    assert choice.use(str(path)) is model and choice.terms == 'ou'

    def refuse():
        raise InputError('bad.yaml: no list of terms')
    bad = tmp_path / 'bad.yaml'
    bad.write_text('')
    for _ in range(2):
        with pytest.raises(ValueError, match='no list of terms'):
            choice.check(str(bad), slow(monkeypatch, 30, refuse))
        assert choice.use(str(path)) is model
    choice.check('')
    assert choice.use('') is None and choice.terms == ''


def test_a_file_that_is_never_read_is_refused(tmp_path, monkeypatch):
    """Of a network that hangs, say: the answer comes, with that reason."""
    path = tmp_path / 'model.yaml'
    path.write_text('')
    monkeypatch.setattr(node_files, 'PATIENCE', 0.1)
    meanwhile = slow(monkeypatch, 50, lambda: None)
    with pytest.raises(ValueError, match='was not read within 0.1 s'):
        ModelChoice().check(str(path), meanwhile)
    # Its thread ends, else the interpreter would wait for it.
    for _ in range(50):
        meanwhile()


def test_a_flight_is_saved_into_its_own_file_alone(tmp_path):
    """In place, head, mode and terms kept, with a history; never over what was not read."""
    path = tmp_path / 'model.yaml'
    path.write_text((ROOT / 'models' / 'gecko.yaml').read_text())
    path.chmod(0o640)
    choice = ModelChoice()
    with pytest.raises(InputError, match='no model_file in use'):
        choice.save(None, {})
    choice.check(str(path))
    model = choice.use(str(path))
    for k in range(2):
        load = replace(model.load, volts=14.0 + k)
        assert choice.save(load, {'date': f'2026-08-0{k + 1}', 'sag_ratio': 1.1}) == str(path)
        assert choice.use(str(path)).load == load
        assert choice.use(str(path)).date == f'2026-08-0{k + 1}'
    written = read_model(path)
    assert written.model == replace(model, load=load) and written.model.date == '2026-08-02'
    assert [entry['date'] for entry in written.provenance['history']] == [
        '2026-08-01', '2026-08-02']
    assert written.provenance['recording'] == 'gecko.csv'
    assert path.read_text().startswith('# Learned by') and stat.S_IMODE(
        path.stat().st_mode) == 0o640
    other = tmp_path / 'other.yaml'
    changed = path.read_text() + '# by hand'
    path.write_text(changed)
    for change, words in (
            (lambda: None, 'has changed'),
            (lambda: (path.rename(other), path.symlink_to(other)), 'symbolic link'),
            (lambda: (path.unlink(), os.mkfifo(path)), 'not a regular file'),
            (path.unlink, 'No such file')):
        change()
        with pytest.raises(InputError, match=f'was not changed: .*{words}'):
            choice.save(load, {'date': '2026-08-03'})
        assert choice.use(str(path)).date == '2026-08-02'
    assert other.read_text() == changed and os.listdir(tmp_path) == ['other.yaml']
