"""Records, verdicts and words of a finding: strict JSON with its keys, and each rule."""

from dataclasses import replace
import json
import math

import numpy as np
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.discover import discover, doubts, judge
from ou_monitor.discovery.finding import Cause, Criticism, Explanation, Finding, LowDips, Verdict
from ou_monitor.discovery.fitting import with_reach
from ou_monitor.discovery.words import parameters
from ou_monitor.model.ou import simulate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadDependentSigma, LoadSag, LoadTransient
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import Saturation
from ou_monitor.model.terms.tones import Tone
from ou_monitor.records import Recording
import pytest

OFF = Criticism('throttle', -20.0, 1.0, -3.7, 3.7, 0.0, 1.0)
WORSE = Criticism('band 4, 1 to 2 Hz', 30.0, -9.0, -3.7, 3.7, 0.0, 1e-9)
FINE = Criticism('skewness', 1.0, 0.5, -3.7, 3.7, 1.0, 1.0)


def finding(**changes):
    """Return a finding with a sag and two tones."""
    sag, tone = LoadSag(0.5, 0.0), Tone(0.01, 50.0, 0.0, 0.0)
    cause = Cause(sag, {'linear': 0.02}, 0.015, 0.002, 1e-9, ('load_transient',),
                  Explanation('It sags.', ('linear = 0.5 V',), ('Alone.',), 'Mend it.'), False)
    simulated = {
        'recording': 'x', 'n': 10, 'duration': 1.0, 'verdict': Verdict.PARTLY_EXPLAINED,
        'words': ('s',), 'baseline': OU(60.0, 0.3, 5.0), 'baseline_score': 2.0,
        'criticism': (FINE, OFF, WORSE), 'causes': (cause,),
        'model': SupplyModel((OU(61.0, 0.3, 5.0), sag, tone, tone)),
        'se': ({'alpha': 1.0}, {'linear': 0.02}, {}, {}), 'score': 2.015, 'gain': 0.015,
        'gain_se': 0.002, 'dips': LowDips(4.8, 5, 3, 10.0, 20.0, 11.0)}
    return Finding(**{**simulated, **changes})


def test_json_has_the_documented_keys():
    """Every key of section 5, its values, and strict JSON."""
    data = finding().as_data()
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert (data['recording'], data['n'], data['duration_s']) == ('x', 10, 1.0)
    assert data['verdict'] == 'partly_explained'
    assert data['baseline']['params'] == {'alpha': 60.0, 'sigma': 0.3, 'u0': 5.0}
    assert data['baseline']['heldout_score'] == 2.0
    worst, other = data['discrepancies']
    assert worst == {'statistic': WORSE.statistic, 'observed': 30.0, 'simulated_low': -3.7,
                     'simulated_high': 3.7, 'p_value': 0.0}
    assert other['statistic'] == 'throttle'
    assert [c['observed'] for c in data['remaining']] == [-9.0]
    (cause,) = data['causes']
    assert {'name': 'load_sag', 'family': 'load', 'gain': 0.015, 'gain_se': 0.002,
            'p_value': 1e-9, 'params': {'linear': 0.5, 'square': 0.0, 'growth': 0.0},
            'alternatives': ['load_transient'],
            'explanation': 'It sags. Estimate: linear = 0.5 V. Alone. Mend it.'
            }.items() <= cause.items()
    assert cause['units'] == {'linear': 'V', 'square': 'V', 'growth': 'V/s'}
    assert cause['exact'] is False
    extended = data['extended']
    assert list(extended['params']) == ['ou', 'load_sag', 'tone', 'tone 2']
    assert (extended['heldout_score'], extended['gain'], extended['gain_se']) == (
        2.015, 0.015, 0.002)
    assert {'level_v': 4.8, 'count': 5, 'made_by_load': 3}.items() <= data['dips'].items()
    assert {'observed': 10.0, 'baseline': 20.0, 'extended': 11.0}.items() <= data['extended'][
        'crossing_rate'].items()


@pytest.mark.parametrize('full, throttle, load', [
    (math.nan, True, 'throttle'), (20.0, True, 'current'), (20.0, False, 'current'),
    (math.nan, False, 'none')])
def test_a_finding_knows_its_load(full, throttle, load):
    assert finding(full=full, has_throttle=throttle).load == load


def test_unknown_numbers_are_null():
    """Nothing fitted: all keys are there, no NaN is."""
    data = finding(baseline=None, baseline_score=math.nan, criticism=(), causes=(), model=None,
                   se=(), score=math.nan, gain=math.nan, gain_se=math.nan, duration=math.nan,
                   dips=LowDips()).as_data()
    json.dumps(data, allow_nan=False)
    assert data['duration_s'] is None and data['baseline']['params']['alpha'] is None
    assert data['extended']['crossing_rate']['observed'] is None
    assert data['dips']['made_by_load'] is None
    assert data['extended']['params'] == {} and data['causes'] == []


@pytest.mark.parametrize('remaining, causes, verdict', [
    ([], 0, 'no_effect'), ([WORSE], 0, 'unexplained'), ([], 2, 'explained'),
    ([WORSE], 2, 'partly_explained')])
def test_the_verdict_follows_causes_and_what_is_left(remaining, causes, verdict):
    assert judge(remaining, causes).value == verdict


def test_explained_needs_statistics_errors_dips_and_parameters():
    dips = LowDips(14.0, 46, None, 46.0, 15.5, 2.9, 2.0, 1.0, 0.5)
    assert dips.worse and not replace(dips, extended=20.0).worse
    # 1.96 of the error of both, 2.06, is 4.04.
    for extended, worse in ((42.1, False), (41.8, True)):
        assert replace(dips, extended=extended, baseline=45.0).worse is worse
    (said,) = doubts((OU(60.0, 0.3, 5.0),), dips, 60.0, 0.001)
    assert judge([], 1, (said,)) is Verdict.PARTLY_EXPLAINED
    assert all(words in said for words in ('2.9', '46', '15.5'))
    good = LowDips(14.0, 46, None, 46.0, 15.5, 44.0, 2.0, 1.0, 0.5)
    assert len(doubts((OU(60.0, 0.3, 5.0),), good, 60.0, 0.001, larger=True)) == 1
    lag = LoadTransient(0.2, 0.0005, 0.0)
    (said,) = doubts((lag,), good, 60.0, 0.001)
    assert 'tau of load_transient' in said
    assert not doubts((replace(lag, tau=0.1), replace(lag, tau=6000.0, delay=0.02)), good, 60.0,
                      0.001)
    steep = LoadDependentSigma((0.0, 1.0), (0.0, 4.0))
    assert doubts((steep,), good, 60.0, 0.001) and not doubts(
        (replace(steep, log_factor=(0.0, 3.9)),), good, 60.0, 0.001)


def test_parameters_that_the_recording_cannot_determine_are_not_shown():
    """In 17 s no time of 1700 s and no rate of 0.01 1/s is seen, nor an end never met."""
    samples = Samples(np.linspace(0.0, 17.0, 50), np.linspace(14.0, 16.0, 50), None)
    late = LoadTransient(0.2, 1700.0, 0.02)
    ends = Saturation(14.0, 2000.0)
    slow = OU(0.01, 0.3, 15.0)
    assert parameters(late, with_reach(late, {}, samples)) == (
        'decaying part = 0.2000 V; delay = 0.02000 s')
    assert parameters(ends, with_reach(ends, {}, samples)) == 'low = 14.00 V'
    assert 'alpha' not in parameters(slow, with_reach(slow, {'alpha': 1.0}, samples))
    near = LoadTransient(0.2, 16.0, 0.0)
    assert with_reach(near, {'tau': 1.0}, samples) == {'tau': 1.0}


@pytest.mark.parametrize('even', [True, False])
def test_a_periodic_load_is_no_random_switch(even):
    # A load of 50 mV that is on for 0.3 s of each second, or for random times with that mean.
    rng, rate, n = np.random.default_rng(1), 100.0, 6000
    t = np.arange(n) / rate
    turns = np.cumsum(np.tile([0.7, 0.3], 60) if even else
                      rng.exponential(np.tile([0.7, 0.3], 60)))
    on = np.searchsorted(turns, t, 'right') % 2
    voltage = simulate(t, 20.0, 0.06, rng) + 5.0 - 0.05 * on
    found = discover(Recording(name='rail', t=t, voltage=voltage))
    assert [cause.name for cause in found.causes] == ['regime_switching']
    assert ('as with a periodic load' in found.sentence) is even
    assert not even or found.verdict is Verdict.PARTLY_EXPLAINED
