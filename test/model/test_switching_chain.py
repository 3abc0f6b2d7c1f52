"""Levels under white noise: an OU follows them slowly; a hidden chain knows them."""

import math

import numpy as np
from ou_monitor.model.hidden_chain import forward, log_likelihood, smoothed
from ou_monitor.model.terms.regime_switching import (
    calm_levels, chain_of, rates_between, Scores, stationary_law, step_chances, without_levels)
from ou_monitor.model.terms.term import normal_scores, View
import pytest
from scipy.signal import lfilter
from scipy.special import ndtr

N, RATE, KEEP, DRIVE, WHITE = 4000, 100.0, 0.98, 0.02, 0.1
UP, DOWN = 1.5, 2.5


def filtered(voltage, drive):
    """Return what the settled filter of an OU in white noise leaves over."""
    b = WHITE ** 2 * (1.0 - KEEP ** 2) - drive ** 2
    ahead = 0.5 * (-b + math.sqrt(b * b + 4.0 * (drive * WHITE) ** 2))
    variance = ahead + WHITE ** 2
    trust = ahead / variance
    guess = lfilter([0.0, KEEP * trust], [1.0, -KEEP * (1.0 - trust)], voltage)
    ones = np.ones(N)
    return View(z=(voltage - guess) / math.sqrt(variance), variance=variance * ones,
                phi=KEEP * ones, state=np.concatenate(([0.0], voltage[:-1])), residual=voltage,
                at=np.arange(N) / RATE, step=ones / RATE, throttle=None, train=slice(0, N),
                trust=trust * ones)


def drawn(height, at_once, seed):
    """Return a rail in white noise with levels on it, and the levels, less their mean."""
    rng = np.random.default_rng(seed)
    state, states = 0, []
    for u in rng.random(N):
        state = int(u > DOWN / RATE) if state else int(u < UP / RATE)
        states.append(state)
    levels = height * (np.array(states) - UP / (UP + DOWN))
    drive = DRIVE * rng.standard_normal(N)
    if not at_once:
        drive += (1.0 - KEEP) * np.concatenate(([0.0], levels[:-1]))
    rail = lfilter([1.0], [1.0, -KEEP], drive)
    return rail + at_once * levels + WHITE * rng.standard_normal(N), levels


@pytest.mark.parametrize('height, at_once', [(0.4, 1.0), (1.0, 0.0)])
def test_scores_of_the_true_levels_are_standard_normal(height, at_once):
    """Variance within 4 errors, sqrt(2/n); no correlation of neighbours, 1/sqrt(n)."""
    voltage, _ = drawn(height, at_once, 3)
    view = filtered(voltage, DRIVE)
    x = np.array([math.log(UP), math.log(DOWN), height / math.sqrt(view.variance[0]), 0.0, 0.0])
    scores = Scores.of(view).following(x, at_once)
    chain, mean, std = chain_of(scores, x, at_once)
    before, density = forward(*chain)
    chance = sum(before[:, i] * chain[1][i, j] * ndtr((view.z - mean[i, j]) / std[j])
                 for i, j in np.ndindex(2, 2))
    z = normal_scores(chance)
    if at_once:
        assert abs(np.mean(z ** 2) - 1.0) < 4.0 * math.sqrt(2.0 / N)
        assert abs(np.mean(z[1:] * z[:-1])) < 4.0 / math.sqrt(N)
    # As if the filter followed at once, the levels are hardly seen.
    blind = log_likelihood(*chain_of(scores.at_once, x, at_once)[0])
    assert float(density.sum()) > blind + (300.0 if at_once else 80.0)


@pytest.mark.parametrize('at_once', [0.0, 1.0])
def test_the_followed_level_is_that_of_the_recursion(at_once):
    """The recursion, sample by sample and pair by pair."""
    view = filtered(drawn(0.4, at_once, 6)[0], DRIVE)
    x = np.array([math.log(UP), math.log(DOWN), 4.0, 0.2, 0.0])
    scores = Scores.of(view)
    chances, law = step_chances(x, scores.step, 2), stationary_law(rates_between(UP, DOWN, 2))
    middle, std = law[1], np.exp(0.2 * np.arange(2))
    before, followed, moved, wanted = law.copy(), 0.0, 0.0, []
    for k in range(N):
        keep, draw = view.phi[k] * np.array([1.0 - scores.trust[k], scores.trust[k]])
        behind = keep * (followed if at_once else followed - moved)
        wanted.append(behind)
        known, after = before[1] - middle, np.zeros(2)
        for i, j in np.ndindex(2, 2):
            mean = ((j - middle) - draw * (i - middle) if at_once
                    else (1.0 - view.phi[k]) * (i - middle)) - behind
            off = (view.z[k] - x[2] * scores.unit[k] * mean) / std[j]
            after[j] += before[i] * chances[i, j] / std[j] * math.exp(-0.5 * off * off)
        before = after / after.sum()
        followed = keep * followed + draw * (known if at_once else moved)
        moved = view.phi[k] * moved + (1.0 - view.phi[k]) * known
    found = scores.following(x, at_once).followed
    assert np.ptp(found) > 0.05
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_without_white_noise_nothing_is_behind():
    view = filtered(drawn(0.4, 1.0, 4)[0], 1e3 * WHITE)
    x = np.array([0.0, 0.0, 4.0, 0.0, 0.0])
    assert not Scores.of(view).following(x, 1.0).followed.any()
    assert calm_levels(view, slice(0, N), 0.2, np.zeros(1)) is None


def test_levels_that_the_filter_followed_are_found():
    voltage, levels = drawn(0.4, 1.0, 5)
    view = filtered(voltage, 5.0 * DRIVE)
    start = calm_levels(view, slice(0, N), float(voltage.std()), np.array([0.7]))
    assert start is not None
    x, calm = start.x, start.view
    assert x[2] * math.sqrt(calm.variance[0]) == pytest.approx(0.4, rel=0.4)
    chain = chain_of(Scores.of(calm).following(x, start.at_once), x, start.at_once)[0]
    found = smoothed(*chain)[:, 1] > 0.5
    assert np.mean(found == (levels > 0.0)) > 0.94
    again = without_levels(view, levels)
    # The OU and the noise that are there: one-step variance within a fifth.
    true = filtered(voltage, DRIVE)
    assert again.variance[0] == pytest.approx(true.variance[0], rel=0.2)
    assert float(again.trust) == pytest.approx(true.trust[0], rel=0.4)
