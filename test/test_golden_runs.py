"""
Golden tables of online parts, causes and criticism: every change of a number is noticed.

After an intended change, run `scripts/make_golden.py RUN` and look at the differences.
"""

import json
import math

import golden_models
import golden_parts
import golden_runs
from project import ROOT
import pytest

RUNS = {**golden_runs.RUNS, **golden_models.RUNS, **golden_parts.RUNS}
# Another BLAS or version of NumPy moves numbers by less; what is below the second is nothing.
RELATIVE, ABSOLUTE = 1e-5, 1e-9


def differences(found, wanted, where=''):
    """Return the places at which two tables differ."""
    if isinstance(wanted, dict) and isinstance(found, dict) and found.keys() == wanted.keys():
        return [line for key in wanted
                for line in differences(found[key], wanted[key], f'{where}/{key}')]
    if isinstance(wanted, list) and isinstance(found, list) and len(found) == len(wanted):
        return [line for k, (a, b) in enumerate(zip(found, wanted))
                for line in differences(a, b, f'{where}[{k}]')]
    same = (math.isclose(found, wanted, rel_tol=RELATIVE, abs_tol=ABSOLUTE)
            if isinstance(wanted, float) and isinstance(found, float) else found == wanted)
    return [] if same else [f'{where}: {found}, not {wanted}']


@pytest.mark.parametrize('name', RUNS)
def test_golden_runs_are_unchanged(name):
    wanted = json.loads((ROOT / 'test/golden' / f'{name}.json').read_text(encoding='utf-8'),
                        parse_int=float)
    found = json.loads(json.dumps(RUNS[name]()), parse_int=float)
    assert differences(found, wanted)[:10] == []
