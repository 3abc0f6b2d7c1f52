"""Rules for readings, each at its edge: codes, single samples, units and holes of throttle."""

import math

import numpy as np
from ou_monitor.criticism.readings import find_bad, usable, why_no_model
from ou_monitor.records import Recording
from ou_monitor.text import counted
import pytest

N = 1001
# Quantiles 0.2 and 0.8 of it are 0.2 and 0.8: a spread of 0.6 / 1.683, reach 0.5 about 0.5.
EVEN = np.arange(N) / (N - 1.0)
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
    near = np.full(N, 0.5) + 1e-3 * (EVEN - 0.5)
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


@pytest.mark.parametrize('count', (5, 120, 249, 251))
def test_a_code_is_found_whatever_its_share(count):
    """Up to a fifth by its distance, above that because it rests; 100 others at least."""
    v = np.concatenate((EVEN, np.full(count, 99.0)))
    assert find_bad(v).sum() == count and find_bad(v)[N:].all()


@pytest.mark.parametrize('others, bad', [(100, True), (99, False)])
def test_a_resting_value_needs_a_hundred_others(others, bad):
    v = np.concatenate((np.arange(others) / 99.0, np.full(500, 99.0)))
    assert find_bad(v)[others:].all() == bad


def test_values_with_most_of_them_equal_use_the_wider_quantiles():
    """An ADC at rest: nine in ten within 5 and 95 % give the spread."""
    v = np.where(np.arange(N) % 8 == 0, np.where(np.arange(N) % 16 == 0, 1.0, -1.0), 0.0)
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


@pytest.mark.parametrize('values, holes', [((-1.4, 1.4), 0), ((-1.6, 1.6), 2), ((1e4, -9.0), 2)])
def test_throttle_beyond_its_range_is_unknown(values, holes):
    share = np.linspace(0.0, 1.0, 1001)
    some = share.copy()
    some[[400, 700]] = values
    u, notes = throttle(some)
    assert ('far outside its range at 2 samples' in notes) == bool(holes)
    np.testing.assert_allclose(u[[400, 700]], share[[399, 699]] if holes else values)


def test_holes_of_throttle_are_held_and_measured():
    raw = np.linspace(0.2, 0.8, 100)
    raw[:10] = raw[30:50] = raw[95:] = math.nan
    u, notes = throttle(raw)
    assert (u[:10] == raw[10]).all() and (u[30:50] == raw[29]).all() and (u[95:] == raw[94]).all()
    assert np.array_equal(u[50:95], raw[50:95])
    # The last sample has no step after it.
    assert '35 samples (0.340 of 0.990 s, the longest gap 0.200 s)' in notes
    assert 'and the first known one at the start' in notes
    raw[:10] = 0.2
    assert 'first known one at the start' not in throttle(raw)[1]
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
