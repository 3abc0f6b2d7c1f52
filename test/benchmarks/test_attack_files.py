"""The attack on files, in small: nothing wrong, nothing lost in silence, no traceback."""

import sys

import attack_files
import pytest


@pytest.mark.parametrize('seed', [11, 900_000])
def test_a_small_attack(monkeypatch, capsys, seed):
    """Every kind of damage that the generator knows."""
    monkeypatch.setattr(sys, 'argv', [
        'attack_files.py', '--mutated', '130', '--crafted', '60', '--sheets', '300', '--seed',
        str(seed)])
    assert attack_files.main() == 0, capsys.readouterr().err
    said = capsys.readouterr().out
    assert said.splitlines()[-1].startswith('0 faults in 680 readings')
    for kind in ('bits', 'cut', 'swap', 'length', 'crafted', 'csv quote', 'csv cell'):
        assert kind in said
