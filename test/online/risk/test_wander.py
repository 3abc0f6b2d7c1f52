"""A random walk whose speed is learned: against walks of known speed."""

import math

import numpy as np
from ou_monitor.online.risk.curve_filters import Wander
import pytest

DT, NOISE = 0.25, 0.04


def followed(speed, seed, count=400):
    """Return the filter after a walk, the walk, and how far the filter was off over its error."""
    rng = np.random.default_rng(seed)
    level = np.cumsum(np.sqrt(speed * DT) * rng.standard_normal(count))
    wander, away = Wander(), []
    for x in level:
        wander.elapse(DT)
        wander.correct(x + NOISE * rng.standard_normal(), NOISE**2)
        away.append((wander.value - x) / np.sqrt(wander.variance))
    return wander, level, np.array(away[40:])


@pytest.mark.parametrize('speed', (0.0, 5e-4, 8e-3))
def test_it_is_where_it_says_to_within_its_error(speed):
    # 20 walks of 100 s: neighbours are alike over seconds, some 25 independent looks each.
    away = np.concatenate([followed(speed, seed)[2] for seed in range(20)])
    assert np.mean(np.abs(away) < 1.96) > 0.93
    if speed > 0.0:
        # Not too wide, either: the spread of scores is 1 within a sixth (500 looks, 4.5 errors
        # of 3 %) and what the unknown speed adds.
        assert 0.7 < np.std(away) < 1.15


def test_the_speed_is_learned():
    speeds = {true: np.mean([followed(true, seed)[0].speed for seed in range(10)])
              for true in (0.0, 2e-3, 3e-2)}
    assert speeds[0.0] < 4e-4
    assert 1e-3 < speeds[2e-3] < 4e-3
    assert speeds[3e-2] > 1e-2


def test_a_long_silence_widens_it_and_brings_the_first_belief_back():
    wander = followed(0.0, 1)[0]
    before, sure = wander.variance, wander.speed
    wander.elapse(600.0)
    assert wander.variance > 100.0 * before
    assert wander.speed > 5.0 * sure


def test_an_outlier_does_not_carry_it_away():
    wander = followed(1e-4, 2)[0]
    before = wander.value
    wander.correct(before + 10.0, NOISE**2)
    assert abs(wander.value - before) < 5.0 * NOISE


@pytest.mark.parametrize('seed', range(5))
def test_what_was_seen_is_forgotten_over_two_minutes(seed):
    """In logarithms: after t without data exp(-t / 120 s) of the odds between speeds is left."""
    prior = np.array([0.15, 0.2, 0.2, 0.2, 0.15, 0.1])
    speeds = np.array([0.0, 1e-4, 5e-4, 2e-3, 8e-3, 3e-2])

    def faded(weight, t):
        kept = weight ** math.exp(-t / 120.0) * prior ** (1.0 - math.exp(-t / 120.0))
        return float(kept @ speeds / kept.sum())

    for silence in (30.0, 120.0, 300.0):
        wander = Wander()
        # One look, by which the odds between speeds are known in closed form.
        wander.elapse(1e-9)
        variance = 0.5 + speeds * 1e-9
        wander.elapse(20.0)
        variance = variance + speeds * 20.0
        seen = 0.3 * np.random.default_rng(seed).standard_normal()
        wander.correct(seen, NOISE**2)
        total = variance + NOISE**2
        weight = prior * np.exp(-0.5 * seen**2 / total) / np.sqrt(total)
        wander.elapse(silence)
        assert wander.speed == pytest.approx(faded(weight, silence), rel=1e-6)
        assert abs(faded(weight, silence) / faded(weight, 2.0 * silence) - 1.0) > 1e-3
