"""The lowest voltage of a course: Monte Carlo, closed forms, and calibration by a flight."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.model.load import LAGS, LINEAR_LAGS, SIZE
from ou_monitor.online.load.supply_load import LoadState
from ou_monitor.online.risk import courses
from ou_monitor.online.risk.courses import held, lowest, mean_now, Sampling
import pytest

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


@pytest.mark.parametrize('interval, share', [(0.1, 1.0), (0.16, 0.25), (0.25, 0.0)])
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


def test_inrush_is_that_of_a_ramp():
    """A tenth of the step, 20 ms of 0.2 s, and only in the first group."""
    coefficients = COEFFICIENTS.copy()
    coefficients[2], coefficients[-1] = 0.0, 2.0
    known = state(mean=coefficients, **QUIET)
    mean, *_ = lowest(known, held(0.9, 1.0, 0.4), 2.0, SAMPLING)
    assert mean[0] == pytest.approx(16.0 - 2.0 * 0.5 * 0.1, abs=1e-4)


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


def test_a_rise_is_noisier():
    """Its noise is that of the change that a ramp of 0.2 s makes: a tenth of the step."""
    noisy = state(log_variance=(2.0 * math.log(NOISE), 0.0, 4.0), mean=COEFFICIENTS * (
        np.arange(2 + SIZE) == 0))
    mean, deviation, *_ = lowest(noisy, held(0.9, 0.04, 0.9), 0.04, SAMPLING)
    factor = math.exp(0.5 * 4.0 * math.sqrt(0.05))
    plain, narrow, *_ = lowest(noisy, held(0.4, 0.04, 0.4), 0.04, SAMPLING)
    assert 16.0 - mean[0] == pytest.approx(factor * (16.0 - plain[0]))
    assert deviation[0] == pytest.approx(factor * narrow[0])
