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
    Sag, sigma and level where throttle only passes, each within 4 standard errors.

    What lies outside 0.2 .. 0.7 is not known.
    """
    simulated = swept(1)
    found = by_throttle(slide(simulated, 2.0, 4.5), True)
    at = found.throttle
    inside = (at > 0.22) & (at < 0.68)
    assert found.known[inside].all() and not found.known[(at < 0.1) | (at > 0.8)].any()
    level_error = (found.level - (5.0 - 0.4 * at)) / found.level_se
    ln_error = np.log(found.sigma / (0.1 + at)) / (
        np.log(found.sigma_high / found.sigma_low) / 3.92)
    assert np.abs(level_error[inside]).max() < 4.0 and np.abs(ln_error[inside]).max() < 4.0
    first = at[found.known.argmax()]
    slope = found.sag[inside] - 0.4 * (at[inside] - first)
    assert np.abs(slope).max() < 0.03
    for curve in (found.sag, found.sigma, found.level):
        assert np.isnan(curve[~found.known]).all() and np.isfinite(curve[inside]).all()
    # The risk is that of the load, which knows all throttles below the highest.
    assert np.isfinite(found.risk[at <= 0.68]).all() and np.isnan(found.risk[at > 0.72]).all()


def test_the_node_says_the_same():
    """
    Fed as the node is, ten times a second, its monitor has the same curves and budget.

    Within a standard error: the node's estimates are newer by half a second than those here.
    """
    simulated = swept(2)
    found = by_throttle(slide(simulated, 2.0, 4.5), True)
    monitor = SupplyMonitor(MonitorSettings())
    for part in np.array_split(np.arange(simulated.n), int(10 * simulated.duration)):
        monitor.push(simulated.t[part], simulated.voltage[part], simulated.throttle[part])
        report = monitor.report(age=0.0)
    curves = monitor.outlook.curves
    for mine, se, theirs in (
            (found.level, found.level_se, curves.level_curve(found.throttle)[0]),
            (np.log(found.sigma), np.log(found.sigma_high / found.sigma_low) / 3.92,
             curves.sigma_curve(found.throttle)[0])):
        assert np.nanmax(np.abs(mine - theirs) / se) < 1.0
    assert found.budget == pytest.approx(report.budget, abs=0.03)
    assert np.nanmax(found.risk) > found.limit > np.nanmin(found.risk)


def test_without_throttle_there_are_no_curves():
    """And the budget says why."""
    analysis = analyze(without_throttle(recording(1, ((0.1, 0.3),))))
    assert not analysis.by_throttle.known.any()
    assert np.isnan(analysis.by_throttle.risk).all()
    assert 'No throttle' in analysis.by_throttle.budget_reason


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
