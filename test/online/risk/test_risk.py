"""First-passage risk: limits and averages; after a step of throttle; terms of a model."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor import brownout_probability
from ou_monitor.model import passage as passage_law
from ou_monitor.model.passage import mean_first_passage, passage_probability
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.shocks import Jumps, Volatility
from ou_monitor.model.terms.tones import Tone
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Estimate, Status
import pytest
from scipy.special import ndtr


GOOD = Estimate(t=0.0, alpha=63.0, sigma=0.632, var_inf=0.632**2 / 126.0, u0=5.0,
                status=Status.OK)


def test_a_barrier_at_the_mean_is_the_reflection_of_the_present_voltage():
    """For the level u0 itself the law is 2 Phi(-x e^-s / sqrt(1 - e^-2s)), s = alpha h."""
    sd = math.sqrt(GOOD.var_inf)
    for now, horizon in ((5.1, 0.01), (5.05, 0.002), (5.2, 0.03)):
        fall = math.exp(-GOOD.alpha * horizon)
        exact = 2.0 * ndtr(-(now - 5.0) / sd * fall / math.sqrt(1.0 - fall * fall))
        assert brownout_probability(GOOD, 5.0, horizon, now) == pytest.approx(exact, rel=3e-3)


def test_rare_passages_come_at_the_rate_of_the_mean_first_passage():
    sd = math.sqrt(GOOD.var_inf)
    mean = mean_first_passage(0.0, 4.5) / GOOD.alpha
    p = brownout_probability(GOOD, 5.0 - 4.5 * sd, 5.0)
    # Before the first tau it has hardly begun: 1 part in alpha h = 315.
    assert p == pytest.approx(-math.expm1(-5.0 / mean), rel=0.01)


def test_errors_are_averaged_over():
    """Against draws of the parameters; 4.5 standard errors of 40 000 draws."""
    rng = np.random.default_rng(8)
    e = replace(GOOD, alpha_se=0.2, sigma_se=0.05, var_inf_se=0.18, u0_se=0.01)
    cov = 0.25 * (4 * 0.05**2 + 0.2**2 - 0.18**2)
    draws = rng.multivariate_normal([0.0, 0.0], [[0.04, cov], [cov, 0.0025]], 40_000)
    alpha, sigma = 63.0 * np.exp(draws[:, 0]), 0.632 * np.exp(draws[:, 1])
    sd = sigma / np.sqrt(2.0 * alpha)
    u0 = 5.0 + 0.01 * rng.standard_normal(40_000)
    for level in (4.85, 4.8, 4.76):
        each = passage_probability((u0 - 4.97) / sd, (u0 - level) / sd, alpha * 2.0)
        expected, error = each.mean(), each.std() / 200.0
        assert brownout_probability(e, level, 2.0, 4.97) == pytest.approx(
            expected, abs=4.5 * error + 0.01 * expected)


def test_noise_on_the_present_voltage_is_averaged_over():
    """A low reading with much noise says less of where the rail is."""
    noisy = replace(GOOD, noise_std=0.05)
    near = brownout_probability(GOOD, 4.85, 0.005, now=4.86)
    assert near > 0.5 > brownout_probability(noisy, 4.85, 0.005, now=4.86)


def test_monotone_in_horizon_level_and_present_voltage():
    low = brownout_probability(GOOD, 4.8, 1.0)
    assert low < brownout_probability(GOOD, 4.8, 5.0) < 1.0
    assert low < brownout_probability(GOOD, 4.85, 1.0)
    assert low < brownout_probability(GOOD, 4.8, 1.0, now=4.81)


def test_risk_is_0_far_away_and_1_at_the_level():
    assert brownout_probability(GOOD, 0.0, 1.0) < 1e-100
    assert brownout_probability(GOOD, 4.8, 1.0, now=4.8) == 1.0
    assert brownout_probability(GOOD, 5.5, 1.0) == 1.0
    assert brownout_probability(GOOD, 4.8, 1e-12) < 1e-10


def test_unknown_is_nan_never_zero():
    for status in Status:
        p = brownout_probability(Estimate(status=status), 4.5, 5.0, now=4.9)
        assert math.isnan(p)


@pytest.mark.parametrize('voltage, horizon', [(4.5, 0.0), (4.5, -1.0), (4.5, math.nan),
                                              (math.nan, 1.0), (math.inf, 1.0)])
def test_bad_questions_are_refused(voltage, horizon):
    with pytest.raises(ValueError, match='horizon|voltage'):
        brownout_probability(GOOD, voltage, horizon)


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
