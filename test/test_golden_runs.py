"""
Golden tables of online parts, causes and criticism: every change of a number is noticed.

After an intended change, run `scripts/make_golden.py RUN` and look at the differences.
"""

import json

import golden_models
import golden_parts
import golden_runs
from project import differences, ROOT
import pytest

RUNS = {**golden_runs.RUNS, **golden_models.RUNS, **golden_parts.RUNS}
# Another BLAS or version of NumPy moves numbers by less; what is below the second is nothing.
RELATIVE, ABSOLUTE = 1e-5, 1e-9
# Evidence comes from searches that stop near the maximum: two processors differ by 4.2e-4, that
# is 0.2 nats.
OF_SEARCHES = {'discovery': 1e-3}


@pytest.mark.parametrize('name', RUNS)
def test_golden_runs_are_unchanged(name):
    wanted = json.loads((ROOT / 'test/golden' / f'{name}.json').read_text(encoding='utf-8'),
                        parse_int=float)
    found = json.loads(json.dumps(RUNS[name]()), parse_int=float)
    assert differences(found, wanted, OF_SEARCHES.get(name, RELATIVE), ABSOLUTE)[:10] == []
