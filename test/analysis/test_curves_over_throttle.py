"""Curves over throttle: those of the node, with what has not been flown left out."""

import math

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.replay import by_throttle, slide
from ou_monitor.model.ou import simulate
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Recording
import pytest
from simulated_recordings import ALPHA, recording, without_throttle


def swept(seed, seconds=60.0, rate=500.0):
    """Return a flight whose throttle never stands still: 0.2 to 0.7 in 6 s and back."""
    t = np.arange(int(seconds * rate)) / rate
    throttle = 0.45 + 0.25 * np.sin(2.0 * math.pi * t / 12.0)
    voltage = simulate(t, ALPHA, 0.1 + throttle, np.random.default_rng(seed),
                       u0=5.0 - 0.4 * throttle)
    return Recording(t, voltage, throttle, 'swept')


def test_curves_without_levels_hold_the_truth():
    """
    Sag where throttle only passes, within 4 standard errors, and noise within a factor of 1.5.

    What lies outside 0.2 .. 0.7 is not known.
    """
    found = by_throttle(slide(swept(1), 2.0, 4.5))
    at = found.throttle
    inside = (at > 0.21) & (at < 0.69)
    assert found.known[inside].all() and not found.known[(at < 0.19) | (at > 0.71)].any()
    error = (found.sag_high - found.sag) / 1.96
    assert np.abs((found.sag - 0.4 * at) / error)[inside].max() < 4.0
    truth = (0.1 + at) / math.sqrt(2.0 * ALPHA)
    assert np.abs(np.log(found.noise / truth))[inside].max() < math.log(1.5)
    for curve in (found.sag, found.noise):
        assert np.isnan(curve[~found.known]).all() and np.isfinite(curve[inside]).all()
    # The risk is that of the load, which knows all throttles below the highest.
    assert np.isfinite(found.risk[at <= 0.68]).all() and np.isnan(found.risk[at > 0.72]).all()


def test_the_node_says_the_same():
    """Fed as the node is, ten times a second, its monitor has the same sag, noise and budget."""
    simulated = swept(2)
    found = by_throttle(slide(simulated, 2.0, 4.5))
    monitor = SupplyMonitor(MonitorSettings(window=2.0))
    for part in np.array_split(np.arange(simulated.n), int(10 * simulated.duration)):
        monitor.push(simulated.t[part], simulated.voltage[part], simulated.throttle[part])
        report = monitor.report(age=0.0)
    at = found.throttle[found.known]
    assert found.sag[found.known] == pytest.approx(report.load.sag(at), rel=1e-6)
    assert found.noise[found.known] == pytest.approx(report.load.noise(at), rel=1e-6)
    assert found.budget == pytest.approx(report.budget, abs=0.03)
    assert np.nanmax(found.risk) > found.limit > np.nanmin(found.risk)


def test_without_throttle_there_are_no_curves():
    """And the budget says why."""
    analysis = analyze(without_throttle(recording(1, ((0.1, 0.3),))))
    assert not analysis.by_throttle.known.any()
    assert np.isnan(analysis.by_throttle.risk).all()
    assert 'Throttle is not known' in analysis.by_throttle.budget_reason


def test_without_a_fit_the_budget_says_why():
    """A recording too short for any window, and one that never changes."""
    short = analyze(recording(2, ((0.1, 0.3),), seconds=0.02)).by_throttle
    assert math.isnan(short.budget) and short.budget_reason
    t = np.arange(3000) / 500.0
    stuck = analyze(Recording(t, np.full(t.size, 5.0), np.full(t.size, 0.1))).by_throttle
    assert math.isnan(stuck.budget) and 'sensor is stuck' in stuck.budget_reason


def test_the_voltage_is_the_nodes_unless_asked_for():
    """4.5 V by default; NaN switches the risk off."""
    simulated = recording(3, ((0.1, 0.3), (0.4, 0.5)), seconds=4.0)
    default = analyze(simulated)
    assert default.by_throttle.voltage == MonitorSettings().brownout_voltage
    assert default.brownout_default
    assert not analyze(simulated, brownout_voltage=4.5).brownout_default
    none = analyze(simulated, brownout_voltage=math.nan)
    assert np.isnan(none.by_throttle.risk).all() and math.isnan(none.by_throttle.budget)
    assert default.by_throttle.at(math.nan, 'risk') != 0.0
