"""Health, risk and flag: never silently fine."""

import math

import numpy as np
from ou_monitor.model.ou import simulate
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import (
    monitor_settings,
    MonitorSettings)
from ou_monitor.records import Level, Status
import pytest


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


def test_silence_is_stale_and_unknown_whatever_was_known():
    report = filled().report(1.01)
    assert report.level is Level.STALE and report.brownout is None
    assert math.isnan(report.risk) and '1.0 s' in report.summary


def test_only_nan_is_said():
    monitor = SupplyMonitor()
    monitor.push([0.0, 0.1], [math.nan, math.inf])
    report = monitor.report(0.0)
    assert report.level is Level.STALE and '2 samples were NaN' in report.summary


def test_slow_input_warns_and_has_a_rough_risk():
    monitor = SupplyMonitor()
    monitor.push(np.arange(3.0), [5.0, 5.1, 4.9])
    report = monitor.report(0.0)
    assert report.level is Level.WARN and report.brownout is False
    assert 0.0 < report.risk < 0.1 and report.risk_basis == 'excursions'
    assert '1 Hz' in report.summary


def test_low_supply_raises_the_flag_even_without_a_model():
    monitor = SupplyMonitor()
    monitor.push([0.0, 0.1], [4.4, 4.4])
    report = monitor.report(0.0)
    assert report.brownout is True and report.risk == 1.0 and report.level is Level.ERROR


def test_risk_levels_follow_the_parameters():
    """56 mV rms, 0.17 V above the barrier: b = 3, passages every ~150 tau."""
    critical = filled(brownout_voltage=4.83, brownout_warn=0.01, brownout_critical=0.1,
                      brownout_delay=0.0).report(0.0)
    assert critical.brownout is True and critical.level is Level.ERROR
    warned = filled(brownout_voltage=4.83, brownout_warn=0.1,
                    brownout_critical=1.0, brownout_delay=0.0).report(0.0)
    assert warned.brownout is (warned.risk >= 1.0) and warned.level is not Level.OK


def test_a_parameter_change_keeps_the_samples():
    monitor = filled()
    before = monitor.report(0.0).estimate
    monitor.configure(MonitorSettings(brownout_voltage=4.0))
    assert monitor.report(0.0).estimate == before
    monitor.configure(MonitorSettings(window=1.0))
    assert monitor.report(0.0).estimate.n == 1001
    monitor.configure(MonitorSettings(window=5.0))
    assert monitor.report(0.0).estimate.n == 1001


def test_reset_is_counted_and_said():
    monitor = filled()
    monitor.reset('the clock jumped back by 3 s')
    report = monitor.report(0.0)
    assert report.estimate.counters.resets == 1 and 'jumped back' in report.summary
    assert report.level is Level.STALE


@pytest.mark.parametrize('values, words', [
    ({'windw': 2.0}, "'window'"), ({'window': -1.0}, 'window'), ({'window': True}, 'window'),
    ({'window': 'two'}, 'window'), ({'brownout.warn': 0.5}, 'brownout.critical'),
    ({'brownout.horizon': 0.0}, 'brownout.horizon')])
def test_bad_settings_are_refused_by_name(values, words):
    with pytest.raises(ValueError, match=words):
        monitor_settings(values)


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
