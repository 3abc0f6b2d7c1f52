"""The flag inside the monitor: levels of the diagnostics, words, silence, parameters."""

import math

from hypothesis import given, settings as hypothesis_settings, strategies as st
import numpy as np
from ou_monitor.model.ou import simulate
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.risk.flag import FlagLevel
from ou_monitor.online.settings import monitor_settings, MonitorSettings
from ou_monitor.records import Level
import pytest

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
    """Risk, horizon, level, throttle, what the flag does and since when."""
    report = Feed(brownout_voltage=4.93, brownout_delay=0.0).feed(5.0)
    assert report.level is Level.ERROR and report.flag.level is FlagLevel.CRITICAL
    for words in ('Brown-out risk', 'within 5 s of 4.93 V', 'critical from 0.5',
                  'at throttle 0.62', 'CRITICAL for 0.0 s', 'brownout.critical'):
        assert words in report.summary
    assert report.fields['brownout_level'] == 'CRITICAL'
    assert report.fields['brownout_reason'] == report.flag.reason


def test_held_after_a_dip():
    """The rail is well again, the flag is still held, and says so; then it is not."""
    # What has just gone down by 0.6 V may do so again: not below 0.01 yet.
    feed = Feed(brownout_hold=5.0, window=1.0, brownout_warn=0.05, brownout_floor=4.3,
                brownout_delay=0.0)
    assert feed.feed(4.4).level is Level.ERROR
    held = feed.feed(5.0, 3.0)
    assert held.risk < 0.025 and held.level is Level.ERROR and held.brownout is True
    assert 'held for brownout.hold (5 s)' in held.summary
    well = feed.feed(5.0, 3.0)
    assert well.level is Level.OK and well.brownout is False


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
    monitor = SupplyMonitor()
    monitor.push(0.0, 4.2)
    monitor.reset('the clock jumped')
    monitor.push([0.001, 0.002], [4.2, 5.0])
    assert monitor.report(0.0).brownout is None


def test_floor_of_a_silent_source_does_not_decide():
    monitor = SupplyMonitor(MonitorSettings(brownout_hold=0.0))
    monitor.push([0.0, 0.001, 0.002], [4.2] * 3)
    assert monitor.report(0.9).brownout is True
    assert monitor.report(1.1).brownout is None


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


def test_samples_that_nobody_can_place_reach_the_floor():
    """They are no samples of an estimate."""
    monitor = SupplyMonitor(MonitorSettings(brownout_hold=0.0))
    monitor.watch([5.0, math.nan, 4.2, 4.2, 1e30, 4.2], 0.01 * np.arange(6))
    report = monitor.report(None, 1.0)
    assert report.brownout is True and report.estimate.counters.pushed == 0
    assert monitor.report(None, 1.1).brownout is None


def test_floor_without_an_estimate():
    """Five samples: no fit yet, and the risk knows only the newest ones."""
    monitor = SupplyMonitor()
    monitor.push([0.0, 0.001, 0.002, 0.003, 0.004], [4.2, 4.2, 4.2, 4.6, 4.6])
    report = monitor.report(0.0)
    assert math.isnan(report.risk) and not report.estimate.usable
    assert report.level is Level.ERROR and report.brownout is True
    assert 'brownout.floor (4.5 V)' in report.summary and 'risk unknown' in report.summary


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
    """From unknown, with a delay: WARN, and the words say what is waited for."""
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
    """One parameter is enough for another rail: the floor follows the voltage."""
    made = monitor_settings(values)
    assert made.floor <= made.brownout_voltage


def test_the_budget_keeps_under_the_warning_when_told_so():
    made = MonitorSettings(brownout_budget_limit=0.0)
    assert made.budget_limit == made.brownout_warn
    assert MonitorSettings(brownout_budget_limit=0.05).budget_limit == 0.05
