"""One step of the load's filters is one of a textbook Kalman filter; what its numbers say."""

import copy
import math

import numpy as np
from ou_monitor.model.load import usual_coefficients
from ou_monitor.online.load import load_filter as volts
from ou_monitor.online.load.blocks import CLIP, LoadBlock
from ou_monitor.online.load.load_filter import CurrentFilter, LoadFilter
from ou_monitor.online.load.supply_load import LAGS, LoadStatus, POWER, static
import pytest


def updated(m, P, h, e, total):
    """Return mean and covariance after a scalar innovation of a variance."""
    gain = P @ h / total
    return m + gain * e, P - np.outer(gain, P @ h)


def weighed(noise, e, s, R, rounding=0.0):
    """Return the variance that an innovation is weighed by: scale, correlation, clipping."""
    total = s + R * max(1.0, noise.scale) * (1.0 + noise.correlation) / (1.0 - noise.correlation)
    total += rounding
    return total * max(1.0, abs(e) / math.sqrt(total) / CLIP)


def block(t, v, u=math.nan, x=math.nan):
    """Return a block of one sample."""
    return LoadBlock(t, t, v, u, x, 1, math.nan)


def flown(throttles=(0.2, 0.6)):
    """Return a filter that has seen a few seconds of a pack of 15 V."""
    loads = LoadFilter()
    rng = np.random.default_rng(4)
    for k in range(200):
        u = throttles[k // 20 % len(throttles)]
        loads._take(block(0.02 * k, 15.0 - u + 0.02 * rng.standard_normal(), u))
    return loads


@pytest.mark.parametrize('off', [0.02, -0.1, 5.0])
@pytest.mark.parametrize('dt', [0.02, 5.0])
def test_a_block_with_throttle(off, dt):
    """Charge drawn, the lags, walks and gain; a gap lets the pack recover."""
    loads = flown()
    u = loads._throttle
    before, noise = copy.deepcopy(loads), copy.deepcopy(loads._noise)
    m, P, cells = before._m, before._P, before._cells
    x = u ** POWER
    lagged = u + (before._lagged - u) * math.exp(-dt / 0.004)
    x = lagged ** POWER
    F, Q = np.eye(9), np.zeros((9, 9))
    F[0, 1] = -x * dt * before._fall(float(m[0]))
    m, P = F @ m, F @ P @ F.T
    factor = before._factor + ((min(4.3, max(3.2, m[0] / cells)) / 3.8) ** 0.8
                               - before._factor) * -math.expm1(-dt / 30.0)
    Q[0, 0] = (0.0015 * cells) ** 2 * dt + (0.02 * before._volts) ** 2 * max(0.0, dt - 2.0) / 60.0
    Q[2:, 2:] = dt * (0.25 ** 2 / 100.0 * np.outer(m[2:], m[2:]) + np.eye(7)
                      * 0.02 ** 2 / 100.0 * (volts._SIZE * before._volts) ** 2)
    P = P + Q
    lags = [x + (low - x) * math.exp(-dt / tau) for low, tau in zip(before._lags, LAGS)]
    settled = lagged + (before._settled - lagged) * math.exp(-dt / 0.02)
    h = np.array([1.0, 0.0, *(-factor * y for y in (
        lagged ** POWER, lagged, lagged ** 3, *lags, max(lagged - settled, 0.0)))])
    v = float(h @ m) + off
    noise.see(v)
    m, P = updated(m, P, h, off, weighed(noise, off, float(h @ P @ h),
                                         noise.variance(u, 0.0, 1), noise.rounding))
    loads._take(block(before._t + dt, v, u))
    np.testing.assert_allclose(loads._m, m, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(loads._P, P, rtol=1e-6, atol=1e-12)
    assert loads._lags == pytest.approx(lags, rel=1e-12)


def test_a_load_filter_that_diverged_begins_anew():
    """As that of the current."""
    loads = flown()
    loads._P[0, 0] = 1e13
    loads._take(block(loads._t + 0.02, 12.0, loads._throttle))
    fresh = LoadFilter()
    fresh._take(block(0.0, 12.0, loads._throttle))
    np.testing.assert_array_equal(loads._P, fresh._P)
    np.testing.assert_array_equal(loads._m, fresh._m)


@pytest.mark.parametrize('sag, error, status', [
    (1.0, 0.1, LoadStatus.KNOWN), (1.0, 0.30, LoadStatus.KNOWN),
    (1.0, 0.36, LoadStatus.UNCERTAIN), (1.0, 1.0, LoadStatus.UNCERTAIN),
    (-1.0, 0.45, LoadStatus.NO_RELATION), (-1.0, 0.55, LoadStatus.UNCERTAIN),
    (0.0, 0.004, LoadStatus.NO_RELATION), (0.01, 0.004, LoadStatus.KNOWN),
    (0.0, 0.2, LoadStatus.UNCERTAIN)])
def test_what_is_said_of_the_sag(sag, error, status):
    """
    By the fall over the throttle flown, V, and its error.

    Known to a third of itself or to half the noise (20 mV); below zero by two errors, or less
    than two errors though these are small, is no relation.
    """
    loads = flown()
    low, high = loads._between(0.1)
    reach = float(static(high)[0] - static(low)[0]) * loads._factor
    loads._m[2:], loads._P[:] = 0.0, 0.0
    loads._m[2], loads._P[2, 2] = sag / reach, (error / reach) ** 2
    loads._noise.b[:] = math.log(0.02 ** 2), 0.0, 0.0
    loads._noise.scale, loads._noise._within = 1.0, 0.0
    loads._noise._step = math.inf
    assert loads.load().status is status


@pytest.mark.parametrize('throttles', [(0.3,), (0.2, 0.6)])
def test_an_open_level_shares_the_errors_of_the_coefficients(throttles):
    """The voltage at hand is known to 2 % whatever they are; so is the fall to come, to theirs."""
    for one in (flown(throttles), current_flown()):
        if isinstance(one, LoadFilter):
            one._settle(15.0, throttles[-1])
        else:
            one._settle(15.0)
        h = one._regressors()
        assert float(h @ one._m) == pytest.approx(15.0)
        assert float(h @ one._P @ h) == pytest.approx((0.02 * one._volts) ** 2, rel=1e-9)
        np.testing.assert_allclose(one._P, one._P.T, rtol=1e-12, atol=1e-15)
        own = one._P[1:, 1:]
        np.testing.assert_allclose(one._P[0, 1:], -own @ h[1:], rtol=1e-12)
        assert np.linalg.eigvalsh(one._P)[0] > -1e-9 * np.trace(one._P)


def current_flown():
    """Return a filter of the current that has seen a few seconds."""
    one = CurrentFilter()
    rng = np.random.default_rng(6)
    for k in range(60):
        one.take(block(0.05 * k, 15.0 + 0.02 * rng.standard_normal(), x=20.0 + 10.0 * (k % 7 == 0)
                       ), 4.0, fresh=False)
    return one


def test_coefficients_begin_with_the_prior_or_with_another_flight():
    """Discharge to a factor of two; what another flight learned may differ by a fifth."""
    first = block(0.0, 15.0, 0.3)
    plain, begun = LoadFilter(), LoadFilter()
    plain._take(first)
    mean, covariance, _ = usual_coefficients()
    np.testing.assert_allclose(plain._m[1:], [1.0 / 80.0, *(15.0 * mean)])
    np.testing.assert_allclose(plain._P[2:, 2:], 225.0 * covariance)
    assert plain._P[1, 1] == pytest.approx(1.0 / 80.0 ** 2)
    assert not plain._P[1, 2:].any()
    learned = flown().learned()
    begun.begin_with(learned)
    begun._take(first)
    coefficients = np.array(learned.coefficients)
    np.testing.assert_allclose(begun._m[1:], [learned.discharge, *coefficients])
    np.testing.assert_allclose(begun._P[2:, 2:], np.array(learned.covariance)
                               + 0.2 ** 2 * np.outer(coefficients, coefficients))
    np.testing.assert_allclose(begun._noise.b, learned.log_variance)
