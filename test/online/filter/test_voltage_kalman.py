"""Law kalman for the voltage: against dense algebra, a Riccati solver, and sines."""

import cmath
import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor import AdaptiveLowPass
import pytest
from scipy import signal

NAN = math.nan
TWO_PI = 2.0 * math.pi
WHITE = 0.02


def made(rate=1000.0, **more):
    """Return a filter of the law, open to every lag."""
    return AdaptiveLowPass(**{
        'law': 'kalman', 'n0': WHITE ** 2 / rate, 'fmin': 0.01, 'fmax': 400.0, 'smoothing': 0.0,
        'lag_frequency': 5.0, **more})


def dense(t, x, sigma, alpha, level, white):
    """Return the estimated deviation at each sample, by a Kalman filter written out in full."""
    p, m = sigma[0] ** 2 / (2.0 * alpha), x[0] - level
    found = [m]
    for k in range(1, t.size):
        phi = math.exp(-alpha * (t[k] - t[k - 1]))
        m, p = phi * m, phi * phi * p + sigma[k] ** 2 / (2.0 * alpha) * (1.0 - phi * phi)
        gain = p / (p + white)
        m, p = m + gain * (x[k] - level - m), p - gain * p
        found.append(m)
    return np.array(found)


def recording(seed=1, n=600):
    """Return stamps with gaps of 20 ms in 1 ms, a voltage, and sigma in steps."""
    rng = np.random.default_rng(seed)
    steps = np.full(n, 1e-3)
    steps[rng.choice(np.arange(50, n), 8, replace=False)] = 0.02
    return (np.cumsum(steps), 5.0 + rng.standard_normal(n),
            np.repeat(rng.choice([0.3, 1.7], n // 100), 100))


def test_it_is_the_kalman_filter():
    """Every output, gaps and steps of sigma included."""
    t, x, sigma = recording()
    y = made().filter(t, x, sigma, alpha=63.0, level=5.0)
    wanted = 5.0 + dense(t, x, sigma, 63.0, 5.0, WHITE ** 2)
    assert y[1:] == pytest.approx(list(wanted[1:]), abs=1e-6)


def swing(f, frequency, n=6000, **known):
    """Return the phase by which a sine comes out late, degrees."""
    t = np.arange(n) * 1e-3
    y = f.filter(t, np.sin(TWO_PI * frequency * t), 1.0, **known)
    last = slice(n // 2, None)
    turn = np.exp(-1j * TWO_PI * frequency * t[last])
    return -math.degrees(cmath.phase(np.sum(y[last] * turn) * 1j))


@pytest.mark.parametrize('most', [0.0, 25.0, 1.5])
def test_a_sine_lags_as_told_and_no_more_than_allowed(most):
    """Without a limit more than the limits, with one just that; what is published is what is."""
    f = made(max_lag=most, smoothing=0.2, dead_band=0.0, slew=0.0, n0=1e-4)
    lag = swing(f, 5.0, alpha=200.0, level=0.0)
    free = made(n0=1e-4)
    free.filter(np.arange(500) * 1e-3, np.zeros(500), 1.0, alpha=200.0, level=0.0)
    assert f.phase_lag == pytest.approx(lag, abs=0.1)
    assert lag == pytest.approx(min(most, free.phase_lag) if most else free.phase_lag, abs=0.1)
    assert free.phase_lag > 1.7


def test_an_unsure_level_counts_less():
    """A level that is wrong by 1 V and says so costs little; one that claims to be exact much."""
    rng, n = np.random.default_rng(6), 20_000
    u = signal.lfilter([0.015], [1.0, -math.exp(-0.063)], rng.standard_normal(n))
    t, x = np.arange(n) * 1e-3, 5.0 + u + WHITE * rng.standard_normal(n)

    def error(level, level_se):
        y = made().filter(t, x, 0.4, alpha=63.0, level=level, level_se=level_se)
        return float(np.mean((y - 5.0 - u)[1000:] ** 2))
    exact = error(5.0, 0.0)
    assert error(6.0, 1.0) < 1.15 * exact
    assert error(6.0, 0.0) > 3.0 * exact
    assert error(NAN, NAN) < 1.5 * exact


def test_a_new_level_does_not_move_the_output():
    """At the time it comes; afterwards the output goes there by the filter."""
    f = made()
    t = np.arange(500) * 1e-3
    y = f.filter(t, np.full(500, 5.0), 0.4, level=5.0, level_se=0.01)
    after = f.step(0.499 + 1e-9, 5.0, 0.4, level=4.0, level_se=0.01)
    assert y[-1] == pytest.approx(5.0, abs=1e-6)
    assert after == pytest.approx(5.0, abs=1e-4)


def test_changed_noise_begins_where_the_old_one_is():
    """The next sample moves the output as the old settings would, and what follows settles."""
    f, twin = made(n0=1e-3), made(n0=1e-3)
    t, known = np.arange(4000) * 1e-3, {'level': 5.0, 'level_se': 0.01, 'alpha': 63.0}
    for one in (f, twin):
        before = one.filter(t[:1000], np.full(1000, 6.0), 0.3, **known)[-1]
    f.configure(n0=1e-6)
    assert f.filter(t[999], 77.0, 0.3, **known) == before
    soon = [one.step(t[999] + 1e-5, 6.0, 0.3, NAN, 63.0, NAN, 5.0, 0.01) for one in (f, twin)]
    assert soon[0] == pytest.approx(soon[1], abs=1e-2)
    end = f.filter(t[1000:], np.full(3000, 6.0), 0.3, **known)[-1]
    assert end == pytest.approx(
        made(n0=1e-6).filter(t, np.full(4000, 6.0), 0.3, **known)[-1], abs=2e-3)
    assert abs(end - before) > 0.1


ANY = st.floats(allow_nan=True, allow_infinity=True)


@settings(max_examples=150, deadline=None)
@given(samples=st.lists(
    st.tuples(st.floats(1e-12, 1e3), st.floats(-1e9, 1e9), ANY, ANY, ANY, ANY), max_size=25))
def test_any_number_on_the_topics_gives_a_finite_output(samples):
    f, t = made(), 0.0
    for dt, x, sigma, alpha, level, level_se in samples:
        t += dt
        y = f.step(t, x, sigma, NAN, alpha, NAN, level, level_se)
        assert math.isfinite(y)
        assert 0.0 < f.cutoff < math.inf and not f.phase_lag > 180.0
