"""Invalid readings (codes, single bad samples, units of throttle): left out, with a note."""

import math
import warnings

import numpy as np
from ou_monitor.criticism.readings import find_bad, usable, why_no_model
from ou_monitor.discovery.discover import discover
from ou_monitor.discovery.finding import Verdict
from ou_monitor.model.ou import simulate
from ou_monitor.records import Recording
from ou_monitor.text import counted
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


MANY = 1001
# Quantiles 0.2 and 0.8 of it are 0.2 and 0.8: a spread of 0.6 / 1.683, reach 0.5 about 0.5.
EVEN = np.arange(MANY) / (MANY - 1.0)
SPREAD = 0.6 / 1.683


def with_values(*values):
    return np.concatenate((EVEN, values))


@pytest.mark.parametrize('side', (1.0, -1.0))
@pytest.mark.parametrize('times, bad', [(49.0, False), (51.0, True)])
def test_far_is_fifty_spreads_from_the_middle(side, times, bad):
    v = with_values(0.5 + side * times * SPREAD)
    # One more sample moves the quantiles by a thousandth.
    assert find_bad(v)[-1] == bad and not find_bad(v)[:-1].any()


@pytest.mark.parametrize('times, count', [(4.9, 0), (5.1, 1)])
def test_far_is_five_times_as_far_as_the_others_go(times, count):
    """A first one at 60 spreads is bad in itself: the others end at a half."""
    near = np.full(MANY, 0.5) + 1e-3 * (EVEN - 0.5)
    reach = 45.0 * SPREAD * 1e-3
    v = np.concatenate((near, [0.5 + reach, 0.5 + times * reach]))
    assert find_bad(v).sum() == count


@pytest.mark.parametrize('values, bad', [
    ((99.0, 99.0, 99.0, 99.0), 4), ((99.0, 98.0, 97.0), 3), ((99.0, 98.0, 97.0, 96.0), 0),
    ((99.0, 99.0, 99.0, 98.0, 97.0, 96.0, 95.0), 3)])
def test_three_of_one_value_are_a_code_and_more_than_three_singles_are_none(values, bad):
    assert find_bad(with_values(*values)).sum() == bad


def test_of_long_recordings_more_single_samples_may_be_bad():
    v = np.tile(EVEN, 400)[:400_000]
    for count, bad in ((4, 4), (5, 0)):
        at = 1000 * np.arange(1, count + 1) + 1
        w = v.copy()
        w[at] = 99.0 + np.arange(count)
        assert find_bad(w).sum() == bad


@pytest.mark.parametrize('count', (5, 120, 249))
def test_a_code_is_found_whatever_its_share(count):
    """Up to a fifth of the samples."""
    v = np.concatenate((EVEN, np.full(count, 99.0)))
    assert find_bad(v).sum() == count and find_bad(v)[MANY:].all()


def test_values_with_most_of_them_equal_use_the_wider_quantiles():
    """An ADC at rest: nine in ten within 5 and 95 % give the spread."""
    v = np.where(np.arange(MANY) % 8 == 0, np.where(np.arange(MANY) % 16 == 0, 1.0, -1.0), 0.0)
    # 1.683 spreads are 2: what is 50 times 1.19 from the middle is far.
    for value, bad in ((50.0, 0), (60.0, 1)):
        assert find_bad(np.append(v, value)).sum() == bad
    assert not find_bad(np.append(np.full(50, 5.0), 9.0)).any()
    assert not find_bad(np.array([0.0, 5.0, 65535.0])).any()


def throttle(u, t=None):
    u = np.asarray(u, dtype=float)
    t = np.arange(u.size) * 0.01 if t is None else t
    notes = []
    v = 5.0 + 0.01 * np.random.default_rng(1).standard_normal(u.size)
    return usable(Recording(t, v, u, 'r'), notes)[2], ' '.join(notes)


@pytest.mark.parametrize('low, high, word', [
    (0.0, 1.0, ''), (-0.05, 1.05, ''), (-0.06, 1.0, 'not 0 to 1'), (0.0, 1.06, 'not 0 to 1'),
    (-1.5, 1.5, 'not 0 to 1')])
def test_throttle_outside_its_range_is_noted(low, high, word):
    raw = np.linspace(low, high, 101)
    u, notes = throttle(raw)
    assert (word in notes) if word else notes == ''
    np.testing.assert_array_equal(u, raw)


@pytest.mark.parametrize('values, holes', [((-1.9, 1.9), 0), ((-2.1, 2.1), 2), ((1e4, -9.0), 2)])
def test_throttle_beyond_its_range_is_unknown(values, holes):
    share = np.linspace(0.0, 1.0, 1001)
    some = share.copy()
    some[[400, 700]] = values
    u, notes = throttle(some)
    assert ('unknown at 2 samples' in notes) == bool(holes)
    np.testing.assert_allclose(u[[400, 700]], share[[399, 699]] if holes else values)


def test_holes_of_throttle_are_held_and_measured():
    raw = np.linspace(0.2, 0.8, 100)
    raw[:10] = raw[30:50] = raw[95:] = math.nan
    u, notes = throttle(raw)
    assert (u[:10] == raw[10]).all() and (u[30:50] == raw[29]).all() and (u[95:] == raw[94]).all()
    assert np.array_equal(u[50:95], raw[50:95])
    # The last sample has no step after it.
    assert '35 samples (0.340 of 0.990 s)' in notes
    assert throttle(np.full(9, math.nan)) == (None, '')


def test_readings_are_sorted_and_finite():
    t = np.array([0.0, 0.1, 0.3, 0.2, 0.2, math.nan, 0.5, 0.6])
    v = np.array([5.0, 5.1, 5.3, 5.2, 9.9, 5.4, math.inf, 5.6])
    notes = []
    t, v, u = usable(Recording(t, v, np.full(8, math.nan), 'r'), notes)
    assert t.tolist() == [0.0, 0.1, 0.2, 0.3, 0.6] and v.tolist() == [5.0, 5.1, 5.2, 5.3, 5.6]
    assert u is None
    assert '2 samples dropped' in notes[0]
    assert '1 sample came after a later stamp' in notes[1]
    assert '1 sample dropped: repeated stamp' in notes[2]
    assert counted(1, 'stamp') == '1 stamp' and counted(0, 'stamp') == '0 stamps'


@pytest.mark.parametrize('level, said', [(999.0, False), (1001.0, True), (-1001.0, True),
                                         (1e31, False)])
def test_voltages_above_a_thousand_may_be_millivolts(level, said):
    notes, v = [], level + 0.0 * np.arange(9.0)
    found = usable(Recording(np.arange(9.0), v, np.full(9, math.nan), ''), notes)[1]
    assert any('millivolts' in note for note in notes) == said and (found == v).all()


@pytest.mark.parametrize('n, odd, stuck', [(100, 3, True), (100, 4, False), (5000, 5, True),
                                           (5000, 6, False)])
def test_a_voltage_in_which_few_samples_differ_is_constant(n, odd, stuck):
    v = np.full(n, 5.0)
    v[1:1 + odd] = 5.1 + 0.01 * np.arange(odd)
    assert why_no_model(v).startswith('All but') == stuck


def test_voltages_that_no_sensor_measures_are_refused():
    """Beyond 1e30 V, below 1e-30 V; a straight line to 16 roundings."""
    rng = np.random.default_rng(2)
    noise = rng.standard_normal(200)
    assert 'reaches' in why_no_model(1.01e30 * noise / np.abs(noise).max())
    assert why_no_model(0.99e30 * noise / np.abs(noise).max()) == ''
    assert 'moves by' in why_no_model(0.99e-30 * noise / np.ptp(noise))
    assert why_no_model(1.01e-30 * noise / np.ptp(noise)) == ''
    line = 4.0 + np.arange(200) / 64.0
    bend = line.copy()
    bend[100] += 2.0 ** -48
    assert 'straight line' in why_no_model(bend)
    bend[100] += 2.0 ** -46
    assert why_no_model(bend) == ''
