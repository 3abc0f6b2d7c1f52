"""Throttle budget: where a curve of risks passes the limit, and where the flight ends."""

import math

import numpy as np
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.risk.forecast import throttle_budget
import pytest

GRID = np.linspace(0.0, 1.0, 51)


def budget(risks, limit=1e-2, highest=0.9):
    """Return the budget and its reason."""
    return throttle_budget(np.asarray(risks), highest, limit)


@pytest.mark.parametrize('limit', [1e-6, 1e-4, 1e-3, 1e-2, 0.1])
def test_the_budget_is_where_the_risk_passes_the_limit(limit):
    """A logarithm that is straight over throttle is interpolated exactly."""
    throttle, reason = budget(np.exp(20.0 * (GRID - 1.0)), limit)
    end = 1.0 + math.log(limit) / 20.0
    assert throttle == pytest.approx(min(end, 0.9))
    assert f'{limit:.2g}' in reason or end > 0.9


def test_monotone_in_the_limit():
    """A higher limit never gives a lower budget, whatever the curve."""
    risks = np.random.default_rng(1).random(51)
    budgets = [budget(risks, limit)[0] for limit in np.geomspace(1e-6, 1.0, 30)]
    assert np.all(np.diff(budgets) >= 0.0) and budgets[-1] == 0.9


def test_the_edge_of_the_flight_is_no_claim_of_safety():
    """Flown up to 0.4 only, where the risk is small: the budget ends there and says why."""
    throttle, reason = budget(np.full(51, 1e-9), highest=0.4)
    assert throttle == 0.4 and 'No data above 0.40' in reason
    assert budget(np.full(51, 1e-9), highest=1.0)[0] == 1.0


def test_a_risk_that_falls_again_is_no_way_through():
    risks = np.where(np.abs(GRID - 0.5) < 0.05, 0.5, 1e-6)
    assert 0.42 <= budget(risks)[0] <= 0.48


def test_above_the_limit_from_the_start():
    throttle, reason = budget(np.full(51, 0.3))
    assert throttle == 0.0 and 'idle' in reason


def test_without_a_load_it_is_unknown_and_says_why():
    """No sample, no throttle, throttle that never moved."""
    monitor = SupplyMonitor()
    assert math.isnan(monitor.report(None).budget)
    t = np.arange(400) / 100.0
    v = 5.0 + 0.01 * np.random.default_rng(2).standard_normal(400)
    monitor.push(t, v)
    report = monitor.report(0.0)
    assert math.isnan(report.budget) and 'Throttle is not known' in report.budget_reason
    monitor.push(t + 4.0, v, 0.4)
    report = monitor.report(0.0)
    assert math.isnan(report.budget) and 'Throttle has not moved' in report.budget_reason
