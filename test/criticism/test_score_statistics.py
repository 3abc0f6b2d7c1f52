"""Statistics of scores: N(0, 1) without an effect, and far off with one."""

import math

import numpy as np
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.score_statistics import (
    _PRIOR, criticise, family_chance, family_edge,
    is_sign, score, simulate_bank, SIZE, throttle_paths)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
import pytest


N = 8000
KEEP = 0.9


def throttle(rng):
    """Return a throttle that wanders over its whole range."""
    knots = rng.uniform(0.1, 0.9, 60)
    return np.interp(np.arange(N), np.linspace(0, N, 60), knots)


def test_paths_are_no_function_of_throttle_now():
    u = throttle(np.random.default_rng(1))
    paths = dict(throttle_paths(u, 0.0))
    assert set(paths) == {'growing effect of throttle', 'loop of throttle 15 to 85 %',
                          'loop of throttle 28 to 72 %', 'loop of throttle 40 to 60 %'}
    for path in paths.values():
        for power in (1, 2, 3):
            assert abs(score(path, u**power)) < 0.5


def test_a_throttle_that_only_rises_has_no_loop_and_a_constant_one_nothing():
    # The relay turns once, with throttle: a function of it.
    rising = dict(throttle_paths(np.repeat([0.2, 0.8], N // 2), KEEP))
    assert not any(name.startswith('loop') for name in rising)
    assert not dict(throttle_paths(np.full(N, 0.5), KEEP))


def test_the_loop_statistic_detects_a_relay_in_the_mean_and_growth_does_not():
    rng = np.random.default_rng(2)
    u = throttle(rng)
    state, out = 1.0, np.empty(N)
    for k, x in enumerate(u):
        state = 1.0 if x > 0.7 else -1.0 if x < 0.3 else state
        out[k] = state
    mean = 2.0 * out
    errors = rng.standard_normal(N) + mean - KEEP * np.concatenate((mean[:1], mean[:-1]))
    statistics_of = {name: score(errors, path) for name, path in throttle_paths(u, KEEP)}
    assert statistics_of['loop of throttle 28 to 72 %'] > 4.8
    assert abs(statistics_of['growing effect of throttle']) < 4.0


def test_an_effect_of_throttle_that_grows_is_detected():
    rng = np.random.default_rng(3)
    u = throttle(rng)
    mean = 12.0 * np.linspace(-1.0, 1.0, N) * (u - u.mean())
    errors = rng.standard_normal(N) + mean - KEEP * np.concatenate((mean[:1], mean[:-1]))
    statistics_of = {name: score(errors, path) for name, path in throttle_paths(u, KEEP)}
    assert statistics_of['growing effect of throttle'] > 5.0


RATE = 512.0


def test_a_sign_has_its_direction():
    for sign, name, value, wanted in (
            ('+kurtosis', 'kurtosis', 1.0, True), ('+kurtosis', 'kurtosis', -1.0, False),
            ('-kurtosis', 'kurtosis', -1.0, True), ('-kurtosis', 'kurtosis', 1.0, False),
            ('-kurtosis', 'kurtosis', 0.0, True), ('+band', 'skewness', 1.0, False),
            ('band', 'band 3, 1 to 2 Hz', -1.0, True), ('band', 'band 0, 1 to 2 Hz', 1.0, True),
            ('band', 'order line', 1.0, False)):
        assert is_sign(sign, name, value) is wanted, (sign, name, value)


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
        bank = simulate_bank(samples, plain, rng)
        scores = criticise(samples, plain, bank)
        found.append(family_chance(max(map(abs, scores.values())), len(scores)))
    assert np.sum(np.array(found) < 0.05) <= 5
    assert np.median(found) < 0.9
