"""The bank of simulated nulls: probability that the largest of many statistics is as far off."""

import math

import numpy as np
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.score_statistics import (
    _PRIOR, covariates_of, criticise, family_chance, family_edge, simulate_bank, SIZE)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
import pytest


def test_a_score_by_a_spread_of_few_draws_has_heavy_tails():
    """Of 4 million scores divided as `_summary` does: the share beyond 3.5."""
    # To four standard errors; the normal law would be 10 of them off.
    rng = np.random.default_rng(1)
    weight = SIZE / (SIZE + _PRIOR)
    drawn = weight * rng.chisquare(SIZE - 1, 40_000) / (SIZE - 1) + 1.0 - weight
    beyond = np.abs(rng.standard_normal((100, 40_000))) > 3.5 * np.sqrt(drawn)
    share, error = float(beyond.mean()), math.sqrt(float(beyond.mean()) / beyond.size)
    assert abs(share - family_chance(3.5, 1)) < 4.0 * error
    assert share > math.erfc(3.5 / math.sqrt(2.0)) + 10.0 * error


@pytest.mark.parametrize('chance', [0.05, 0.01, 0.001])
@pytest.mark.parametrize('count', [1, 30, 70])
def test_the_edge_is_where_the_chance_is(chance, count):
    assert family_chance(family_edge(chance, count), count) == pytest.approx(chance, rel=1e-9)
    assert family_chance(-family_edge(chance, count), count) == pytest.approx(chance, rel=1e-9)


def test_of_plain_recordings_few_are_off():
    t, found = np.arange(2000) / 200.0, []
    for seed in range(30):
        rng = np.random.default_rng([7, seed])
        throttle = np.repeat(rng.random(50), 40)
        voltage = SupplyModel((OU(20.0, 0.3, 15.0),)).simulate(t, rng, throttle)
        samples = Samples(t, voltage, throttle)
        plain = fit_composite(samples, [OU(20.0, 0.3, 15.0)], samples.train)
        bank = simulate_bank(covariates_of(samples, plain), float(plain.gaussian.phi[1]), rng)
        scores = criticise(samples, plain, bank)
        found.append(family_chance(max(map(abs, scores.values())), len(scores)))
    assert np.sum(np.array(found) < 0.05) <= 5
    assert np.median(found) < 0.9
