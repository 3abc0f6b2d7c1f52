"""Past blocks of the flight, its excursions and its pilot: by brute force and formulas."""


import numpy as np
from ou_monitor.online.risk.courses import (
    BLOCK, excursion_risk, FlightHistory, flown, pilot)
import pytest

RATE = 100.0


def made(seconds=60.0, parts=37, seed=1):
    """Return a past fed in parts, and its samples."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    # No stamp is where a block ends.
    t[0] -= 0.002
    u = np.repeat(rng.uniform(0.1, 0.9, round(seconds)), round(RATE))
    v = 16.0 - u + 0.05 * rng.standard_normal(t.size)
    past = FlightHistory()
    for part in np.array_split(np.arange(t.size), parts):
        past.push(t[part], v[part], u[part])
    return past, t, v, u


def middle_of(v):
    padded = np.concatenate((v[:1], v[:1], v))
    return np.median(np.stack((padded[:-2], padded[1:-1], padded[2:])), axis=0)


def test_what_a_horizon_became():
    past, t, v, u = made()
    lowest, peak, dwell = past.outcome(10.02, 2.0)
    inside = slice(201 + 1004 - 200, 1205)
    assert lowest == middle_of(v)[inside].min()
    assert peak == u[inside].max()
    assert dwell == pytest.approx((u[inside] >= peak - 0.05).sum() / RATE)
    assert past.outcome(59.0, 2.0) is None


def test_parts_of_samples_change_nothing():
    u = np.random.default_rng(1).uniform(0.0, 1.0, 600)
    whole, parts, single = FlightHistory(), FlightHistory(), FlightHistory()
    for past, step in ((whole, 600), (parts, 7), (single, 1)):
        for k in range(0, 600, step):
            part = slice(k, k + step)
            past.push(np.arange(600)[part] / RATE, 16.0 - u[part], u[part])
    np.testing.assert_allclose(parts.table, whole.table, rtol=1e-12)
    np.testing.assert_allclose(single.table, whole.table, rtol=1e-12)


def test_slow_sources_are_held_and_silence_is_not():
    past = FlightHistory()
    past.push(np.arange(10.0), np.arange(10.0) + 10.0, np.full(10, 0.5))
    assert np.isfinite(past.table).all() and past.table.shape[1] == 181
    past.push(np.array([14.0]), np.array([9.0]), np.array([0.5]))
    assert past.outcome(8.0, 3.0) is None
    assert past.drops(1.0).size < past.table.shape[1] - 60
    past.push(np.array([1e9]), np.array([9.0]), np.array([0.5]))
    assert past.table.shape[1] == 1


def test_no_more_than_five_minutes_are_kept():
    past = FlightHistory()
    t = np.arange(0.0, 400.0, 0.04)
    past.push(t, np.full(t.size, 12.0), np.full(t.size, 0.3))
    assert past.table.shape[1] == round(300.0 / BLOCK)
    assert past.end == pytest.approx(400.0, abs=0.06)


@pytest.mark.parametrize('horizon', [0.1, 1.0, 2.0, 5.0, 60.0])
@pytest.mark.parametrize('mean', [-0.1, 0.05, 0.3, 2.0])
def test_excursions_fall_with_the_margin(horizon, mean):
    """Everywhere; beyond 8 deviations with the fifth power."""
    risk = excursion_risk(12.0, 12.0 - np.linspace(0.0, 3.0, 400), horizon, mean, 0.1)
    assert (np.diff(risk) <= 1e-12).all()
    far = excursion_risk(12.0, np.array([11.2, 10.4]), horizon, mean, 0.1)
    assert far[0] / far[1] == pytest.approx(32.0)


def test_futures_are_those_flown():
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
    courses, weight = pilot(flown(FlightHistory(), 2.0), 0.2, 2.0)
    np.testing.assert_allclose(weight, 0.2)
    np.testing.assert_allclose(courses.rest, 0.2)
