"""Every fast command on a recorded run, and on real ones if available: no traceback."""


from every_command import run, runs_of, wide
from project import REAL, ROOT
import pytest



@pytest.mark.parametrize('path', [
    # The second is almost white: relative errors of 4e4.
    ROOT / 'bags/recorded/micromouse_3.csv', REAL / 'px_tg1.csv'],
    ids=lambda path: path.stem)
def test_no_command_breaks_off(path, tmp_path):
    """Status 0, or 2 with one line; in the JSON nothing that is not known."""
    if not path.exists():
        pytest.skip('OU_MONITOR_REALDATA is not set')
    done = list(runs_of(path, tmp_path, quick=True))
    assert len(done) >= 5 and not [one for one in done if one.fault]


def test_a_fault_is_noticed(tmp_path):
    """What the program looks for: more than one line, a Traceback, a number that is not known."""
    assert not run('analyze', tmp_path / 'none.csv', cwd=tmp_path).fault
    found = wide({'levels': [{'tau': 0.8, 'tau_ci95': [8e-15, 8e13]},
                             {'tau': 0.8, 'tau_ci95': [0.4, 1.6]},
                             {'sigma': None, 'sigma_ci95': [None, None]}]})
    assert list(found) == ['/levels[0]/tau']
