"""Effects of throttle and time on the level: closed forms, without noise."""


import numpy as np
import pytest
from term_examples import still, term

DT = 1e-3
T = np.arange(400) * DT


def level(*terms, throttle=None, t=T):
    """Return what the terms add to the level, V."""
    return still(*terms).simulate(t, np.random.default_rng(0), throttle)


def step_at(k, low=0.0, high=1.0):
    return np.where(np.arange(T.size) < k, low, high)


@pytest.mark.parametrize('start', [0.0, 1000.0])
def test_sag_follows_throttle_at_once(start):
    """-((linear + growth t) u + square u^2), at once, t from the first sample."""
    throttle = np.random.default_rng(1).random(T.size)
    sag = term('load_sag', linear=0.3, square=0.07, growth=-0.4)
    np.testing.assert_allclose(
        level(sag, throttle=throttle, t=start + T),
        -(0.3 - 0.4 * T) * throttle - 0.07 * throttle ** 2, rtol=0, atol=1e-12)
    np.testing.assert_allclose(level(sag.at(0.2), throttle=throttle),
                               -(0.3 - 0.08) * throttle - 0.07 * throttle ** 2, atol=1e-14)


@pytest.mark.parametrize('gain, tau', [(0.4, 0.03), (-0.2, 0.005), (0.1, 2.0)])
def test_transient_of_a_step(gain, tau):
    """A step from 20 to 70 % shows as 0.5 gain exp(-t/tau) and nothing before."""
    found = level(term('load_transient', gain=gain, tau=tau, delay=0.0),
                  throttle=step_at(100, 0.2, 0.7))
    since = T - T[100]
    np.testing.assert_allclose(
        found, np.where(since >= 0.0, 0.5 * gain * np.exp(-since / tau), 0.0), rtol=0, atol=1e-13)


def test_transient_of_uneven_stamps():
    t = np.cumsum(np.random.default_rng(3).exponential(DT, 400))
    found = level(term('load_transient', gain=0.4, tau=0.03, delay=0.0), throttle=step_at(100),
                  t=t)
    since = t - t[100]
    np.testing.assert_allclose(
        found, np.where(since >= 0.0, 0.4 * np.exp(-since / 0.03), 0.0), rtol=0, atol=1e-13)


@pytest.mark.parametrize('delay, later', [(0.02, 20), (0.001, 1), (0.1, 100), (0.0205, 21)])
@pytest.mark.parametrize('start', [0.0, 0.3, 1000.1])
def test_transient_comes_after_its_delay(delay, later, start):
    t = start + np.arange(400) / 1000.0
    throttle = step_at(100) * 0.5 + 0.1
    prompt = level(term('load_transient', gain=0.4, tau=0.03, delay=0.0), throttle=throttle, t=t)
    late = level(term('load_transient', gain=0.4, tau=0.03, delay=delay), throttle=throttle, t=t)
    np.testing.assert_allclose(late[later:], prompt[:-later], rtol=0, atol=1e-9)
    assert not late[:100 + later].any() and late[100 + later] != 0.0


@pytest.mark.parametrize('start', [0.0, 1.7e9])
def test_drift_counts_from_the_first_sample(start):
    """Rate t + curvature t^2 from the first sample, whatever clock the stamps are of."""
    found = level(term('drift', rate=-0.5, curvature=0.3), t=start + T)
    np.testing.assert_allclose(found, -0.5 * T + 0.3 * T ** 2, rtol=0,
                               atol=1e-12 if start == 0.0 else 1e-6)


def test_drift_follows_the_charge_drawn():
    """Charge times the sum of throttle over time, each value held over the step before it."""
    throttle = np.random.default_rng(2).random(T.size)
    drawn = np.append(0.0, np.cumsum(throttle[1:] * np.diff(T)))
    found = level(term('drift', rate=-0.5, curvature=0.0, charge=-0.2), throttle=throttle)
    np.testing.assert_allclose(found, -0.5 * T - 0.2 * drawn, rtol=0, atol=1e-12)
