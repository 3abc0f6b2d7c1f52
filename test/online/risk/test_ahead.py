"""The risk ahead: after a step of throttle, with terms of a model, the budget, and unknown."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.model import passage as passage_law
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.shocks import Jumps, Volatility
from ou_monitor.model.terms.tones import Tone
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import MonitorSettings
import pytest

RATE, ALPHA = 1000.0, 60.0
# ln sigma at throttle 0.2 and 0.8, V/sqrt(s).
QUIET, LOUD = math.log(0.2), math.log(0.8)
SETTINGS = MonitorSettings(brownout_voltage=4.6, brownout_horizon=1.0, brownout_floor=0.0)


def flown(monitor, steps, *, seed=1, throttle=True, begin=0.0, sag=0.1):
    """Fly throttles for some seconds each: exact OU steps, sigma by throttle, and a sag."""
    rng = np.random.default_rng(seed)
    phi, t, x = math.exp(-ALPHA / RATE), begin, 0.0
    for u, seconds in steps:
        sigma = math.exp(QUIET + (u - 0.2) / 0.6 * (LOUD - QUIET))
        kick = sigma * math.sqrt((1.0 - phi * phi) / (2.0 * ALPHA))
        for _ in range(round(seconds * 20)):
            v = np.empty(50)
            for k in range(50):
                x = phi * x + kick * rng.standard_normal()
                v[k] = 5.0 - sag * u + x
            stamps = t + np.arange(1, 51) / RATE
            t = float(stamps[-1])
            monitor.push(stamps, v, np.full(50, u) if throttle else None)
            report = monitor.report(0.0)
    return report


def test_after_a_step_the_intensity_is_that_of_the_new_throttle():
    monitor = SupplyMonitor(replace(SETTINGS, brownout_voltage=4.75))
    flown(monitor, [(0.8, 4.0), (0.2, 4.0)])
    report = flown(monitor, [(0.8, 0.1)], seed=2, begin=8.0)
    supply = monitor._forecast.supply()
    # sigma of the window is of 1.9 s at 0.2 and 0.1 s at 0.8: still less than half of 0.8.
    assert math.log(report.estimate.sigma) < math.log(0.45)
    assert supply.ln_sigma == pytest.approx(LOUD, abs=0.35)
    # 3.4 sd: a passage each four seconds; by the sigma of the window one in a month.
    assert 0.01 < report.risk < 0.6


def test_the_budget_lies_between_the_quiet_and_the_loud_throttle():
    monitor = SupplyMonitor(SETTINGS)
    report = flown(monitor, [(0.2, 4.0), (0.5, 4.0), (0.8, 4.0), (0.2, 3.0)], sag=0.3)
    # At 0.2 the level is 18 sd away, at 0.8 2 sd: 1 s of that is nearly certain.
    assert 0.2 <= report.budget <= 0.8
    assert 'throttle' in report.budget_reason or 'data' in report.budget_reason
    tight = replace(SETTINGS, brownout_voltage=4.8)
    monitor.configure(tight)
    assert monitor.report(0.0).budget < report.budget


def test_without_throttle_there_is_a_risk_and_no_budget():
    monitor = SupplyMonitor(replace(SETTINGS, brownout_voltage=4.75))
    report = flown(monitor, [(0.8, 4.0)], throttle=False)
    assert 1e-4 < report.risk < 0.9
    assert math.isnan(report.budget) and 'Throttle is unknown' in report.budget_reason
    later = flown(monitor, [(0.2, 3.0)], seed=3, begin=4.0)
    assert later.risk < report.risk


def test_one_bad_sample_is_no_brownout_and_three_are():
    monitor = SupplyMonitor(SETTINGS)
    flown(monitor, [(0.2, 3.0)])
    monitor.push(3.001, 1.0, 0.2)
    assert monitor.report(0.0).risk < 0.5
    monitor.push([3.002, 3.003], [1.0, 1.0], 0.2)
    assert monitor.report(0.0).risk == 1.0


def model(*terms):
    return SupplyModel((OU(ALPHA, 0.2, 5.0), *terms))


def test_terms_that_the_risk_does_not_know_are_named():
    """Those that move the supply, and that the live estimate does not follow; no number moves."""
    monitor = SupplyMonitor(SETTINGS)
    first = flown(monitor, [(0.2, 3.0)])
    assert first.left_out == ()
    monitor.set_model(model(Jumps(1.0, -0.5, 0.0), Tone(0.01, 100.0, 0.0, 0.0),
                            LoadSag(0.3, 0.0), MeasurementNoise(0.01), Volatility(0.3, 0.1)))
    after = monitor.report(0.0)
    assert after.left_out == ('jumps', 'tone', 'volatility')
    assert after.fields['model_left_out'] == 'jumps,tone,volatility'
    assert after.risk == first.risk and after.estimate == first.estimate
    monitor.set_model(None)
    assert monitor.report(0.0).left_out == ()


def test_the_table_is_made_before_samples_come(monkeypatch):
    """A node that built it at its first report would lose what arrives meanwhile."""
    monitor = SupplyMonitor(SETTINGS)

    def build():
        raise AssertionError('built while samples are coming')
    monkeypatch.setattr(passage_law, '_build', build)
    assert flown(monitor, [(0.2, 2.0)]).risk < 1e-6
