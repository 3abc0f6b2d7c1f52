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


# Variance gained per second, and what is believed of it before any data.
SPEEDS = np.array([0.0, 1e-4, 5e-4, 2e-3, 8e-3, 3e-2])
BELIEF = np.array([0.15, 0.2, 0.2, 0.2, 0.15, 0.1])


def test_before_any_data_it_is_the_belief():
    """Mean speed 0.00472 per second, and a variance of 0.5 that grows by it."""
    wander = Wander()
    assert wander.value == 0.0 and wander.variance == pytest.approx(0.5, rel=1e-12)
    assert BELIEF.sum() == pytest.approx(1.0) and wander.speed == pytest.approx(0.00472, rel=1e-12)
    assert wander.fast_speed == pytest.approx(BELIEF @ SPEEDS**2 / 0.00472, rel=1e-12)
    wander.elapse(10.0)
    assert wander.variance == pytest.approx(0.5472, rel=1e-12)
    assert wander.speed == pytest.approx(0.00472, rel=1e-12)


@pytest.mark.parametrize('seen, noise', [(0.3, 0.04), (-1.4, 0.5), (2.0, 0.01)])
def test_one_observation_is_the_rule_of_bayes(seen, noise):
    """After 100 s, by integration over where it may be at each speed; no more is forgotten."""
    wander = Wander()
    wander.elapse(100.0)
    wander.correct(seen, noise)
    x = np.linspace(-15.0, 15.0, 60_001)
    spread = 0.5 + 100.0 * SPEEDS[:, None]
    joint = (BELIEF[:, None] * np.exp(-0.5 * x * x / spread) / np.sqrt(spread)
             * np.exp(-0.5 * (seen - x) ** 2 / noise))
    joint /= joint.sum()
    mean = float(joint.sum(axis=0) @ x)
    assert wander.value == pytest.approx(mean, rel=1e-6)
    assert wander.variance == pytest.approx(float(joint.sum(axis=0) @ (x - mean) ** 2), rel=1e-6)
    weight = joint.sum(axis=1)
    assert wander.speed == pytest.approx(float(weight @ SPEEDS), rel=1e-6)
    # A time of 120 s leaves 1/e of what was learned, in logarithms.
    wander.elapse(120.0)
    kept = BELIEF * (weight / BELIEF) ** math.exp(-1.0)
    assert wander.speed == pytest.approx(float(kept @ SPEEDS / kept.sum()), rel=1e-6)


def test_an_observation_far_away_counts_as_four_deviations():
    """Whatever it is beyond that; the variance before is 0.5, that of the observation 0.5."""
    found = []
    for seen in (4.0, 4.1, 1e3):
        wander = Wander()
        wander.correct(seen, 0.5)
        found.append(wander.value)
    assert found == pytest.approx([2.0, 2.0, 2.0], rel=1e-12)
    wander = Wander()
    wander.correct(3.9, 0.5)
    assert wander.value == pytest.approx(1.95, rel=1e-12)
