"""The flag as time series: given risk and voltage at each time, the level that must follow."""

from dataclasses import replace
import math

from hypothesis import given, settings as hypothesis_settings, strategies as st
from ou_monitor.online.risk.flag import BrownoutFlag, FlagLevel
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
    """Return the states for risks one step apart; None stands for data that do not arrive."""
    return [flag.update(start + k * step, NAN if risk is None else risk, fresh=risk is not None)
            for k, risk in enumerate(risks)]


def check(states, letters):
    assert [s.level for s in states] == [LETTER[c] for c in letters.replace(' ', '')]


def test_levels_are_entered_at_their_probability():
    states = line(made(), [0.0, 0.00999, 0.01, 0.0999, 0.1, 1.0])
    check(states, 'o o w w c c')
    assert [s.brownout for s in states] == [False] * 4 + [True] * 2


@pytest.mark.parametrize('changes, risks, letters', [
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
    # A single gap does not flicker.
    ({'hold': 2.0}, [0.5] * 9 + [NAN] + [0.5], 'c' * 11)])
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


def test_unknown_after_the_grace():
    flag = made(brownout_hold=3.0)
    states = line(flag, [0.5] * 6 + [NAN] * 4)
    check(states, 'cccccc cc uu')
    assert [s.brownout for s in states] == [True] * 8 + [None] * 2
    assert 'not known' in states[6].reason


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


@pytest.mark.parametrize('back', [0.01, 5.0, 1e6])
def test_time_back_is_no_time(back):
    flag = made(brownout_hold=3.0)
    flag.update(1000.0, 0.5)
    assert flag.update(1001.0, 0.0).age == 1.0
    start = 1001.0 - back
    state = flag.update(start, 0.0)
    assert state.level is CRITICAL and state.age == pytest.approx(1.0)
    assert flag.update(start + 1.9, 0.0).level is CRITICAL
    assert flag.update(start + 2.1, 0.0).level is OK


def test_time_back_and_not_knowing():
    flag = made(brownout_hold=3.0, brownout_delay=1.0)
    line(flag, [0.5, 0.5], start=1000.0)
    check([flag.update(10.0, NAN), flag.update(12.9, NAN), flag.update(13.1, NAN)], 'c c u')


def test_delay_and_time_back():
    flag = made(brownout_delay=2.0)
    line(flag, [0.0, 0.5, 0.5], start=1000.0)
    check([flag.update(0.0, 0.5), flag.update(0.9, 0.5), flag.update(1.1, 0.5)], 'o o c')


@pytest.mark.parametrize('when', [NAN, math.inf, -math.inf])
def test_without_a_time_nothing_is_held(when):
    """No hold can be counted then: unknown; and the next known time counts again."""
    flag = made(brownout_hold=3.0)
    line(flag, [0.5])
    check([flag.update(when, NAN), flag.update(1.0, 0.5), flag.update(3.9, 0.0),
           flag.update(4.1, 0.0)], 'u c c o')


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
