"""Blocks of the flight so far, its excursions, and what its pilot did: brute force, formulas."""

import math

import numpy as np
from ou_monitor.online.risk.courses import (
    BLOCK, excursion_risk, excursions, flown, Past, pilot, sliding)
import pytest
from scipy.special import expit

RATE = 100.0


def made(seconds=60.0, parts=37, seed=1):
    """Return a past fed in parts, and its samples."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    # No stamp is where a block ends.
    t[0] -= 0.002
    u = np.repeat(rng.uniform(0.1, 0.9, round(seconds)), round(RATE))
    v = 16.0 - u + 0.05 * rng.standard_normal(t.size)
    past = Past()
    for part in np.array_split(np.arange(t.size), parts):
        past.push(t[part], v[part], u[part])
    return past, t, v, u


def middle_of(v):
    padded = np.concatenate((v[:1], v[:1], v))
    return np.median(np.stack((padded[:-2], padded[1:-1], padded[2:])), axis=0)


def test_blocks_and_parts():
    """The same however the samples come; each block by brute force."""
    past, t, v, u = made()
    whole, *_ = made(parts=1)
    np.testing.assert_array_equal(past.table[[0, 1, 3]], whole.table[[0, 1, 3]])
    blocks = middle_of(v).reshape(-1, 5)
    np.testing.assert_array_equal(whole.table[0], blocks.min(axis=1))
    np.testing.assert_array_equal(whole.table[1], blocks[:, -1])
    np.testing.assert_allclose(whole.table[2], u.reshape(-1, 5).mean(axis=1))


@pytest.mark.parametrize('width', [1, 2, 3, 7, 20, 64])
def test_sliding(width):
    x = np.random.default_rng(width).standard_normal(200)
    found = sliding(np.minimum, x, width)
    np.testing.assert_array_equal(found, [x[k:k + width].min() for k in range(201 - width)])


def test_drops():
    """Now less the lowest of the blocks to come."""
    past, *_ = made()
    low, last = past.table[:2]
    expected = [last[k] - low[k + 1:k + 41].min() for k in range(low.size - 40)]
    np.testing.assert_allclose(past.drops(2.0), expected)


def test_what_a_horizon_became():
    past, t, v, u = made()
    lowest, peak, dwell = past.became(10.02, 2.0)
    inside = slice(201 + 1004 - 200, 1205)
    assert lowest == middle_of(v)[inside].min()
    assert peak == u[inside].max()
    assert dwell == pytest.approx((u[inside] >= peak - 0.05).sum() / RATE)
    assert past.became(59.0, 2.0) is None


def test_slow_sources_are_held_and_silence_is_not():
    past = Past()
    past.push(np.arange(10.0), np.arange(10.0) + 10.0, np.full(10, 0.5))
    assert np.isfinite(past.table).all() and past.table.shape[1] == 181
    past.push(np.array([14.0]), np.array([9.0]), np.array([0.5]))
    assert past.became(8.0, 3.0) is None
    assert past.drops(1.0).size < past.table.shape[1] - 60
    past.push(np.array([1e9]), np.array([9.0]), np.array([0.5]))
    assert past.table.shape[1] == 1


def test_no_more_than_five_minutes_are_kept():
    past = Past()
    t = np.arange(0.0, 400.0, 0.04)
    past.push(t, np.full(t.size, 12.0), np.full(t.size, 0.3))
    assert past.table.shape[1] == round(300.0 / BLOCK)
    assert past.end == pytest.approx(400.0, abs=0.06)


@pytest.mark.parametrize('horizon, b', [
    (0.3, (-0.90, -0.62, -0.34)), (1.0, (-0.90, -0.62, -0.34)), (2.0, (-0.52, -0.12, -0.68)),
    (5.0, (-1.08, 0.23, -0.52)), (60.0, (-1.08, 0.23, -0.52)),
    (math.sqrt(2.0), (-0.71, -0.37, -0.51))])
def test_formula_of_excursions(horizon, b):
    """With 12 V now and drops of 0.3 +- 0.1 V; halfway in ln h the mean of both."""
    levels = np.array([11.9, 11.5, 11.3])
    z2 = (12.0 - levels) / 0.1
    z1 = np.clip(z2 - 3.0, -4.0, 8.0)
    np.testing.assert_allclose(excursion_risk(12.0, levels, horizon, 0.3, 0.1),
                               expit(b[0] + b[1] * z1 + b[2] * z2))


@pytest.mark.parametrize('horizon', [0.1, 1.0, 2.0, 5.0, 60.0])
@pytest.mark.parametrize('mean', [-0.1, 0.05, 0.3, 2.0])
def test_excursions_fall_with_the_margin(horizon, mean):
    """Everywhere; beyond 8 deviations with the fifth power."""
    risk = excursion_risk(12.0, 12.0 - np.linspace(0.0, 3.0, 400), horizon, mean, 0.1)
    assert (np.diff(risk) <= 1e-12).all()
    far = excursion_risk(12.0, np.array([11.2, 10.4]), horizon, mean, 0.1)
    assert far[0] / far[1] == pytest.approx(32.0)


def test_moments_of_excursions():
    """Blocks count as n dt / h, and one horizon more of twice the deviation of 5 s."""
    past, *_ = made()
    drops = past.drops(2.0)
    first = 2.0 * past.table[1, -100:].std()
    n = drops.size * BLOCK / 2.0
    mean = (n * drops.mean() + first) / (n + 1.0)
    square = (n * ((drops - mean) ** 2).mean() + (first - mean) ** 2) / (n + 1.0)
    np.testing.assert_allclose(excursions(past, 2.0), (mean, math.sqrt(square)))
    few = Past()
    few.push(np.arange(95) / RATE, np.full(95, 12.0), np.full(95, 0.3))
    assert math.isnan(excursions(few, 2.0)[0])
    few.push(0.95 + np.arange(10) / RATE, np.full(10, 12.0), np.full(10, 0.3))
    assert excursions(few, 2.0) == (0.0, pytest.approx(0.012))


def test_futures_are_those_flown():
    """Each with its throttle at first, peak, dwell and rest; the nearer and newer weigh more."""
    past, *_ = made()
    done = flown(past, 2.0)
    mean, high = past.table[2:]
    n = mean.size - 40
    at = np.arange((n - 1) % 4, n, 4)
    k = 17
    window = slice(at[k] + 1, at[k] + 41)
    near = mean[window] >= high[window].max() - 0.05
    assert done.first[k] == mean[at[k]] and done.peak[k] == high[window].max()
    assert done.dwell[k] == pytest.approx(near.sum() * BLOCK)
    assert done.rest[k] == pytest.approx(mean[window][~near].mean())
    assert done.age[k] == pytest.approx((n - 1 - at[k]) * BLOCK)
    courses, weight = pilot(done, 0.5, 2.0)
    assert weight.sum() == pytest.approx(1.0)
    flown_weight = np.exp(-0.5 * ((done.first - 0.5) / 0.25) ** 2 - done.age / 100.0) * 0.1
    # Five courses that were never flown share one horizon.
    np.testing.assert_allclose(weight[:-5] / weight[-1], flown_weight * 5.0)
    np.testing.assert_allclose(courses.peak[-5:], 0.5 + 0.5 * np.array([.1, .3, .5, .7, .9]))
    np.testing.assert_allclose(courses.dwell[-5:], 0.4)
    assert (courses.peak[:-5] >= 0.5).all()


def test_without_any_past_a_pilot_may_rise():
    courses, weight = pilot(flown(Past(), 2.0), 0.2, 2.0)
    np.testing.assert_allclose(weight, 0.2)
    np.testing.assert_allclose(courses.rest, 0.2)
