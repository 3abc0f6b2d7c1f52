"""Helpers for the tests of commands: write a CSV, read strict JSON, expect a failure."""

import json
import re

import numpy as np
from ou_monitor.cli.main import main


def write_csv(path, t, voltage, throttle=None):
    columns = [t, voltage] if throttle is None else [t, voltage, throttle]
    np.savetxt(path, np.column_stack(columns), '%.9g', ',', comments='',
               header=','.join(['time_s', 'voltage_v', 'throttle'][:len(columns)]))


def strict(text):
    """Parse JSON; NaN and Infinity are errors."""
    def refuse(word):
        raise ValueError(f'{word} is not JSON')

    return json.loads(text, parse_constant=refuse)


def failure(capsys, *argv):
    """Run a command that must fail; return its one line."""
    assert main([*map(str, argv)]) == 2
    out, err = capsys.readouterr()
    # The finding is printed even if its model is refused.
    assert out == '' or '--save-model' in argv
    assert re.fullmatch(rf'ou-monitor( {argv[0] if argv else None})?: [^\n]+\n', err), out + err
    return err
