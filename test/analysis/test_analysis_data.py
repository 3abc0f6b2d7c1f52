"""The JSON of `analyze`: its numbers, and its keys, all of them documented."""

from dataclasses import replace
import math
import re

from ou_monitor.analysis.analyze import analyze, as_data
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import plain_data
from project import ROOT
import pytest
from simulated_recordings import recording


@pytest.fixture(scope='module')
def analysis():
    return analyze(recording(6, ((0.1, 0.3156), (0.4, 0.632))))


def test_data_has_the_values_of_the_levels(analysis):
    """The tau interval is that of alpha, turned over."""
    data = as_data(analysis)
    assert (data['n'], data['duration_s']) == (20000, pytest.approx(19.999))
    assert data['rate_hz'] == pytest.approx(1000.0)
    for level, found in zip(data['levels'], analysis.levels):
        assert level['alpha'] == found.estimate.alpha
        assert level['tau'] == pytest.approx(1.0 / level['alpha'])
        assert level['tau_ci95'][0] == pytest.approx(1.0 / level['alpha_ci95'][1])
        assert level['alpha_ci95'][1] / level['alpha'] == pytest.approx(
            math.exp(1.96 * level['alpha_se']), rel=1e-4)
        assert level['var_inf'] == pytest.approx(level['sigma'] ** 2 / (2 * level['alpha']))
        assert len({len(level['psd'][name]) for name in level['psd']}) == 1
    lengths = {len(data['sliding'][name]) for name in ('t', 'alpha', 'sigma', 'status')}
    assert len(lengths) == 1 and lengths.pop() > 10


def test_times_count_from_the_first_sample(analysis):
    """As in `supply`, of a log whose stamps are dates."""
    dated = replace(analysis.recording, t=analysis.recording.t + 1.7e9)
    found, wanted = (as_data(analyze(one)) for one in (dated, analysis.recording))
    assert 19.0 < found['brownout']['t'] < 20.0
    assert found['brownout']['t'] == pytest.approx(wanted['brownout']['t'], abs=1e-3)
    assert found['sliding']['t'] == pytest.approx(wanted['sliding']['t'], abs=1e-3)


def names(value):
    """Yield every key of nested data."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield key
            yield from names(item)
    elif isinstance(value, list):
        for item in value:
            yield from names(item)


def test_every_key_is_documented(analysis):
    text = (ROOT / 'doc' / 'analysis.md').read_text(encoding='utf-8')
    documented = set(re.findall(r'`([a-z0-9_]+)`', text))
    data = plain_data(as_data(analyze(read_recording(ROOT / 'bags' / 'transient'))))
    data['source'] = {}
    assert sorted(set(names(data)) - documented) == []
