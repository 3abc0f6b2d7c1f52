"""The flag as time series: levels by risk and voltage; the floor without a model."""

from dataclasses import replace
import math

from hypothesis import given, settings as hypothesis_settings, strategies as st
import numpy as np
from ou_monitor.online.risk.flag import BrownoutFlag, FlagLevel, FloorWatch
from ou_monitor.online.settings import MonitorSettings
import pytest


NAN = math.nan
OK, WARN, CRITICAL, UNKNOWN = (
    FlagLevel.OK, FlagLevel.WARN, FlagLevel.CRITICAL, FlagLevel.UNKNOWN)
LETTER = {'o': OK, 'w': WARN, 'c': CRITICAL, 'u': UNKNOWN}


def made(**changes):
    """Return a flag with warn 0.01, critical 0.1, leave 0.5; no hold unless it is given."""
    return BrownoutFlag(MonitorSettings(**{
        'brownout_warn': 0.01, 'brownout_critical': 0.1, 'brownout_hold': 0.0,
        'brownout_delay': 0.0, 'brownout_floor': 4.3, **changes}))


def line(flag, risks, step=1.0, start=0.0):
    """Return the states for risks one step apart, or at times; None: data do not arrive."""
    return [flag.update(*risk) if isinstance(risk, tuple) else flag.update(
        start + k * step, NAN if risk is None else risk, fresh=risk is not None)
            for k, risk in enumerate(risks)]


def check(states, letters):
    assert [s.level for s in states] == [LETTER[c] for c in letters.replace(' ', '')]


@pytest.mark.parametrize('changes, risks, letters', [
    ({}, [0.0, 0.00999, 0.01, 0.0999, 0.1, 1.0], 'o o w w c c'),
    # Entered at 0.1 and 0.01, left below 0.05 and 0.005, one level at a time or two.
    ({}, [0.1, 0.06, 0.05, 0.049, 0.01, 0.005, 0.0049], 'c c c w w w o'),
    ({}, [0.2, 0.006, 0.2, 0.004], 'c w c o'),
    ({'leave': 0.9}, [0.1, 0.091, 0.089, 0.0091, 0.0089], 'c c w w o'),
    # Between leave and enter from below: nothing happens.
    ({}, [0.006, 0.06, 0.06, 0.006], 'o w w w'),
    # WARN that follows CRITICAL is held as a level of its own; a rise is never held back.
    ({'hold': 2.0}, [0.5, 0.02, 0.02, 0.0, 0.0, 0.0], 'c c w w o o'),
    ({'hold': 10.0}, [0.0, 0.02, 0.5], 'o w c'),
    # Only a risk that lasts; a break starts the delay anew; without a delay at once.
    ({'delay': 2.0}, [0.0, 0.5, 0.5, 0.0, 0.5, 0.5, 0.5, 0.5], 'o o o o o o c c'),
    ({}, [0.0, 0.5], 'o c'),
    # A risk that swings about critical has been above warn all the time.
    ({'delay': 2.0}, [0.0, 0.5, 0.05, 0.5, 0.5, 0.5], 'o o o w w c'),
    ({'latch': True}, [0.02, 0.0], 'w o'),
    # A single gap does not flicker; a longer one ends with the hold.
    ({'hold': 2.0}, [0.5] * 9 + [NAN] + [0.5], 'c' * 11),
    ({'hold': 3.0}, [0.5] * 6 + [NAN] * 4, 'cccccc cc uu'),
    # Time back is no time.
    ({'hold': 3.0, 'delay': 1.0}, [(1000.0, 0.5), (1001.0, 0.5), (10.0, NAN), (12.9, NAN),
                                   (13.1, NAN)], 'u c c c u'),
    ({'delay': 2.0}, [(1000.0, 0.0), (1001.0, 0.5), (1002.0, 0.5), (0.0, 0.5), (0.9, 0.5),
                      (1.1, 0.5)], 'o o o o o c'),
    # Without a time no hold can be counted: unknown; and the next known time counts again.
    *(({'hold': 3.0}, [(0.0, 0.5), (when, NAN), (1.0, 0.5), (3.9, 0.0), (4.1, 0.0)], 'c u c c o')
      for when in (NAN, math.inf, -math.inf))])
def test_levels_follow_the_risk_over_time(changes, risks, letters):
    check(line(made(**{f'brownout_{name}': value for name, value in changes.items()}), risks),
          letters)


def test_latch_stays_until_cleared():
    flag = made(brownout_latch=True)
    states = line(flag, [0.5, 0.0, NAN, None, 0.0])
    check(states, 'c c c c c')
    assert all(s.brownout is True for s in states) and 'latched' in states[-1].reason
    assert flag.clear() and flag.state.brownout is None
    check(line(flag, [0.0, 0.02], start=5.0), 'o w')
    assert not flag.clear()


def test_clear_does_not_hide_a_risk_that_is_there():
    flag = made(brownout_latch=True, brownout_hold=10.0)
    line(flag, [0.5])
    assert flag.clear()
    check(line(flag, [0.5], start=1.0), 'c')


def test_clear_begins_the_delay_anew():
    flag = made(brownout_latch=True, brownout_delay=2.0)
    check(line(flag, [0.5, 0.5, 0.5]), 'u u c')
    assert flag.clear()
    check(line(flag, [0.5, 0.5, 0.5], start=3.0), 'u u c')


def test_latch_switched_off_ends_it_and_on_begins_it():
    flag = made(brownout_latch=True)
    check(line(flag, [0.5, 0.0]), 'c c')
    flag.configure(replace(flag.settings, brownout_latch=False))
    check(line(flag, [0.06, 0.0], start=2.0), 'c o')
    check(line(flag, [0.5], start=4.0), 'c')
    flag.configure(replace(flag.settings, brownout_latch=True))
    check(line(flag, [0.0], start=5.0), 'c')


def test_a_held_warning_never_says_false():
    states = line(made(brownout_hold=3.0), [0.02, NAN, NAN, NAN, 0.0])
    check(states, 'w w w u o')
    assert [s.brownout for s in states] == [False, None, None, None, False]


def test_parameters_do_not_reset_it():
    flag = made(brownout_hold=5.0)
    line(flag, [0.5, 0.0])
    flag.configure(MonitorSettings(brownout_hold=5.0, brownout_critical=0.2,
                                   brownout_delay=0.0))
    state = flag.update(2.0, 0.0)
    assert state.level is CRITICAL and state.since == 0.0
    flag.configure(MonitorSettings(brownout_hold=2.5))
    check(line(flag, [0.0, 0.0], start=2.0), 'c o')


@pytest.mark.parametrize('risk', [-1e-9, 1.0 + 1e-9, math.inf, -math.inf])
def test_no_probability_is_refused(risk):
    with pytest.raises(ValueError, match='0..1'):
        BrownoutFlag().update(0.0, risk)


def test_floor_decides_without_a_risk():
    flag = made(brownout_hold=2.0)
    flag.push([0.0, 0.01, 0.02], [4.3, 4.2, 4.3])
    state = flag.update(0.0, NAN)
    assert state.level is CRITICAL and state.brownout is True
    assert 'brownout.floor (4.3 V)' in state.reason
    flag.push([1.0, 1.01, 1.02], [5.0, 5.0, 5.0])
    check([flag.update(1.0, NAN), flag.update(1.9, NAN), flag.update(3.1, NAN)], 'c c u')


def test_floor_of_stale_data_decides_once():
    """What came since the last update is told; that nothing has come since is not."""
    flag = made(brownout_hold=0.0)
    flag.push([0.0, 0.01, 0.02], [4.2] * 3)
    check([flag.update(0.1 * k, NAN, fresh=False) for k in range(3)], 'cuu')
    check([flag.update(0.3, NAN, fresh=False, arriving=True)], 'c')


def test_critical_is_of_the_next_second_and_warn_of_the_horizon():
    """Throttle held as it is decides what must be done now; the rest is a caution."""
    flag = made()
    cases = [(0.9, 0.05, False), (0.0, 0.2, False), (0.0, 0.0, True), (0.0, 0.0, False),
             (0.3, NAN, False)]
    check([flag.update(float(k), *case) for k, case in enumerate(cases)], 'w c w o c')
    assert 'budget' in made().update(0.0, 0.0, 0.0, True).reason


events = st.lists(st.tuples(
    st.floats(-3.0, 5.0), st.one_of(st.just(NAN), st.floats(0.0, 1.0)), st.booleans(),
    st.one_of(st.none(), st.floats(3.0, 6.0)), st.booleans()), max_size=60)
options = st.fixed_dictionaries({
    'brownout_hold': st.sampled_from([0.0, 1.0, 10.0]),
    'brownout_delay': st.sampled_from([0.0, 0.5, 5.0]),
    'brownout_leave': st.sampled_from([0.001, 0.5, 0.99]),
    'brownout_latch': st.booleans(), 'brownout_floor': st.sampled_from([0.0, -1.0, 4.5])})


@given(options, events)
@hypothesis_settings(max_examples=200, deadline=None)
def test_whatever_happens_it_is_never_silently_fine(changes, happened):
    flag = made(**changes)
    t, known = 0.0, -math.inf
    for step, risk, fresh, voltage, clear in happened:
        t += step
        known += min(step, 0.0)
        if voltage is not None:
            flag.push(t, voltage)
        if clear and voltage is None:
            flag.clear()
        state = flag.update(t, risk, fresh=fresh)
        unknown = math.isnan(risk) or not fresh
        if unknown:
            assert state.level is not OK and state.brownout is not False
        elif risk >= 0.1 and changes['brownout_delay'] == 0.0:
            assert state.level is CRITICAL
        if not unknown or 'floor' in state.reason:
            known = t
        elif t - known > changes['brownout_hold'] and not changes['brownout_latch']:
            assert state.level is UNKNOWN
        assert (state.brownout is True) == (state.level is CRITICAL)
        assert state.age >= 0.0 and state.reason
        assert state.level is not UNKNOWN or state.brownout is None


@given(st.lists(st.floats(0.0, 0.2), min_size=1, max_size=60), st.sampled_from([1.0, 3.0, 7.0]))
@hypothesis_settings(max_examples=100, deadline=None)
def test_no_level_is_left_downwards_before_its_hold(risks, hold):
    states = line(made(brownout_hold=hold), risks)
    for before, after in zip(states, states[1:]):
        if after.level.value < before.level.value:
            assert after.since - before.since >= hold


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
              'jumping': 1000.0 + 0.001 * np.arange(n) + (
                  100.0 if arrivals else 0.5) * rng.uniform(-1.0, 1.0, n),
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
    assert floor.dips == 1 or not arrivals


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
