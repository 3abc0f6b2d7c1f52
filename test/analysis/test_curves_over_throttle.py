"""Results over throttle: the supply facts, and the risk of the node at the end."""

import math

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.model.ou import simulate
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Recording
from ou_monitor.report.analysis_document import answer
import pytest
from simulated_recordings import ALPHA, recording


def swept(seed, seconds=60.0, rate=500.0):
    """Return a flight whose throttle never stands still: 0.2 to 0.7 in 6 s and back."""
    t = np.arange(int(seconds * rate)) / rate
    throttle = 0.45 + 0.25 * np.sin(2.0 * math.pi * t / 12.0)
    voltage = simulate(t, ALPHA, 0.1 + throttle, np.random.default_rng(seed),
                       u0=5.0 - 0.4 * throttle)
    return Recording(t, voltage, throttle, 'swept')


def test_throttle_that_only_passes_is_known():
    """Sag within 4 standard errors, noise within 15 %, where flown; the risk up to there."""
    analysis = analyze(swept(1), brownout_voltage=4.5)
    found, facts = analysis.by_throttle, analysis.overview.facts
    at, inside = found.throttle, found.known
    assert at[inside] == pytest.approx([0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    error = np.array(facts.sag.se_v)
    assert (np.abs(np.array(facts.sag.sag_v) - 0.4 * at) < 4.0 * error)[inside].all()
    truth = (0.1 + at[inside]) / math.sqrt(2.0 * ALPHA)
    assert np.array(facts.noise.rms_v)[inside] == pytest.approx(truth, rel=0.15)
    assert np.isfinite(found.risk[at <= 0.7]).all() and np.isnan(found.risk[at > 0.81]).all()


def test_without_a_fit_the_budget_says_why():
    """A recording too short for any window, and one that never changes."""
    short = analyze(recording(2, ((0.1, 0.3),), seconds=0.02)).by_throttle
    assert math.isnan(short.budget) and short.budget_reason
    t = np.arange(3000) / 500.0
    stuck = analyze(Recording(t, np.full(t.size, 5.0), np.full(t.size, 0.1))).by_throttle
    assert math.isnan(stuck.budget) and 'sensor is stuck' in stuck.budget_reason


def test_without_throttle_the_budget_is_unknown():
    """Even where the recording ends below the limit."""
    low = swept(4, seconds=20.0)
    low = Recording(low.t, low.voltage, np.full(low.n, math.nan), current=20.0 * low.throttle)
    found = analyze(low, brownout_voltage=float(low.voltage[-1]) + 0.1)
    assert math.isnan(found.by_throttle.budget)
    assert math.isnan(found.overview.facts.budget.throttle)
    assert 'no throttle keeps' not in ' '.join(answer(found)).lower()


def test_the_voltage_is_the_nodes_unless_asked_for():
    """4.5 V by default; NaN switches the risk off."""
    simulated = recording(3, ((0.1, 0.3), (0.4, 0.5)), seconds=4.0)
    default = analyze(simulated)
    assert default.by_throttle.voltage == MonitorSettings().brownout_voltage
    assert default.brownout_default
    assert not analyze(simulated, brownout_voltage=4.5).brownout_default
    none = analyze(simulated, brownout_voltage=math.nan)
    assert np.isnan(none.by_throttle.risk).all() and math.isnan(none.by_throttle.budget)
