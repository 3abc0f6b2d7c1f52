"""What the search decides, by tables: each constant held from both sides, each rule by a case."""

from typing import ClassVar

from ou_monitor.criticism.null_bank import family_chance
from ou_monitor.discovery import decision
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Role, Term
import pytest
from scipy.stats import binom, norm

KINDS = catalogue()


class Cheap(Term):
    """A latent cause that asks for one statistic, in one direction."""

    NAME = 'cheap'
    FAMILY = 'toys'
    ROLE = Role.BLOCK
    SIGNS: ClassVar[tuple[str, ...]] = ('+band', 'line')


class Dear(Cheap):
    """The same, whose fit takes seconds, of another family."""

    NAME = 'dear'
    FAMILY = 'dolls'
    DEAR = True


class Imitator(Dear):
    """One that imitates the cheap one."""

    NAME = 'imitator'
    IMITATES: ClassVar[tuple[str, ...]] = ('cheap',)


class Law(Cheap):
    """Another law of the noise."""

    NAME = 'law'
    ROLE = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('kurtosis',)


class White(Cheap):
    """A noise of the measurement."""

    NAME = 'white'
    ROLE = Role.NOISE
    MAY_LEAVE = 0.3
    SIGNS: ClassVar[tuple[str, ...]] = ('-autocorrelation',)


class Mean(Cheap):
    """A mean that answers to throttle."""

    NAME = 'mean'
    ROLE = Role.MEAN
    MEASURED = True
    NEEDS_THROTTLE = True
    SIGNS: ClassVar[tuple[str, ...]] = ('throttle',)


class Intensity(Mean):
    """A sigma that answers to throttle."""

    NAME = 'intensity'
    FAMILY = 'intensity'
    ROLE = Role.DRIVE
    SIGNS: ClassVar[tuple[str, ...]] = ('variance throttle',)


class Trend(Mean):
    """A mean that answers to time, and needs a share of the largest evidence."""

    NAME = 'trend'
    NEEDS_THROTTLE = False
    LEAST_SHARE = 0.02
    SIGNS: ClassVar[tuple[str, ...]] = ('time',)


class Clear(Cheap):
    """A latent cause that has its turn early where it is clear."""

    NAME = 'clear'
    CLEAR_ABOVE: ClassVar[dict[str, float]] = {'order line': 10.0}


class Ringing(Cheap):
    """One that some statistics refute."""

    NAME = 'ringing'
    MAY_LEAVE = 0.1
    REFUTED_BY: ClassVar[tuple[str, ...]] = ('bursts',)


TOYS = [Cheap, Dear, Imitator, Law, White, Mean, Intensity, Trend, Clear, Ringing]


@pytest.mark.parametrize('kind, values, asked', [
    (Cheap, {'band 3': 2.61}, 2.61), (Cheap, {'band 3': 2.59}, 0.0),
    (Dear, {'band 3': 3.21}, 3.21), (Dear, {'band 3': 3.19}, 0.0),
    # In one direction only, or in both.
    (Cheap, {'band 3': -9.0}, 0.0), (Cheap, {'line': -9.0}, 9.0),
    # The largest of those that ask counts.
    (Cheap, {'band 3': 5.0, 'line': 7.0, 'time': 20.0}, 7.0),
    # A sign is the beginning of a name.
    (Cheap, {'order line': 9.0}, 0.0), (Mean, {'throttle change over 2 s': -4.0}, 4.0)])
def test_a_statistic_asks_for_the_kinds_that_it_is_a_sign_of(kind, values, asked):
    assert decision.asks(kind, values) == asked


@pytest.mark.parametrize('largest, off', [(4.49, False), (4.51, True), (-4.51, True)])
def test_clearly_off(largest, off):
    assert decision.any_off({'a': 0.0, 'b': largest}) is off


@pytest.mark.parametrize('kind, values, tier', [
    (Mean, {}, 0), (Trend, {}, 0), (Cheap, {'kurtosis': 99.0}, 2),
    (Law, {'kurtosis': 24.9}, 2), (Law, {'kurtosis': 25.1}, 1),
    (Law, {'tails beyond 4': -26.0}, 1),
    (Clear, {'order line': 9.9}, 2), (Clear, {'order line': 10.1}, 0),
    (White, {'kurtosis': 24.9}, 0), (White, {'kurtosis': 25.1}, 1),
    (White, {'kurtosis': 99.0, 'small errors lag 1': -7.9}, 1),
    (White, {'kurtosis': 99.0, 'small errors lag 1': -8.1}, 0)])
def test_when_a_kind_has_its_turn(kind, values, tier):
    assert decision.tier_of(kind, values) == tier


def tried(values, model=(), given=(), tier=2, throttle=True, kinds=TOYS):
    """Return the names of the kinds to try."""
    return [kind.NAME for kind in decision.kinds_to_try(
        kinds, list(model), values, given, tier, throttle)]


BAND = {'band 3': 5.0}


def test_cheap_kinds_are_tried_first_and_of_these_the_most_asked_for():
    assert tried(BAND) == ['cheap', 'clear', 'ringing', 'dear', 'imitator']

    class Line(Cheap):
        NAME = 'only lines'
        SIGNS: ClassVar[tuple[str, ...]] = ('line',)

    assert tried({**BAND, 'line': 6.0}, kinds=[White, Mean, Cheap, Line]) == [
        'cheap', 'only lines']
    assert tried({**BAND, 'line': 4.0}, kinds=[Line, Cheap]) == ['cheap', 'only lines']


@pytest.mark.parametrize('changes, missing', [
    ({'given': ['cheap']}, 'cheap'), ({'model': [Cheap]}, 'cheap'),
    # One that imitates what is there already, whichever of the two says so.
    ({'model': [Cheap]}, 'imitator'), ({'model': [Imitator]}, 'cheap')])
def test_what_is_not_tried(changes, missing):
    assert missing in tried(BAND) and missing not in tried(BAND, **changes)


def test_a_kind_that_recurs_is_tried_again():
    class Again(Cheap):
        NAME = 'again'
        RECURS = True

    assert tried(BAND, [Again], kinds=[Again]) == ['again']
    assert tried(BAND, [Cheap], kinds=[Cheap]) == []


def test_exact_findings_and_kinds_without_signs_are_never_tried():
    class Exact(Cheap):
        NAME = 'exact'
        ROLE = Role.EXACT

    class Mute(Cheap):
        NAME = 'mute'
        SIGNS: ClassVar[tuple[str, ...]] = ()

    assert tried(BAND, kinds=[Exact, Mute, KINDS['ou']]) == []


def test_throttle_must_be_known_to_what_needs_it():
    asked = {'variance throttle': 5.0}
    assert tried(asked, tier=0) == ['intensity']
    assert tried(asked, tier=0, throttle=False) == []


def test_answers_of_the_mean_to_what_is_measured_are_left_to_the_regression():
    assert tried({'throttle': 50.0, 'time': 50.0}, tier=0) == []
    assert [kind for kind in TOYS if decision.is_answer(kind)] == [Mean, Trend]


@pytest.mark.parametrize('kind, largest, again, least', [
    (Mean, 0.0, False, 3.0), (Mean, 1e4, False, 3.0), (Mean, 1e4, True, 50.0),
    (Mean, 100.0, True, 3.0), (Cheap, 1e4, True, 6.0)])
def test_one_more_answer_needs_a_share_of_the_largest(kind, largest, again, least):
    """A form that is right to 7 % leaves (7 %)^2 = 0.5 % of what it explains."""
    assert decision.least_evidence(kind, largest, again) == pytest.approx(least)


@pytest.mark.parametrize('gains, shared', [
    ([5.0, 0.0, 0.0, 0.0], False), ([5.0, 1.0, 0.0, 0.0], True), ([3.0, 2.0, -6.0, 3.0], False),
    ([1.0, 1.0, 1.0, 1.0], True), ([-1.0, -1.0, -1.0, -1.0], False)])
def test_more_than_one_part_must_gain(gains, shared):
    """Of one part alone the error of the sum is the sum."""
    assert decision.is_shared(gains) is shared


@pytest.mark.parametrize('one, left, kind, spared', [
    (Cheap, {'time': 1.0}, Dear, True), (Cheap, None, Dear, False),
    # A cheap kind is tried in any case, as is one of the same family or an imitator.
    (Dear, {'time': 1.0}, Cheap, False), (Imitator, {'time': 1.0}, Dear, False),
    (Cheap, {'time': 1.0}, Imitator, False),
    # What is left asks for it, or is off.
    (Cheap, {'band 1': 3.3}, Dear, False), (Cheap, {'band 1': 3.1}, Dear, True),
    (Cheap, {'time': 4.6}, Dear, False), (Cheap, {'time': 4.4}, Dear, True)])
def test_a_clear_trial_spares_dear_ones(one, left, kind, spared):
    assert decision.settled(one, left, kind) is spared


@pytest.mark.parametrize('kind, cost, may', [
    (Cheap, 14.9, True), (Cheap, 15.1, False), (Dear, 9.9, True), (Dear, 10.1, False)])
def test_kinds_are_tried_while_time_is_left_for_them(kind, cost, may):
    assert decision.affordable(kind, cost) is may


@pytest.mark.parametrize('kind, evidence, ragged, throughout, accepted', [
    (Cheap, 6.1, False, True, True), (Cheap, 5.9, False, True, False),
    (Mean, 5.9, False, True, False), (Intensity, 6.1, False, True, True),
    # Where scores are ragged, what was measured must gain throughout; the others need not.
    (Mean, 9.0, True, False, False), (Mean, 9.0, True, True, True),
    (Mean, 9.0, False, False, True), (Cheap, 9.0, True, False, True)])
def test_what_is_accepted(kind, evidence, ragged, throughout, accepted):
    assert decision.acceptable(kind, evidence, ragged, throughout) is accepted


@pytest.mark.parametrize('trials, best', [
    ([('second_relaxation', 68.0), ('drift', 65.1)], 'drift'),
    ([('second_relaxation', 68.0), ('jumps', 67.0), ('drift', 64.9)], 'second_relaxation'),
    ([('flicker_noise', 68.0), ('drift', 66.0)], 'drift'),
    ([('jumps', 68.0), ('drift', 66.0)], 'jumps'), ([('drift', 9.0), ('jumps', 8.0)], 'drift')])
def test_a_trend_comes_before_a_slow_cause_that_does_as_well(trials, best):
    assert decision.best_of(trials) == best


@pytest.mark.parametrize('alone, beside, throttles', [
    # The larger part of it is throttle's, or none is.
    (100.0, 49.0, True), (100.0, 51.0, False), (100.0, 130.0, False), (692.0, 171.0, True),
    # Beside the free law it needs what any cause needs.
    (8.0, 5.9, True), (8.0, 6.1, False), (0.0, -20.0, True)])
def test_what_throttle_explains_in_another_form(alone, beside, throttles):
    assert decision.is_throttles(alone, beside) is throttles


@pytest.mark.parametrize('name, value, ragged', [
    ('kurtosis', 7.9, False), ('kurtosis', 8.1, True), ('tails beyond 4', 8.1, True),
    ('clustering 0.1 s', 8.1, True), ('kurtosis', -20.0, False), ('skewness', 20.0, False)])
def test_ragged_scores(name, value, ragged):
    assert decision.is_ragged({'time': 50.0, name: value}) is ragged


@pytest.mark.parametrize('mean, error, positive, throughout', [
    (4.1, 1.0, 1, True), (3.9, 1.0, 17, False), (3.9, 1.0, 18, True), (-9.0, 1.0, 24, True)])
def test_a_gain_is_throughout(mean, error, positive, throughout):
    gains = [1.0] * positive + [-1.0] * (24 - positive)
    assert decision.is_throughout(mean, error, gains) is throughout


def test_rivals_are_those_within_a_tie_of_the_best():
    evidence = [('a', 13.1), ('best', 10.0), ('b', 7.1), ('c', 6.9)]
    assert decision.rivals_of('best', evidence) == ['a', 'b']


@pytest.mark.parametrize('before, after, kind, helps', [
    # Little is left: four times 25.
    ({'a': 5.1}, {'a': 9.9}, None, True), ({'a': 5.1}, {'a': 10.1}, None, False),
    # Half of the sum of squares must go.
    ({'a': 20.0}, {'a': 14.1}, None, True), ({'a': 20.0}, {'a': 14.2}, None, False),
    # Of scores below 4 nothing counts.
    ({'a': 3.9, 'b': 14.2}, {'a': 3.9, 'b': 10.05}, None, False),
    ({f'{k}': 4.1 for k in range(9)}, {f'{k}': 3.9 for k in range(9)}, None, True),
    ({f'{k}': 4.1 for k in range(9)}, {f'{k}': 4.1 for k in range(9)}, None, False),
    # Only what asks for the kind, or everything; what was not there before is not counted.
    ({'band 1': 20.0, 'time': 50.0}, {'band 1': 1.0, 'time': 50.0}, Cheap, True),
    ({'band 1': 20.0, 'time': 50.0}, {'band 1': 1.0, 'time': 50.0}, None, False),
    ({'band 1': 20.0}, {'band 1': 1.0, 'time': 50.0}, None, True)])
def test_what_helps(before, after, kind, helps):
    assert decision.helped(before, after, kind) is helps


@pytest.mark.parametrize('kind, last, doubted', [
    (Mean, Mean, True), (Cheap, Law, True), (Mean, Cheap, True),
    # A law of the noise does not take the place of an answer to an input...
    (Intensity, Law, False),
    # ... but one of the same family may.
    (KINDS['load_dependent_sigma'], KINDS['volatility'], True),
    (KINDS['load_dependent_sigma'], KINDS['jumps'], False)])
def test_what_is_in_doubt_again(kind, last, doubted):
    assert decision.in_doubt(kind, last) is doubted


@pytest.mark.parametrize('kind, needed', [(Mean, 0.0), (Intensity, 0.0), (Cheap, 3.0), (Law, 3.0)])
def test_what_a_cause_must_bring_to_stay(kind, needed):
    assert decision.needed_evidence(kind) == needed


@pytest.mark.parametrize('before, after, fails', [
    ({'a': 0.0}, {'a': 4.79}, False), ({'a': 0.0}, {'a': -4.81}, True),
    ({'a': 100.0}, {'a': 6.9}, False), ({'a': 100.0}, {'a': 7.1}, True),
    ({'a': 0.0, 'b': 300.0}, {'a': 5.9}, False), ({'a': 0.0, 'b': 300.0}, {'a': 6.1}, True)])
def test_what_fails(before, after, fails):
    assert decision.failing(before, after) == (['a'] if fails else [])


@pytest.mark.parametrize('before, after, accepted, out', [
    ({}, {'time': 4.7}, [Cheap, Law], []), ({}, {'time': 4.9}, [Cheap, Law], [0, 1]),
    ({}, {'throttle': 9.0}, [Cheap, Law], [0, 1]),
    # Noise and lines go only where their own signs are left, by more than their share.
    ({}, {'time': 9.0}, [White], []),
    ({'autocorrelation lag 1': -40.0}, {'autocorrelation lag 1': -11.9}, [White], []),
    ({'autocorrelation lag 1': -40.0}, {'autocorrelation lag 1': -12.1}, [White], [0]),
    ({'autocorrelation lag 1': -40.0}, {'autocorrelation lag 1': 30.0}, [White], []),
    ({'band 1': 60.0}, {'band 1': 5.9}, [Ringing], []),
    ({'band 1': 60.0}, {'band 1': 6.1}, [Ringing], [0]),
    # What comes and goes does not ring.
    ({'band 1': 60.0}, {'bursts within 1 s': 9.0}, [Ringing, White], [0])])
def test_what_is_withdrawn(before, after, accepted, out):
    assert decision.withdrawn(before, after, accepted) == out


@pytest.mark.parametrize('left, withdrawn', [(-44.0, False), (-46.0, True), (46.0, False)])
def test_an_ac_coupling_may_leave_three_quarters_of_the_slow_power_missing(left, withdrawn):
    """An instrument may have two corners; slow power in excess is none of its signs."""
    kinds = [catalogue()['ac_coupling']]
    found = decision.withdrawn({'band 0': -60.0}, {'band 0': left}, kinds)
    assert found == ([0] if withdrawn else [])


def test_the_origins_of_the_constants():
    """What the comments say of chances is so."""
    assert 2.0 * norm.sf(decision.ASK) == pytest.approx(0.0093, rel=0.01)
    assert 2.0 * norm.sf(decision.ASK_DEAR) == pytest.approx(1 / 700, rel=0.05)
    assert family_chance(decision.OFF, 70) == pytest.approx(1 / 700, rel=0.05)
    assert family_chance(decision.FAILS, 70) == pytest.approx(1 / 2300, rel=0.05)
    assert binom.sf(decision.MOSTLY * 24 - 1, 24, 0.5) == pytest.approx(0.011, rel=0.05)
    assert norm.sf(decision.STEADY) == pytest.approx(1 / 30_000, rel=0.1)
    assert family_chance(decision.MISFIT, 1) == pytest.approx(1 / 8000, rel=0.05)


@pytest.mark.parametrize('name, value', [
    ('CLEAR', 30.0), ('ROUGH', 20.0), ('TIERS', 3), ('MOST', 8), ('MOST_LATENT', 3),
    ('MOST_LINES', 12)])
def test_what_only_the_search_reads(name, value):
    """Limits of rounds and of fits: by value, as no table can reach them."""
    assert getattr(decision, name) == value


@pytest.mark.parametrize('gain, error, chance, earns', [
    (0.01, 0.02, 0.01, True), (-0.01, 0.02, 0.01, True), (-0.03, 0.02, 0.01, False),
    (0.05, 0.02, 0.06, False), (0.05, 0.02, 0.04, True), (float('nan'), float('nan'), 0.01, True),
    (float('nan'), float('nan'), 0.83, False), (0.0, 0.0, 1.0, False)])
def test_what_earns_its_place(gain, error, chance, earns):
    """A gain below zero by more than its error does not, nor what does not show: p above 0.05."""
    assert decision.earns(gain, error, chance) is earns


@pytest.mark.parametrize('before, asked, after, out', [
    # It answers for its own signs alone, and for three tenths of what they were.
    ({'band 1': 20.0, 'kurtosis': 300.0}, {}, {'band 1': 5.9, 'kurtosis': 300.0}, []),
    ({'band 1': 20.0, 'kurtosis': 300.0}, {}, {'band 1': 6.1, 'kurtosis': 0.0}, [1]),
    # A larger effect may have hidden it until its turn.
    ({'band 1': 5.0}, {'band 1': 20.0}, {'band 1': 5.9}, []),
    ({'band 1': 5.0}, {'band 1': 19.0}, {'band 1': 5.9}, [1]),
    # Small ones may stay in their band; what was never off is no reason to be there.
    ({'band 1': 5.0}, {}, {'band 1': 4.7}, []), ({'band 1': 5.0}, {}, {'band 1': 4.9}, [1]),
    ({'band 1': 4.4}, {}, {'band 1': 0.0}, [1])])
@pytest.mark.parametrize('measured', [Mean, Intensity])
def test_what_is_withdrawn_beside_a_measured_cause(measured, before, asked, after, out):
    found = decision.withdrawn(before, after, [measured, Cheap, measured], {Cheap.NAME: asked})
    assert found == out


@pytest.mark.parametrize('loaded, cost, again', [
    (False, 0.0, True), (False, decision.MOST_COST, True),
    (False, decision.MOST_COST + 0.1, False), (True, 0.0, False)])
def test_the_search_goes_on_without_what_was_withdrawn(loaded, cost, again):
    """Once, where it costs little; under load the other latent causes are kept instead."""
    assert decision.searched_again(loaded, cost) is again


@pytest.mark.parametrize('evidence, largest, first', [
    (31.0, 20.0, True), (29.0, 20.0, False), (31.0, 80.0, False)])
def test_a_clear_line_comes_first(evidence, largest, first):
    """Where nothing is as far off; kinds of its own family are tried beside it all the same."""
    kinds, values = catalogue(), {'line': 30.0, 'band 1': largest}
    tone = kinds['tone']
    assert decision.comes_first(tone, evidence, kinds['flicker_noise'], values) is first
    assert not decision.comes_first(tone, evidence, kinds['resonance'], values)
    assert not decision.comes_first(tone, evidence, kinds['jumps'], values)
    assert not decision.comes_first(kinds['measurement_noise'], 1e3, kinds['flicker_noise'],
                                    {'autocorrelation lag 1': -30.0})


@pytest.mark.parametrize('one, other, plainer', [
    ('load_sag', 'load_transient', True), ('load_transient', 'load_sag', False),
    ('load_sag', 'load_sag', False), ('drift', 'load_transient', False)])
def test_what_was_not_searched_is_named_first(one, other, plainer):
    """Within a family: of a sag and a lag that do as well, the sag."""
    assert decision.is_plainer(catalogue()[one], catalogue()[other]) is plainer


@pytest.mark.parametrize('rate, duration, shown', [
    (1.0, 19.9, False), (1.0, 20.1, True), (10.0, 2.1, True), (0.1, 100.0, False)])
def test_twenty_relaxations_make_a_rate(rate, duration, shown):
    assert decision.relaxes(rate, duration) is shown


@pytest.mark.parametrize('names, changes', [
    (['load_transient'], True), (['load_transient', 'load_transient', 'drift'], True),
    (['load_transient', 'load_sag'], False), (['drift'], False), ([], False)])
def test_a_mean_that_answers_to_changes_only(names, changes):
    assert decision.only_to_changes(catalogue()[name] for name in names) is changes
