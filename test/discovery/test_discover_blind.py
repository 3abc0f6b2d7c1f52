"""
Randomly drawn hidden effects, which must be found: the fast part of `benchmarks/discover.py`.

Rail, flight, strength and noise are drawn from a base seed, which is in the names of the tests;
OU_MONITOR_BLIND_SEED sets another. Recordings are shorter than the minute of the requirements, but
effects are stronger, so that amplitude squared times duration is the same. If the module of a
cause is removed, its test below fails: a cause outside the catalogue is never named.
"""

from collections.abc import Callable, Mapping
from functools import cache
import math
import os
import sys

from blind_scores import hide, Outcome, outcome
from hidden_effects import causes, labels, pairs, unknowns
import numpy as np
from ou_monitor import discover
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Role
from ou_monitor.records import Recording
import pytest
from scipy.stats import binom

BASE = int(os.environ.get('OU_MONITOR_BLIND_SEED', '20260131'))
SEED = f'seed {BASE}'
MINUTE, DURATION, SHORT, RATE = 60.0, 20.0, 10.0, 1000.0
# The generator limits how nonlinear a force can be: no strength compensates a short recording.
WHOLE = ('nonlinear_restoring',)
# Effects of single samples and lines: named alone at 10 s as at 20 s, with each of two base seeds.
# Effects of seconds or of throttle are not.
QUICK = ('measurement_noise', 'quantization', 'held_samples', 'saturation', 'resonance', 'tone',
         'ac_coupling', 'jumps', 'heavy_tails', 'glitches', 'clock_jitter')
# Effects of seconds and throttle: named alone at 500 Hz as at 1 kHz with each of two base seeds.
# Transients and switching are not.
SLOW = (*WHOLE, 'load_sag', 'load_dependent_sigma', 'load_dependent_alpha',
        'load_dependent_noise', 'drift', 'second_relaxation', 'throttle_tone', 'volatility',
        'flicker_noise')
# A count fails if it is less probable than this at the required level.
RARE = 0.01
TRIES = 3


def drawn(kind: str, effect: str, number: int) -> tuple[Recording, object]:
    """Return a recording and its hidden effect."""
    short = kind in ('none', 'unknown') or effect in QUICK
    duration = MINUTE if effect in WHOLE else SHORT if short else DURATION
    hidden = hide(kind, effect, BASE, number, duration=duration,
                  rate=0.5 * RATE if effect in SLOW else RATE,
                  strength=math.sqrt(MINUTE / duration))
    return Recording(hidden.t, hidden.voltage, hidden.throttle, 'blind'), hidden


@cache
def outcome_of(kind: str, effect: str, number: int) -> Outcome:
    """Return the finding of `discover` for a recording, computed once for all tests."""
    recording, hidden = drawn(kind, effect, number)
    finding = discover(recording)
    return outcome(hidden, finding.verdict.value, finding.causes)


def chosen(what: list, count: int, word: int) -> list:
    """Return some names, drawn without replacement."""
    rng = np.random.default_rng([BASE, word])
    return [what[k] for k in rng.choice(len(what), count, replace=False)]


def least(count: int, share: float) -> int:
    """Return the lowest number of `count` that is not too improbable if `share` is required."""
    return int(binom.ppf(RARE, count, share))


def enough(names: list[tuple[str, str, int]], share: float,
           right: Callable[[Outcome], bool]) -> None:
    """Count right outcomes until the verdict on all of them is certain; fail if they are few."""
    needed, wrong = least(len(names), share), []
    good = 0
    for name in names:
        one = outcome_of(*name)
        good += right(one)
        wrong += [] if right(one) else [one]
        if good >= needed:
            return
        assert len(wrong) <= len(names) - needed, summary(wrong)


def summary(outcomes: list[Outcome]) -> str:
    """Return the finding for each, for the message of a failure."""
    return f'{SEED}: ' + '; '.join(
        f"{one.effect}: {one.verdict}, {dict(one.named) or 'nothing'}" for one in outcomes)


@pytest.mark.parametrize('cause', causes(), ids=lambda cause: f'{cause}, {SEED}')
def test_each_cause_is_named(cause):
    """In at least one of three recordings; most are found in the first."""
    # At the required nine in ten, a cause is missed three times with probability 1/1000; one of
    # the 22 causes (for an unlucky base seed) with 1/46. A cause without its module is never
    # named; one that is named in half of the recordings fails with 1/8.
    tried = []
    for number in range(TRIES):
        tried.append(outcome_of('single', cause, number))
        if cause in tried[-1].named:
            return
    pytest.fail(summary(tried))


def test_most_causes_are_named_alone_or_in_the_set():
    """Required: 90 % alone and 95 % in the set; at least 16 and 18 of 22."""
    # Fewer have chances of 0.4 % each at those levels, and of 84 % and 97 % at 60 %.
    found = [outcome_of('single', cause, 0) for cause in causes()]
    alone, in_set = sum(one.alone for one in found), sum(one.in_set for one in found)
    print(f'{SEED}: {alone} of {len(found)} alone, {in_set} in the set')
    assert alone >= least(len(found), 0.90), summary([one for one in found if not one.alone])
    assert in_set >= least(len(found), 0.95), summary([one for one in found if not one.in_set])


def test_nothing_is_found_where_nothing_is_hidden():
    # Three or more have a chance of 0.6 % at 5 %, and of 86 % if half are alarms.
    enough([('none', '', number) for number in range(8)], 0.95, lambda one: not one.alarm)


def test_two_at_once_are_both_named():
    """Required: 80 %; at least two of five pairs."""
    # Fewer have a chance of 0.7 % at that level, and of 53 % at 30 %.
    strong = [pair for pair in pairs() if not set(pair) & set(WHOLE)]
    enough([('pair', '+'.join(pair), 0) for pair in chosen(strong, 5, 1)], 0.80,
           lambda one: one.all_named)


def test_effects_outside_the_catalogue_get_no_wrong_name():
    """Required: 90 % reported as unexplained, wholly or partly, with no wrong name; 3 of 5."""
    # Fewer have a chance of 0.9 % at that level, and of 84 % at 30 %.
    enough([('unknown', name, 0) for name in chosen(list(unknowns()), 5, 2)], 0.90,
           lambda one: one.left_open and not one.misnamed)


def searched() -> list[str]:
    """Return the causes that the search finds from the catalogue, not from exact findings."""
    kinds = catalogue()
    return [cause for cause in causes() if cause in kinds and kinds[cause].SIGNS
            and kinds[cause].ROLE is not Role.EXACT and cause != 'clock_jitter']


@pytest.mark.parametrize('cause', chosen(searched(), 1, 3),
                         ids=lambda cause: f'{cause}, {SEED}')
def test_a_cause_removed_from_the_catalogue_is_not_named(cause, monkeypatch):
    """A cause is named by its entry: found with it; without it neither found nor a rival."""
    number = next((k for k in range(TRIES) if cause in outcome_of('single', cause, k).named), None)
    assert number is not None, f'{cause} was not named with its entry either'
    every = catalogue
    less: Mapping = {name: kind for name, kind in every().items() if name != cause}
    for name, module in list(sys.modules.items()):
        if name.startswith('ou_monitor.') and getattr(module, 'catalogue', None) is every:
            monkeypatch.setattr(module, 'catalogue', lambda: less)
    recording, hidden = drawn('single', cause, number)
    finding = discover(recording)
    without = outcome(hidden, finding.verdict.value, finding.causes)
    assert without.verdict and cause not in without.reported, summary([without])


SAG, NOISE = 'load_sag', 'measurement_noise'


@pytest.mark.parametrize('accepted, named, alone, in_set, all_named, family', [
    ([[SAG]], {SAG: ()}, True, True, True, True),
    ([[SAG]], {}, False, False, False, False),
    # In the set of a similar cause: reported, not named; the families are those of the names.
    ([[SAG]], {'load_transient': (SAG,)}, False, True, False, True),
    ([['tone']], {'drift': ('tone',)}, False, True, False, False),
    # Named, together with a false name.
    ([[SAG]], {SAG: (), 'tone': ()}, False, False, True, False),
    # A false name is not excused by an alternative that is named already.
    ([[SAG]], {SAG: (), 'tone': (SAG,)}, False, False, True, False),
    ([[SAG, 'tone']], {'drift': (SAG, 'tone')}, False, True, False, False),
    ([[SAG, NOISE]], {SAG: (), 'tone': (NOISE,)}, False, True, False, False),
    ([[SAG, NOISE]], {SAG: (), NOISE: ()}, True, True, True, True),
    ([[SAG, NOISE]], {SAG: ()}, False, False, False, False),
    # Any accepted list is right.
    ([['tone'], ['resonance']], {'resonance': ()}, True, True, True, True),
])
def test_outcomes_are_scored_by_what_is_true(accepted, named, alone, in_set, all_named, family):
    one = Outcome('single', 'x', tuple(map(tuple, accepted)), (), 'explained', named)
    assert (one.alone, one.in_set, one.all_named, one.family) == (
        alone, in_set, all_named, family)
    failed = Outcome('single', 'x', one.accepted, (), '', {})
    assert not (failed.alone or failed.in_set or failed.covered or failed.family)
    assert failed.alarm and not failed.left_open
    assert set(named) <= set(labels)


@pytest.mark.parametrize('named, wrong', [
    ({}, False), ({'jumps': ()}, False), ({'tone': ()}, True), ({'tone': ('jumps',)}, False),
    ({'jumps': (), 'tone': ()}, True)])
def test_a_name_near_the_unknown_is_not_wrong(named, wrong):
    one = Outcome('unknown', 'unknown/x', ((),), ('jumps',), 'partly_explained', named)
    assert one.misnamed is wrong and one.left_open
