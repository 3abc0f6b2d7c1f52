"""Files named by users: those that are refused, and errors that quote none of their content."""

import os
import time

from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import find_files
from ou_monitor.recordings.model_file import read_model
from ou_monitor.stream.config import load_msg_config
from ou_monitor.stream.files import (
    MOST_CHARACTERS, MOST_DIGITS, MOST_NODES, open_regular, read_yaml)
from ou_monitor.text import printable
import pytest

SECRET = 'hunter2-pa55word'


def bomb():
    """Return YAML of 1 kB that stands for 10^12 values."""
    lines = ['a: &a [x, x, x, x, x, x, x, x, x, x]']
    for before, name in zip('abcdefghijk', 'bcdefghijkl'):
        lines.append(f'{name}: &{name} [' + ', '.join(['*' + before] * 10) + ']')
    return '\n'.join(lines)


def merges():
    """Return a bomb of merge keys."""
    lines = ['a0: &a0 {x: 1, y: 2}']
    lines += [f'a{k + 1}: &a{k + 1} {{<<: [*a{k}, *a{k}, *a{k}]}}' for k in range(30)]
    return '\n'.join(lines)


BAD = {
    'bomb': bomb(), 'merges': merges(), 'deep': '[' * 5000, 'deep_block': '- ' * 5000,
    'deep_map': '{a: ' * 3000, 'digits': 'a: ' + '9' * 5000, 'hex': 'a: 0x' + 'f' * 100_000,
    'base_60': 'a: 1' + ':59' * 2000, 'float': 'a: 1.' + '1' * 5000,
    'many': '- x\n' * (MOST_NODES + 1), 'large': '#' * 1_000_001,
    'one_alias': 'a: &a x\nb: *a', 'loop': 'a: &a [*a]',
    'syntax': f'a: [{SECRET}', 'token': f'a: @{SECRET}', 'tag': f'!{SECRET} x',
    'alias': f'*{SECRET.replace("-", "")}', 'int': f'!!int {SECRET}',
    'python': f'!!python/name:{SECRET} x', 'date': '2026-99-99', 'two': f'a: 1\n---\n{SECRET}: 2',
    'escape': '"\\x1b[31m', 'control': f'{SECRET}: \x1b[31m', 'key': f'? [{SECRET}]\n: 1',
    'long_line': f'{SECRET}' * 5000 + ': [', 'duplicate': f'a: &{SECRET} 1\nb: &{SECRET} 2',
    'key_twice': f'{SECRET}: 1\n{SECRET}: 2', 'keys_deep': 'a: [{"b": 1, b: 2}]',
    'tab': 'a:\n\t- b', 'nul': '\x00\x01', 'call': '!!python/object/apply:os.getcwd []',
    'binary': f'!!binary "é{SECRET}"', 'indicator': f'- >{SECRET}',
}


def line_of(call, *given):
    """Return the one line of a refusal that comes soon and tells nothing of the file."""
    began = time.monotonic()
    with pytest.raises(InputError) as caught:
        call(*given)
    line = str(caught.value)
    assert time.monotonic() - began < 5.0
    assert line.isprintable() and len(line) <= MOST_CHARACTERS
    assert SECRET not in line and SECRET.replace('-', '') not in line
    return line


@pytest.mark.parametrize('read, name', [
    (read, name) for read in (read_model, load_msg_config, find_files) for name in BAD
    # The metadata of a bag may be larger.
    if read is not find_files or name not in ('many', 'large')])
def test_bad_yaml_is_one_line_that_quotes_nothing(tmp_path, read, name):
    """Also a bomb costs no time and no memory; every reader of YAML refuses in the same way."""
    path = tmp_path / 'metadata.yaml'
    path.write_text(BAD[name], encoding='utf-8')
    given = (path, False) if read is find_files else (path,)
    assert 'metadata.yaml' in line_of(read, *given)


@pytest.mark.parametrize('text', [
    f'{SECRET}: 1', f'[{SECRET}]', SECRET, f'root: {SECRET}', f'{SECRET}:{SECRET}:0:0'])
@pytest.mark.parametrize('read', [read_model, load_msg_config])
def test_errors_do_not_quote_foreign_files(tmp_path, read, text):
    """A path of a wrong file must not make a node read it out."""
    path = tmp_path / 'passwords.yaml'
    path.write_text(text)
    line_of(read, path)


@pytest.mark.parametrize('read', [read_model, load_msg_config, open_regular])
def test_irregular_files_are_refused_at_once(tmp_path, read):
    """A FIFO without a writer, a device without end, a folder, a loop of links."""
    os.mkfifo(tmp_path / 'fifo.yaml')
    (tmp_path / 'link.yaml').symlink_to(tmp_path / 'link.yaml')
    (tmp_path / 'folder.yaml').mkdir()
    (tmp_path / 'zero.yaml').symlink_to('/dev/zero')
    for name in ('fifo', 'link', 'folder', 'zero', 'none'):
        began = time.monotonic()
        with pytest.raises((InputError, OSError)) as caught:
            read(tmp_path / f'{name}.yaml')
        assert time.monotonic() - began < 1.0 and f'{name}.yaml' in str(caught.value)
        assert isinstance(caught.value, OSError if read is open_regular else InputError)


def test_a_long_path_is_shortened(tmp_path):
    """The line keeps its end, which has the reason."""
    folder = tmp_path.joinpath(*['x' * 100] * 5)
    folder.mkdir(parents=True)
    (folder / 'model.yaml').write_text('a: [')
    line = line_of(read_model, folder / 'model.yaml')
    assert 'model.yaml is not YAML' in line and line.endswith('(line 1, column 5)')


def test_honest_yaml_is_read(tmp_path):
    """Limits leave room: merge keys, depth, long numbers, a byte order mark."""
    path = tmp_path / 'x.yaml'
    path.write_text('one: {<<: {unit: V, list: [1, 2]}, more: 3}\n'
                    f'number: 1.{"3" * (MOST_DIGITS - 2)}\ndeep: {"[" * 50}{"]" * 50}\n',
                    encoding='utf-8-sig')
    found = read_yaml(path, 'x')
    assert found['one'] == {'unit': 'V', 'list': [1, 2], 'more': 3}
    assert found['number'] == pytest.approx(4.0 / 3.0)


def test_printable_escapes_control_characters():
    """Printable text, also with umlauts, is unchanged."""
    assert printable('Spannung der Zelle µV ± 5 Ω') == 'Spannung der Zelle µV ± 5 Ω'
    assert printable('\x1b[2Ja\nb\t\x9b\u202e\u2028\udcff') == (
        '\\x1b[2Ja\\nb\\t\\x9b\\u202e\\u2028\\udcff')
    assert printable('abcdefghij' * 10, 15) == 'abcd...cdefghij'
    assert str(InputError('a\nb\x1b')) == 'a b\\x1b'
