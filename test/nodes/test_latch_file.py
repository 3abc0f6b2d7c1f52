"""The latch on disk: kept, cleared, and never believed when it is damaged."""

import json
import os

from ou_monitor.nodes.latch_file import LatchFile
import pytest


def test_kept_until_it_is_cleared(tmp_path):
    """A folder gets a file named after the node; another node's is not believed."""
    latch = LatchFile(tmp_path, '/a/ou_estimator')
    assert latch.read() == '' and latch.problem == ''
    latch.keep(True, 'the voltage is low')
    latch.keep(True, 'and again')
    latch.close()
    path = tmp_path / 'a_ou_estimator.latch.json'
    assert list(tmp_path.iterdir()) == [path]
    again = LatchFile(tmp_path, '/a/ou_estimator')
    assert 'the voltage is low' in again.read() and 'UTC' in again.read()
    other = LatchFile(path, '/b/ou_estimator')
    assert other.read() == '' and 'another node' in other.problem
    again.keep(False, '')
    again.close()
    assert list(tmp_path.iterdir()) == [] and again.problem == ''


GOOD = {'node': '/n', 'level': 'CRITICAL', 'reason': 'low', 'time': 1.7e9}


@pytest.mark.parametrize('text', [
    '', '{', 'null', '[' * 3000, 'x' * 100_000, '\x00\xff', json.dumps({**GOOD, 'time': 'now'}),
    json.dumps({**GOOD, 'time': 1e300}), json.dumps({**GOOD, 'time': float('nan')}),
    json.dumps({**GOOD, 'level': 'OK'}), json.dumps({**GOOD, 'more': 1}),
    json.dumps({**GOOD, 'reason': None}), '1' * 4000], ids=lambda text: text[:12])
def test_a_damaged_file_is_one_line(tmp_path, text):
    path = tmp_path / 'state'
    path.write_text(text)
    latch = LatchFile(path, '/n')
    assert latch.read() == '' and latch.problem
    assert '\n' not in latch.problem and len(latch.problem) < 300 + len(str(path))
    latch.close()


def test_control_characters_of_a_hostile_file_stay_in_it(tmp_path):
    path = tmp_path / 'state'
    path.write_text(json.dumps({**GOOD, 'reason': 'a \x1b[31m\nlow b'}))
    assert LatchFile(path, '/n').read().endswith('a low b')


def test_a_fifo_and_a_folder_without_rights_hang_nothing(tmp_path):
    os.mkfifo(tmp_path / 'fifo')
    latch = LatchFile(tmp_path / 'fifo', '/n')
    assert latch.read() == '' and 'regular file' in latch.problem
    latch = LatchFile('/proc/no/such/file', '/n')
    latch.keep(True, 'low')
    latch.close()
    assert 'cannot be written' in latch.problem
