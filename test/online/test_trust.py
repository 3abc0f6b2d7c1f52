"""Inputs that cannot be trusted: named, never called good, no exception, bounded memory."""

import math
import tracemalloc

from hypothesis import example, given, settings as hypothesis_settings, strategies as st
import numpy as np
from ou_monitor import AdaptiveLowPass
from ou_monitor.model.ou import simulate
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.risk.flag import FlagLevel
from ou_monitor.online.risk.forecast import Forecast
from ou_monitor.online.settings import monitor_settings, MonitorSettings
from ou_monitor.online.trust import (
    ConstantReading, Doubt, InputClock, SourceInterval, StampOrder, StampWatch)
from ou_monitor.records import Flag, Level
from project import needs_recordings, REAL, recorded
from pushed import pushed
import pytest


def fed(volts, dt=0.01, *, start=0.0, monitor=None, throttle=None, **settings):
    """Return a monitor that has got readings at a rate, stamps and arrivals alike."""
    monitor = monitor or SupplyMonitor(MonitorSettings(**settings))
    t = start + dt * np.arange(1, len(volts) + 1)
    for k in range(0, t.size, 50):
        part = slice(k, k + 50)
        monitor.push(t[part], volts[part], None if throttle is None else throttle[part], t[part])
        monitor.report(0.0, now=t[part][-1])
    return monitor, float(t[-1])


def noisy(n, level=5.0, seed=1):
    """Return an OU about a level at 100 Hz, V."""
    return simulate(0.01 * np.arange(n), 20.0, 0.05, np.random.default_rng(seed), u0=level)


def unknown(report, doubt, level):
    """Assert that a report claims nothing."""
    assert report.doubt is doubt and report.level is level, report.summary
    assert math.isnan(report.risk) and math.isnan(report.budget) and report.brownout is None
    assert report.flag.level is FlagLevel.UNKNOWN and not report.fresh
    assert report.fields['brownout'] == 'unknown' and report.fields['doubt'] == doubt.value


def test_a_reading_that_never_changed_is_unknown():
    for n in (20, 3000):
        monitor, now = fed(np.full(n, 5.0))
        unknown(monitor.report(0.0, now=now), Doubt.STUCK, Level.STALE)
        assert math.isnan(monitor.risk()) and math.isnan(monitor.risk_if(0.5, 1.0))


@pytest.mark.parametrize('dt', [0.001, 0.01, 1.0])
def test_a_sensor_that_gets_stuck_is_unknown_until_it_moves(dt):
    monitor, now = fed(noisy(2000), dt, brownout_hold=0.0)
    assert monitor.report(0.0, now=now).brownout is False
    last = float(noisy(2000)[-1])
    monitor, now = fed(np.full(round(4.8 / dt), last), dt, start=now, monitor=monitor)
    if dt < 1.0:
        assert monitor.report(0.0, now=now).doubt is Doubt.NONE
    monitor, now = fed(np.full(max(round(0.4 / dt), 10), last), dt, start=now, monitor=monitor)
    unknown(monitor.report(0.0, now=now), Doubt.STUCK, Level.STALE)
    monitor, now = fed(noisy(2000, seed=3), dt, start=now, monitor=monitor)
    assert monitor.report(0.0, now=now).brownout is False


def test_a_sensor_stuck_below_the_floor_is_critical():
    monitor, now = fed(np.full(3000, 4.0))
    report = monitor.report(0.0, now=now)
    assert report.brownout is True and report.doubt is Doubt.STUCK and math.isnan(report.risk)


def plateaus(still):
    """Return a reading of 100 mV steps that falls by one every 20 s at 25 Hz, and a throttle."""
    volts = np.repeat([16.1, 16.0, 15.9, 15.8, 15.7], 500)
    throttle = np.full(volts.size, 0.3) if still else 0.3 + 0.2 * np.sin(0.05 * np.arange(
        volts.size))
    return volts, throttle


def test_a_coarse_adc_on_a_slow_discharge_is_not_stuck():
    """The first plateau proves nothing; one that ended by one step allows four times as much."""
    volts, throttle = plateaus(still=True)
    watch = ConstantReading()
    for k, (value, load) in enumerate(zip(volts.reshape(-1, 500), throttle.reshape(-1, 500))):
        for j in range(0, 500, 50):
            watch.push(20.0 * k + 0.04 * np.arange(j, j + 50), value[j:j + 50], load[j:j + 50])
            assert (watch.why == '') is (k > 1 or (k == 1 and j < 500)), (k, j)
    volts, throttle = plateaus(still=False)
    watch = ConstantReading()
    watch.push(0.04 * np.arange(volts.size), volts, throttle)
    assert watch.why


def test_a_gap_is_no_still_reading():
    watch = ConstantReading()
    watch.push(np.arange(20) * 0.1, 5.0 + 0.01 * np.arange(20), None)
    watch.push(np.array([100.0]), np.array([5.19]), None)
    watch.push(101.0 + 0.01 * np.arange(20), np.full(20, 5.19), None)
    assert not watch.why


@needs_recordings
def test_no_recorded_source_is_called_stuck():
    """The first 20 000 readings, 1 Hz to 5 kHz, of sources that are still for up to 2.81 s."""
    looked = 0
    for path in sorted([*REAL.glob('*.csv'), *REAL.glob('raw/*')]):
        # Large logs take half of the time to read, and smaller ones are of the same makers.
        if path.suffix == '.ulg' or path.stat().st_size > 2_000_000:
            continue
        recording = recorded(path)
        watch = ConstantReading()
        for k in range(0, min(recording.n, 20_000), 29):
            part = slice(k, k + 29)
            watch.push(recording.t[part], recording.voltage[part], recording.throttle[part])
            # An INAV, a Crazyflie and a thrust stand take up to 60 readings to the first change.
            assert not watch.why or k < 60, (path.name, recording.t[k], watch.why)
        looked += 1
    assert looked >= 25


@pytest.mark.parametrize('factor, limit, doubt', [
    (1000.0, 4.5, Doubt.UNIT), (100.0, 4.5, Doubt.UNIT), (1.0, 4.5, Doubt.NONE),
    (300.0, 900.0, Doubt.UNIT), (1.0, 0.0, Doubt.LIMIT), (0.1, 0.0, Doubt.LIMIT),
    (20.0, 4.5, Doubt.NONE)])
def test_unit_and_limit(factor, limit, doubt):
    monitor, now = fed(factor * noisy(500), brownout_voltage=limit)
    report = monitor.report(0.0, now=now)
    if doubt is Doubt.NONE:
        assert report.doubt is doubt and report.brownout is False
    else:
        unknown(report, doubt, Level.ERROR)


def test_a_dip_of_millivolts_is_unknown_too():
    monitor, now = fed(np.concatenate([1000.0 * noisy(500), 700.0 * noisy(50)]))
    unknown(monitor.report(0.0, now=now), Doubt.UNIT, Level.ERROR)


def test_volts_after_millivolts_begin_with_nothing_known():
    monitor, now = fed(1000.0 * noisy(500))
    monitor, now = fed(noisy(1000), start=now, monitor=monitor)
    report = monitor.report(0.0, now=now)
    assert report.brownout is False and report.risk < 0.01
    assert report.estimate.counters.pushed == 1500


def test_a_limit_of_0_at_run_time_is_unknown_until_it_is_set_again():
    monitor, now = fed(noisy(500))
    assert monitor.report(0.0, now=now).brownout is False
    monitor.configure(MonitorSettings(brownout_voltage=0.0))
    monitor, now = fed(noisy(500, 0.5), start=now, monitor=monitor)
    unknown(monitor.report(0.0, now=now), Doubt.LIMIT, Level.ERROR)
    monitor.configure(MonitorSettings())
    monitor, now = fed(noisy(50, 0.5), start=now, monitor=monitor)
    assert monitor.report(0.0, now=now).brownout is True


@pytest.mark.parametrize('interval', [0.2, 1.0, 2.0, 4.0])
def test_a_slow_source_is_fresh_for_two_and_a_half_intervals(interval):
    """MAVROS and PX4 send the battery at 1 Hz or 0.5 Hz."""
    rng = np.random.default_rng(5)
    monitor, t = SupplyMonitor(MonitorSettings(brownout_voltage=14.0)), 0.0
    for k in range(40):
        t += interval * (1.0 + 0.05 * rng.standard_normal())
        monitor.push(t, 16.0 + 0.02 * rng.standard_normal(), None, t)
        for age in (0.0, 0.9, 1.05, 1.5, 2.2):
            report = monitor.report(age * interval, now=t + age * interval)
            if k > 2:
                assert report.fresh and report.level is not Level.STALE, report.summary
            if k > 25:
                assert report.brownout is False and report.risk < 0.01
    gone = 2.6 * max(interval, 0.4)
    report = monitor.report(gone, now=t + gone)
    assert report.level is Level.STALE and report.brownout is None


@pytest.mark.parametrize('interval', [1.0, 2.0, 3.0])
def test_the_floor_holds_for_a_slow_source(interval):
    monitor = SupplyMonitor(MonitorSettings(brownout_hold=0.0))
    rng = np.random.default_rng(6)
    dips = []
    for k in range(40):
        t = interval * (k + 1.0)
        monitor.push(t, (3.8 if k in (20, 21) else 5.0) + 0.01 * rng.standard_normal(), None, t)
        if monitor.report(0.0, now=t).flag.low:
            dips.append(k)
    assert dips and set(dips) <= {21, 22}


def test_bursts_and_blocks_are_as_slow_as_their_deliveries():
    """100 readings at once, each second; a fast source that pauses now and then is fast."""
    slow, fast = SourceInterval(), SourceInterval()
    for k in range(10):
        slow.push(np.full(100, 1.0 * k) + 1e-5 * np.arange(100))
        fast.push(2.0 * k + 1e-3 * np.arange(1700))
    assert slow.value == pytest.approx(1.0, rel=0.01) and fast.value == 0.0
    one = SourceInterval()
    for k in range(4):
        one.push_one(2.0 * k)
    assert one.value == 2.0


STAMPS = {
    'frozen': lambda k, rng: np.full(k.size, 50.0), 'back': lambda k, rng: 50.0 - 0.002 * k,
    'far back': lambda k, rng: 50.0 - 0.5 * k, 'random': lambda k, rng: 100.0 * rng.random(k.size),
    'two clocks': lambda k, rng: 50.0 + 0.002 * k - 1000.0 * (k % 2)}


@pytest.mark.parametrize('kind', STAMPS)
def test_a_filter_whose_stamps_are_no_time_goes_on_by_arrival(kind):
    """1 500 messages in 3 s, 1 and then 5 in the input; then good stamps again."""
    clock, low_pass = InputClock(), AdaptiveLowPass()
    arrived = 7.0 + 0.002 * np.arange(1500.0)
    stamps = STAMPS[kind](np.arange(1500.0), np.random.default_rng(2))
    good = stamps[-1] + 0.002 * np.arange(1.0, 500.0)
    out, at = [], []
    for k, (stamp, came) in enumerate(zip(
            np.append(stamps, good), np.append(arrived, arrived[-1] + good - stamps[-1]))):
        at.append(clock.time_of(float(stamp), float(came)))
        out.append(low_pass.filter(at[-1], 5.0 if 200 < k < 1500 else 1.0, 0.3))
        if k in (100, 1499):
            assert clock.stamps is not StampOrder.GOOD, k
    assert clock.by_arrival > 1400
    assert np.diff(at)[100:1500] == pytest.approx(np.full(1400, 0.002), abs=1e-9)
    assert out[300] == pytest.approx(5.0, abs=1e-6) and out[1499] == pytest.approx(5.0, abs=1e-6)
    assert clock.stamps is StampOrder.GOOD and out[-1] == pytest.approx(1.0, abs=1e-6)
    assert 20.0 <= low_pass.cutoff <= 150.0


def test_good_stamps_are_taken_as_they_are():
    """With jitter of arrival, repeats, a few late ones, and a bag that begins anew."""
    clock, rng = InputClock(), np.random.default_rng(3)
    stamps = np.repeat(10.0 + 0.001 * np.arange(1000), 2)
    stamps[::50] -= 0.005
    stamps[1500:] -= 8.0
    found = [clock.time_of(stamp, came) for stamp, came in zip(
        stamps.tolist(), np.sort(rng.uniform(0.0, 1.0, stamps.size)).tolist())]
    assert found == stamps.tolist() and clock.by_arrival == 0


DT = 0.001


def ou(n, seed=3, u0=5.0):
    """Return an OU at 1 kHz, V."""
    return simulate(np.arange(n) * DT, 63.0, 0.3, np.random.default_rng(seed), u0=u0)


def good(**changes):
    """Return a monitor after 3 s of a good input, and the time, s."""
    monitor = SupplyMonitor(MonitorSettings(**changes))
    t = np.arange(3000) * DT
    monitor.push(t, ou(3000), 0.4, arrival=t)
    report = monitor.report(0.0, now=3.0)
    assert report.level is Level.OK and report.brownout is False
    return monitor, 3.0


@pytest.mark.parametrize('arrivals', [True, False])
@pytest.mark.parametrize('kind', ['frozen', 'jumping', 'back'])
def test_stamps_that_are_no_time_end_freshness(kind, arrivals):
    """6 s: no flag that says false once 0.3 s have passed, each dip is seen, and it is named."""
    monitor, start = good(brownout_hold=0.0)
    rng = np.random.default_rng(7)
    dips = []
    for k in range(120):
        arrived = start + 0.05 * k + DT * (1.0 + np.arange(50))
        stamps = {'frozen': np.full(50, 2.999), 'back': 3.0 - 0.05 * k - DT * np.arange(50),
                  'jumping': arrived + rng.uniform(-1.5, 1.5, 50)}[kind]
        volts = ou(50, seed=k)
        if k % 60 == 30:
            volts[5:45] = 3.0
        monitor.push(stamps, volts, 0.4, arrival=arrived if arrivals else None)
        report = monitor.report(0.0, now=arrived[-1])
        if k < 8:
            continue
        assert report.brownout is not False and report.level is not Level.OK
        assert math.isnan(report.risk) and not report.fresh
        if report.brownout:
            dips.append(k)
            assert report.level is Level.ERROR and 'brownout.floor' in report.summary
        else:
            assert report.level is Level.STALE
        assert report.fields['stamps'] == report.stamps.name != 'GOOD'
        assert report.stamps.sentence('they allow no estimate') in report.summary
    low = range(30, 120, 60)
    assert set(low) <= set(dips) <= {k + j for k in low for j in (0, 1)}


def test_good_stamps_again_are_good_again():
    monitor, start = good()
    arrived = start + DT * np.arange(1, 1001)
    monitor.push(np.full(1000, 2.999), ou(1000), arrival=arrived)
    assert monitor.report(0.0, now=4.0).stamps is StampOrder.FROZEN
    t = 4.0 + DT * np.arange(1, 3001)
    monitor.push(t, ou(3000, 5), arrival=t)
    report = monitor.report(0.0, now=7.0)
    assert report.stamps is StampOrder.GOOD and report.brownout is False


@pytest.mark.parametrize('every, order', [
    (0, StampOrder.GOOD), (20, StampOrder.GOOD), (8, StampOrder.IRREGULAR)])
def test_a_tenth_of_late_samples_is_disorder_and_repeats_are_none(every, order):
    """Each message twice, or one of some a little late."""
    watch, arrived = StampWatch(), np.arange(1000) * DT
    stamps = arrived.copy()
    if every:
        stamps[every::every] -= 0.0015
        watch.push(stamps, arrived)
    else:
        watch.push(np.repeat(stamps, 2), np.repeat(arrived, 2))
    assert watch.judge(0.3, DT) is order


def test_irregular_is_never_ok_and_ends():
    monitor, _ = good()
    monitor.push(1.0, 5.0)
    report = monitor.report(0.0)
    assert Flag.IRREGULAR in report.estimate.flags and report.level is Level.WARN
    t = 3.0 + np.arange(3000) * DT
    monitor.push(t, ou(3000, 6), 0.4)
    report = monitor.report(0.0)
    assert Flag.IRREGULAR not in report.estimate.flags and report.level is Level.OK
    assert report.estimate.counters.late == 1


def test_a_fast_source_is_stale_after_300_missed_samples():
    """1 kHz: 0.3 s; 100 Hz: `stale_after`, 1 s; 10 kHz: not before 0.3 s."""
    monitor, _ = good()
    assert monitor.report(0.29).brownout is False
    report = monitor.report(0.31)
    assert report.level is Level.STALE and report.brownout is None
    assert '0.3 s' in report.summary and '1000 Hz' in report.summary
    for dt, limit in ((0.01, 1.0), (1e-4, 0.3), (0.002, 0.6)):
        monitor = pushed(SupplyMonitor(), np.arange(3000) * dt, ou(3000))
        assert monitor.report(0.0).patience == pytest.approx(limit)


@pytest.mark.parametrize('values', [
    {'brownout.warn': 0.0, 'brownout.budget_limit': 0.0},
    {'brownout.critical': 1.0, 'brownout.budget_limit': 1.0}])
def test_limits_that_no_budget_can_keep_are_refused_with_the_range(values):
    with pytest.raises(ValueError, match='budget_limit .* above 0 and below 1'):
        monitor_settings(values)


@pytest.mark.parametrize('volts, throttle, wrong', [
    ([1e200] * 14, 0.4, 14), ([-2e6, 2e6], None, 2), ([5.0] * 20, 3e4, 0)])
def test_what_is_no_reading_is_counted_as_none(volts, throttle, wrong):
    monitor, _ = good()
    for k in range(20):
        t = 3.0 + DT * (50 * k + np.arange(50))
        monitor.push(t, ou(50, k), 0.4)
        monitor.push(t[-1] + 1e-5 * (1.0 + np.arange(len(volts))), volts, throttle)
    report = monitor.report(0.0)
    assert report.estimate.counters.non_finite == 20 * wrong and report.restarts == 0
    assert math.isfinite(report.estimate.sigma) and not report.estimate.throttle > 1.0


@pytest.mark.parametrize('where, name', [('_estimator', 'take'), ('_forecast', 'take')])
def test_an_error_restarts_the_estimator_and_is_told(where, name, monkeypatch):
    monitor, t = good(brownout_hold=60.0)
    low = t + DT * np.arange(1, 101)
    monitor.push(low, np.full(100, 4.0), 0.4, arrival=low)
    assert monitor.report(0.0, now=3.1).flag.level is FlagLevel.CRITICAL

    def fails(*_):
        raise ZeroDivisionError('float\ndivision')

    monkeypatch.setattr(getattr(monitor, where), name, fails)
    later = 3.1 + DT * np.arange(1, 51)
    monitor.push(later, ou(50), 0.4, arrival=later)
    report = monitor.report(0.0, now=3.15)
    assert report.level is Level.ERROR and report.brownout is True and math.isnan(report.risk)
    assert 'ZeroDivisionError: float division' in report.summary and '\n' not in report.summary
    assert report.fields['restarts'] == '1' and 'Zero' in report.fields['fault']
    assert report.estimate.counters.pushed >= 3100
    t = 3.2 + np.arange(3000) * DT
    monitor.push(t, ou(3000, 9), 0.4, arrival=t)
    report = monitor.report(0.0, now=6.2)
    assert 'failed' not in report.summary and report.restarts == 1
    assert monitor.clear_brownout() and monitor.report(0.0, now=6.2).level is Level.OK


def test_an_error_of_the_fit_leaves_the_floor_at_work(monkeypatch):
    monitor, t = good(brownout_hold=0.0)

    def fails(*_):
        raise np.linalg.LinAlgError('Singular matrix')

    monkeypatch.setattr(monitor._estimator, 'estimate', fails)
    assert monitor.report(0.0, now=t).brownout is None
    low = t + DT * np.arange(1, 51)
    monitor.push(low, np.full(50, 4.0), arrival=low)
    report = monitor.report(0.0, now=3.05)
    assert report.brownout is True and 'LinAlgError' in report.summary


ANY = st.floats(allow_nan=True, allow_infinity=True)
LEVELS = st.one_of(ANY, st.sampled_from([5.0, 4.0, 1e-160, 5e-324, 1e6, -1e6, 1e200, 0.0]),
                   st.floats(3.0, 6.0))
STEPS = st.one_of(st.sampled_from([0.001, 0.0, -0.001, 1e-9, 1e-300, 1.0]), ANY)


@given(st.lists(st.tuples(STEPS, LEVELS, st.one_of(st.none(), ANY, st.floats(0.0, 1.0)),
                          st.integers(1, 60), st.floats(0.0, 1e-3)), min_size=1, max_size=12))
@example([(0.001, 0.0, None, 1, 0.0), (-1.0, 0.0, None, 1, 0.0)])
@hypothesis_settings(max_examples=150, deadline=None)
@pytest.mark.filterwarnings('ignore::RuntimeWarning')
def test_no_float_breaks_the_monitor_or_is_called_fine(history):
    monitor = SupplyMonitor(MonitorSettings(window=0.2))
    rng = np.random.default_rng(2)
    t, now = 1000.0, 0.0
    for step, level, throttle, n, spread in history:
        stamps = t + step * np.arange(1.0, n + 1.0)
        t = stamps[-1] if math.isfinite(stamps[-1]) else 1000.0
        volts = level * (1.0 + spread * rng.standard_normal(n))
        arrived = now + DT * np.arange(1, n + 1)
        now = arrived[-1]
        monitor.push(stamps, volts, throttle, arrived)
        report = monitor.report(0.0, now)
        # Errors do not end it, but none is wanted.
        assert report.restarts == 0, report.fault
        assert math.isnan(report.risk) or 0.0 <= report.risk <= 1.0
        assert math.isnan(report.budget) or 0.0 <= report.budget <= 1.0
        assert report.level is not Level.OK or report.brownout is False
        if report.brownout is False:
            assert report.fresh and not math.isnan(report.risk)
        assert all(isinstance(text, str) for text in report.fields.values())


@pytest.mark.filterwarnings('ignore::RuntimeWarning')
def test_memory_is_flat_whatever_arrives():
    rng = np.random.default_rng(8)
    monitor = SupplyMonitor(MonitorSettings(window=0.5))

    def fed(rounds):
        for k in range(rounds):
            n = 200
            stamps = (k % 7 + DT * np.arange(n)) * rng.choice([1.0, 0.0, 1e-9, 1e300, math.nan])
            monitor.push(stamps, 10.0 ** rng.uniform(-300, 300) * rng.standard_normal(n),
                         rng.uniform(-3.0, 3.0, n), 0.2 * k + DT * np.arange(n))
            monitor.report(0.0, 0.2 * k)

    fed(80)
    tracemalloc.start()
    fed(80)
    before = tracemalloc.get_traced_memory()[0]
    fed(160)
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 125_000


@pytest.mark.parametrize('stamps, least', [
    (1000.0 + DT * np.arange(2000), 8), (1000.0 + np.arange(2000), 30),
    (1000.0 + np.random.default_rng(9).uniform(-9.0, 9.0, 2000), 8)])
def test_stamps_that_run_cost_no_more_looks(monkeypatch, stamps, least):
    """By arrival 20 a second at most; a recording, without arrivals, has one for each."""
    looks = []
    monkeypatch.setattr(Forecast, '_look', lambda self: looks.append(1))
    volts, came = ou(2000), DT * np.arange(2000)
    monitor = SupplyMonitor(MonitorSettings())
    for begin in range(0, 2000, 20):
        part = slice(begin, begin + 20)
        monitor.push(stamps[part], volts[part], None, came[part])
    assert least <= len(looks) <= 2.0 / 0.05 + 1
    del looks[:]
    SupplyMonitor(MonitorSettings()).push(1000.0 + np.arange(2000), volts)
    assert len(looks) == 2000
