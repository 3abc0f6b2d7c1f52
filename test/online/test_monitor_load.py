"""The load inside the monitor: what feeds it, what resets it, what never does."""


import numpy as np
from ou_monitor.model.load import LoadModel
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.supply_load import LoadStatus
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import MonitorSettings
import pytest

TRUE = LoadModel(4, 0.25, charge=0.85, size=0.15, power=1.8)


@pytest.fixture(scope='module')
def flight():
    """Return stamps, voltage and throttle of 25 s at 50 Hz."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 25.0, 0.02)
    u = np.clip(0.35 + 0.25 * rng.standard_normal(51), 0.0, 1.0)[(2 * t).astype(int)]
    return t, TRUE.path(t, u) + 0.05 * rng.standard_normal(t.size), u


def test_the_report_tells_the_load_where_no_relaxation_is_visible(flight):
    """White noise and sag at 50 Hz: alpha is unknown, the load is that of the filter alone."""
    monitor = SupplyMonitor()
    monitor.push(*flight)
    report = monitor.report(0.0)
    alone = LoadFilter()
    alone.push(*flight)
    assert not report.estimate.usable and report.load.known
    assert report.load == alone.load() == monitor.load_filter.load()


def test_parameters_never_reset_the_load_and_errors_do(flight):
    """A shorter window and another limit change nothing; a restart begins anew."""
    monitor = SupplyMonitor()
    monitor.push(*flight)
    before = monitor.report(0.0).load
    monitor.configure(MonitorSettings(window=0.5, brownout_voltage=13.0))
    monitor.set_model(None)
    assert monitor.report(0.0).load == before
    monitor.restart(RuntimeError('a fault'))
    assert monitor.report(0.0).load.status is LoadStatus.NO_DATA


def test_a_reset_of_time_keeps_the_sag(flight):
    """The same stamps again, another pack: known with the first seconds."""
    t, v, u = flight
    monitor = SupplyMonitor()
    monitor.push(t, v, u)
    before = monitor.report(0.0).load
    monitor.reset('a loop of a bag')
    monitor.push(t[:200], v[:200] - 1.0, u[:200])
    after = monitor.report(0.0).load
    assert after.known and after.level == pytest.approx(before.level - 1.0, abs=0.4)
    assert float(after.sag(0.5)) == pytest.approx(float(before.sag(0.5)), rel=0.2)


def test_what_needs_no_alpha_is_told_first(flight):
    """Sag with its error, then why alpha is unknown; every number is a field."""
    monitor = SupplyMonitor()
    monitor.push(*flight)
    report = monitor.report(0.0)
    sag, error = float(report.load.sag(1.0)), float(report.load.sag_se(1.0))
    assert report.summary.startswith(f'Sag {sag:.1f} V at full throttle \u00b1 {error:.1f}, level')
    assert report.summary.endswith(
        'The relaxation is not visible at 50 Hz: only a higher rate can show it.')
    fields = report.fields
    assert fields['load_status'] == 'KNOWN' and fields['load_basis'] == 'THROTTLE'
    assert float(fields['sag']) == sag and float(fields['sag_se']) == error
    assert float(fields['load_level']) == report.load.level
    assert float(fields['load_noise']) == float(report.load.noise(report.estimate.throttle))
    assert fields['load_resistance'] == 'nan' and fields['load_delay'] == '0.0'


def test_what_is_known_without_throttle_is_told():
    """Level and noise first, then why the sag is not known."""
    t = np.arange(0.0, 10.0, 0.02)
    monitor = SupplyMonitor()
    monitor.push(t, 16.0 + 0.05 * np.random.default_rng(1).standard_normal(t.size))
    summary = monitor.report(0.0).summary
    assert summary.startswith('Level 16.0') and 'Throttle is not known' in summary
    assert float(monitor.report(0.0).fields['load_noise']) == pytest.approx(0.05, rel=0.15)


def test_fields_are_numbers_whatever_leg_they_stand_on(flight):
    """As text that any language reads: no 'np.float64(0.3)'; numbers round-trip."""
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=13.5, brownout_horizon=1.0))
    monitor.push(*flight)
    report = monitor.report(0.0)
    assert report.risk_basis == 'load' and 0.0 < report.budget <= 1.0
    assert float(report.fields['throttle_budget']) == report.budget
    assert not [name for name, text in report.fields.items() if 'np.' in text]
