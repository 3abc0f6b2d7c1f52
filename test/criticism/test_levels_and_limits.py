"""Limits of an ADC, bins and events: against formulas and dense algebra."""

import math
from types import SimpleNamespace

import numpy as np
from numpy.testing import assert_allclose
from ou_monitor.criticism.adc import find_rails
from ou_monitor.criticism.composite import _converged
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate, Events, solved
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
import pytest


@pytest.mark.parametrize('offset', (50.0, -50.0))
@pytest.mark.parametrize('side', (1.0, -1.0))
def test_a_limit_is_found_in_single_precision(offset, side):
    """Continuous readings that float32 rounds, clipped on one side only."""
    rng = np.random.default_rng(6)
    x = side * np.minimum(rng.standard_normal(20_000), 1.0)
    v = (offset + 0.1 * x).astype(np.float32).astype(np.float64)
    low, high = find_rails(v, 0.0, 0.1)
    assert (low == v.min()) == (side < 0.0) and (high == v.max()) == (side > 0.0)
    # The same where later arithmetic has spread the limit over a part of a rounding.
    v = (offset + 0.1 * x) * (1.0 + rng.uniform(-3e-8, 3e-8, x.size))
    low, high = find_rails(v, 0.0, 0.1)
    assert (low == v.min()) == (side < 0.0) and (high == v.max()) == (side > 0.0)


def test_the_same_events_are_found_again_where_push_and_error_begin_at_the_same_samples():
    """A tenth of the power apart in the mean logarithm and 1 % of a variance of the mean."""
    one, zero = np.array([0.0, 1.0, 0.0]), np.zeros(3)
    fit = SimpleNamespace(variance=np.full(3, 4.0))

    def same(push, error, before, power=1.0, moved=0.0, offset=None):
        found = Events(push, error, np.full(3, power), np.ones(3))
        return _converged(before, offset, found, np.full(3, moved), fit)
    none = Events(zero, zero, np.ones(3), np.ones(3))
    assert same(zero, zero, None) and same(zero, zero, none)
    for push, error in ((one, zero), (zero, one)):
        assert not same(push, error, None) and not same(push, error, none)
        assert same(9.0 * push, 9.0 * error, Events(push, error, np.ones(3), np.ones(3)))
        assert not same(zero, zero, Events(push, error, np.ones(3), np.ones(3)))
    assert same(zero, zero, None, moved=0.199) and not same(zero, zero, None, moved=0.201)
    assert same(zero, zero, None, moved=5.1, offset=np.full(3, 5.0))
    assert not same(zero, zero, None, power=4.0)


@pytest.mark.parametrize('width', (3, 400))
def test_least_squares_agree_for_few_and_for_many_columns(width):
    rng = np.random.default_rng(7)
    columns, y = rng.standard_normal((1000, width)), rng.standard_normal(1000)
    columns[:, 1] = 0.0
    columns *= np.geomspace(1.0, 1e3, width)
    both = np.column_stack((y, columns))
    assert_allclose(solved(both.T @ both)[0], np.linalg.pinv(columns) @ y, atol=1e-9)


def test_events_add_to_the_joint_normal_law():
    rng = np.random.default_rng(9)
    n, alpha, sigma, u0 = 40, 1.3, 0.5, 5.0
    t = np.cumsum(rng.choice([0.1, 0.2, 0.5], n))
    v = u0 + 0.4 * rng.standard_normal(n)
    push, error, power = np.zeros(n), np.zeros(n), np.ones(n)
    push[9], error[20], power[30:33] = 0.7, 0.9, 3.0
    std, white = 0.2, np.where(np.arange(n) // 4 == 4, 5.0, 1.0)
    found = evaluate(Samples(t, v, None), [OU(alpha, sigma, u0), MeasurementNoise(std)],
                     Events(push, error, power, white))
    keep = np.append(0.0, np.exp(-alpha * np.diff(t)))
    added = power * sigma**2 / (2.0 * alpha) * (1.0 - keep**2) + push
    spread = np.zeros(n)
    for k in range(n):
        spread[k] = (keep[k]**2 * spread[k - 1] if k else 0.0) + added[k]
    decay = np.exp(-alpha * np.abs(t[:, None] - t))
    covariance = decay * spread[np.minimum.outer(np.arange(n), np.arange(n))] + np.diag(
        error + white * std**2)
    known = np.linalg.cholesky(covariance)
    assert_allclose(found.innovation, np.diag(known) * np.linalg.solve(known, v - u0), atol=1e-4)
    # What an event adds at its own sample is not in the variance there.
    own = (power - 1.0) / power * (added - push) + push + error + (white - 1.0) * std**2
    assert_allclose(found.variance, np.diag(known)**2 - own, rtol=1e-3)


def test_a_rail_at_rest_is_not_clipped():
    """Readings of a robot (regbot_19): more are just above the fullest code than below it."""
    counts = {12.35: 3, 12.34: 134, 12.33: 182, 12.32: 58, 12.31: 23, 12.30: 35, 12.29: 63}
    voltage = np.random.default_rng(1).permutation(np.repeat([*counts], [*counts.values()]))
    assert find_rails(voltage, 0.01, 0.0095) == (-math.inf, math.inf)
    # Noise after a limit lowers as many readings as it raises.
    counts |= {12.34: 30, 12.33: 400, 12.32: 60}
    clipped = np.random.default_rng(1).permutation(np.repeat([*counts], [*counts.values()]))
    assert find_rails(clipped, 0.01, 0.0095) == (-math.inf, 12.33)
