"""Words about gains, chances and what is left, at the edges where they change; crossings."""

from dataclasses import replace
import math
from types import SimpleNamespace

import numpy as np
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.finding import Cause, Criticism, Verdict
from ou_monitor.discovery.gain import (
    BLOCKS, blocks_of, cause_gain, crossing_level, crossing_rates, crossings, FOLDS, gain_of,
    guess, HeldOut, mean_difference, why_unknown)
from ou_monitor.discovery.words import (
    cause_rows, explain, gain_remark, gain_text, gain_words, left_out_note, no_relaxation_note,
    overlap_words, remaining_words, unmeasured_words, verdict_sentence, why_named,
    with_error)
from ou_monitor.model.ou import simulate
from ou_monitor.model.terms.load_answer import LoadSag
from ou_monitor.model.terms.ou import OU
import pytest
from scipy.stats import chi2, norm

NAN = math.nan
SAG = Cause(LoadSag(0.5, 0.0), {}, 0.02, 0.003, 1e-3, (), 'It sags.', False)


@pytest.mark.parametrize('gain, error, words, remark', [
    (0.0197, 0.01, 'Gain on', ''), (0.0195, 0.01, 'No measurable', 'not distinguishable'),
    (-0.0195, 0.01, 'No measurable', 'not distinguishable'), (-0.0197, 0.01, 'Worse on', 'worse'),
    (NAN, 0.01, 'cannot be measured on this recording.', ''), (0.1, NAN, 'No measurable', '')])
def test_a_gain_is_one_beyond_its_error(gain, error, words, remark):
    """1.96 standard errors; in mnat."""
    assert words in gain_words(gain, error)
    found = gain_remark(gain, error)
    assert found.startswith(remark) and bool(found) == bool(remark)
    row, = cause_rows([replace(SAG, gain=gain, gain_se=error)])
    if math.isfinite(gain):
        assert row.remark.endswith('; named for what it explains in the recording as a whole'
                                   ) == bool(remark)
        assert f'{1e3 * gain:.3g}'[:4] in row.gain
    else:
        assert row.remark.startswith('not measurable here;') and row.gain == gain_text(NAN, 0.1)
    assert cause_rows([replace(SAG, gain=gain, gain_se=error, exact=True)])[0].chance == 'exact'


def test_gains_as_text():
    assert gain_text(0.0123, 0.0021) == '12.3 +- 2.1'
    assert gain_text(0.0123, NAN).startswith('12.3, error ')
    assert gain_words(0.0123, 0.0021) == (
        'Gain on samples not used for the fit: 12.3 +- 2.1 mnat per sample.')
    assert gain_words(NAN, NAN, 'why.') == 'Its gain cannot be measured on this recording: why.'
    assert why_named(0.0197, 0.01, 0.5) == '' != why_named(0.0195, 0.01, 0.5)
    assert why_named(0.0, 0.01, NAN) == ''


@pytest.mark.parametrize('value, error, text', [
    (1.0, 9.99, '1.0 +- 10'), (1.0, 0.1, '1.00 +- 0.10'), (100.0, 0.1, '100.00 +- 0.10'),
    (123456.0, 1e-3, '123456 +- 0.0010'), (0.0, 0.1, '0 +- 0.10'), (1.0, 0.0, '1.000'),
    (-1.0, 9000.0, '-1.0 +- 9000')])
def test_digits_follow_the_error(value, error, text):
    assert with_error(value, error) == text


@pytest.mark.parametrize('error, text', [
    (1.17, '1.0 +- 1.2'), (1.18, 'not determined'), (1e300, 'not determined')])
def test_what_is_positive_is_known_to_a_factor_of_10(error, text):
    """A coefficient of either sign is shown with any error: it is known to be that small."""
    assert with_error(1.0, error, positive=True) == text
    assert '+-' in with_error(1.0, error)


@pytest.mark.parametrize('chance, text', [
    (0.9e-3, '< 0.001'), (1.1e-3, '0.0011'), (0.25, '0.25')])
def test_chances_as_text(chance, text):
    assert cause_rows([replace(SAG, p_value=chance)])[0].chance == text


def test_causes_share_a_row_where_gain_and_chance_are_the_same():
    other = replace(SAG, term=LoadSag(0.2, 0.1), alternatives=('drift', 'load_transient'))
    row, = cause_rows([replace(SAG, alternatives=('drift',)), other])
    assert row.alternatives == ('drift', 'load_transient') and row.label == 'load_sag x2'
    assert len(cause_rows([SAG, replace(other, gain=0.021)])) == 2
    assert len(cause_rows([SAG, replace(other, p_value=0.5)])) == 2


def test_what_is_left_names_four_things():
    """And says how many more; each thing once."""
    def left(*names):
        return remaining_words([Criticism(name, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0) for name in names])
    five = left('skewness', 'kurtosis', 'throttle', 'clustering', 'time')
    assert five.endswith('(1 more)') and 'time' not in five
    assert '(2 more)' in left('skewness', 'kurtosis', 'throttle', 'clustering', 'time', 'bursts')
    four = left('skewness', 'kurtosis', 'throttle', 'throttle change over 2 s', 'clustering')
    assert 'more' not in four


def test_sentences_of_the_verdict():
    one = verdict_sentence(Verdict.PARTLY_EXPLAINED, [SAG], [], 0.02, 0.003, ['drift'])
    assert one.startswith(
        'load_sag explains a part of what the plain OU gets wrong; another part remains. The '
        'nearest entries of the catalogue (drift) fit in part only.')
    two = verdict_sentence(Verdict.PARTLY_EXPLAINED, [SAG, replace(SAG, term=OU(1.0, 1.0, 1.0))],
                           [], 0.02, 0.003)
    assert two.startswith('load_sag and ou explain a part')
    for why, end in (('', 'than once would decide.'), ('x', 'that alone may be what is left.')):
        text = verdict_sentence(
            Verdict.UNEXPLAINED, [], [Criticism('time', 9.0, 9.0, 0.0, 0.0, 0.0, 0.0)], 0.0, 0.1,
            why=why, uncovered=7)
        assert text.endswith(end)
    assert 'uncovered' not in verdict_sentence(Verdict.NO_EFFECT, [], [], 0.0, 0.1)
    for verdict, said in ((Verdict.UNEXPLAINED, True), (Verdict.NO_EFFECT, False)):
        text = verdict_sentence(verdict, [], [], 0.0, 0.1, stopped=True)
        assert ('stopped before it found a cause.' in text) == said
        assert 'no known cause' not in text


def test_notes_with_numbers():
    assert no_relaxation_note(50.0, 0.02).startswith('Samples 20.0 ms apart')
    assert 'alpha = 50.0 1/s is only' in no_relaxation_note(50.0, 0.02)
    assert left_out_note(3, 7).startswith('3 samples') and 'other 7 are' in left_out_note(3, 7)
    assert unmeasured_words(24, 5, False) == (
        '5 samples are left to score it on, fewer than 24. A longer recording would measure it.')
    assert 'no part of the recording' in unmeasured_words(24, 0, True)
    assert 'range of throttle' in unmeasured_words(24, 0, True)
    text = explain(SAG.term, {}, 0.02, 0.003, [], False, together=2)
    assert 'gain of all 2 terms load_sag together' in text
    assert 'terms load_sag' not in explain(SAG.term, {}, 0.02, 0.003, [], False, together=1)
    assert 'terms load_sag' not in explain(SAG.term, {}, NAN, NAN, [], False, together=2)
    assert 'without a model' in explain(SAG.term, {}, 0.02, 0.003, [], True)


@pytest.mark.parametrize('gain, whole, said', [
    (0.026, 0.02, True), (0.0258, 0.02, False), (0.006, -0.5, True), (0.0058, -0.5, False)])
def test_single_gains_larger_than_the_whole_are_said(gain, whole, said):
    """By 1.96 errors of 3 mnat; a whole that loses counts as none."""
    cause = replace(SAG, gain=gain, gain_se=0.003)
    assert bool(overlap_words([cause], whole)) == (said and cause.measurable)


def held(density, free=2, search=0.0, known=None):
    """Return a model that was scored, as far as a gain looks at it."""
    n = density.size
    return HeldOut(SimpleNamespace(density=density, free=free, search=search), density,
                   np.ones(n, bool) if known is None else known, np.zeros(n))


@pytest.mark.parametrize('gain', (0.02, 0.0, -0.02))
@pytest.mark.parametrize('search', (0.0, 2.0))
def test_the_chance_of_a_cause_is_twice_the_smaller_of_two(gain, search):
    """Of the likelihood ratio, a chi-square, with the price of the search; of the gain kept."""
    rng = np.random.default_rng(1)
    n = 2400
    old = rng.standard_normal(n)
    new = old + gain + 0.2 * rng.standard_normal(n)
    scored = np.arange(n) >= 1200
    found, error, chance = cause_gain(held(new, 4, search), held(old, 2), scored)
    mean, se = mean_difference(new[1200:], old[1200:])
    assert (found, error) == (mean, se)
    fitted = min(1.0, chi2.sf(max(0.0, 2.0 * (new - old).sum()), 2) * math.exp(search))
    assert chance == pytest.approx(min(1.0, 2.0 * min(fitted, norm.sf(mean / se))), rel=1e-9)


def test_a_gain_needs_as_many_samples_as_blocks():
    """Scored, and determined by the others in both models."""
    n = 100
    new, old = np.full(n, 1.0), np.zeros(n)
    for count, known in ((BLOCKS, True), (BLOCKS - 1, False)):
        few = np.arange(n) < count
        for which in range(3):
            every = np.ones(n, bool)
            masks = [few if k == which else every for k in range(3)]
            a, b = held(new, known=masks[0]), held(old, known=masks[1])
            assert math.isfinite(gain_of(a, b, masks[2])[0]) == known
            assert (why_unknown(a, b, masks[2], False) == '') == known


def test_a_mean_and_the_error_of_its_blocks():
    """24 blocks; a lag adds half of itself where it is positive; what is over is left out."""
    rng = np.random.default_rng(2)
    for keep in (0.9, -0.9):
        blocks = np.zeros(24)
        for k in range(1, 24):
            blocks[k] = keep * blocks[k - 1] + rng.standard_normal()
        d = np.concatenate((np.repeat(blocks, 3), [9.0] * 20))
        mean, error = mean_difference(d, np.zeros(d.size))
        c = blocks - blocks.mean()
        shared = max(0.0, (c[1:] * c[:-1]).sum() / 23.0)
        assert mean == pytest.approx(d.mean())
        assert error == pytest.approx(math.sqrt((blocks.var(ddof=1) + shared) / 24.0))


def test_crossings_count_between_neighbours_that_are_scored():
    """From the level on is above; times of pairs that are left out do not count."""
    t = np.array([0.0, 1.0, 2.0, 3.0, 13.0, 14.0])
    v = np.array([0.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    assert crossings(t, v, 0.0) == 60.0 * 3 / 14.0
    scored = np.array([True, True, True, True, False, True])
    assert crossings(t, v, 0.0, scored) == 60.0 * 2 / 3.0
    assert math.isnan(crossings(t, v, 0.0, np.zeros(6, bool)))


def test_the_level_of_crossings_is_lowered_until_both_parts_cross_it_five_times():
    """From 2.5 deviations in quarters; half-way between the samples beside it."""
    n = 4000
    v = 0.05 * np.sin(np.arange(n) * 1.7) + 5.0
    v[100:2000:400] = v[2500:4000:300] = 4.0
    samples = Samples(np.arange(n) * 1e-3, v, None)
    level = crossing_level(samples)
    below, above = v[v < 4.5].max(), v[v >= 4.5].min()
    assert level == pytest.approx(0.5 * (below + above))
    # One dip fewer in the part kept: the level lies within the sine, at a half or above.
    w = v.copy()
    w[3700] = 5.0
    shallow = crossing_level(Samples(samples.t, w, None))
    assert 4.94 < shallow < w.mean() - 0.4 * w.std()


def test_rates_of_crossings_have_errors_of_counts():
    t = np.arange(3000) * 1e-3
    v = simulate(t, 63.0, 0.3, np.random.default_rng(3), u0=5.0)
    samples = Samples(t, v, None)
    rates = crossing_rates(samples, (OU(63.0, 0.3, 5.0),), (OU(63.0, 0.3, 5.0),),
                           np.random.default_rng(4))
    assert rates.observed == crossings(t, v, rates.level)
    minutes = (t[-1] - t[0]) / 60.0
    assert rates.observed_se == pytest.approx(math.sqrt(rates.observed * minutes) / minutes)
    none = crossing_rates(samples, (OU(63.0, 0.3, 5.0),), (OU(63.0, 0.3, 5.0),),
                          np.random.default_rng(4), np.arange(3000) < BLOCKS - 1)
    assert math.isnan(none.level)


def test_a_guess_is_that_of_an_autoregression():
    t = np.arange(20_000) * 1e-3
    v = simulate(t, 63.0, 0.3, np.random.default_rng(5), u0=5.0)
    c = v - v.mean()
    found = guess(Samples(t, v, None))
    alpha = -1e3 * math.log((c[1:] @ c[:-1]) / (c @ c))
    assert found.values() == pytest.approx(
        {'alpha': alpha, 'sigma': v.std() * math.sqrt(2.0 * alpha), 'u0': v.mean()})
    white = guess(Samples(t, np.random.default_rng(6).standard_normal(t.size), None))
    assert white.alpha == pytest.approx(-1e3 * math.log(0.05))
    slow = guess(Samples(t, np.cos(0.1 * t), None))
    assert 0.1 < slow.alpha < 0.2


@pytest.mark.parametrize('n', (10, 101, 1000))
def test_blocks_are_all_samples_once(n):
    parts = blocks_of(n)
    assert len(parts) == FOLDS
    assert np.concatenate([np.arange(n)[part] for part in parts]).tolist() == list(range(n))
    sizes = [part.stop - part.start for part in parts]
    assert max(sizes) - min(sizes) <= 1
