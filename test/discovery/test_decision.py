"""Decisions of the search, from tables: each constant from both sides, each rule by a case."""

from typing import ClassVar

from ou_monitor.discovery import decision
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Role, Term
import pytest

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
    SLOW_FIT = True


class Imitator(Dear):
    """One that imitates the cheap one."""

    NAME = 'imitator'
    IMITATES: ClassVar[tuple[str, ...]] = ('cheap',)


class Law(Cheap):
    """Another law of the noise."""

    NAME = 'law'
    ROLE = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('kurtosis',)


class Events(Law):
    """Single events, which the other law imitates."""

    NAME = 'events'
    EVENTS = True
    IMITATES: ClassVar[tuple[str, ...]] = ('law',)


class White(Cheap):
    """A noise of the measurement."""

    NAME = 'white'
    ROLE = Role.NOISE
    MAY_LEAVE = 0.3
    SIGNS: ClassVar[tuple[str, ...]] = ('-autocorrelation',)


class Mean(Cheap):
    """A mean that responds to throttle."""

    NAME = 'mean'
    ROLE = Role.MEAN
    MEASURED = True
    NEEDS_THROTTLE = True
    SIGNS: ClassVar[tuple[str, ...]] = ('throttle',)


class Intensity(Mean):
    """A sigma that responds to throttle."""

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


class Ringing(Cheap):
    """One that some statistics refute."""

    NAME = 'ringing'
    MAY_LEAVE = 0.1
    REFUTED_BY: ClassVar[tuple[str, ...]] = ('bursts',)


TOYS = [Cheap, Dear, Imitator, Law, White, Mean, Intensity, Trend, Ringing]


def tried(model=(), given=(), throttle=True, first=False, kinds=TOYS):
    return [kind.NAME for kind in decision.kinds_to_try(
        kinds, list(model), given, throttle, first)]


def test_measured_inputs_and_white_noise_come_first():
    """No statistic is asked; answers of the mean are left to the regression, but for trends."""
    assert tried(first=True) == ['white', 'intensity']
    assert tried() == ['cheap', 'dear', 'imitator', 'law', 'ringing']
    assert [kind for kind in TOYS if decision.is_response(kind)] == [Mean, Trend]
    drift = KINDS['drift']
    assert tried(kinds=[drift]) == ['drift'] and tried(first=True, kinds=[drift]) == []


def test_every_kind_of_the_catalogue_is_tried_once():
    """First or later, but for the OU, what is known without a model, and the regression's."""
    both = [tried(first=first, kinds=KINDS.values()) for first in (True, False)]
    # The shape of something waits until it is there.
    shapes = [kind for kind in KINDS.values()
              if kind.ROLE is Role.LAW and kind.CHANGES is not None]
    beside = [tried([kind.CHANGES], kinds=[kind]) for kind in shapes]
    assert beside == [[kind.NAME] for kind in shapes] != []
    assert not set(both[0]) & set(both[1])
    assert set(KINDS) - {*both[0], *both[1]} == {
        'ou', 'load_sag', 'load_transient', *(kind.NAME for kind in shapes),
        *(name for name, kind in KINDS.items() if kind.ROLE is Role.EXACT)}


@pytest.mark.parametrize('changes, missing', [
    ({'given': ['cheap']}, 'cheap'), ({'model': [Cheap]}, 'cheap'),
    # One that imitates what is there already, whichever of the two says so.
    ({'model': [Cheap]}, 'imitator'), ({'model': [Imitator]}, 'cheap'),
    ({'throttle': False, 'first': True}, 'intensity')])
def test_kinds_that_do_not_apply_are_not_tried(changes, missing):
    assert missing in tried(first=changes.get('first', False))
    assert missing not in tried(**changes)


def test_events_are_tried_beside_a_law_that_imitates_them():
    """They are taken out first, so that their evidence beside the law is their own."""
    assert tried([Law], kinds=[Events]) == ['events']
    assert tried([Events], kinds=[Law]) == ['law']
    both = [KINDS['jumps'], KINDS['glitches']]
    assert tried([both[0]], kinds=both) == tried([both[1]], kinds=both) == []


@pytest.mark.parametrize('kind, values, nats', [
    (Cheap, {'band 3': 3.0}, 4.5), (Cheap, {'band 3': -3.0}, 0.0), (Cheap, {'line': -3.0}, 4.5),
    (Cheap, {'band 3': 3.0, 'line': 4.0, 'time': 20.0}, 8.0), (Cheap, {'order line': 9.0}, 0.0),
    (Cheap, {}, 0.0)])
def test_the_score_gain_of_a_kind_is_half_the_square_of_its_largest_sign(kind, values, nats):
    assert decision.score_gain(kind, values) == nats


@pytest.mark.parametrize('kind, largest, again, least', [
    (Mean, 0.0, 0, 4.0), (Mean, 1e4, 0, 4.0), (Mean, 1e4, 10000, 50.0), (Mean, 1e4, 2000, 40.0),
    (Mean, 100.0, 10000, 4.0), (Trend, 1e4, 0, 200.0), (Trend, 100.0, 0, 4.0)])
def test_a_further_response_needs_a_share_of_the_largest_evidence(kind, largest, again, least):
    """A form that is right to 7 % leaves 0.5 % of what it explains; 2 % of an error is visible."""
    assert decision.least_evidence(kind, largest, again) == pytest.approx(least)


@pytest.mark.parametrize('gains, shared', [
    ([5.0, 0.0, 0.0, 0.0], False), ([5.0, 1.0, 0.0, 0.0], True), ([3.0, 2.0, -6.0, 3.0], False),
    ([1.0, 1.0, 1.0, 1.0], True), ([-1.0, -1.0, -1.0, -1.0], False)])
def test_more_than_one_part_must_gain(gains, shared):
    """Of one part alone the error of the sum is the sum."""
    assert decision.is_shared(gains) is shared


@pytest.mark.parametrize('kind, cost, may', [
    (Cheap, 99.0, True), (Dear, 9.9, True), (Dear, 10.1, False),
    (KINDS['second_relaxation'], 19.9, True), (KINDS['second_relaxation'], 20.1, False)])
def test_slow_kinds_are_tried_only_while_time_is_left(kind, cost, may):
    assert decision.affordable(kind, cost) is may


@pytest.mark.parametrize('before, after, fails', [
    ({'a': 0.0}, {'a': 4.79}, False), ({'a': 0.0}, {'a': -4.81}, True),
    ({'a': 100.0}, {'a': 6.9}, False), ({'a': 100.0}, {'a': 7.1}, True)])
def test_a_statistic_fails_beyond_its_band_and_share(before, after, fails):
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
def test_unexplained_statistics_withdraw_their_causes(before, after, accepted, out):
    assert decision.withdrawn(before, after, accepted) == out


@pytest.mark.parametrize('gain, error, chance, earns', [
    (0.01, 0.02, 0.01, True), (-0.019, 0.02, 0.01, True), (-0.021, 0.02, 0.01, False),
    (0.05, 0.02, 0.06, False), (0.05, 0.02, 0.04, True), (float('nan'), float('nan'), 0.01, True),
    (float('nan'), float('nan'), 0.83, False), (0.0, 0.0, 1.0, False)])
def test_a_cause_stays_if_its_gain_and_its_p_value_allow(gain, error, chance, earns):
    """A gain below zero by more than its error does not, nor what does not show: p above 0.05."""
    assert decision.improves_predictions(gain, error, chance) is earns


@pytest.mark.parametrize('before, asked, after, out', [
    # It answers for its own signs alone, and for three tenths of what they were.
    ({'band 1': 20.0, 'kurtosis': 300.0}, {}, {'band 1': 5.9, 'kurtosis': 300.0}, []),
    ({'band 1': 20.0, 'kurtosis': 300.0}, {}, {'band 1': 6.1, 'kurtosis': 0.0}, [1]),
    # A larger effect may have hidden it until its turn.
    ({'band 1': 5.0}, {'band 1': 20.0}, {'band 1': 5.9}, []),
    ({'band 1': 5.0}, {'band 1': 19.0}, {'band 1': 5.9}, [1]),
    # Small ones may stay in their band, which they need never have left.
    ({'band 1': 5.0}, {}, {'band 1': 4.7}, []), ({'band 1': 5.0}, {}, {'band 1': 4.9}, [1]),
    ({'band 1': 2.0}, {}, {'band 1': 0.0}, [])])
@pytest.mark.parametrize('measured', [Mean, Intensity])
def test_a_latent_cause_is_tested_by_its_own_signs_only(measured, before, asked, after, out):
    found = decision.withdrawn(before, after, [measured, Cheap, measured], {Cheap.NAME: asked})
    assert found == out
