"""Setting model_file: the file is read before the answer, and a refusal gives its reason."""

from dataclasses import replace
import os
import stat
import sys
from types import SimpleNamespace

from live import ROOT
from ou_monitor.errors import InputError
from ou_monitor.nodes import node_files
from ou_monitor.nodes.node_files import ModelChoice
from ou_monitor.recordings.model_file import read_model
import pytest


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
