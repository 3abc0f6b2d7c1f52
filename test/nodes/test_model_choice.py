"""The model file in force: it is read before the answer, and a refusal has its reason."""

import os
import sys
from types import SimpleNamespace

from ou_monitor.errors import InputError
from ou_monitor.nodes import node_files
from ou_monitor.nodes.node_files import ModelChoice
import pytest


def test_what_is_no_file_is_refused(tmp_path):
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
