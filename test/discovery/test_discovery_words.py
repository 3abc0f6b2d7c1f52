"""Words of a finding: gains, probabilities and remainders, at the edges where they change."""

from dataclasses import replace
import math
import re

from ou_monitor.discovery.finding import Cause, Criticism, Explanation, Finding, Verdict
from ou_monitor.discovery.words import (
    both_names, cause_rows, coupling_note, explain, gain_text, input_words, parameters,
    PLAIN_NAMES, plain_words, verdict_words, with_error)
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.load_response import LoadDependentNoise, LoadSag, LoadTransient
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.slow import Drift
from ou_monitor.model.terms.tones import Tone
import pytest

NAN = math.nan
SAG = Cause(LoadSag(0.5, 0.0), {}, 0.02, 0.003, 1e-3, (),
            Explanation('It sags.', ('linear = 0.5 V',), (), ''), False)


def left_over(name):
    return Criticism(name, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize('gain, error, words', [
    (0.0197, 0.01, 'one-step errors shrink'), (0.0195, 0.01, 'No measurable gain on'),
    (-0.0195, 0.01, 'No measurable gain on'), (-0.0197, 0.01, 'Worse on'),
    (NAN, 0.01, 'cannot be measured on this recording.'), (0.1, NAN, 'No measurable gain on')])
def test_a_gain_counts_beyond_1_96_standard_errors(gain, error, words):
    found = replace(finding(Verdict.EXPLAINED, [SAG]), gain=gain, gain_se=error)
    assert words in verdict_words(found)[2]


@pytest.mark.parametrize('value, error, text', [
    (1.0, 9.99, '1.0 +- 20'), (1.0, 0.05, '1.00 +- 0.098'), (100.0, 0.05, '100.00 +- 0.098'),
    (123456.0, 1e-3, '123456 +- 0.0020'), (0.0, 0.1, '0 +- 0.20'), (1.0, 0.0, '1.000'),
    (-1.0, 4600.0, '-1.0 +- 9016'), ([0.0, 1.5], [NAN, 0.1], '[0, 1.5 +- 0.20]'),
    (2.0, NAN, '2.000'), (1e-4, 0.02, '1.0e-4 +- 0.039')])
def test_digits_follow_the_error(value, error, text):
    assert with_error(value, error) == text


@pytest.mark.parametrize('error, text', [
    (0.5, '1.0 +- 0.98'), (0.52, '0.36 to 2.8'), (1.17, '0.10 to 9.9'),
    (1.18, 'not determined'), (1e300, 'not determined')])
def test_a_positive_parameter_is_shown_if_known_to_a_factor_of_10(error, text):
    """A coefficient of either sign is shown with any error: it is known to be that small."""
    assert with_error(1.0, error, positive=True) == text
    assert with_error([1.0], [error], positive=True) == f'[{text}]'
    assert '+-' in with_error(1.0, error)


@pytest.mark.parametrize('chance, text', [
    (0.9e-3, '< 0.001'), (1.1e-3, '0.0011'), (0.25, '0.25')])
def test_p_values_are_written_with_one_rule(chance, text):
    assert cause_rows([replace(SAG, p_value=chance)])[0].chance == text
    assert cause_rows([replace(SAG, p_value=chance, exact=True)])[0].chance == 'exact'


def tone_cause(frequency):
    """Return a cause with a gain that all lines share."""
    term = Tone(0.01, frequency, 0.3, 0.0)
    return Cause(term, {}, 0.02, 0.003, 1e-6, (), explain(term, {}, [], together=2), False)


def test_terms_that_share_a_gain_are_one_row_with_the_estimates_of_all():
    first, other = tone_cause(31.0), tone_cause(67.0)
    (single,) = cause_rows([first])
    estimate, last = (parameters(one.term, one.se) for one in (first, other))
    assert '31.00 Hz' in estimate and f' Estimate: {estimate}. ' in single.explanation
    assert single.label == first.name and single.explanation == first.explanation.text
    (row,) = cause_rows([first, other])
    assert row.label == f'{first.name} x2'
    assert row.explanation == single.explanation.replace(
        f'Estimate: {estimate}.', f'Estimates: (1) {estimate}. (2) {last}.')


def finding(verdict, causes=(), left=(), **more):
    return Finding('x', 10, 1.0, verdict, causes=tuple(causes), criticism=tuple(left), gain=0.02,
                   gain_se=0.003, **{'shrink': 0.01, **more})


@pytest.mark.parametrize('verdict, named, left, words', (
    (Verdict.NO_EFFECT, False, False, 'The plain OU reproduces this recording'),
    (Verdict.UNEXPLAINED, False, True, 'no known cause explains it: prediction errors are skewed'),
    (Verdict.EXPLAINED, True, False, 'the simulation passes every test'),
    (Verdict.PARTLY_EXPLAINED, True, False, 'comes closer, but is not yet right: too slow'),
    (Verdict.PARTLY_EXPLAINED, True, True, 'comes closer, but is not yet right: too slow')))
def test_each_verdict_has_its_sentence(verdict, named, left, words):
    found = finding(verdict, [tone_cause(31.0)] * named, [left_over('skewness')] * left)
    text = ' '.join(verdict_words(found, doubts=['too slow'] if 'slow' in words else []))
    assert words in text and ('mnat' in text) == named
    assert ('A plain simulation lacks a spectral line' in text) == named


def test_the_answer_begins_with_the_largest_gains():
    """Three names, the number of the others; then the reason why the model is not to be used."""
    causes = [replace(SAG, term=term, gain=gain) for term, gain in (
        (SAG.term, 0.2), (Drift(0.1, 0.0), NAN), (Tone(0.01, 11.0, 0.0, 0.0), 0.3),
        (Tone(0.01, 23.0, 0.0, 0.0), 0.3))]
    first, *_ = verdict_words(finding(Verdict.EXPLAINED, causes))
    assert re.findall(r'\((\w+)\)', first) == ['tone', 'load_sag', 'drift']
    more = finding(Verdict.PARTLY_EXPLAINED, refused='It strays', causes=[
        *causes, replace(SAG, term=MeasurementNoise(0.01), gain=0.1)])
    strongest, *_, refused = verdict_words(more)
    assert re.findall(r'\((\w+)\)', strongest) == ['tone', 'load_sag', 'measurement_noise']
    assert '1 more' in strongest and refused.startswith('It strays')
    assert more.closer and not replace(more, larger=True).closer


def test_the_verdict_comes_before_the_gain():
    """The last lines on a terminal repeat the first two sentences."""
    _, verdict, gain = verdict_words(finding(Verdict.EXPLAINED, [SAG]))
    assert verdict.startswith('With it the simulation passes every test') and 'mnat' in gain


@pytest.mark.parametrize('error, inrush', [(0.2, True), (1.1, False)])
def test_an_answer_whose_sign_is_not_known_is_not_said_to_be_inrush(error, inrush):
    term = LoadTransient(2.0, 0.009, 0.0, -3.6)
    text = explain(term, {'gain': error, 'rise': 2.0 * error}, []).text
    assert ('inrush of motors' in text.replace('lag, inrush', '')) == inrush


def test_every_cause_has_a_plain_name():
    assert set(PLAIN_NAMES) == set(catalogue()) - {'ou'}
    assert len(set(PLAIN_NAMES.values())) == len(PLAIN_NAMES)
    assert both_names('load_sag') == 'sag (load_sag)' and both_names('new') == 'new'


@pytest.mark.parametrize('name', [name for name in catalogue() if name != 'ou'])
def test_every_cause_has_its_words(name):
    """What it is and what to do; what would separate it is said where it is not alone."""
    kind = catalogue()[name]
    values = dict.fromkeys(kind.parameters(), 0.7)
    values.update({'low': 0.1} if 'low' in values else {})
    values.update({p: [0.7] for p in ('throttle', 'log_factor', 'at') if p in values})
    values.update({'number': [0.0]} if 'number' in values else {})
    values.update({p: v for p, v in (('dof', 5.0), ('states', 2.0)) if p in values})
    term = kind.read(values)
    text = explain(term, {}, ['drift']).text
    assert len(text) > 120 and 'To separate them' in text and '(for drift)' in text
    told = [p for p in kind.parameters() if not (term.factors() and isinstance(values[p], list))]
    assert all(f'{kind.label(p)} = ' in text for p in told)
    assert all(f'factor over {input_words(name)} = ' in text for name in term.factors())


@pytest.mark.parametrize('index, what, when', [
    (0.0, 'follows throttle', 'at high throttle'),
    (4.0, 'follows changes of throttle', 'soon after changes of throttle')])
@pytest.mark.parametrize('load', ['throttle', 'current'])
def test_noise_says_which_input_it_follows(index, what, when, load):
    what, when = what.replace('throttle', load), when.replace('throttle', load)
    law = replace(SAG, term=LoadDependentNoise((index, index), (0.1, 0.2), (0.0, 1.0)))
    assert f'sensor noise that {what} (load_dependent_noise)' in verdict_words(
        finding(Verdict.EXPLAINED, [law], full=10.0 if load == 'current' else NAN))[0]
    assert cause_rows([law], load)[0].what == f'sensor noise that {what}'
    assert f'Give readings {when} less weight' in explain(law.term, {}, [], load=load).remedy


def test_the_verdict_says_what_is_left_or_refused():
    """The nearest entries, throttle never flown, a refusal."""
    some = [left_over('band 4, 1 to 2 Hz')]
    lost = finding(Verdict.UNEXPLAINED, (), some)
    for more, words in (({'dropped': ['jumps']}, 'jumps'), ({'uncovered': 900}, '900 samples'),
                        ({}, 'spectrum')):
        (text,) = verdict_words(lost, **more)
        assert words in text and 'no known cause' in text
    refused = finding(Verdict.EXPLAINED, [SAG], refused='It is worse')
    assert verdict_words(refused)[-1].startswith('It is worse: trust the named causes')
    assert plain_words('throttle change over 2 s') == plain_words('throttle')
    assert plain_words('order line') != plain_words('line')
    # 0.24 alpha T = 4 nats + 0.5 ln n; a corner is a rate over a turn.
    note = coupling_note(20.0 * math.pi, 100.0, round(math.exp(8.0)))
    assert 'more than 3.00 s' in note and 'high-pass at 10.0 Hz' in note


@pytest.mark.parametrize('gain, error, text', [
    (NAN, 0.1, 'not known'), (0.25, NAN, '250, error not known'), (0.25, 0.01, '250 +- 20'),
    (5.5e-7, 7.7e-5, '0 +- 0.15')])
def test_a_gain_has_its_error_or_says_that_it_is_unknown(gain, error, text):
    assert gain_text(gain, error) == text


def test_the_size_of_errors_is_told_only_where_it_gains():
    """Single large errors may outweigh in the rms what the density gains; JSON has both parts."""
    for shrink, parts in ((0.0, True), (0.0198, False), (0.1, False)):
        words = verdict_words(finding(Verdict.EXPLAINED, [SAG], shrink=shrink))[2]
        assert ('size is predicted' in words) is parts and '20.0 +- 5.9 mnat' in words


def test_a_response_is_told_by_its_sign_and_time_constant():
    told = [LoadTransient(gain, tau, 0.0).MEANING for gain in (0.1, -0.1) for tau in (0.1, 1.0)]
    assert [word in text for word, text in zip(
        ('motors and filters', 'polarisation', 'inrush', 'warms'), told)] == [True] * 4
    assert LoadTransient(0.1, 1.0, 0.1).MEANING == LoadTransient.MEANING
    assert len({*told, LoadTransient.MEANING}) == 5
