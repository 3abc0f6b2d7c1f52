"""Brown-out probability: limits, monotonicity, unknown input."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor import brownout_probability
from ou_monitor.model.passage import mean_first_passage, passage_probability
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


def test_errors_raise_small_risks():
    e = replace(GOOD, alpha_se=0.2, sigma_se=0.05, var_inf_se=0.18, u0_se=0.01)
    assert brownout_probability(e, 4.7, 2.0) > 2.0 * brownout_probability(GOOD, 4.7, 2.0)


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
