"""Invalid readings (codes, single bad samples, units of throttle): left out, with a note."""

from dataclasses import replace
import math
import warnings

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.criticism.integrity import examine
from ou_monitor.criticism.readings import find_bad, two_levels, usable, why_no_model
from ou_monitor.discovery.discover import discover
from ou_monitor.discovery.finding import Verdict
from ou_monitor.model.ou import simulate
from ou_monitor.records import Recording
import pytest

N, RATE = 6000, 100.0
T = np.arange(N) / RATE
CODES = np.random.default_rng(1).choice(N, 40, replace=False)


def rail(seed=3, n=N):
    """Return the voltage of a rail of 28 mV around 5 V."""
    return simulate(np.arange(n) / RATE, 20.0, 0.178, np.random.default_rng(seed), u0=5.0)


def with_bad(what):
    """Return a rail with some samples that are none, and where they are."""
    v, at = rail(), {
        'last': [N - 1], 'first': [0], 'middle': [3000], 'in the part kept': [5000],
        'two': [700, 5000], 'off at first': range(3000), 'codes': CODES,
        'codes at the end': range(N - 300, N),
        'minus one': CODES, 'supply off': range(2000, 2150)}[what]
    bad = np.zeros(N, bool)
    bad[list(at)] = True
    v[bad] = {'last': -1e9, 'first': 1e3, 'minus one': -1.0, 'codes': 65535.0,
              'codes at the end': 65535.0}.get(what, 0.0)
    return v, bad


ALL = ('last', 'first', 'middle', 'in the part kept', 'two', 'codes', 'codes at the end',
       'minus one', 'supply off', 'off at first')


@pytest.mark.parametrize('what', ALL)
def test_bad_samples_become_a_note_and_no_cause(what):
    """A plain rail stays one; the note counts them and says what they read."""
    # At 1 % the rail itself might alarm: this seed does not (of 0 to 13, one does).
    v, bad = with_bad(what)
    kept = usable(Recording(T, v, np.full(N, math.nan)), [])[0]
    assert np.array_equal(kept, T[~bad])
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = discover(Recording(T, v, np.full(N, math.nan), what))
    assert found.verdict is Verdict.NO_EFFECT and found.causes == ()
    (note,) = [note for note in found.notes if 'left out' in note]
    assert f'{v[bad][0]:.6g} V' in note and str(int(bad.sum())) in note
    assert found.samples.n == N - bad.sum()


@pytest.mark.parametrize('seed', range(20))
def test_noise_has_no_bad_samples(seed):
    """Neither has a rail, one that sags with load, nor noise with tails down to 2.5 degrees."""
    rng = np.random.default_rng(seed)
    load = np.where(T % 20.0 < 19.0, 0.0, 1.0)
    for v in (rail(seed), rail(seed) - 2.0 * load, 5.0 + 0.01 * rng.standard_t(2.5, N),
              np.round(rail(seed), 1)):
        assert not find_bad(v).any()


def test_gradual_or_frequent_excursions_are_kept():
    """A brown-out that recovers, and glitches of many sizes, are for the models."""
    v = rail()
    v[3000:3400] -= 4.0 * np.exp(-np.arange(400) / 60.0)
    assert not find_bad(v).any()
    v = rail()
    v[CODES] += np.random.default_rng(3).normal(0.0, 4.0, CODES.size)
    assert not find_bad(v).any()


NOTHING = {
    'constant': (np.full(N, 5.0), 'does not change'),
    'but one': (np.where(np.arange(N) == 50, 5.2, 5.0), 'All but 1 of its 6000 samples read 5 V'),
    'but the last': (np.where(np.arange(N) == N - 1, 5.2, 5.0), 'All but 1'),
    'huge': (1e200 * rail(), 'check its unit'), 'largest': (3e307 * rail(), 'check its unit'),
    'tiny': (1e-200 * rail(), 'check its unit'), 'denormal': (1e-310 * rail(), 'check its unit'),
    'half huge': (rail() * np.where(np.arange(N) % 2, 1.0, 1e150), 'check its unit'),
    'ramp': (5.0 + 0.01 * T, 'straight line')}


@pytest.mark.parametrize('what', sorted(NOTHING))
def test_a_voltage_that_cannot_be_fitted_gives_a_reason_and_no_warning(what):
    v, part = NOTHING[what]
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = discover(Recording(T, v, np.full(N, math.nan), what))
    assert found.verdict is Verdict.INSUFFICIENT_DATA and part in found.sentence
    assert why_no_model(rail()) == ''


def test_a_recording_that_starts_with_a_stuck_sensor_is_still_looked_at():
    """As logged the first 60 % are constant: the plain OU is that of the samples left."""
    v = rail()
    v[:4000] = 5.0
    found = discover(Recording(T, v, np.full(N, math.nan), 'stuck'))
    assert found.baseline is not None and [c.name for c in found.causes][0] == 'held_samples'


def test_throttle_in_other_units_is_not_used():
    """The readers refuse it; what comes past them is unknown."""
    said = discover(Recording(T, rail(), 65535.0 * np.linspace(0.1, 1.0, N), 'counts')).notes
    assert any('Throttle is not usable: load_dependent_alpha' in note for note in said)


@pytest.mark.parametrize('apart, moves, found', [
    (0.1, lambda k: k % 1600 < 800, True), (0.1, lambda k: k % 800 < 60, True),
    # Too close; once only; rare pulses; a change with each sample; a slope; a sine; ADC codes.
    (0.03, lambda k: k % 1600 < 800, False), (0.1, lambda k: k < 4000, False),
    (0.1, lambda k: k % 800 < 20, False), (0.1, lambda k: k % 2, False),
    (0.1, lambda k: k / 8000, False), (0.1, lambda k: np.sin(0.01 * k), False),
    (0.0, lambda k: k, False)])
def test_a_switched_voltage_without_a_load_is_noted(apart, moves, found):
    """Noise of 10 mV about one or two levels."""
    k = np.arange(8000)
    v = 12.0 + apart * moves(k) + simulate(1e-3 * k, 200.0, 0.2, np.random.default_rng(1))
    assert bool(two_levels(v)) is found
    assert two_levels(np.round(v, 1)) == two_levels(v[:1]) == two_levels(v[:0]) == ''
    if found:
        recording = Recording(1e-3 * k, v, np.full(k.size, np.nan), 'bench')
        assert two_levels(v) in analyze(recording).notes
        assert two_levels(v) in examine(recording).notes
        load = replace(recording, throttle=moves(k).astype(float))
        assert two_levels(v) not in (*analyze(load).notes, *examine(load).notes)
