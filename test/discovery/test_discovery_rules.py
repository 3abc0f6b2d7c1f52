"""Rules and words of a discovery: tables of what is tried, when, and what is written."""

from dataclasses import replace
import math

import numpy as np
from numpy.testing import assert_allclose
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.finding import Cause, Criticism, Verdict
from ou_monitor.discovery.fitting import Fitter
from ou_monitor.discovery.gain import crossings
from ou_monitor.discovery.words import cause_rows, coupling_note, verdict_sentence
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.tones import Tone
import pytest
from scipy.signal import lfilter


def tone_cause(frequency, explanation):
    """Return a cause with a gain that all lines share."""
    return Cause(Tone(0.01, frequency, 0.3, 0.0), {}, 0.02, 0.003, 1e-6, (), explanation, False)


def test_terms_that_share_a_gain_are_one_row_with_the_estimates_of_all():
    """The explanation is that of the first; its estimate gives way to those of all."""
    first, other = tone_cause(31.0, ''), tone_cause(67.0, 'The second.')
    (single,) = cause_rows([first])
    estimate = single.estimates[0]
    assert '31.00 Hz' in estimate
    first = replace(first, explanation=f'The first. Estimate: {estimate}. Mend it.')
    (row,) = cause_rows([first, other])
    assert row.label == f'{first.name} x2' and len(row.estimates) == 2
    assert row.explanation == (f'The first. Estimates: (1) {row.estimates[0]}. '
                               f'(2) {row.estimates[1]}. Mend it.')
    # One that holds no estimate has them added.
    (added,) = cause_rows([replace(first, explanation='Bare.'), other])
    assert added.explanation == (f'Bare. Estimates: (1) {row.estimates[0]}. '
                                 f'(2) {row.estimates[1]}.')
    assert single.label == first.name and cause_rows([other])[0].explanation == 'The second.'


@pytest.mark.parametrize('rate, corner', ((2.0 * math.pi, '1.00'), (62.83185307, '10.0')))
def test_a_corner_is_a_rate_over_a_turn(rate, corner):
    assert f'corner at {corner} Hz' in coupling_note(rate, 100.0)


@pytest.mark.parametrize('verdict, left, begin, gain', (
    (Verdict.NO_EFFECT, False, 'The plain OU simulates this recording', False),
    (Verdict.UNEXPLAINED, True, 'The simulation deviates from the recording', False),
    (Verdict.EXPLAINED, False, 'What the plain OU gets wrong is explained by tone', True),
    (Verdict.PARTLY_EXPLAINED, False, 'tone explains a part of what the plain OU', True),
    (Verdict.PARTLY_EXPLAINED, True, 'tone explains a part of what the plain OU', True)))
def test_each_verdict_has_its_sentence(verdict, left, begin, gain):
    some = [Criticism('skewness', 9.0, 8.0, -3.7, 3.7, 0.0, 0.0)] if left else []
    text = verdict_sentence(verdict, [tone_cause(31.0, '')], some, 0.02, 0.003)
    assert text.startswith(begin) and ('mnat' in text) == gain
    assert ('lopsided' in text) == left


def test_crossings_count_falls_between_scored_neighbours():
    """Falls through 0 at 1, 3 and 6 s; a level reached counts as above."""
    t = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0])
    v = np.array([1.0, -1.0, 0.0, -1.0, 1.0, -2.0])
    assert crossings(t, v, 0.0) == pytest.approx(60.0 * 3.0 / 6.0)
    scored = np.array([True, True, True, True, False, True])
    assert crossings(t, v, 0.0, scored) == pytest.approx(60.0 * 2.0 / 3.0)
    assert math.isnan(crossings(t, v, 0.0, np.arange(6) % 2 == 0))


def test_fits_add_up_their_cost():
    """Each counts, of the first part or of everything; a fit that fails costs nothing."""
    rng = np.random.default_rng(1)
    keep = math.exp(-0.05)
    v = 5.0 + lfilter([0.01 * math.sqrt(1.0 - keep**2)], [1.0, -keep],
                      rng.standard_normal(2000))
    fitter = Fitter(Samples(np.arange(2000) * 1e-3, v, None))
    start = [OU(50.0, 0.1, 5.0)]
    one = fitter.fit(start, None)
    assert one.cost > 0.0 and fitter.cost == one.cost
    two = fitter.whole(one)
    assert_allclose(fitter.cost, one.cost + two.cost)
