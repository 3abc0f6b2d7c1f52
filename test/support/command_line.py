"""Helpers for the tests of commands: write a CSV, run, read strict JSON, expect a failure."""

import json
import re

import numpy as np
from ou_monitor.cli.main import main


def write_csv(path, t, voltage, throttle=None, current=None):
    """Write a recording, s, V, 0..1, A; return its path."""
    columns = {'time_s': t, 'voltage_v': voltage, 'throttle': throttle, 'current_a': current}
    known = {name: column for name, column in columns.items() if column is not None}
    np.savetxt(path, np.column_stack(list(known.values())), '%.9g', ',', comments='',
               header=','.join(known))
    return path


def strict(text):
    """Parse JSON; NaN and Infinity are errors."""
    def refuse(word):
        raise ValueError(f'{word} is not JSON')

    return json.loads(text, parse_constant=refuse)


def answer(capsys, *argv):
    """Run a command; return its JSON, which stands alone on standard output."""
    assert main([*map(str, argv), '--json', '-']) == 0
    out, err = capsys.readouterr()
    assert err == ''
    return strict(out)


def failure(capsys, *argv):
    """Run a command that must fail; return its one line."""
    assert main([*map(str, argv)]) == 2
    out, err = capsys.readouterr()
    # The finding is printed even if its model is refused.
    assert out == '' or '--save-model' in argv
    assert re.fullmatch(rf'ou-monitor( {argv[0] if argv else None})?: [^\n]+\n', err), out + err
    return err
