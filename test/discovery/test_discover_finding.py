"""Records, verdicts and words: the JSON of the contract, strict, and each rule."""

from dataclasses import replace
import json
import math

import numpy as np
from ou_monitor.criticism.battery import family_chance
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.decision import failing, withdrawn
from ou_monitor.discovery.discover import doubts, judge
from ou_monitor.discovery.finding import Cause, Criticism, CrossingRate, Finding, Verdict
from ou_monitor.discovery.fitting import with_reach
from ou_monitor.discovery.words import (
    coupling_note, explain, overlap_words, parameters, plain_words, verdict_sentence, why_named,
    with_error)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.load_answer import LoadSag, LoadTransient
from ou_monitor.model.terms.load_dependent import LoadDependentSigma
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import Saturation
from ou_monitor.model.terms.tones import Tone
import pytest

OFF = Criticism('throttle', -20.0, 1.0, -3.7, 3.7, 0.0, 1.0)
WORSE = Criticism('band 4, 1 to 2 Hz', 30.0, -9.0, -3.7, 3.7, 0.0, 1e-9)
FINE = Criticism('skewness', 1.0, 0.5, -3.7, 3.7, 1.0, 1.0)


def finding(**changes):
    """Return a finding with a sag and two tones."""
    sag, tone = LoadSag(0.5, 0.0), Tone(0.01, 50.0, 0.0, 0.0)
    cause = Cause(sag, {'linear': 0.02}, 0.015, 0.002, 1e-9, ('load_transient',), 'It sags.',
                  False)
    simulated = {
        'recording': 'x', 'n': 10, 'duration': 1.0, 'verdict': Verdict.PARTLY_EXPLAINED,
        'sentence': 's', 'baseline': OU(60.0, 0.3, 5.0), 'baseline_score': 2.0,
        'criticism': (FINE, OFF, WORSE), 'causes': (cause,),
        'model': SupplyModel((OU(61.0, 0.3, 5.0), sag, tone, tone)),
        'se': ({'alpha': 1.0}, {'linear': 0.02}, {}, {}), 'score': 2.015, 'gain': 0.015,
        'gain_se': 0.002, 'crossing': CrossingRate(4.8, 10.0, 20.0, 11.0)}
    return Finding(**{**simulated, **changes})


def test_json_is_that_of_the_contract():
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
            'alternatives': ['load_transient'], 'explanation': 'It sags.'}.items() <= cause.items()
    assert cause['units'] == {'linear': 'V', 'square': 'V', 'growth': 'V/s'}
    assert cause['exact'] is False
    extended = data['extended']
    assert list(extended['params']) == ['ou', 'load_sag', 'tone', 'tone 2']
    assert (extended['heldout_score'], extended['gain'], extended['gain_se']) == (
        2.015, 0.015, 0.002)
    assert {'observed': 10.0, 'baseline': 20.0, 'extended': 11.0}.items() <= extended[
        'crossing_rate'].items()


def test_unknown_numbers_are_null():
    """Nothing fitted: all keys are there, no NaN is."""
    data = finding(baseline=None, baseline_score=math.nan, criticism=(), causes=(), model=None,
                   se=(), score=math.nan, gain=math.nan, gain_se=math.nan, duration=math.nan,
                   crossing=CrossingRate()).as_data()
    json.dumps(data, allow_nan=False)
    assert data['duration_s'] is None and data['baseline']['params']['alpha'] is None
    assert data['extended']['crossing_rate']['observed'] is None
    assert data['extended']['params'] == {} and data['causes'] == []


def test_a_gain_is_measurable_from_two_errors_on():
    """0.015 +- 0.002 is; 0.003 is not, and is said to be none."""
    (cause,) = finding().causes
    assert cause.measurable
    assert 'No measurable gain' in explain(cause.term, {}, 0.003, 0.002, (), False)
    assert 'Gain on samples' in explain(cause.term, {}, 0.015, 0.002, (), False)
    worse = explain(cause.term, {}, -0.015, 0.002, (), False)
    assert 'Worse on samples not used' in worse and 'No measurable gain' not in worse


@pytest.mark.parametrize('remaining, causes, verdict', [
    ([], 0, 'no_effect'), ([WORSE], 0, 'unexplained'), ([], 2, 'explained'),
    ([WORSE], 2, 'partly_explained')])
def test_verdicts(remaining, causes, verdict):
    """Passing or failing, with and without causes."""
    assert judge(remaining, causes).value == verdict


def test_the_chance_counts_all_statistics():
    """The largest of 50: about 50 times its own chance (0.0035 at 3, 2.7e-6 at 5)."""
    assert family_chance(-5.0, 51) == pytest.approx(51 * 2.729e-6, rel=1e-3)
    assert family_chance(3.0, 51) == pytest.approx(1 - (1 - 0.0034736)**51, rel=1e-3)


def test_latent_causes_are_withdrawn_where_something_still_fails():
    """Alone they answer for everything; beside a sag for their own signs."""
    kinds = [catalogue()[name] for name in ('load_sag', 'jumps', 'measurement_noise')]
    before = {'throttle': 30.0, 'kurtosis': 100.0, 'band 7': 20.0}
    assert failing(before, {'throttle': 4.7, 'kurtosis': 7.1, 'band 7': -4.9}) == [
        'kurtosis', 'band 7']
    form = {'throttle': 9.0, 'kurtosis': 7.1, 'band 7': 2.0}
    assert withdrawn(before, form, kinds) == [] and withdrawn(before, form, kinds[1:]) == [0]
    left = {'throttle': 9.0, 'kurtosis': 31.0, 'band 7': 6.1}
    assert withdrawn(before, left, kinds) == [1, 2]


def test_what_is_left_may_be_a_small_share_of_what_was():
    """7 % of itself is form left over; more is not."""
    kinds = [catalogue()['jumps']]
    before = {'band 7': 200.0, 'line': 0.0, 'tails': 400.0}
    assert withdrawn(before, {'band 7': 13.9, 'line': 4.7, 'tails': 27.9}, kinds) == []
    for left in ({'band 7': 14.1}, {'line': 4.9}, {'tails': 28.1}):
        assert withdrawn(before, left, kinds) == [0]


@pytest.mark.parametrize('name', [name for name in catalogue() if name != 'ou'])
def test_every_cause_has_its_words(name):
    """What it is and what to do; what would separate it is said where it is not alone."""
    kind = catalogue()[name]
    values = dict.fromkeys(kind.parameters(), 0.7)
    values.update({'low': 0.1} if 'low' in values else {})
    values.update({p: [0.7] for p in ('throttle', 'log_factor', 'at') if p in values})
    values.update({'number': [0.0]} if 'number' in values else {})
    values.update({p: v for p, v in (('dof', 5.0), ('states', 2.0)) if p in values})
    text = explain(kind.read(values), {}, 0.01, 0.001, ['drift'], False)
    assert len(text) > 120 and 'what would' in text and '(for drift)' in text
    assert all(f'{p} = ' in text for p in kind.parameters())


def test_numbers_have_errors_and_units():
    """Digits as the error allows."""
    assert with_error(0.49096, 0.03225) == '0.491 +- 0.032'
    assert with_error([0.0, 1.5], [math.nan, 0.1]) == '[0, 1.50 +- 0.10]'
    assert with_error(2.0, math.nan) == '2.000'
    assert with_error([4.0], [6.6e6], positive=True) == '[not determined]'
    assert with_error(1e-4, 0.02) == '1.0e-4 +- 0.020'
    assert parameters(OU(60.0, 0.3, 5.0), {'alpha': 2.0}).startswith('alpha = 60.0 +- 2.0 1/s; ')


def test_sentences():
    """Each verdict in words, with what is left; repeated causes counted."""
    cause = finding().causes[0]
    text = verdict_sentence(Verdict.PARTLY_EXPLAINED, [cause, cause], [WORSE], 0.015, 0.002)
    assert 'load_sag (2 terms)' in text and 'spectrum' in text
    lost = verdict_sentence(Verdict.UNEXPLAINED, [], [FINE], 0.0, 0.0, ['jumps'])
    assert 'lopsided' in lost and 'jumps' in lost
    assert plain_words('throttle change over 2 s') == plain_words('throttle')
    assert plain_words('order line') != plain_words('line')
    # 0.24 alpha T = 6 nats.
    assert 'exceeds 0.250 1/s' in coupling_note(63.0, 100.0)


def test_why_a_cause_without_a_gain_is_named():
    """By its p on the whole recording; nothing where the gain says it."""
    assert why_named(0.02, 0.005, 1e-9) == '' and why_named(math.nan, math.nan, math.nan) == ''
    for gain, error in ((0.001, 0.005), (math.nan, math.nan)):
        assert 'as a whole (p < 0.001)' in why_named(gain, error, 1e-9)
    term = finding().causes[0].term
    assert 'p = 0.01)' in explain(term, {}, 0.001, 0.005, [], False, chance=0.01)
    assert 'p = ' not in explain(term, {}, 0.001, 0.005, [], True, chance=0.0)


def test_a_model_that_has_not_earned_its_place_is_said_so():
    """After the verdict, whatever it is."""
    cause = finding().causes[0]
    text = verdict_sentence(Verdict.EXPLAINED, [cause], [], -0.015, 0.002,
                            refused='The extended model predicts worse than the plain OU')
    assert text.endswith('predicts worse than the plain OU: trust the named causes, not the '
                         'fitted values.')
    assert 'believe' not in verdict_sentence(Verdict.EXPLAINED, [cause], [], 0.015, 0.002)


def test_gains_that_overlap_are_noted():
    """Where one is larger than that of the whole by more than its error; by name."""
    cause = replace(finding().causes[0], gain=0.7, gain_se=0.1)
    assert 'Without load_sag' in overlap_words([cause], 0.2)
    assert overlap_words([cause], 0.6) == '' and overlap_words([], math.nan) == ''
    vague = replace(cause, gain=math.nan, gain_se=math.nan)
    assert overlap_words([vague], 0.2) == ''


def test_what_is_left_may_be_throttle_never_flown():
    """The sentence says so, and which recording would tell."""
    cause = finding().causes[0]
    text = verdict_sentence(
        Verdict.PARTLY_EXPLAINED, [cause], [WORSE], 0.015, 0.002, uncovered=900)
    assert '900 samples are at throttle that the rest' in text
    assert '900 samples' not in verdict_sentence(
        Verdict.EXPLAINED, [cause], [], 0.015, 0.002, uncovered=900)


def test_explained_needs_statistics_errors_falls_and_parameters():
    """A statistic outside, larger errors, more wrong falls, a parameter at an end forbid it."""
    falls = CrossingRate(14.0, 46.0, 15.5, 2.9, 2.0, 1.0, 0.5)
    assert falls.worse and not replace(falls, extended=20.0).worse
    assert not replace(falls, extended=44.0, baseline=45.0).worse
    (said,) = doubts((OU(60.0, 0.3, 5.0),), falls, 60.0, 0.001)
    assert judge([], 1, (said,)) is Verdict.PARTLY_EXPLAINED
    assert all(words in said for words in ('2.9', '46', '15.5'))
    good = CrossingRate(14.0, 46.0, 15.5, 44.0, 2.0, 1.0, 0.5)
    assert len(doubts((OU(60.0, 0.3, 5.0),), good, 60.0, 0.001, larger=True)) == 1
    lag = LoadTransient(0.2, 0.0005, 0.0)
    assert doubts((lag,), good, 60.0, 0.001) == ('tau of load_transient stands at the end of the '
                                                 'range',)
    assert not doubts((replace(lag, tau=0.1), replace(lag, tau=6000.0, delay=0.02)), good, 60.0,
                      0.001)
    steep = LoadDependentSigma((0.0, 1.0), (0.0, 4.0))
    assert doubts((steep,), good, 60.0, 0.001) and not doubts(
        (replace(steep, log_factor=(0.0, 3.9)),), good, 60.0, 0.001)


def test_parameters_beyond_the_reach_of_the_recording_are_not_told():
    """In 17 s no time of 1700 s and no rate of 0.01 1/s is seen, nor an end never met."""
    samples = Samples(np.linspace(0.0, 17.0, 50), np.linspace(14.0, 16.0, 50), None)
    late = LoadTransient(0.2, 1700.0, 0.02)
    ends = Saturation(14.0, 2000.0)
    slow = OU(0.01, 0.3, 15.0)
    assert parameters(late, with_reach(late, {}, samples)) == 'gain = 0.2000 V; delay = 0.02000 s'
    assert parameters(ends, with_reach(ends, {}, samples)) == 'low = 14.00 V'
    assert 'alpha' not in parameters(slow, with_reach(slow, {'alpha': 1.0}, samples))
    near = LoadTransient(0.2, 16.0, 0.0)
    assert with_reach(near, {'tau': 1.0}, samples) == {'tau': 1.0}
