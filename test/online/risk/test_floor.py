"""The floor: works without a model, uses every sample, and ignores single glitches."""

import math

from hypothesis import given, settings as hypothesis_settings, strategies as st
import numpy as np
from ou_monitor.online.risk.flag import FloorWatch
from ou_monitor.online.settings import MonitorSettings
import pytest


def watch(**changes):
    """Return a watch at 4.3 V and 20 ms."""
    return FloorWatch(MonitorSettings(**{
        'brownout_floor': 4.3, 'brownout_floor_time': 0.02, **changes}))


def push(floor, voltages, rate=1000.0, start=0.0):
    floor.push(start + np.arange(len(voltages)) / rate, voltages)


@pytest.mark.parametrize('rate', [1.0, 10.0, 100.0, 1000.0, 1e5])
def test_a_lone_glitch_does_not_trip_it(rate):
    """Of any depth, at any rate; nor every third sample."""
    floor = watch(stale_after=5.0)
    good = [5.0] * 50
    push(floor, good + [0.0] + good, rate)
    assert not floor.take()
    floor = watch(stale_after=5.0)
    push(floor, [5.0, 5.0, 0.0] * 50, rate)
    assert not floor.take()


@pytest.mark.parametrize('rate, needed', [(1.0, 2), (100.0, 2), (1000.0, 11), (1e4, 101)])
def test_it_trips_within_half_of_its_time(rate, needed):
    """More than half of the samples of 20 ms, or two of three when the source is slower."""
    for count, trips in ((needed - 1, False), (needed, True)):
        floor = watch(stale_after=5.0)
        push(floor, [5.0] * 1000 + [4.3] * count, rate)
        assert floor.take() is trips, count


def test_a_dip_between_two_reports_is_not_lost():
    """15 ms at 1 kHz within 50 ms: told once, and over."""
    floor = watch()
    push(floor, [5.0] * 20 + [4.0] * 15 + [5.0] * 300)
    assert floor.take() and not floor.take()


@pytest.mark.parametrize('settings, floor', [
    ({}, 4.5), ({'brownout_voltage': 3.0}, 3.0), ({'brownout_floor': 4.0}, 4.0),
    ({'brownout_floor': 0.0}, 0.0), ({'brownout_voltage': 0.0}, 0.0)])
def test_where_the_floor_is(settings, floor):
    assert MonitorSettings(**settings).floor == pytest.approx(floor, abs=1e-12)


def test_switched_off_while_low():
    floor = watch()
    push(floor, [4.0] * 100)
    floor.settings = MonitorSettings(brownout_floor=0.0)
    assert not floor.take()


def test_what_is_not_finite_is_left_out():
    floor = watch()
    push(floor, [4.0, math.nan, math.inf, -math.inf, 4.0, math.nan])
    floor.push([math.nan, math.inf], [5.0, 5.0])
    assert floor.take()


def test_bad_shapes_are_refused():
    with pytest.raises(ValueError, match='shape'):
        watch().push([0.0, 1.0], [5.0])


def test_time_back_is_another_time_line():
    """A step back of more than 1 s forgets; late samples of less count in order of arrival."""
    floor = watch()
    push(floor, [5.0] * 100, start=1000.0)
    push(floor, [4.0] * 3, start=10.0)
    assert floor.take()
    floor = watch()
    push(floor, [5.0] * 100, start=1000.0)
    push(floor, [4.0] * 10, start=999.5)
    assert not floor.take()
    push(floor, [4.0], start=999.6)
    assert floor.take()


@pytest.mark.parametrize('arrivals', [True, False])
@pytest.mark.parametrize('kind', ['frozen', 'back', 'jumping', 'sawtooth'])
def test_stamps_that_are_no_time_do_not_hide_a_dip(kind, arrivals):
    """20 low samples of 1 kHz trip it, a lone one does not, whatever their stamps are."""
    rng = np.random.default_rng(4)
    n = 5000
    arrived = 50.0 + 0.001 * np.arange(n)
    stamps = {'frozen': np.full(n, 1000.0), 'back': 1000.0 - 0.001 * np.arange(n),
              'jumping': 1000.0 + 0.001 * np.arange(n) + rng.uniform(-0.5, 0.5, n),
              'sawtooth': 1000.0 + 0.001 * (np.arange(n) % 7)}[kind]
    volts = np.full(n, 5.0)
    volts[[100, 1700]] = 0.0
    volts[3000:3020] = 4.0
    floor, tripped = watch(), []
    for k in range(0, n, 50):
        # Without arrivals a batch is put in order: here they come one by one.
        for j in range(k, k + 50, 50 if arrivals else 1):
            part = slice(j, j + (50 if arrivals else 1))
            floor.push(stamps[part], volts[part], arrived[part] if arrivals else None)
        if floor.take():
            tripped.append(k)
    assert tripped and set(tripped) <= {3000, 3050}


def test_frozen_stamps_take_no_memory():
    floor = watch()
    for k in range(300):
        floor.push(np.full(100, 7.0), np.full(100, 5.0), 0.1 * k + 0.001 * np.arange(100))
    assert floor._t.size <= 21


def test_stamps_that_start_anew_keep_what_is_known_by_its_arrival():
    """A driver whose stamps step back at each message loses no sample of a dip."""
    floor = watch()
    for k in range(40):
        floor.push([1000.0 - k], [4.0 if k > 20 else 5.0], [0.001 * k])
        floor.new_time_line()
    assert floor.take()


@pytest.mark.parametrize('part', [slice(0, 3000), slice(1500, 2500), slice(2005, 2011)])
def test_samples_without_a_stamp_count_by_their_arrival(part):
    arrived = 50.0 + 0.001 * np.arange(3000)
    stamps = 1000.0 + arrived
    stamps[part] = math.nan
    volts = np.full(3000, 5.0)
    volts[[100, 1700]] = 0.0
    volts[2000:2020] = 4.0
    floor = watch()
    tripped = []
    for k in range(0, 3000, 50):
        floor.push(stamps[k:k + 50], volts[k:k + 50], arrived[k:k + 50])
        tripped += [k] if floor.take() else []
    assert tripped == [2000] and floor.dips == 1


def test_stamps_at_random_do_not_wear_it_out():
    """A million steps of up to 68 years, as of memory that nobody has set; then a dip of 20 ms."""
    rng = np.random.default_rng(9)
    n = 2_000_000
    floor = watch()
    for k in range(0, n, 10_000):
        floor.push(rng.uniform(0.0, 2.0 ** 31, 10_000), np.full(10_000, 5.0),
                   0.001 * (k + np.arange(10_000)))
    volts = np.full(1000, 5.0)
    volts[500:520] = 4.0
    arrived = 0.001 * (n + np.arange(1000))
    floor.push(1.7e9 + arrived, volts, arrived)
    assert floor.take() and floor.dips == 1


def test_dips_are_counted():
    """Each way down to the floor, over batches and reads; staying there is none."""
    floor = watch()
    for k in range(6):
        push(floor, [4.0] * 30 if k in (1, 2, 4) else [5.0] * 30, start=0.03 * k)
        assert floor.take() is (k in (1, 2, 3, 4, 5))
        assert floor.dips == (0, 1, 1, 1, 2, 2)[k]


@pytest.mark.parametrize('kind', ['lumps', 'catching up', 'jitter'])
@pytest.mark.parametrize('low, trips', [(42, True), (15, True), (7, False)])
def test_samples_sent_at_once_lie_as_far_apart_as_usual(kind, low, trips):
    """
    Of 1 kHz: 100 at once, 600 at once behind a pause, or two at once, stamped as they are sent.

    A dip of 42 samples among 600 in 6 ms is no median of 20 ms of their stamps.
    """
    sent = 0.001 * np.arange(1.0, 6001.0)
    if kind == 'lumps':
        sent = 0.1 * np.ceil(sent / 0.1 - 1e-6) + 1e-5 * (np.arange(6000) % 100)
    elif kind == 'jitter':
        sent[1::2] -= 0.00098
    else:
        sent[3000:3600] = 3.6 + 1e-5 * np.arange(600)
    volts = np.full(6000, 5.0)
    volts[3333:3333 + low] = 4.0
    floor = watch()
    tripped = []
    # Fetched 50 times a second.
    for part in np.split(np.arange(6000), np.searchsorted(sent, 0.02 * np.arange(1, 310))):
        floor.push(1000.0 + sent[part], volts[part], sent[part])
        tripped += [part[0]] if part.size and floor.take() else []
    assert floor.dips == trips and bool(tripped) is trips


def test_a_dip_is_one_whatever_its_stamps_are():
    """50 samples of 1 kHz whose stamps lie within 100 s of the truth."""
    arrived = 0.001 * np.arange(3000)
    stamps = 1000.0 + arrived + np.random.default_rng(6).uniform(-100.0, 100.0, 3000)
    volts = np.full(3000, 5.0)
    volts[1000:1050] = volts[2000:2050] = 4.0
    floor = watch()
    for k in range(0, 3000, 20):
        floor.push(stamps[k:k + 20], volts[k:k + 20], arrived[k:k + 20])
    assert floor.dips == 2


def test_old_samples_do_not_outvote_a_new_one():
    floor = watch()
    floor.push([0.0, 0.5], [4.0, 4.0])
    assert floor.take()
    floor.push(3600.0, 5.0)
    assert not floor.take()


@given(st.lists(st.tuples(st.floats(0.0, 0.02), st.sampled_from([4.0, 5.0])),
                min_size=1, max_size=80), st.lists(st.integers(1, 20), max_size=40),
       st.randoms())
@hypothesis_settings(max_examples=200, deadline=None)
def test_against_the_definition(steps, sizes, random):
    """Batches of any size, shuffled inside: the median of the last 20 ms, three at least."""
    t = np.cumsum([max(step, 1e-6) for step, _ in steps])
    v = np.array([value for _, value in steps])
    expected = []
    for k in range(t.size):
        inside = (t[:k + 1] > t[k] - 0.02) | (np.arange(k + 1) >= k - 2)
        low = v[:k + 1][inside] <= 4.3
        expected.append(np.sum(low) > 1 and np.mean(low) > 0.5)
    floor, at = watch(), 0
    for size in [*sizes, t.size]:
        stop = min(at + size, t.size)
        if stop > at:
            order = list(range(at, stop))
            random.shuffle(order)
            was = floor.take()
            floor.push(t[order], v[order])
            assert floor.take() == any(expected[at:stop])
            assert was == (at > 0 and expected[at - 1])
        at = stop
