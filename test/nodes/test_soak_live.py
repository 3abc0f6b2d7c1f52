"""Six seconds of the soak run."""

import json
import os
import subprocess
import sys

from live import DEADLINE, new_domain, ROOT


def test_a_soak_of_six_seconds_writes_its_figures(tmp_path):
    """All processes come and go; the figures are written, and the table between its marks."""
    page = tmp_path / 'page.md'
    page.write_text('before\n<!-- soak begins -->\noutdated\n<!-- soak ends -->\nafter\n')
    env = {key: value for key, value in os.environ.items()
           if key != '_ROS_WHEELS_BOOTSTRAP_COMPLETE'}
    done = subprocess.run(
        [sys.executable, ROOT / 'benchmarks/soak.py', '--minutes', '0.1', '--seed', '6',
         '--domain', str(new_domain()), '--json', tmp_path / 'all.json', '--markdown', page],
        env=env, capture_output=True, text=True, timeout=DEADLINE)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / 'all.json').read_text())
    assert found['deaths'] == 0 and found['status'] == 0 and found['counters']['messages'] > 1000
    dips = found['dips']
    untold = dips['lost'] + dips['unheard']
    assert dips['asked'] == dips['in_time'] + len(untold) >= 1, dips['missed']
    assert found['counters']['floor_dips'] >= dips['in_time']
    text = page.read_text()
    assert text.startswith('before\n') and text.endswith('after\n') and 'outdated' not in text
    assert '| exit status after SIGINT, time | 0' in text
