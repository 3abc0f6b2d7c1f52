"""Automatic windows for alpha, sigma and Var_inf: node and offline, bounds, settings."""

from dataclasses import replace
import math
import time

import numpy as np
from ou_monitor import supply_facts
from ou_monitor.model.ou_fit import known_ou
from ou_monitor.online.estimator.estimator import RelaxationFits, SlidingEstimator
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Recording, Status
from project import ROOT
from pushed import pushed
import pytest
from scipy.signal import lfilter

GECKO = np.genfromtxt(ROOT / 'bags/recorded/gecko.csv', delimiter=',', names=True)


def flown(seed, deviation, white, seconds=20.0, rate=200.0):
    """Return a quad's rail under gecko's throttle: an OU of 40 1/s and white noise, V."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate)
    t = np.arange(n) / rate
    u = np.interp(t + 20.0, GECKO['time_s'], GECKO['throttle'])
    phi = math.exp(-40.0 / rate)
    e = rng.standard_normal(n)
    e[1:] *= math.sqrt(1.0 - phi * phi)
    x = deviation * lfilter([1.0], [1.0, -phi], e)
    sag = 1.5 * lfilter([0.1], [1.0, -0.9], u ** 1.8)
    return Recording(t, 16.0 - sag + x + white * rng.standard_normal(n), u)


def push(monitor, recording, begin=0.0, end=math.inf):
    part = (recording.t >= begin) & (recording.t < end)
    monitor.push(recording.t[part], recording.voltage[part], recording.throttle[part])


def ou_of(recording):
    return known_ou(recording.t, recording.voltage, recording.throttle, None)


def gecko():
    return Recording(GECKO['time_s'], GECKO['voltage_v'], GECKO['throttle'])


@pytest.mark.parametrize('recording', [
    gecko(), flown(1, 0.03, 0.005), flown(2, 0.01, 0.02), flown(3, 0.0, 0.01)],
    ids=['gecko', 'strong', 'buried', 'white'])
def test_node_and_bench_agree(recording):
    """At the end of a recording both say the same, to the last digit."""
    monitor = SupplyMonitor()
    push(monitor, recording)
    report = monitor.report(0.0)
    assert report.ou == supply_facts(recording).ou and report.ou_age == 0.0
    e, ou = report.estimate, report.ou
    if ou.status == 'ok':
        assert (e.alpha, e.sigma, e.var_inf) == (ou.alpha, ou.sigma, ou.var_inf) and e.usable
    else:
        assert ou.status == 'not_visible' and math.isnan(e.alpha) and math.isnan(e.sigma)
        assert math.isfinite(ou.tau_below_s) and math.isfinite(ou.var_inf_below)
        assert not e.usable


def test_windows_grow_in_flight():
    """Buried in noise the relaxation is known when the windows are long, not before."""
    recording = flown(2, 0.02, 0.03, 40.0, 100.0)
    monitor = SupplyMonitor()
    found = []
    for begin in np.arange(0.0, 40.0, 2.0):
        push(monitor, recording, begin, begin + 2.0)
        found.append(monitor.report(0.0))
    last = found[-1]
    assert last.ou.status == 'ok' and last.ou.window_s > 2.0
    assert last.ou.alpha_95[0] < 40.0 < last.ou.alpha_95[1]
    # Between two fits the last one counts, and says how old it is.
    assert any(0.9 < report.ou_age < last.ou.window_s for report in found)
    known = [math.isfinite(report.estimate.alpha) for report in found[10:]]
    assert np.mean(known) > 0.9
    for report in found:
        assert (report.ou.status == 'ok') == math.isfinite(report.estimate.alpha)


def test_the_fit_in_the_background_is_the_same():
    recording = flown(1, 0.03, 0.005)
    monitor = SupplyMonitor(background=True)
    push(monitor, recording)
    end = time.monotonic() + 60.0
    expected = ou_of(recording)
    while monitor.report(0.0).ou != expected:
        assert time.monotonic() < end


def test_an_error_of_the_fit_is_told(monkeypatch):
    """In the background as in the foreground the monitor begins anew, and says why."""
    def fail(*readings):
        raise FloatingPointError('no fit')
    monkeypatch.setattr('ou_monitor.online.estimator.estimator.known_ou', fail)
    recording = flown(1, 0.03, 0.005)
    for background in (False, True):
        monitor = SupplyMonitor(background=background)
        push(monitor, recording)
        end = time.monotonic() + 60.0
        while not (report := monitor.report(0.0)).restarts:
            assert time.monotonic() < end
        assert report.fault == 'FloatingPointError: no fit'


def test_a_number_is_the_sliding_window_and_a_change_loses_nothing():
    """As before with a number; back to auto all readings are still there."""
    recording = flown(2, 0.02, 0.03)
    monitor = SupplyMonitor(MonitorSettings(window=5.0))
    push(monitor, recording)
    report = monitor.report(0.0)
    plain = pushed(SlidingEstimator(5.0), recording.t, recording.voltage, recording.throttle)
    assert report.estimate == plain.estimate()
    assert report.ou.window_s == report.estimate.duration
    monitor.configure(MonitorSettings())
    assert monitor.report(0.0).ou == ou_of(recording)


def test_what_is_too_old_is_not_known():
    """A fit that ended longer ago than its window is long says nothing of now."""
    recording = flown(1, 0.03, 0.005)
    plain = pushed(SlidingEstimator(2.0), recording.t, recording.voltage, recording.throttle)
    e = plain.estimate()
    relaxation = RelaxationFits(background=False)
    monitor = SupplyMonitor()
    monitor._relaxation = relaxation
    push(monitor, recording)
    assert monitor.report(0.0).ou.status == 'ok'
    late = replace(e, t=e.t + 2.1 * relaxation.facts.window_s)
    told, ou, age = relaxation.in_force(late)
    assert math.isnan(told.alpha) and told.status is Status.TOO_SHORT
    assert ou.status == 'no_data' and age == pytest.approx(2.1 * relaxation.facts.window_s)


def test_a_new_time_line_and_repeats():
    """A step back begins anew; repeats found later are taken out of what is kept."""
    recording = flown(1, 0.03, 0.005)
    monitor = SupplyMonitor()
    push(monitor, recording)
    monitor.push(recording.t[:100] - 100.0, recording.voltage[:100], recording.throttle[:100])
    assert monitor._relaxation.readings.shape[1] == 100
    repeated = SupplyMonitor()
    t = np.repeat(recording.t, 4) + np.tile(np.arange(4) / 800.0, recording.n)
    for part in np.array_split(np.arange(t.size), 40):
        repeated.push(t[part], np.repeat(recording.voltage, 4)[part],
                      np.repeat(recording.throttle, 4)[part])
    assert abs(repeated._relaxation.readings.shape[1] - recording.n) < 5
    assert repeated.report(0.0).ou == ou_of(recording)


def test_the_state_has_the_facts():
    recording = flown(1, 0.03, 0.005, 40.0)
    monitor = SupplyMonitor()
    for begin in range(0, 40, 4):
        push(monitor, recording, begin, begin + 4.0)
        report = monitor.report(0.0)
    fields = report.fields
    assert 'load_sag' not in fields and float(fields['sag']) == float(report.load.sag(1.0)) > 0.5
    assert float(fields['sag_se']) == float(report.load.sag_se(1.0))
    assert fields['ou_status'] == 'ok' and float(fields['window_s']) == report.ou.window_s
    low, high = (float(end) for end in fields['alpha_95'].split())
    assert (low, high) == report.ou.alpha_95 and low < float(fields['alpha']) < high
    assert math.isnan(float(fields['tau_below_s'])) and float(fields['ou_age']) == report.ou_age
    white = SupplyMonitor()
    push(white, flown(3, 0.0, 0.01))
    fields = white.report(0.0).fields
    assert fields['ou_status'] == 'not_visible' and fields['alpha'] == 'nan'
    assert float(fields['tau_below_s']) > 0.0 and float(fields['var_inf_below']) > 0.0


@pytest.mark.parametrize('window, words', [
    ('long', "unknown 'long'"), (True, 'a finite number or auto'), (None, 'or auto'),
    (math.nan, 'or auto'), (0.01, '0.05..3600'), (1e9, '0.05..3600')])
def test_a_window_is_a_word_or_a_number(window, words):
    with pytest.raises(ValueError, match=f'window.*{words}'):
        MonitorSettings(window=window)
    for good in ('auto', 2, 0.05, 3600.0):
        assert MonitorSettings(window=good).window == good
