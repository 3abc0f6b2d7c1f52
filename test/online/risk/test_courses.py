"""Past blocks by brute force; the lowest voltage of a course by Monte Carlo and formulas."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.model.load import LAGS, LINEAR_LAGS, SIZE
from ou_monitor.online.load.supply_load import LoadState
from ou_monitor.online.risk import courses
from ou_monitor.online.risk.courses import (
    BLOCK, excursion_risk, FlightHistory, flown, held, lowest, mean_now, pilot, Sampling)
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


# A pack of 16 V that sags by 1.5 V at once, without errors: level, discharge, coefficients.
COEFFICIENTS = np.array([16.0, 0.0, 1.5] + [0.0] * (SIZE - 1))
AFTER_2_S = 5 + LAGS.index(2.0)
NOISE = 0.05
SAMPLING = Sampling(0.02, 0.0)
QUIET = {'deviation': (1e-6, 1e-6)}


def state(throttle=0.4, **changes):
    """Return what a filter would know that knows all."""
    lags = (throttle ** 1.8,) * len(LAGS) + (throttle,) * len(LINEAR_LAGS)
    return replace(LoadState(
        0.0, throttle, COEFFICIENTS, np.zeros((2 + SIZE, 2 + SIZE)), lags, 1.0, 0.0,
        (2.0 * math.log(NOISE), 0.0, 0.0), 0.0, (NOISE, NOISE), (0.0, 1.0)), **changes)


@pytest.mark.parametrize('n', [1, 2, 8, 64, 512])
def test_the_largest_of_running_medians(n):
    """Mean and deviation within four standard errors of 20 000 draws."""
    rng = np.random.default_rng(n)
    count = 20000 if n < 100 else 4000
    x = rng.standard_normal((count, n + 2))
    middle = np.median(np.stack((x[:, :-2], x[:, 1:-1], x[:, 2:])), axis=0).max(axis=1)
    mean = np.interp(math.log(n), courses._LN_N, courses._MEAN)
    deviation = np.interp(math.log(n), courses._LN_N, courses._DEVIATION)
    assert mean == pytest.approx(middle.mean(), abs=4.0 * middle.std() / math.sqrt(count))
    # The kurtosis is below 4.5, so the error of a deviation below 0.94 / sqrt(n).
    assert deviation == pytest.approx(middle.std(), rel=4.0 * 0.94 / math.sqrt(count))


def test_throttle_that_stays():
    """16 V less 1.5 x, less what the largest of 48 medians is; the first two are a group."""
    mean, deviation, error, _ = lowest(state(), held(0.4, 1.0, 0.4), 1.0, SAMPLING)
    rng = np.random.default_rng(1)
    v = 16.0 - 1.5 * 0.4 ** 1.8 + NOISE * rng.standard_normal((20000, 52))
    low = np.median(np.stack((v[:, :-2], v[:, 1:-1], v[:, 2:])), axis=0).min(axis=1)
    assert mean[0] == pytest.approx(low.mean(), abs=0.05 * NOISE)
    # Throttle of a peak is even within 5 %.
    peak = 0.05 / math.sqrt(12.0) * 1.5 * 1.8 * 0.4 ** 0.8
    assert deviation[0] == pytest.approx(math.hypot(low.std(), peak), rel=0.05)
    assert error[0] == 0.0
    assert mean_now(state()) == pytest.approx(16.0 - 1.5 * 0.4 ** 1.8)


@pytest.mark.parametrize('interval, share', [(0.02, 1.0), (0.1, 1.0), (0.16, 0.25), (1.0, 0.0)])
def test_a_slow_sensor_misses_the_inrush(interval, share):
    """A coefficient of 10 +- 30 V that no reading shows; two of three are within 0.2 s or not."""
    coefficients, error = COEFFICIENTS.copy(), np.zeros((2 + SIZE, 2 + SIZE))
    coefficients[-1], error[-1, -1] = 10.0, 900.0
    mean, _, deviation, _ = lowest(state(mean=coefficients, covariance=error, **QUIET),
                                held(0.9, 5.0, 0.4), 5.0, Sampling(interval, 0.0))
    plain, *_ = lowest(state(**QUIET), held(0.9, 5.0, 0.4), 5.0, Sampling(interval, 0.0))
    assert plain - mean == pytest.approx(share * 0.5 * 0.02 / 0.2 * 10.0, abs=1e-5)
    assert deviation == pytest.approx(share * 0.5 * 0.02 / 0.2 * 30.0, abs=1e-5)


@pytest.mark.parametrize('interval, share', [
    (0.02, 1.0), (0.1, 1.0), (0.16, 0.25), (0.25, 0.0)])
def test_a_slow_sensor_misses_the_noise_of_a_rise(interval, share):
    """As it misses the inrush: a source of 5 Hz never had so large a change between samples."""
    noisy = state(log_variance=(2.0 * math.log(NOISE), 0.0, 8.0), mean=COEFFICIENTS * (
        np.arange(2 + SIZE) == 0))
    mean, deviation, *_ = lowest(noisy, held(0.9, 2.0 * interval, 0.4), 2.0 * interval,
                                Sampling(interval, 0.0))
    plain, narrow, *_ = lowest(
        replace(noisy, log_variance=(2.0 * math.log(NOISE), 0.0, 0.0)),
        held(0.9, 2.0 * interval, 0.4), 2.0 * interval, Sampling(interval, 0.0))
    factor = math.exp(0.5 * 8.0 * math.sqrt(0.05 * share))
    assert 16.0 - mean[0] == pytest.approx(factor * (16.0 - plain[0]))
    assert deviation[0] == pytest.approx(factor * narrow[0])


def test_a_peak_and_its_lag():
    """Throttle after a lag of 2 s, the mean of the second half of its way; little noise."""
    coefficients = COEFFICIENTS.copy()
    coefficients[2], coefficients[AFTER_2_S] = 0.0, 1.5
    known = state(mean=coefficients, **QUIET)
    for dwell in (0.5, 2.0):
        mean, *_ = lowest(known, held(0.9, dwell, 0.4), 4.0, SAMPLING)
        a, b = 0.4 ** 1.8, 0.9 ** 1.8
        stay = dwell - 0.04
        start = b + (a - b) * math.exp(-0.04 / 2.0)
        half = start + (b - start) * (1.0 - math.exp(-0.5 * stay / 2.0))
        way = b + (half - b) * (1.0 - math.exp(-0.5 * stay / 2.0)) * 2.0 / (0.5 * stay)
        back = start + (b - start) * (1.0 - math.exp(-stay / 2.0))
        rest = 4.0 - dwell
        after = a + (back - a) * (1.0 - math.exp(-rest / 2.0)) * 2.0 / rest
        assert mean[0] == pytest.approx(16.0 - 1.5 * max(way, after), abs=1e-4)


def test_the_fall_of_a_longer_peak_is_better_known():
    """Its dwell is known to about a block of 50 ms; a tenth of the squared error remains."""
    *_, brief = lowest(state(), held(0.9, [0.0, 0.05, 0.1, 3.0], 0.4), 2.0, SAMPLING)
    assert brief == pytest.approx([1.0, 1.0, 0.25, 0.1])


def test_what_is_not_known_of_the_level_is_in_the_error():
    error = np.zeros((2 + SIZE, 2 + SIZE))
    error[0, 0] = 0.3 ** 2
    _, exact, *_ = lowest(state(), held(0.4, 1.0, 0.4), 1.0, SAMPLING)
    _, noise, found, _ = lowest(state(covariance=error), held(0.4, 1.0, 0.4), 1.0, SAMPLING)
    assert noise[0] == exact[0] and found[0] == pytest.approx(0.3)


def test_the_level_falls_as_charge_is_drawn():
    coefficients = COEFFICIENTS.copy()
    coefficients[1], coefficients[2] = 1.0 / 80.0, 0.0
    known = state(mean=coefficients, fall=8.0, **QUIET)
    mean, *_ = lowest(known, held(0.8, 10.0, 0.4), 10.0, SAMPLING)
    assert mean[0] == pytest.approx(16.0 - 8.0 / 80.0 * 0.8 ** 1.8 * 10.0, abs=1e-4)
