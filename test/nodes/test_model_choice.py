"""The model file in force: what is no file is refused at once, what takes long comes later."""

import os
import sys
import time
from types import SimpleNamespace

from live import wait_until
from ou_monitor.nodes.model_choice import ModelChoice
import pytest


def test_what_is_no_file_is_refused_however_long_loading_takes(tmp_path, monkeypatch):
    """The first load of the terms takes longer than a callback waits."""
    monkeypatch.setitem(sys.modules, 'ou_monitor.recordings.model_file',
                        SimpleNamespace(read_model=lambda path: time.sleep(1.0)))
    choice = ModelChoice()
    fifo = tmp_path / 'fifo'
    os.mkfifo(fifo)
    for path in (str(fifo), '/dev/zero', str(tmp_path), '/no/such.yaml', 'a\0b'):
        with pytest.raises(ValueError, match='model_file: cannot read the model file') as caught:
            choice.check(path, 20.0)
        assert '\n' not in str(caught.value)


def test_what_takes_long_comes_into_force_later(tmp_path):
    """The model before stays so long; a file that is wrong becomes the problem."""
    path = tmp_path / 'model.yaml'
    path.write_text('model:\n- term: ou\n  params: {alpha: 63.0, sigma: 0.3, u0: 5.0}\n')
    choice = ModelChoice()
    choice.check(str(path), 0.0)
    choice.use(str(path))
    wait_until(lambda: choice.now() is not None, what='the model')
    assert choice.terms == 'ou' and choice.problem == ''
    bad = tmp_path / 'bad.yaml'
    bad.write_text('model: 3\n')
    try:
        choice.check(str(bad), 0.0)
    except ValueError:
        return
    choice.use(str(bad))
    wait_until(lambda: (choice.now(), choice.problem)[1], what='the problem')
    assert choice.terms == 'ou' and 'bad.yaml' in choice.problem
