"""The monitor: health, risk, flag and load; it is never wrongly OK."""

import math
from pathlib import Path
import sys

from hypothesis import given, settings as hypothesis_settings, strategies as st
import numpy as np
import ou_monitor
from ou_monitor.model.ou import simulate
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.supply_load import LoadStatus
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.risk.flag import FlagLevel
from ou_monitor.online.settings import monitor_settings, MonitorSettings
from ou_monitor.recordings.model_file import read_model
from ou_monitor.records import Level, Status
from ou_monitor.stream.config import FieldSpec
from ou_monitor.stream.samples import SampleStream
from project import ROOT
from pushed import pushed
import pytest
from simulated_packs import flown


def filled(seed=3, sigma=0.632, u0=5.0, n=2001, **settings):
    """Return a monitor with two seconds of an OU at 1 kHz in it."""
    monitor = SupplyMonitor(MonitorSettings(**settings))
    t = np.arange(n) * 1e-3
    monitor.push(t, simulate(t, 63.0, sigma, np.random.default_rng(seed), u0=u0), 0.4)
    return monitor


def test_nothing_yet_is_stale_and_unknown():
    report = SupplyMonitor().report(None)
    assert report.level is Level.STALE
    assert math.isnan(report.risk) and report.brownout is None
    assert report.fields['brownout'] == 'unknown'


def test_good_input_is_ok():
    report = filled(brownout_voltage=4.0).report(0.01)
    assert report.level is Level.OK and report.brownout is False
    assert float(report.fields['alpha']) == report.estimate.alpha


def test_slow_input_warns_and_has_a_rough_risk():
    monitor = pushed(SupplyMonitor(), np.arange(3.0), [5.0, 5.1, 4.9])
    report = monitor.report(0.0)
    assert report.level is Level.WARN and report.brownout is False
    assert 0.0 < report.risk < 0.1 and report.risk_basis == 'excursions'
    assert '1 Hz' in report.summary


def test_risk_levels_follow_the_parameters():
    """56 mV rms, 0.17 V above the barrier: b = 3, passages every ~150 tau."""
    critical = filled(brownout_voltage=4.83, brownout_warn=0.01, brownout_critical=0.1,
                      brownout_delay=0.0).report(0.0)
    assert critical.brownout is True and critical.level is Level.ERROR
    warned = filled(brownout_voltage=4.83, brownout_warn=0.1,
                    brownout_critical=1.0, brownout_delay=0.0).report(0.0)
    assert warned.brownout is (warned.risk >= 1.0) and warned.level is not Level.OK


def test_distrusted_stamps_leave_the_floor():
    """What rests on the stamps is unknown, the parameters of before too; the floor needs none."""
    monitor = filled(u0=4.0, brownout_voltage=4.5, brownout_floor=4.3, window=2.0)
    assert monitor.report(0.0).estimate.usable
    for again in (False, True):
        monitor.distrust('They come in bursts.')
        report = monitor.report(0.0, again=again)
        assert not report.fresh and math.isnan(report.risk) and report.brownout is True
        assert 'They come in bursts.' in report.summary
        assert report.estimate.status is Status.UNTIMED
        assert {report.fields[name] for name in (
            'alpha', 'alpha_se', 'sigma', 'var_inf', 'tau')} == {'nan'}
        monitor.distrust('')
        report = monitor.report(0.0, again=again)
        assert report.fresh and report.estimate.usable


RATE = 1000.0


class Feed:
    """A monitor fed with an OU at 1 kHz whose mean is set second by second."""

    def __init__(self, **changes):
        self.monitor = SupplyMonitor(MonitorSettings(**changes))
        self._rng = np.random.default_rng(11)
        self.t = 0.0

    def feed(self, level, seconds=2.0):
        """Feed some seconds at a level, V; return the report."""
        n = round(seconds * RATE)
        t = self.t + (1.0 + np.arange(n)) / RATE
        self.t = t[-1]
        self.monitor.push(t, simulate(t, 63.0, 0.3, self._rng, u0=level), 0.62)
        return self.monitor.report(0.0)


def test_summary_says_why():
    report = Feed(brownout_voltage=4.93, brownout_delay=0.0).feed(5.0)
    assert report.level is Level.ERROR and report.flag.level is FlagLevel.CRITICAL
    for words in ('Risk of falling below 4.93 V within 5 s: ', 'critical from 0.5 within 1 s',
                  'throttle 0.62', 'CRITICAL for 0.0 s', 'brownout.critical'):
        assert words in report.summary
    assert report.fields['brownout_level'] == 'CRITICAL'
    assert report.fields['brownout_reason'] == report.flag.reason


def test_a_reset_keeps_the_flag_and_forgets_the_samples():
    """Another time line: what was low there is not low here, but the hold goes on."""
    feed = Feed(brownout_hold=2.0, window=1.0)
    assert feed.feed(4.2).brownout is True
    feed.monitor.reset('the clock jumped back by 1 s')
    report = feed.monitor.report(0.0, now=3.0)
    assert report.level is Level.STALE and math.isnan(report.risk)
    assert report.brownout is True and 'is still set' in report.summary
    feed.t = -1000.0
    assert feed.feed(5.0, 3.0).risk < 0.005
    assert feed.feed(5.0, 3.0).brownout is False


def test_a_reset_forgets_what_the_floor_has_seen():
    """One bad sample before and one after are two lone ones."""
    monitor = pushed(SupplyMonitor(), 0.0, 4.2)
    monitor.reset('the clock jumped')
    monitor.push([0.001, 0.002], [4.2, 5.0])
    assert monitor.report(0.0).brownout is None


def test_a_dip_is_told_though_the_source_is_silent_since():
    """A rail that dies takes its sensor with it, perhaps between two reports: told once."""
    monitor = SupplyMonitor(MonitorSettings(brownout_hold=0.0))
    monitor.push([0.0, 0.001, 0.002], [4.2] * 3)
    report = monitor.report(1.1)
    assert report.brownout is True and report.level is Level.ERROR
    assert 'brownout.floor (4.5 V)' in report.summary and 'No voltage for 1.1 s' in report.summary
    assert report.fields['floor_dips'] == '1'
    silent = monitor.report(1.2)
    assert silent.brownout is None and silent.level is Level.STALE


@pytest.mark.parametrize('at, off', [(0.0, 30.0), (30.0, 3.0)], ids=['plugged', 'changed'])
# The supply goes and comes within pieces of 70.
@pytest.mark.parametrize('size', [70, 20_000])
def test_what_is_read_while_the_supply_is_off_teaches_nothing(at, off, size):
    """Started on USB before the pack is plugged, or a pack changed: the load is the flight's."""
    rng, rate = np.random.default_rng(1), 50
    u = np.repeat(rng.uniform(0.1, 0.9, 60), rate)
    v = 16.0 - 1.5 * u**1.8 + (0.01 + 0.02 * u) * rng.standard_normal(u.size)
    k, n = int(at * rate), int(off * rate)
    u = np.insert(u, k, np.zeros(n))
    v = np.insert(v, k, 0.05 + 0.005 * rng.standard_normal(n))
    t = np.arange(u.size) / rate
    monitor, worst = SupplyMonitor(MonitorSettings(brownout_voltage=13.2)), 0
    for begin in range(0, t.size, size):
        part = slice(begin, begin + size)
        monitor.push(t[part], v[part], u[part])
        worst = max(worst, monitor.report(0.0).flag.level.value)
    # The flag has seen the limit undershot.
    assert worst == FlagLevel.CRITICAL.value or size > n
    load = monitor.report(0.0).load
    # Errors: one standard deviation of the noise of 3,000 readings is far below.
    assert load.known and abs(float(load.sag(0.9)) - 1.5 * 0.9**1.8) < 0.1
    assert float(load.noise(0.5)) == pytest.approx(0.02, rel=0.2)


@given(st.lists(st.sampled_from([0.0, 0.05, 0.5, 2.1, 3.0, 12.0, 16.0, 400.0, -5.0, math.nan]),
                min_size=1, max_size=40), st.integers(1, 5))
@hypothesis_settings(max_examples=200, deadline=None)
def test_no_voltages_stop_the_monitor(voltages, size):
    """Whatever is plugged, pulled or misread."""
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=10.0))
    for begin in range(0, len(voltages), size):
        part = voltages[begin:begin + size]
        monitor.push(0.01 * (begin + np.arange(len(part))), part, 0.3)
    assert monitor.report(0.0).restarts == 0


def test_samples_that_nobody_can_place_reach_the_floor():
    monitor = SupplyMonitor(MonitorSettings(brownout_hold=0.0))
    monitor.watch([5.0, math.nan, 4.2, 4.2, 1e30, 4.2], 0.01 * np.arange(6))
    report = monitor.report(None, 1.0)
    assert report.brownout is True and report.estimate.counters.pushed == 0
    assert monitor.report(None, 1.1).brownout is None


def test_silence_keeps_a_flag_that_is_set_for_the_hold():
    """A rail that dies takes its sensor with it: the flag outlasts it, and is said to."""
    feed = Feed(brownout_hold=2.0, stale_after=1.0)
    feed.feed(4.4)
    silent = feed.monitor.report(1.5)
    assert silent.level is Level.STALE and silent.brownout is True and math.isnan(silent.risk)
    assert 'No voltage for 1.5 s' in silent.summary and 'brownout.hold' in silent.summary
    gone = feed.monitor.report(2.1)
    assert gone.level is Level.STALE and gone.brownout is None and math.isnan(gone.risk)


def test_a_risk_that_waits_is_not_ok():
    report = Feed(brownout_voltage=4.93, brownout_delay=10.0).feed(5.0)
    assert report.flag.level is FlagLevel.UNKNOWN and report.brownout is None
    assert report.level is Level.WARN and 'waits for brownout.delay (10 s)' in report.summary


def test_a_budget_needs_a_second_of_flight():
    """The sag of a square wave of throttle is known sooner; the pilot and the noise are not."""
    rng = np.random.default_rng(1)
    t = np.arange(1200) / 1000.0
    throttle = 0.2 + 0.6 * (t % 0.4 > 0.2)
    voltage = 16.0 - 1.2 * throttle ** 1.8 + 0.005 * rng.standard_normal(t.size)
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=14.0, brownout_horizon=1.0))
    monitor.push(t[:900], voltage[:900], throttle[:900])
    report = monitor.report(0.0)
    assert report.load.known and math.isnan(report.budget)
    assert report.budget_reason == 'Less than a second has been flown.'
    monitor.push(t[900:], voltage[900:], throttle[900:])
    assert monitor.report(0.0).budget == 0.8


@given(st.lists(st.tuples(st.sampled_from([4.2, 4.45, 4.6, 5.0, math.nan]),
                          st.integers(0, 60), st.sampled_from([0.0, 0.5, 1.5, None]),
                          st.floats(-2.0, 3.0)), min_size=1, max_size=12))
@hypothesis_settings(max_examples=40, deadline=None)
def test_never_silently_fine(history):
    """Whatever arrives, and however time goes: no OK and no false flag on an unknown risk."""
    monitor = SupplyMonitor(MonitorSettings(window=0.2, brownout_delay=0.0))
    rng = np.random.default_rng(5)
    t = now = 0.0
    for level, n, age, step in history:
        stamps = t + 0.001 * np.arange(n)
        monitor.push(stamps, level + 0.03 * rng.standard_normal(n))
        t, now = t + 0.001 * n, now + step
        report = monitor.report(age, now)
        if math.isnan(report.risk):
            assert report.level is not Level.OK and report.brownout is not False
        if report.brownout is None:
            assert report.level is not Level.OK
        if report.level is Level.STALE:
            assert math.isnan(report.risk) and math.isnan(report.budget)
        if report.risk >= 0.1:
            assert report.flag.level is not FlagLevel.OK
            assert report.level in (Level.WARN, Level.ERROR)


@pytest.mark.parametrize('values, words', [
    ({'windw': 2.0}, "'window'"),
    ({'brownout.warn': 0.5}, r'brownout.warn \(0.5\) must be less than brownout.critical'),
    ({'brownout.leave': 1.0}, r'brownout.leave \(1.0\) must be less than 1'),
    ({'brownout.leave': 0.0}, 'brownout.leave must lie within 0.001..1.0'),
    ({'brownout.hold': -1.0}, 'brownout.hold must lie within'),
    ({'brownout.hold': math.nan}, 'brownout.hold must be a finite number'),
    ({'brownout.delay': math.inf}, 'brownout.delay must be a finite number'),
    ({'brownout.latch': 1}, 'brownout.latch must be true or false, got 1'),
    ({'brownout.floor': 4.6}, r'brownout.floor \(4.6 V\) must not exceed brownout.voltage'),
    ({'brownout.floor': 4.0, 'brownout.voltage': 3.0}, 'lower it'),
    ({'brownout.floor_time': -0.1}, 'brownout.floor_time'),
    ({'brownout.budget_limit': 0.6}, 'brownout.budget_limit .* brownout.critical'),
    ({'brownout.horizon': -1.0}, 'brownout.horizon'),
    ({'brownout.voltage': math.nan}, 'brownout.voltage'),
    ({'model_file': 3}, 'model_file must be text'),
])
def test_contradictions_are_refused_in_one_line(values, words):
    with pytest.raises(ValueError, match=words) as caught:
        monitor_settings(values)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('values', [
    {'brownout.voltage': 3.0}, {'brownout.floor': 4.5}, {'brownout.floor': 0.0},
    {'brownout.voltage': 0.0}, {'brownout.budget_limit': 0.1}, {'brownout.leave': 0.999},
    {'brownout.hold': 0, 'brownout.floor_time': 0}])
def test_what_does_not_contradict_is_taken(values):
    made = monitor_settings(values)
    assert made.floor <= made.brownout_voltage


def test_the_budget_keeps_under_the_warning_when_told_so():
    made = MonitorSettings(brownout_budget_limit=0.0)
    assert made.budget_limit == made.brownout_warn
    assert MonitorSettings(brownout_budget_limit=0.05).budget_limit == 0.05


FLIGHT = flown(3, 25.0)


def test_the_report_tells_the_load_where_no_relaxation_is_visible():
    """White noise and sag at 50 Hz: alpha is unknown, the load is that of the filter alone."""
    monitor = pushed(SupplyMonitor(), *FLIGHT)
    report = monitor.report(0.0)
    alone = pushed(LoadFilter(), *FLIGHT)
    assert not report.estimate.usable and report.load.known
    assert report.load == alone.load() == monitor.load_filter.load()


def test_parameters_never_reset_the_load_and_errors_do():
    """A shorter window and another limit change nothing; a restart begins anew."""
    monitor = pushed(SupplyMonitor(), *FLIGHT)
    before = monitor.report(0.0).load
    monitor.configure(MonitorSettings(window=0.5, brownout_voltage=13.0))
    monitor.set_model(None)
    assert monitor.report(0.0).load == before
    monitor.restart(RuntimeError('a fault'))
    assert monitor.report(0.0).load.status is LoadStatus.NO_DATA


def test_a_reset_of_time_keeps_the_sag():
    """The same stamps again, another pack: known with the first seconds."""
    t, v, u = FLIGHT
    monitor = pushed(SupplyMonitor(), t, v, u)
    before = monitor.report(0.0).load
    monitor.reset('a loop of a bag')
    monitor.push(t[:200], v[:200] - 1.0, u[:200])
    after = monitor.report(0.0).load
    assert after.known and after.level == pytest.approx(before.level - 1.0, abs=0.4)
    assert float(after.sag(0.5)) == pytest.approx(float(before.sag(0.5)), rel=0.2)


def test_the_fields_have_the_numbers_of_the_load():
    monitor = pushed(SupplyMonitor(), *FLIGHT)
    report = monitor.report(0.0)
    fields = report.fields
    assert fields['load_status'] == 'KNOWN' and fields['load_basis'] == 'THROTTLE'
    assert float(fields['load_level']) == report.load.level
    assert float(fields['load_noise']) == float(report.load.noise(report.estimate.throttle))
    assert fields['load_resistance'] == 'nan' and fields['load_delay'] == '0.0'


def test_fields_are_numbers_whatever_leg_they_stand_on():
    """As text that any language reads: no 'np.float64(0.3)'; numbers round-trip."""
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=13.5, brownout_horizon=1.0))
    monitor.push(*FLIGHT)
    report = monitor.report(0.0)
    assert report.risk_basis == 'load' and 0.0 < report.budget <= 1.0
    assert float(report.fields['throttle_budget']) == report.budget
    assert not [name for name, text in report.fields.items() if 'np.' in text]


@pytest.mark.parametrize('limit, supply, warned', [
    (4.5, 15.8, True), (4.5, 5.0, False), (13.2, 15.8, False)])
def test_the_default_limit_on_another_supply_is_a_warning(limit, supply, warned):
    """A pack of four cells is never near 4.5 V: OK would say that it is safe."""
    t = 0.01 * np.arange(1000)
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=limit))
    monitor.push(t, supply + simulate(t, 60.0, 0.1, np.random.default_rng(3)))
    report = monitor.report(age=0.0)
    assert ('set brownout.voltage' in report.summary) is warned
    assert report.level is (Level.WARN if warned else Level.OK)


def test_a_model_file_in_place_of_its_model_is_refused():
    """It failed only later, without a hint."""
    with pytest.raises(TypeError, match='read_model'):
        SupplyMonitor(MonitorSettings(), read_model(ROOT / 'models/gecko.yaml'))


PACKAGE = str(Path(ou_monitor.__file__).parent)
MOST = 24


def files_of(calls):
    """Return the files of the package in which the calls run any line."""
    found = set()

    def note(frame, event, arg):
        if frame.f_code.co_filename.startswith(PACKAGE):
            found.add(frame.f_code.co_filename[len(PACKAGE) + 1:])

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        calls()
    finally:
        sys.setprofile(before)
    return found


@pytest.mark.parametrize('moving', [False, True])
def test_one_voltage_message_to_one_report(moving):
    rng = np.random.default_rng(1)
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=4.5, brownout_horizon=1.0))
    stream = SampleStream(monitor)
    stream.open_voltage(FieldSpec('voltage', 'x/msg/X', 'data'))
    stream.open_throttle(FieldSpec('throttle', 'x/msg/X', 'data'))
    away, passed = 0.0, []
    for k in range(6000):
        t = 1e-3 * k
        throttle = 0.5 + 0.3 * math.sin(2.0 * t) * moving
        away = away * math.exp(-0.063) + 0.0187 * rng.standard_normal()
        voltages = (np.array([t]), np.zeros(1, bool), np.ones(1, int),
                    np.array([5.0 - 0.3 * throttle + away]))
        if k % 20 == 0:
            stream.add_throttle(t, False, throttle)
        if k % 100 or k < 5000:
            stream.take_voltages(*voltages)
            if k % 100 == 0:
                stream.flush()
                monitor.report(0.0)
            continue
        reports = []

        def pass_on(voltages=voltages, reports=reports):
            stream.take_voltages(*voltages)
            stream.flush()
            reports.append(monitor.report(0.0))

        passed.append(files_of(pass_on))
        # All of it is known but the budget of a throttle that stands still: nothing was left out.
        assert reports[0].estimate.status is Status.OK
        assert math.isfinite(reports[0].risk) and math.isfinite(reports[0].budget) == moving
    # One more is the module of the node whose callback it is.
    assert all(len(files) + 1 <= MOST for files in passed), passed
