"""Mean first passage against published values and a simulation."""

import math

import numpy as np
from ou_monitor.model.passage.law import mean_first_passage
import pytest


@pytest.mark.parametrize('start, barrier, expected', [
    (0.0, 1.0, 2.0934066496783218), (0.0, 0.0, 0.0), (2.0, 1.0, 0.0)])
def test_known_values(start, barrier, expected):
    assert mean_first_passage(start, barrier) == pytest.approx(expected, rel=1e-12)


def test_high_level_approaches_the_published_rate():
    """For b > 3 the rate is near b phi(b) (within 15 % at b = 3, less beyond)."""
    for b, slack in ((4.0, 0.10), (6.0, 0.04)):
        rate = b * math.exp(-b * b / 2.0) / math.sqrt(2.0 * math.pi)
        assert mean_first_passage(0.0, b) * rate == pytest.approx(1.0, abs=slack)


def test_out_of_reach_is_never():
    assert mean_first_passage(0.0, 40.0) == math.inf


def test_additive_along_the_way():
    """The strong Markov property: T(0 -> 2) = T(0 -> 1) + T(1 -> 2)."""
    assert mean_first_passage(0.0, 2.0) == pytest.approx(
        mean_first_passage(0.0, 1.0) + mean_first_passage(1.0, 2.0), rel=1e-10)


def test_against_a_simulated_walk():
    """
    Mean over 4 000 paths of step 2e-3 tau, barrier moved for discreteness.

    Sampled paths see the barrier shifted by 0.5826 sqrt(2 dt) (Broadie,
    Glasserman & Kou 1997); what is left is far below the Monte Carlo error.
    """
    rng = np.random.default_rng(2)
    dt, paths = 2e-3, 4000
    phi, q = math.exp(-dt), math.sqrt(-math.expm1(-2.0 * dt))
    barrier = 1.0 - 0.5826 * math.sqrt(2.0 * dt)
    x, when = np.zeros(paths), np.full(paths, np.nan)
    for step in range(1, 20_000):
        alive = np.isnan(when)
        if not alive.any():
            break
        x[alive] = phi * x[alive] + q * rng.standard_normal(int(alive.sum()))
        when[alive & (x >= barrier)] = step * dt
    assert not np.isnan(when).any()
    error = when.std() / math.sqrt(paths)
    assert abs(when.mean() - mean_first_passage(0.0, 1.0)) < 4.0 * error
