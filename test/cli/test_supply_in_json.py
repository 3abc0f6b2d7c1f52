"""One set of facts: `supply` in the JSON of `analyze`, `compare`, `coupling` and `discover`."""

import json

from ou_monitor.cli.main import main
from project import ROOT
import pytest


@pytest.mark.parametrize('name, signal, limit, part', [
    ('bags/recorded/gecko_gyro.csv', 'gyro_x_deg_s', '15.5', ('0', '6')),
    ('bags/recorded/micromouse', '/throttle', '3.5', ('0', '10')),
    ('bags/flight', '/throttle', '4.7', ('0', '3')),
])
def test_all_commands_give_the_same_object(name, signal, limit, part, tmp_path):
    """Equal to the last digit."""
    path, found = str(ROOT / name), {}
    for command in ('analyze', 'compare', 'coupling', 'discover'):
        target = tmp_path / f'{command}.json'
        more = ('--signal', signal) if command == 'coupling' else (
            '--seeds', '20') if command == 'compare' else ()
        status = main([command, path, '--brownout-voltage', limit, '--from', part[0], '--to',
                       part[1], '--json', str(target), *more])
        if target.exists():
            found[command] = json.loads(target.read_text())['supply']
        else:
            # Less than a command needs: refused in one line, as the micromouse by two.
            assert status == 2
    assert {'analyze', 'discover'} <= set(found)
    assert all(one == found['analyze'] for one in found.values())
    assert found['analyze']['dips']['limit_v'] == float(limit)
