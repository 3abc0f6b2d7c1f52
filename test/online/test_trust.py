"""The monitor's words for an input that cannot be trusted, and for a slow one that can."""

import math

import numpy as np
from ou_monitor import AdaptiveLowPass
from ou_monitor.model.ou import simulate
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.risk.flag import FlagLevel
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.online.trust import ConstantReading, Doubt, InputClock, SourceInterval, StampOrder
from ou_monitor.records import Level
from project import needs_recordings, REAL, recorded
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
        for k in range(0, min(recording.n, 20_000), 7):
            part = slice(k, k + 7)
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
