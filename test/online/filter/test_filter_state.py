"""The filter against scipy: response, irregular steps, moving cutoffs, bounds."""

import math

import numpy as np
from ou_monitor.online.filter.filter_state import (
    cutoff_for_lag, delay, LowPassState, phase_lag)
import pytest
from scipy import integrate, signal


def analog(order, fc, mode):
    num, den = signal.butter(order, 2.0 * math.pi * fc, analog=True)
    return (np.polymul(num, [1.0, 0.0]) if mode == 'derivative' else num), den


def run(order, fc, mode, t, x):
    """Filter samples with one cutoff, starting at rest at the first."""
    state, out = LowPassState(0.0 if mode == 'derivative' else x[0]), []
    for k in range(1, len(t)):
        dt = t[k] - t[k - 1]
        slope = (x[k] - x[k - 1]) / dt
        ends = (slope, slope) if mode == 'derivative' else (x[k - 1], x[k])
        out.append(state.advance(order, 2.0 * math.pi * fc * dt, *ends))
    return np.array(out)


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
@pytest.mark.parametrize('order', [1, 2])
@pytest.mark.parametrize('fc', [0.01, 5.0, 40.0, 150.0, 450.0])
def test_equals_the_linear_input_solution_of_scipy(order, fc, mode):
    """First-order-hold discretisation by scipy, sample for sample."""
    dt = 1e-3
    x = np.random.default_rng(1).standard_normal(400)
    x[0] = 0.0
    ad, bd, cd, dd, _ = signal.cont2discrete(
        signal.tf2ss(*analog(order, fc, mode)), dt, method='foh')
    _, expected, _ = signal.dlsim((ad, bd, cd, dd, dt), x)
    got = run(order, fc, mode, np.arange(400) * dt, x)
    scale = np.abs(expected).max()
    assert got == pytest.approx(expected[1:, 0], abs=1e-9 * scale, rel=1e-7)


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
@pytest.mark.parametrize('order', [1, 2])
def test_irregular_steps_and_moving_cutoffs_against_an_ode_solver(order, mode):
    rng = np.random.default_rng(5)
    t = np.concatenate([[0.0], np.cumsum(10.0 ** rng.uniform(-4.0, -1.0, 60))])
    x = rng.standard_normal(61)
    w = 2.0 * math.pi * 10.0 ** rng.uniform(0.0, 2.3, 60)
    state = LowPassState(0.0 if mode == 'derivative' else x[0])
    reference = np.array([state.y, 0.0])
    for k in range(60):
        dt, slope = t[k + 1] - t[k], (x[k + 1] - x[k]) / (t[k + 1] - t[k])

        def rate(s, z, k=k, slope=slope):
            u = slope if mode == 'derivative' else x[k] + slope * s
            if order == 1:
                return [w[k] * (u - z[0]), 0.0]
            return [w[k] * z[1], w[k] * (u - z[0] - math.sqrt(2.0) * z[1])]
        reference = integrate.solve_ivp(
            rate, (0.0, dt), reference, method='DOP853', rtol=1e-11, atol=1e-12).y[:, -1]
        ends = (slope, slope) if mode == 'derivative' else (x[k], x[k + 1])
        got = state.advance(order, w[k] * dt, *ends)
        assert got == pytest.approx(reference[0], rel=1e-7, abs=1e-8)


@pytest.mark.parametrize('order', [1, 2])
def test_short_steps_lose_nothing(order):
    """100 000 steps of 1e-8 of the time constant add up to the one long step."""
    short, long = LowPassState(), LowPassState()
    for k in range(100_000):
        short.advance(order, 1e-8, k * 1e-5, (k + 1) * 1e-5)
    long.advance(order, 1e-3, 0.0, 1.0)
    assert short.y == pytest.approx(long.y, rel=1e-6)


@pytest.mark.parametrize('order', [1, 2])
@pytest.mark.parametrize('fc', [5.0, 10.0, 40.0])
def test_lag_is_that_of_the_filter(order, fc):
    """Phase of scipy's response; and FIELD's 14, 27, 45, 63 degrees of order 1 come out."""
    response = signal.freqs(*analog(order, fc, 'lowpass'), worN=[20.0 * math.pi])[1][0]
    lag = phase_lag(order, fc, 10.0)
    assert lag == pytest.approx(-math.degrees(np.angle(response)))
    assert delay(lag, 10.0) == pytest.approx(lag / 3600.0)
    assert cutoff_for_lag(order, lag, 10.0) == pytest.approx(fc)


@pytest.mark.parametrize('order, lag', [(1, 90.0), (2, 180.0), (1, 0.0), (2, math.nan)])
def test_impossible_lags_are_refused(order, lag):
    with pytest.raises(ValueError, match='lags by more than 0'):
        cutoff_for_lag(order, lag, 10.0)
