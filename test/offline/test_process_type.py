"""Kinds of process: each word has its test."""

import math

import numpy as np
from ou_monitor.offline.process_type import classify, excess_kurtosis, ProcessType
from ou_monitor.records import Estimate, Flag, Status
import pytest

USABLE = Estimate(alpha=63.0, sigma=0.3, var_inf=7e-4, u0=5.0, alpha_se=0.1, sigma_se=0.1,
                  var_inf_se=0.1, status=Status.OK, n=10000, duration=10.0, rate=1000.0)


def changed(**changes):
    """Return the usable estimate with some fields changed."""
    return Estimate(**{**{name: getattr(USABLE, name) for name in (
        'alpha', 'sigma', 'var_inf', 'u0', 'alpha_se', 'sigma_se', 'var_inf_se', 'status',
        'n', 'duration', 'rate')}, **changes})


@pytest.mark.parametrize('estimate, kurtosis, kind', [
    (USABLE, 0.0, ProcessType.DIFFUSION),
    (USABLE, 2.0, ProcessType.IMPULSES),
    (changed(alpha=2000.0), 0.0, ProcessType.GAUSSIAN),
    (changed(noise_std=0.03), 0.0, ProcessType.GAUSSIAN),
    (changed(noise_std=0.02), 0.0, ProcessType.DIFFUSION),
    (changed(flags=(Flag.TREND,)), 2.0, ProcessType.NOT_STATIONARY),
    (changed(flags=(Flag.QUANTIZED,)), 9.0, ProcessType.DIFFUSION),
    (Estimate(status=Status.NO_RELAXATION), 0.0, ProcessType.NOISE),
    (Estimate(status=Status.CONSTANT), math.nan, ProcessType.CONSTANT),
    (Estimate(status=Status.TOO_SHORT), 0.0, ProcessType.UNDETERMINED),
    (Estimate(status=Status.TOO_FEW_SAMPLES), math.nan, ProcessType.UNDETERMINED),
])
def test_each_kind_has_its_reason(estimate, kurtosis, kind):
    """The first rule that applies decides, and says why."""
    found, reason = classify(estimate, kurtosis, 0.05)
    assert found is kind
    assert reason.endswith('.')


def test_kurtosis_needs_both_significance_and_size():
    """0.6 with a standard error of 0.2 and 0.4 with 0.01 are both no impulses."""
    assert classify(USABLE, 0.6, 0.2)[0] is ProcessType.DIFFUSION
    assert classify(USABLE, 0.4, 0.01)[0] is ProcessType.DIFFUSION
    assert classify(USABLE, 0.6, 0.1)[0] is ProcessType.IMPULSES


def test_excess_kurtosis_of_known_laws():
    """Normal 0, uniform -6/5, Laplace 3; within 5 standard errors of each law."""
    rng = np.random.default_rng(1)
    n = 200_000
    value, se = excess_kurtosis(rng.normal(size=n))
    assert abs(value) < 5.0 * se and se == pytest.approx(math.sqrt(27.0 / n))
    assert excess_kurtosis(rng.uniform(-1, 1, n))[0] == pytest.approx(-1.2, abs=5 * se)
    # Var of the kurtosis of a Laplace: moments to the 8th, about 6500/n.
    assert excess_kurtosis(rng.laplace(size=n))[0] == pytest.approx(
        3.0, abs=5 * math.sqrt(6500.0 / n))


def test_the_standard_error_holds_for_increments_of_white_noise():
    """
    Differences of white noise (lag-1 correlation -1/2) scatter as stated.

    The standard deviation of 400 values is known to 1/sqrt(800) = 3.5 %; the
    kurtosis estimate is skewed, so 15 % is allowed; the bare sqrt(24/n) is
    6 % lower, the effect of the correlation is in the formula of the module.
    """
    rng = np.random.default_rng(2)
    values = [excess_kurtosis(np.diff(rng.normal(size=2001))) for _ in range(400)]
    assert np.std([v for v, _ in values]) == pytest.approx(values[0][1], rel=0.15)


@pytest.mark.parametrize('increments', [np.zeros(0), np.ones(49), np.zeros(500)])
def test_too_little_is_unknown(increments):
    """Few or only zero increments: NaN, not 0."""
    assert all(math.isnan(v) for v in excess_kurtosis(increments))
